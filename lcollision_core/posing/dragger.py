"""Drag a body by hand: goals of grips and pins, in steps that keep out of contact."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.contact import SelfCollisions
from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.meshes.limbs import LEAST_LIMB
from lcollision_core.meshes.topology import FloatArray, IntArray
from lcollision_core.posing.exact import ContactRegions, Contacts, ExactCheck, least_step
from lcollision_core.posing.pose_space import MeanSlopes, PoseSpace, long_axis


@compiled
def largest_stretch(vertices: FloatArray, edges: IntArray, longest: FloatArray) -> float:
    """Return the largest ratio of an edge to its longest length in plausible poses.

    Parameters
    ----------
    vertices : (V, 3) float64 array, in normalised length
    edges : (E, 2) int32 array
    longest : (E,) float64 array, in normalised length: see `PoseSpace.longest_edges`
    """
    largest = 0.0
    for edge in range(len(edges)):
        largest = max(largest, _length(vertices, edges[edge, 0], edges[edge, 1]) / longest[edge])
    return largest


@compiled
def excess_stretch(
    vertices: FloatArray, edges: IntArray, longest: FloatArray, slope: FloatArray
) -> float:
    """Return the root of the sum of squares of the edges' stretch beyond 1.

    Parameters
    ----------
    vertices, edges, longest : see `largest_stretch`
    slope : (V, 3) float64 array, overwritten with the derivative by the vertices, 0 where no edge
        is stretched

    Returns
    -------
    excess : 0 or more
    """
    slope[:] = 0.0
    squared_excess = 0.0
    for edge in range(len(edges)):
        start, end = edges[edge, 0], edges[edge, 1]
        length = _length(vertices, start, end)
        if length > longest[edge]:
            beyond = length / longest[edge] - 1.0
            squared_excess += beyond * beyond
            for axis in range(3):
                along = vertices[end, axis] - vertices[start, axis]
                by_end = along * beyond / (length * longest[edge])
                slope[end, axis] += by_end
                slope[start, axis] -= by_end
    excess = math.sqrt(squared_excess)
    if excess > 0.0:
        slope /= excess
    return excess


@compiled_part
def _length(vertices: FloatArray, start: int, end: int) -> float:
    x = vertices[end, 0] - vertices[start, 0]
    y = vertices[end, 1] - vertices[start, 1]
    z = vertices[end, 2] - vertices[start, 2]
    return math.sqrt(x * x + y * y + z * z)


GRIP_RADIUS = 0.03
"""The default radius of a patch, in normalised length along the surface."""

LEAST_RADIUS, LARGEST_RADIUS = 0.005, 0.25


@dataclass(frozen=True, eq=False)
class Grip:
    """A patch of the surface; its weighted mean is the point that follows the pointer.

    Attributes
    ----------
    vertex : the vertex in its middle, an index from 0
    radius : normalised, along the surface
    vertices : (n,) int64 array, ascending
    weights : (n,) float64 array > 0 that sums to 1, falling off along the surface
    """

    vertex: int
    radius: float
    vertices: npt.NDArray[np.int64]
    weights: FloatArray

    @classmethod
    def at(cls, vertex: int) -> Grip:
        """Return a grip of a single vertex."""
        return cls(vertex, 0.0, np.array([vertex]), np.ones(1))

    def position(self, vertices: npt.NDArray[np.floating]) -> FloatArray:
        """Return the (3,) weighted mean of the patch on (V, 3) vertices."""
        mean: FloatArray = self.weights @ vertices[self.vertices].astype(np.float64)
        return mean


@dataclass(frozen=True)
class Twist:
    """A body part that is turned about its long axis.

    Attributes
    ----------
    domain : index from 0
    """

    domain: int


Point = tuple[float, float, float]


@dataclass(frozen=True)
class Pin:
    """A patch that stays in its place while others are dragged.

    Attributes
    ----------
    vertex, radius : of the `Grip`
    position : x, y, z of the patch's mean in the data's unit, in model coordinates
    frame : further vertices of the same body part and their positions, for a pin that keeps the
        orientation too
    """

    vertex: int
    radius: float
    position: Point
    frame: tuple[tuple[int, Point], ...] = ()

    @classmethod
    def of(cls, grip: Grip, vertices: npt.NDArray[np.floating], frame: Iterable[int] = ()) -> Pin:
        """Pin a patch and further vertices as in (V, 3) `vertices`, in the data's unit."""

        def point(place: FloatArray) -> Point:
            x, y, z = place.tolist()
            return x, y, z

        places = vertices.astype(np.float64)
        others = tuple((int(vertex), point(places[vertex])) for vertex in frame)
        return cls(grip.vertex, grip.radius, point(grip.position(vertices)), others)

    def moved(self, grip: Grip, vertices: npt.NDArray[np.floating]) -> Pin:
        """Return the same pin at its positions in (V, 3) vertices, in the data's unit."""
        return Pin.of(grip, vertices, (vertex for vertex, _ in self.frame))

    @property
    def patches(self) -> list[tuple[int, float, Point]]:
        """The vertex, radius and position of each patch of the pin."""
        return [
            (self.vertex, self.radius, self.position),
            *((vertex, LEAST_RADIUS, place) for vertex, place in self.frame),
        ]


def make_grip(space: PoseSpace, vertex: int, radius: float = GRIP_RADIUS) -> Grip:
    """Return the patch around a vertex.

    Parameters
    ----------
    space : of the poses; the patch is measured on the reference and the same in all poses
    vertex : index from 0
    radius : clipped to `LEAST_RADIUS` and `LARGEST_RADIUS`

    Raises
    ------
    LCollisionError : there is no such vertex.

    Notes
    -----
    A vertex at distance s along the edges has weight (1 - (s / r)^2)^2, the biweight kernel.
    """
    n_vertices = space.topology.n_vertices
    if not 0 <= vertex < n_vertices:
        raise LCollisionError.must_be(
            "the vertex to take hold of", f"0 to {n_vertices - 1}", vertex
        )
    radius = float(np.clip(radius, LEAST_RADIUS, LARGEST_RADIUS))
    along = scipy.sparse.csgraph.dijkstra(
        space.surface_graph, directed=False, indices=vertex, limit=radius
    )
    # A vertex at the rim has weight 0.
    weights = np.clip(1.0 - (along / radius) ** 2, 0.0, None) ** 2
    inside = np.flatnonzero(weights > 0.0)
    return Grip(vertex, radius, inside, weights[inside] / weights[inside].sum())


PIN_WEIGHT = 100.0
"""Weight of the squared drift of a pin, relative to the squared miss of the grip."""

STRETCH_WEIGHT = 0.01
"""Weight of the squared excess stretch of the edges, likewise."""

STANDING_WEIGHT = 10.0
"""Weight of the squared drift of a point standing on the ground, likewise."""


class HeldPatch(NamedTuple):
    """A patch that stays.

    Attributes
    ----------
    grip : the patch
    place : (3,) float64 array, position of its mean, normalised
    weight : of the squared drift
    """

    grip: Grip
    place: FloatArray
    weight: float = PIN_WEIGHT


class Decoded(NamedTuple):
    """A pose and its mesh.

    Attributes
    ----------
    codes : (D,) float64 array
    vertices : (V, 3) float64 array, in normalised length
    """

    codes: FloatArray
    vertices: FloatArray


class Goal(Protocol):
    """A goal of the poses of one drag; lengths are normalised.

    Attributes
    ----------
    reach : the largest part of the miss that one step aims at
    longest_step : the largest root mean square vertex displacement of a step, within which one
        quadratic models the cost
    price : factor of the price of moving parts, see `PoseSpace.price`
    """

    reach: float
    longest_step: float
    price: float

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Return the distance left to a target."""

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the (D, D) hessian and (D,) gradient of half the squared miss by the codes."""


class PatchGoal:
    """Move a patch's mean to a point; other patches stay.

    Parameters
    ----------
    space : of the poses
    grip : the patch
    pins : patches that stay
    strength : of the price of stretched edges

    Attributes
    ----------
    grip : the patch
    """

    reach, longest_step, price = 0.012, 0.01, 1.0

    def __init__(
        self, space: PoseSpace, grip: Grip, pins: Sequence[HeldPatch], strength: float
    ) -> None:
        self._space, self._pins, self.grip, self._strength = space, pins, grip, strength
        self._means = _mean_slopes(space, [grip, *(pin.grip for pin in pins)])
        self._weights = np.repeat([1.0, *(pin.weight for pin in pins)], 3)

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Return the distance to the target."""
        return float(np.linalg.norm(target - self.grip.position(pose.vertices)))

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Goal.cost`."""
        way = _shortened(target - self.grip.position(pose.vertices), self.reach)
        ways = np.concatenate([way, *_drifts(self._pins, pose)])
        return _squares(self._space, pose, self._means, ways, self._weights, self._strength)


class TwistGoal:
    """Turn a body part about its long axis by an angle; its middle and pinned patches stay.

    Parameters
    ----------
    space : of the poses
    domain : the body part
    pins : patches that stay
    strength : of the price of stretched edges
    decoded : (V, 3) float64 array, the vertices at the drag's start
    """

    reach, longest_step, price = 0.25, 0.01, 0.01

    def __init__(
        self,
        space: PoseSpace,
        domain: int,
        pins: Sequence[HeldPatch],
        strength: float,
        decoded: FloatArray,
    ) -> None:
        inside = np.flatnonzero(space.vertex_domain == domain)
        self._part = Grip(int(inside[0]), 0.0, inside, np.full(len(inside), 1.0 / len(inside)))
        self._space, self._strength = space, strength
        self._pins = [HeldPatch(self._part, self._part.position(decoded)), *pins]
        self._means = _mean_slopes(space, [pin.grip for pin in self._pins])
        self._weights = np.append(np.repeat([pin.weight for pin in self._pins], 3), 1.0)
        self._arms = self._arms_of(decoded)
        self.axis = long_axis(self._arms)

    def _arms_of(self, decoded: FloatArray) -> FloatArray:
        arms: FloatArray = decoded[self._part.vertices] - self._part.position(decoded)
        return arms

    def _angle(self, arms: FloatArray) -> float:
        """Return the angle by which the part has turned about the axis since the start."""
        before, now = (np.cross(self.axis, arm) for arm in (self._arms, arms))
        return float(
            np.arctan2((np.cross(self._arms, arms) @ self.axis).sum(), (before * now).sum())
        )

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Return the angle left to the target, in radians."""
        return abs(float(target[0]) - self._angle(self._arms_of(pose.vertices)))

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Goal.cost`; the miss is the path of a vertex at the part's mean radius."""
        arms = self._arms_of(pose.vertices)
        across = np.cross(self.axis, arms)
        radius = np.sqrt((across**2).sum() / len(arms))
        left = float(target[0]) - self._angle(arms)
        # The rotation is the mean of the motions across the axis.
        turn = np.zeros_like(pose.vertices)
        turn[self._part.vertices] = across / (radius * len(arms))
        way = np.array([radius * np.clip(left, -self.reach, self.reach)])
        ways = np.concatenate([*_drifts(self._pins, pose), way])
        return _squares(self._space, pose, self._means, ways, self._weights, self._strength, turn)


class CodesGoal:
    """Move the codes to a target; codes whose target is their start value stay.

    Parameters
    ----------
    space : of the poses
    """

    reach = longest_step = 0.02
    price = 0.0

    def __init__(self, space: PoseSpace) -> None:
        self._space = space

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Return the remaining root mean square vertex displacement, to first order."""
        way = target - pose.codes
        return float(np.sqrt(way @ self._space.metric @ way))

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Goal.cost`."""
        miss = self.miss(pose, target)
        way = (target - pose.codes) * min(1.0, self.reach / max(miss, self.reach))
        return self._space.metric, -(self._space.metric @ way)


def _mean_slopes(space: PoseSpace, patches: Sequence[Grip]) -> MeanSlopes:
    """Solve once for the means of all patches that a drag moves or holds in place."""
    weights = np.concatenate([patch.weights for patch in patches])
    vertices = np.concatenate([patch.vertices for patch in patches])
    ends = np.cumsum([0, *(len(patch.vertices) for patch in patches)])
    shape = (len(patches), space.topology.n_vertices)
    return space.mean_slopes(scipy.sparse.csr_matrix((weights, vertices, ends), shape=shape))


def _drifts(pins: Sequence[HeldPatch], pose: Decoded) -> list[FloatArray]:
    return [
        _shortened(pin.place - pin.grip.position(pose.vertices), PatchGoal.reach) for pin in pins
    ]


def _shortened(way: FloatArray, most: float) -> FloatArray:
    length = float(np.linalg.norm(way))
    return way if length <= most else way * (most / length)


def _squares(
    space: PoseSpace,
    pose: Decoded,
    means: MeanSlopes,
    ways: FloatArray,
    weights: FloatArray,
    strength: float,
    *others: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton hessian and gradient of half the weighted squares of the misses.

    The (r,) misses `ways` are those of the means, then those whose (V, 3) derivatives by the
    vertices are `others`. The excess stretch of the edges is added to them.
    """
    slope = np.empty_like(pose.vertices)
    excess = excess_stretch(pose.vertices, space.topology.edges, space.longest_edges, slope)
    if strength * excess > 0.0:
        others = (*others, slope)
        ways = np.append(ways, -excess)
        weights = np.append(weights, STRETCH_WEIGHT * strength)
    rows = means(pose.codes, np.array(others).reshape(-1, *pose.vertices.shape))
    weighted = rows * weights[:, None]
    return weighted.T @ rows, -(ways @ weighted)


MAX_STEPS = 3
"""Most steps per event; where the pointer leapt, the next events continue."""

PATIENCE = 3
"""Successive events without progress after which more of the body joins in."""

ROUNDS = 3
"""Most times that a step is solved, each time with the contacts that it ran into before."""

CUTS = (0.5, 0.25, 0.1)
"""Fractions of a step that are tried if it still collides after the last round."""

LEAST_PACE, FASTER = 0.125, 1.5
"""Least share of the longest step, and the factor of the share after a step that came nearer."""

KEPT_CONTACTS = 18

DAMPING = 0.02
"""Price of the mean squared vertex displacement of a step, relative to the squared miss."""

IMPLAUSIBLE = 3e-6
"""Price of the squared Mahalanobis distance from the drag's start: see `PoseSpace.precision`."""

STRETCH = 0.14
"""Largest relative excess of an edge's length over plausible poses in a drag of strength 1."""

_NEAR, _WORTHWHILE, _SHORT, _SETTLED = 0.5, 0.5, 0.25, 0.01
"""Shares of a goal's reach: a miss that is left to the next event, the gain from which another step
follows at once, the gain below which there is no progress, and the miss or gain below which the
drag has settled."""

_ROUNDING = 1e-6
"""Fraction by which the squared depths of a contact vary with the rounding of the vertices."""

_STILL = 1e-5
"""Normalised root mean square vertex displacement below which a step counts as none."""


@dataclass(frozen=True)
class DragOptions:
    """Options of a drag.

    Attributes
    ----------
    solid : whether to keep the pose from penetrating itself
    strength : of the prices of implausible poses and stretched limbs: 0 for none
    locked_domains : body parts whose codes stay
    locked_codes : further codes that stay, by index
    standing : whether parts on the ground stay there, unless their limb is dragged
    whole_body : whether the whole body helps, not only the limb that is held
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
    """The result of one event of a drag.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    vertices : (V, 3) float32 array, read-only, in the data's unit, in model coordinates
    miss : distance left to the target: normalised length, or radians for a twist
    collisions : the exact check of these vertices as exported, without excluded pairs, with the
        clearance of the drag; None if the drag is not solid
    crossing : the same without the clearance: pairs that penetrate
    contacts : (C, 3) float64 array, points of the surface, in the data's unit, where contact stops
        the pose
    standing : (S, 3) float64 array, points of the surface, likewise, that stay on the ground
    settled : whether another event with the same target would make no progress
    """

    latent: FloatArray
    vertices: npt.NDArray[np.float32]
    miss: float
    collisions: SelfCollisions | None
    crossing: SelfCollisions | None
    contacts: FloatArray
    standing: FloatArray
    settled: bool

    @property
    def exactly_free(self) -> bool | None:
        """Whether the pose is free of collisions; None if it was not checked."""
        return None if self.collisions is None else not self.collisions.colliding


class PoseDragger:
    """Drag poses of one space; for one thread at a time.

    After `begin` each `move` is one event of the pointer. It moves the limb that is held. Only if
    that makes no progress, the limbs that it hangs on join in, one by one. Limbs that hang on a
    moving one follow it. A solid drag that starts free stays exactly free; one that starts
    colliding does not deepen the contact of any two body parts.

    Parameters
    ----------
    check : decodes and checks the poses, placed for export
    up : (3,) unit vector, away from the ground; not needed for drags of codes
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
        grip : the object that the targets of `move` are for: a patch, a twist, or the codes if
            None; then codes that a target does not change stay
        pins : patches that stay in their places; ignored in a drag of codes
        options : the defaults if None

        Returns
        -------
        step : the initial pose

        Raises
        ------
        ShapeError : another shape, a number that is not finite, or a clearance out of range.
        LCollisionError : the mesh lacks a pin's vertex or the body part to twist.
        """
        space = self._space
        self._goal = None
        self._options = options or DragOptions()
        self._check = check = self._plain.with_clearance(self._options.clearance)
        start: FloatArray = np.array(latent, dtype=np.float64)
        if start.shape != space.low.shape:
            raise ShapeError.must_be("a pose to drag", f"{len(space.low)} numbers", start.shape)
        if not np.isfinite(start).all():
            raise ShapeError("the pose to drag contains NaN or infinity", "repair the pose")
        self._start = start
        locked = space.codes_of(self._options.locked_domains)
        locked[sorted(self._options.locked_codes)] = True
        self._least = self._low = np.where(locked, start, np.minimum(space.low, start))
        self._most = self._high = np.where(locked, start, np.maximum(space.high, start))
        self._reaches: list[frozenset[int]] = []
        self._contacts, self._pace = Contacts(check), 1.0
        self._helps_at = _SHORT, _SHORT
        self._has_forgotten, self._blocking = False, np.empty(0, dtype=np.int64)
        self._here = Decoded(start, check.decode(start)[0])
        self._collisions: SelfCollisions | None = None
        self._allowed: dict[int, tuple[float, float]] = {}
        if self._options.solid:
            self._collisions = check.find(check.exported(self._here.vertices))
            self._allowed = ContactRegions.of(space, self._collisions).by_name()
        self._stands: list[HeldPatch] = []
        self._goal = CodesGoal(space) if grip is None else self._take(grip, pins)
        self._stretch = self._stretch_of(self._here.vertices)
        return self._result(0.0, settled=True)

    def _take(self, grip: Grip | Twist, pins: Iterable[Pin]) -> Goal:
        """Find which codes move and which patches stay when a patch or a body part is dragged."""
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
        held_joints = limbs.held_segment(inside, weights)
        stays = [
            HeldPatch(grip, np.array(place) / self._check.body_size)
            for pin in pins
            for vertex, radius, place in pin.patches
            for grip in (make_grip(space, vertex, radius),)
        ]
        if options.standing and self._up is not None:
            stands = limbs.standing(here, self._up, held_joints).values()
            self._stands = [
                HeldPatch(Grip.at(vertex), here[vertex], STANDING_WEIGHT)
                for vertex in np.concatenate([*stands, []]).astype(int).tolist()
            ]
        pinned = [limbs.held_segment(stay.grip.vertices, stay.grip.weights) for stay in stays]
        if any(held_joints in limbs.limb(end, LEAST_LIMB)[1:] for end in pinned):
            # A pinned hand slows its arm: the trunk helps only once the arm has stopped.
            self._helps_at = _SETTLED, _NEAR
        pinned += [int(limbs.leads[stand.grip.vertex]) for stand in self._stands]
        reaches = [set(reach) for reach in limbs.drag_stages(held_joints, least)]
        # Twisting a learned model's body part needs its neighbours, as domains turn in space.
        if options.whole_body or (isinstance(grip, Twist) and not limbs.is_relative):
            # A body without a hold would float to the target.
            root = limbs.path(held_joints)[-1]
            floats = limbs.is_relative and not pinned and held_joints != root
            reaches = [set(limbs.body(held_joints)) - ({root} if floats else set())]
        moving: frozenset[int] = frozenset()
        self._reaches = []
        for reach in reaches:
            moving = limbs.with_pinned(moving | reach, pinned)
            self._reaches.append(moving)
        self._held = limbs.with_pinned(limbs.limb(held_joints, least), pinned)
        self._extend_reach()
        # Parts that cannot move need no hold.
        self._stands = [
            stand
            for stand in self._stands
            if moving & set(limbs.path(limbs.leads[stand.grip.vertex]))
        ]
        stays += self._stands
        if isinstance(grip, Grip):
            return PatchGoal(space, grip, stays, options.strength)
        return TwistGoal(space, grip.domain, stays, options.strength, here)

    def _extend_reach(self) -> None:
        """Let the codes of the next reach move."""
        self._n_short = 0
        moving = self._space.limbs.codes_of(self._reaches.pop(0))
        self._low = np.where(moving, self._least, self._start)
        self._high = np.where(moving, self._most, self._start)

    def move(self, target: npt.ArrayLike) -> DragStep:
        """Move towards a target, by a few short steps at most.

        Parameters
        ----------
        target : for a patch (3,), a point in the data's unit, in model coordinates; for a twist an
            angle in radians since the start; for codes (D,). If a number is not finite, the pose
            stays.

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
            aim = aim / self._check.body_size
        self._contacts.keep_latest(KEPT_CONTACTS)
        self._blocking = np.empty(0, dtype=np.int64)
        miss, gain = goal.miss(self._here, aim), 0.0
        for _ in range(MAX_STEPS):
            if not self._step(goal, aim):
                gain = 0.0
                break
            left = goal.miss(self._here, aim)
            if miss > goal.reach:
                # Long steps along curved contacts would oscillate about the nearest pose.
                pace = self._pace * (0.5 if left > miss else FASTER)
                self._pace = min(max(pace, LEAST_PACE), 1.0)
            miss, gain = left, miss - left
            # More steps are for a pointer that leapt, not for one that is out of reach.
            if left < _NEAR * goal.reach or gain < _WORTHWHILE * goal.reach:
                break
        # An overshoot is no reason to settle, except in solid drags, which could oscillate.
        gained = gain if self._options.solid else abs(gain)
        settled = min(miss, gained) < _SETTLED * goal.reach
        least_gain, near = self._helps_at
        is_short = gain < least_gain * goal.reach and miss > near * goal.reach
        if is_short and self._more_may_move(goal):
            self._n_short += 1
            settled = False
            if self._n_short == PATIENCE:
                self._extend_reach()
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
            # Contacts of earlier poses may block a path that is clear now: forget them once.
            self._contacts, self._has_forgotten, settled = Contacts(self._check), True, False
        return self._result(miss, settled)

    def _more_may_move(self, goal: Goal) -> bool:
        """Whether more limbs could help and no contact is in the way."""
        return (
            bool(self._reaches)
            and isinstance(goal, PatchGoal)
            and not self._has_forgotten
            and not len(self._contacts.touching(self._here.codes))
        )

    def end(self) -> None:
        """End the drag."""
        self._goal = None

    def _step(self, goal: Goal, aim: FloatArray) -> bool:
        """Take one step; return False if none is possible."""
        space, here = self._space, self._here.codes
        low, high = self._low, self._high
        hessian, gradient = goal.cost(self._here, aim)
        if isinstance(goal, CodesGoal):
            # The target may lie beyond the bounds, as the pose may.
            is_free = low < high
            low = np.where(is_free, np.minimum(low, aim), low)
            high = np.where(is_free, np.maximum(high, aim), high)
            if self._may_land(goal, aim, low, high) and self._try_move(aim):
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
                # Contacts of different poses contradict each other.
                self._contacts = Contacts(self._check)
                continue
            way = there - here
            length = float(np.sqrt(way @ space.metric @ way))
            if length < _STILL:
                return False
            way *= min(1.0, self._pace * goal.longest_step / length)
            if self._try_move(here + way):
                return True
            if len(self._contacts.offsets) == n_contacts:
                break
        return there is not None and any(self._try_move(here + cut * way) for cut in CUTS)

    def _may_land(
        self, goal: CodesGoal, aim: FloatArray, low: FloatArray, high: FloatArray
    ) -> bool:
        """Whether the target codes are one step away, and no known contact is in the way.

        The quadratic program would reach them only within its tolerance.
        """
        contacts = self._contacts
        return bool(
            0.0 < goal.miss(self._here, aim) <= goal.reach
            and ((low <= aim) & (aim <= high)).all()
            and (contacts.normals @ aim <= contacts.offsets).all()
        )

    def _try_move(self, there: FloatArray) -> bool:
        """Move to codes if their pose is allowed; else remember the contacts in the way."""
        check = self._check
        decoded = check.decode(there)[0]
        stretch = self._stretch_of(decoded)
        if stretch > max(STRETCH, self._stretch):
            return False
        if self._options.solid:
            collisions = check.find(check.exported(decoded))
            regions = ContactRegions.of(self._space, collisions)
            depths = regions.by_name()
            allowed = {name: self._allowed.get(name, (0.0, 0.0)) for name in depths}
            if any(depths[name][1] > (1.0 + _ROUNDING) * allowed[name][1] for name in depths):
                self._blocking = self._space.topology.faces[collisions.pairs[:, 0], 0]
                may_keep = {name: depth for name, (depth, _) in self._allowed.items()}
                self._contacts.separate(there, decoded, collisions, regions, may_keep)
                return False
            self._collisions = collisions
            self._allowed = {
                name: (min(depth, allowed[name][0]), min(squared, allowed[name][1]))
                for name, (depth, squared) in depths.items()
            }
            if not collisions.colliding:
                self._contacts.drop_violated(there)
        self._here, self._stretch = Decoded(there, decoded), stretch
        self._blocking = self._blocking[:0]
        return True

    def _stretch_of(self, decoded: FloatArray) -> float:
        """Return the priced excess of the most stretched edge; 0 in drags of codes."""
        if isinstance(self._goal, CodesGoal) or self._options.strength == 0.0:
            return 0.0
        edges, longest = self._space.topology.edges, self._space.longest_edges
        return self._options.strength * (largest_stretch(decoded, edges, longest) - 1.0)

    def _result(self, miss: float, settled: bool) -> DragStep:
        vertices = self._check.drawn(self._here.vertices)
        latent = self._here.codes.copy()
        latent.flags.writeable = vertices.flags.writeable = False
        crossing = self._collisions
        if crossing is not None and crossing.colliding and self._check.clearance > 0.0:
            crossing = self._plain.find(self._plain.exported(self._here.vertices))
        touching = np.unique(self._contacts.touching(latent))
        if not len(touching):
            # A pose with contacts on all sides may have reached no half-space.
            touching = np.unique(self._blocking)
        return DragStep(
            latent=latent,
            vertices=vertices,
            miss=miss,
            collisions=self._collisions,
            crossing=crossing,
            contacts=vertices[touching].astype(np.float64),
            standing=np.array([stand.place for stand in self._stands]).reshape(-1, 3)
            * self._check.body_size,
            settled=settled,
        )
