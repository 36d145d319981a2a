"""Drags of a pose by hand: damped least squares with contacts as constraints."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import SelfCollisions
from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.contact_constraints import ContactRegions, Contacts, least_step
from lcollision_core.posing.exact import ExactCheck
from lcollision_core.posing.goals import (
    STANDING_WEIGHT,
    CodesGoal,
    Decoded,
    Goal,
    Held,
    PatchGoal,
    TwistGoal,
)
from lcollision_core.posing.grip import Grip, Pin, Twist, make_grip
from lcollision_core.posing.stretch import largest_stretch

MAX_STEPS = 3
"""Steps of one event: where the pointer leapt, the next events go on."""

PATIENCE = 3
"""Events in a row that come no nearer to the target, after which more of the body joins in."""

ROUNDS = 3
"""Times that a step is solved with the contacts that it ran into before."""

CUTS = (0.5, 0.25, 0.1)
"""Fractions of a step that are tried where it still collides after the last round."""

LEAST_PACE, FASTER = 0.125, 1.5
"""Of the longest step: what is tried at least, and the factor after a step that came nearer."""

KEPT_CONTACTS = 18

DAMPING = 0.02
"""Price of the mean squared vertex displacement of a step, against the squared miss of the grip."""

IMPLAUSIBLE = 3e-6
"""Price of the squared Mahalanobis distance from the drag's start: see `PoseSpace.precision`."""

STRETCH = 0.14
"""The most by which a drag of strength 1 makes an edge longer than it is in any plausible pose."""

_NEAR, _WORTHWHILE, _SHORT, _SETTLED = 0.5, 0.5, 0.25, 0.01
"""Of a goal's reach: a miss that the next event takes, the gain of a step that another follows at
once, the gain of one that comes no nearer, and the miss or gain of one that no other follows."""

_ROUNDING = 1e-6
"""Fraction by which the squared depths of a contact vary with the rounding of the vertices."""

_STILL = 1e-5
"""Root of the mean squared vertex displacement, normalised, of a step that is none."""


@dataclass(frozen=True)
class DragOptions:
    """What a drag keeps to.

    Attributes
    ----------
    solid : keep the pose out of itself
    strength : of the prices of implausible poses and stretched limbs: 0 for none
    locked_domains : body parts whose codes stay
    locked_codes : further codes that stay, by number
    standing : what stands on the ground stays there, unless its limb is dragged
    whole_body : all of it helps, not only the limb that is held
    clearance : in [0, 1), normalised, that a solid drag keeps between parts
    """

    solid: bool = True
    strength: float = 1.0
    locked_domains: frozenset[int] = frozenset()
    locked_codes: frozenset[int] = frozenset()
    standing: bool = True
    whole_body: bool = False
    clearance: float = 0.0


@dataclass(frozen=True, eq=False)
class DragStep:
    """Where one event of a drag has led.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    vertices : (V, 3) float32 array, read-only, in the data's unit, in the model's frame
    miss : what is left to the target: normalised length, radians of a twist
    found : the exact check of these vertices where they are exported to, without excluded pairs,
        with the clearance of the drag; None of a drag that is not solid
    crossing : the same without the clearance: what the pose shares with itself
    contacts : (C, 3) float64 array, points of the surface, in the data's unit, where contact keeps
        the pose from going on
    standing : (S, 3) float64 array, points of the surface, likewise, that stay on the ground
    settled : whether the same target would lead no further
    """

    latent: FloatArray
    vertices: npt.NDArray[np.float32]
    miss: float
    found: SelfCollisions | None
    crossing: SelfCollisions | None
    contacts: FloatArray
    standing: FloatArray
    settled: bool

    @property
    def exactly_free(self) -> bool | None:
        """Whether the pose is free of collisions; None if it was not checked."""
        return None if self.found is None else not self.found.colliding


class PoseDragger:
    """Drags poses of one space; for one thread at a time.

    After `begin` each `move` is one event of the pointer. It moves the limb that is held; only
    where that comes no nearer to the target, what it hangs on joins in, limb by limb. What hangs on
    what moves follows it. A solid drag that starts free stays exactly free; one that starts
    colliding deepens the contact of no two body parts.

    Parameters
    ----------
    check : decodes and checks the poses, placed for export
    up : (3,) unit vector, away from the ground; not needed for drags of codes alone
    """

    def __init__(self, check: ExactCheck, up: FloatArray | None = None) -> None:
        self._plain = self._check = check
        self._space, self._up = check.space, up
        self._goal: Goal | None = None

    def begin(
        self,
        latent: npt.ArrayLike,
        grip: Grip | Twist | None,
        pins: Iterable[Pin] = (),
        options: DragOptions | None = None,
    ) -> DragStep:
        """Start a drag.

        Parameters
        ----------
        latent : (D,) finite array; codes beyond their bounds may stay there
        grip : what `move` gets the targets of: a patch, a twist, or the codes themselves where
            None; then codes that a target leaves as they were do not move
        pins : patches that stay in their places; those of codes do not
        options : the defaults if None

        Returns
        -------
        step : the pose as it is

        Raises
        ------
        ShapeError : another shape, a number that is not finite, or a clearance out of its range.
        LCollisionError : a pin or a body part to twist that the mesh does not have.
        """
        space = self._space
        self._goal = None
        self._options = options or DragOptions()
        self._check = check = self._plain.with_clearance(self._options.clearance)
        start: FloatArray = np.array(latent, dtype=np.float64)
        if start.shape != space.low.shape:
            raise ShapeError.must_be("a pose to drag", f"{len(space.low)} numbers", start.shape)
        if not np.isfinite(start).all():
            raise ShapeError("a pose to drag has a number that is not finite", "repair the pose")
        self._start = start
        locked = space.codes_of(self._options.locked_domains)
        locked[sorted(self._options.locked_codes)] = True
        self._least = self._low = np.where(locked, start, np.minimum(space.low, start))
        self._most = self._high = np.where(locked, start, np.maximum(space.high, start))
        self._reaches: list[frozenset[int]] = []
        self._contacts, self._pace = Contacts(check), 1.0
        self._has_forgotten = False
        self._here = Decoded(start, check.decode(start)[0])
        self._found: SelfCollisions | None = None
        self._allowed: dict[int, tuple[float, float]] = {}
        if self._options.solid:
            self._found = check.find(check.exported(self._here.vertices))
            self._allowed = ContactRegions.of(space, self._found).by_name()
        self._stands: list[Held] = []
        self._goal = CodesGoal(space) if grip is None else self._take(grip, pins)
        self._stretch = self._stretch_of(self._here.vertices)
        return self._result(0.0, settled=True)

    def _take(self, grip: Grip | Twist, pins: Iterable[Pin]) -> Goal:
        """Find what moves and what stays as a patch or a body part is held."""
        space, limbs, options = self._space, self._space.limbs, self._options
        here = self._here.vertices
        if isinstance(grip, Grip):
            inside, weights, least = grip.vertices, grip.weights, 2.0 * grip.radius
        elif 0 <= grip.domain < space.n_domains:
            inside = np.flatnonzero(space.vertex_domain == grip.domain)
            weights, least = np.full(len(inside), 1.0 / len(inside)), 0.0
        else:
            raise LCollisionError.must_be(
                "the body part to twist", f"1 to {space.n_domains}", grip.domain + 1
            )
        held = limbs.holding(inside, weights)
        stays = [
            Held(grip, (np.array(place) - self._moved(grip)) / self._check.body_size)
            for pin in pins
            for vertex, radius, place in pin.patches
            for grip in (make_grip(space, vertex, radius),)
        ]
        if options.standing and self._up is not None:
            stands = limbs.standing(here, self._up, held).values()
            self._stands = [
                Held(Grip.at(vertex), here[vertex], STANDING_WEIGHT)
                for vertex in np.concatenate([*stands, []]).astype(int).tolist()
            ]
        pinned = [limbs.holding(one.grip.vertices, one.grip.weights) for one in stays]
        pinned += [int(limbs.leads[one.grip.vertex]) for one in self._stands]
        reaches = [set(one) for one in limbs.reaches(held, least)]
        # A twist of a learned model's body part needs its neighbours, as they turn in space.
        if options.whole_body or (isinstance(grip, Twist) and not limbs.is_relative):
            # Without a hold on the ground, the body would float to the target.
            floats = limbs.is_relative and not pinned and held != limbs.root
            reaches = [set(range(len(limbs.parents))) - ({limbs.root} if floats else set())]
        moving: frozenset[int] = frozenset()
        self._reaches = []
        for reach in reaches:
            moving = limbs.with_pinned(moving | reach, pinned)
            self._reaches.append(moving)
        self._held = limbs.with_pinned(limbs.limb(held, least), pinned)
        self._let_move()
        # What nothing moves need not be kept.
        self._stands = [
            one for one in self._stands if moving & set(limbs.path(limbs.leads[one.grip.vertex]))
        ]
        stays += self._stands
        if isinstance(grip, Grip):
            return PatchGoal(space, grip, stays, options.strength)
        return TwistGoal(space, grip.domain, stays, options.strength, here)

    def _let_move(self) -> None:
        """Let the codes move of what comes next into reach."""
        self._n_short = 0
        moving = self._space.limbs.codes_of(self._reaches.pop(0))
        self._low = np.where(moving, self._least, self._start)
        self._high = np.where(moving, self._most, self._start)

    def move(self, target: npt.ArrayLike) -> DragStep:
        """Go towards a target, by a few short steps at most.

        Parameters
        ----------
        target : of a patch (3,), a point in the data's unit, in the model's frame; of a twist an
            angle in radians since the start; of codes (D,). With a number that is not finite the
            pose stays.

        Raises
        ------
        RuntimeError : no drag has begun.
        """
        if self._goal is None:
            raise RuntimeError("no drag has begun")
        goal, aim = self._goal, np.array(target, dtype=np.float64).reshape(-1)
        if not np.isfinite(aim).all():
            return self._result(float("nan"), settled=True)
        if isinstance(goal, PatchGoal):
            aim = (aim - self._moved(goal.grip)) / self._check.body_size
        self._contacts.keep_latest(KEPT_CONTACTS)
        miss, gain = goal.miss(self._here, aim), 0.0
        for _ in range(MAX_STEPS):
            if not self._step(goal, aim):
                gain = 0.0
                break
            left = goal.miss(self._here, aim)
            if miss > goal.reach:
                # Long steps along bent contacts would swing about the nearest place for ever.
                pace = self._pace * (0.5 if left > miss else FASTER)
                self._pace = min(max(pace, LEAST_PACE), 1.0)
            miss, gain = left, miss - left
            # Further steps are for a pointer that leapt, not for one that is out of reach.
            if left < _NEAR * goal.reach or gain < _WORTHWHILE * goal.reach:
                break
        # A step that was too long is no reason to stop; along contacts it would swing for ever.
        gained = gain if self._options.solid else abs(gain)
        settled = min(miss, gained) < _SETTLED * goal.reach
        if gain < _SHORT * goal.reach < miss and self._more_may_move(goal):
            self._n_short += 1
            settled = False
            if self._n_short == PATIENCE:
                self._let_move()
        else:
            self._n_short = 0
        if gain >= _SHORT * goal.reach:
            self._has_forgotten = False
        elif (
            settled
            and not self._has_forgotten
            and miss > goal.reach
            and self._contacts.normals.size
        ):
            # Contacts seen from earlier poses may limit what is no longer in the way: look afresh.
            self._contacts, self._has_forgotten, settled = Contacts(self._check), True, False
        return self._result(miss, settled)

    def _more_may_move(self, goal: Goal) -> bool:
        """Whether there is more that could help, and no contact is in the way."""
        return (
            bool(self._reaches)
            and isinstance(goal, PatchGoal)
            and not self._has_forgotten
            and not len(self._contacts.touching(self._here.codes))
        )

    def end(self) -> None:
        """End the drag; its contacts are forgotten."""
        self._goal = None

    def _step(self, goal: Goal, aim: FloatArray) -> bool:
        """Go one step; False if there is none to go."""
        space, here = self._space, self._here.codes
        low, high = self._low, self._high
        hessian, gradient = goal.cost(self._here, aim)
        if isinstance(goal, CodesGoal):
            # Like the pose itself, its target may lie beyond the bounds.
            is_free = low < high
            low = np.where(is_free, np.minimum(low, aim), low)
            high = np.where(is_free, np.maximum(high, aim), high)
            if self._may_land(goal, aim, low, high) and self._goes(aim):
                return True
            stays = (aim == self._start) & (here == self._start)
            low, high = np.where(stays, here, low), np.where(stays, here, high)
        else:
            price = self._options.strength * IMPLAUSIBLE * space.precision
            whole_body = self._options.whole_body
            price += goal.price * space.price(here - self._start, self._held, whole_body)
            gradient = gradient + price @ (here - self._start)
            hessian = hessian + DAMPING * space.metric + price
        for _ in range(ROUNDS):
            n_contacts = len(self._contacts.offsets)
            there = least_step(
                hessian, gradient, here, low, high, self._contacts.normals, self._contacts.offsets
            )
            if there is None:
                # Contacts seen from different poses contradict each other.
                self._contacts = Contacts(self._check)
                continue
            way = there - here
            length = float(np.sqrt(way @ space.metric @ way))
            if length < _STILL:
                return False
            way *= min(1.0, self._pace * goal.longest_step / length)
            if self._goes(here + way):
                return True
            if len(self._contacts.offsets) == n_contacts:
                break
        return there is not None and any(self._goes(here + cut * way) for cut in CUTS)

    def _may_land(
        self, goal: CodesGoal, aim: FloatArray, low: FloatArray, high: FloatArray
    ) -> bool:
        """Whether codes are one step away, and nothing is known to be in the way.

        The quadratic program would leave its tolerance.
        """
        contacts = self._contacts
        return bool(
            0.0 < goal.miss(self._here, aim) <= goal.reach
            and ((low <= aim) & (aim <= high)).all()
            and (contacts.normals @ aim <= contacts.offsets).all()
        )

    def _goes(self, there: FloatArray) -> bool:
        """Go to codes if the pose may be there; else remember what is in the way."""
        check = self._check
        decoded = check.decode(there)[0]
        stretch = self._stretch_of(decoded)
        if stretch > max(STRETCH, self._stretch):
            return False
        if self._options.solid:
            found = check.find(check.exported(decoded))
            regions = ContactRegions.of(self._space, found)
            depths = regions.by_name()
            allowed = {name: self._allowed.get(name, (0.0, 0.0)) for name in depths}
            if any(depths[name][1] > (1.0 + _ROUNDING) * allowed[name][1] for name in depths):
                may_keep = {name: depth for name, (depth, _) in self._allowed.items()}
                self._contacts.separate(there, decoded, found, regions, may_keep)
                return False
            self._found = found
            self._allowed = {
                name: (min(depth, allowed[name][0]), min(squared, allowed[name][1]))
                for name, (depth, squared) in depths.items()
            }
            if not found.colliding:
                self._contacts.drop_refuted(there)
        self._here, self._stretch = Decoded(there, decoded), stretch
        return True

    def _stretch_of(self, decoded: FloatArray) -> float:
        """Return the excess length of the longest edge, priced; codes may stretch what they do."""
        if isinstance(self._goal, CodesGoal) or self._options.strength == 0.0:
            return 0.0
        edges, longest = self._space.topology.edges, self._space.longest_edges
        return self._options.strength * (largest_stretch(decoded, edges, longest) - 1.0)

    def _moved(self, grip: Grip) -> FloatArray:
        """Return the (3,) displacement of a patch, which codes do not hold."""
        return grip.position(self._check.drawn_displacement)

    def _result(self, miss: float, settled: bool) -> DragStep:
        vertices = self._check.drawn(self._here.vertices)
        latent = self._here.codes.copy()
        latent.flags.writeable = vertices.flags.writeable = False
        crossing = self._found
        if crossing is not None and crossing.colliding and self._check.clearance > 0.0:
            crossing = self._plain.find(self._plain.exported(self._here.vertices))
        touching = np.unique(self._contacts.touching(latent))
        return DragStep(
            latent=latent,
            vertices=vertices,
            miss=miss,
            found=self._found,
            crossing=crossing,
            contacts=vertices[touching].astype(np.float64),
            standing=np.array(
                [one.place * self._check.body_size + self._moved(one.grip) for one in self._stands]
            ).reshape(-1, 3),
            settled=settled,
        )
