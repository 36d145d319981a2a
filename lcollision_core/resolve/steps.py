"""Steps of Resolve: towards a pose, back from a collision, out of contact, feet on the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import SelfCollisions
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import DragOptions, DragStep, ExactCheck, Grip, PoseDragger
from lcollision_core.posing.exact import ContactRegions, Contacts, add_slopes, least_step
from lcollision_core.resolve.problem import ResolveProblem
from lcollision_core.resolve.solvers import polish

FIRST_HALVINGS, FURTHER_HALVINGS = 3, 5
SLIDES = 5
_SLIDE_HALVINGS = 1
_SETTLED = 0.01
"""Fraction of the distance that another slide must gain."""

FALL_BACKS = 6
"""Number of known free poses that are tried, the nearest ones: the segment to the nearest one is
often not the one that becomes free first."""

FALL_BACK_HALVINGS = 8


def bisect(
    check: ExactCheck, problem: ResolveProblem, free: FloatArray, colliding: FloatArray, n: int
) -> tuple[FloatArray, FloatArray]:
    """Halve a segment `n` times between a free and a colliding pose.

    The free set on a segment may have several intervals: this finds one of its boundaries, not
    always that nearest to the colliding end.

    Parameters
    ----------
    check, problem : of the pose
    free, colliding : (D,) float64 arrays
    n : >= 0

    Returns
    -------
    free, colliding : the ends of the remaining segment

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    for _ in range(n):
        problem.deadline.poll()
        middle = 0.5 * (free + colliding)
        if check.is_free(middle):
            free = middle
        else:
            colliding = middle
    return free, colliding


def pull_back(check: ExactCheck, problem: ResolveProblem, free: FloatArray) -> FloatArray:
    """Slide a free pose back, then put each group of codes back alone if that is free.

    Parameters and errors are those of `slide_back`.
    """
    return _put_domains_back(check, problem, slide_back(check, problem, free))


def slide_back(check: ExactCheck, problem: ResolveProblem, free: FloatArray) -> FloatArray:
    """Move a free pose towards Z* for as long as it stays collision-free.

    First move straight towards Z* by bisection. Where contact stops that, the contacts become
    linear constraints, and the nearest pose that they allow is the next goal: the pose slides along
    them.

    Parameters
    ----------
    check, problem : of the pose
    free : (D,) float64 array, collision-free

    Returns
    -------
    latent : (D,) float64 array, collision-free, no farther from Z* than `free`

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    free, colliding = bisect(check, problem, free, problem.target, FIRST_HALVINGS)
    slid = _slide(check, problem, free, colliding)
    if slid is free:
        slid, _ = bisect(check, problem, free, colliding, FURTHER_HALVINGS)
    return slid


def fall_back(
    check: ExactCheck, problem: ResolveProblem, free_latents: FloatArray
) -> FloatArray | None:
    """Bisect the segments from Z* to known free poses, and return the end nearest to Z*.

    Known poses that collide with the locked codes of Z* are left out.

    Parameters
    ----------
    check, problem : of the pose
    free_latents : (F, D) float64 array

    Returns
    -------
    latent : (D,) float64 array, collision-free, or None if all known poses collide

    Raises
    ------
    CancelledError : the job was cancelled.
    """

    def reach(end: FloatArray) -> FloatArray | None:
        if not check.is_free(end):
            return None
        return bisect(check, problem, end, problem.target, FALL_BACK_HALVINGS)[0]

    return _nearest_reached(problem, free_latents, FALL_BACKS, reach)


def _nearest_reached(
    problem: ResolveProblem,
    free_latents: FloatArray,
    most: int,
    reach: Callable[[FloatArray], FloatArray | None],
) -> FloatArray | None:
    """Return the pose nearest to Z* that is reached from one of at most `most` known free poses.

    Parameters
    ----------
    reach : returns the free pose that a known one leads to; None if that one collides with the
        locked codes of Z*
    """
    reached: list[FloatArray] = []
    for end in problem.nearest_first(free_latents):
        problem.deadline.poll()
        if len(reached) == most or (reached and problem.deadline.expired):
            break
        if (pose := reach(end)) is not None:
            reached.append(pose)
    return min(reached, key=problem.distance, default=None)


def _slide(
    check: ExactCheck, problem: ResolveProblem, free: FloatArray, colliding: FloatArray
) -> FloatArray:
    contacts = Contacts(check)
    for _ in range(SLIDES):
        problem.deadline.poll()
        if problem.deadline.expired or not contacts.add(colliding):
            break
        contacts.drop_violated(free)
        goal = problem.nearest(problem.target, contacts)
        if goal is None:
            break
        if problem.distance(goal) >= (1.0 - _SETTLED) ** 2 * problem.distance(free):
            break
        if check.is_free(goal):
            return goal
        nearer, colliding = bisect(check, problem, free, goal, _SLIDE_HALVINGS)
        if problem.distance(nearer) < problem.distance(free):
            free = nearer
    return free


def _put_domains_back(check: ExactCheck, problem: ResolveProblem, free: FloatArray) -> FloatArray:
    """Return each group of codes to Z* where the pose stays free, the largest gain first."""

    def away(codes: npt.NDArray[np.intp]) -> float:
        return float(problem.distance(_with_codes(free, codes, problem.target)))

    for codes in sorted(_code_groups(check), key=away):
        problem.deadline.poll()
        if problem.deadline.expired:
            break
        # If the metric couples groups, putting one back alone may increase the distance.
        tried = _with_codes(free, codes, problem.target)
        gain = problem.distance(free) - problem.distance(tried)
        if gain > _SETTLED * problem.distance(free) and check.is_free(tried):
            free = tried
    return free


def _code_groups(check: ExactCheck) -> list[npt.NDArray[np.intp]]:
    """Return the indices of each group of codes, the shapes with the last."""
    space = check.space
    return np.split(np.arange(len(space.low)), np.cumsum(space.group_sizes)[:-1])


def _with_codes(latent: FloatArray, codes: npt.NDArray[np.intp], other: FloatArray) -> FloatArray:
    """Return a (D,) pose with some codes of another."""
    changed = latent.copy()
    changed[codes] = other[codes]
    return changed


_WAYS = 4
"""Number of poses to head for, in the given order."""

_STAGES = (0.5, 1.0)
"""Shares of the largest change, as successive bounds; each starts from the previous result."""

_ROUNDS, _HALVINGS = 12, 4
_LEAST_GAIN = 0.01
_DAMPING = 1e-2
"""Share of the mean curvature that a step adds in all directions."""

_GAP = 1e-4
"""Normalised gap to which contacts are moved apart, as depths below the check's tolerance are still
contact."""

_BOUNDED, _NEARLY = 8, 0.8
"""Most body parts whose farthest vertex a step bounds, and the share of the bound from which it
does."""

_SHRINKS, _WITHIN = 10, 1.0 - 1e-4

_OUT = ((0.0, 0.08), (0.0, 0.04), (0.0, 0.03), (0.0, 0.02))
"""Starts of steps out of contact, as a share of the path to the nearest known free pose, and the
normalised displacement of the farthest vertex in a step. Where steps of one length end in other
contacts, longer or shorter ones may not."""

_BACK = ((0.75, 0.04), (0.5, 0.02), (0.75, 0.02), (0.25, 0.04))
_PUSHES, _FARTHER = 40, 1.5
_FACES, _LOOKS = 2_000_000, 24
"""Budget of the search for a nearer free pose than the known one: faces of all checked poses, about
two seconds, and least number of poses."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """A checked pose: (D,) codes, (V, 3) decoded vertices and its collisions."""

    latent: FloatArray
    decoded: FloatArray
    collisions: SelfCollisions


def _energy(seen: _Seen) -> float:
    return seen.collisions.energy


class LeastOverlap:
    """Find poses of little overlap in which no vertex moves farther than a bound.

    Parameters
    ----------
    check, problem : of the pose
    largest_change : > 0, of a vertex from its position in the decoded Z*, in normalised length
    """

    def __init__(self, check: ExactCheck, problem: ResolveProblem, largest_change: float) -> None:
        self._check, self._problem = check, problem
        self._most = self._bound = largest_change
        self._start = self._shallowest = self._look(problem.target)

    def is_within(self, latent: FloatArray) -> bool:
        """Whether a (D,) pose moves no vertex farther than the bound."""
        return float(self._lengths(self._check.decode(latent)[0]).max()) <= self._most

    def find(self, ends: Sequence[FloatArray]) -> FloatArray:
        """Return the pose of least exact energy found within the bound.

        Start from Z* and from the best pose on the segments to `ends`, and take Gauss-Newton steps
        on the depths of the contacts, while the bound grows.

        Parameters
        ----------
        ends : (D,) arrays within the problem's bounds, such as free poses beyond the bound

        Returns
        -------
        latent : (D,) float64 array; it has no more energy, no more pairs and none deeper than Z*

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        best = self._start
        for share in _STAGES:
            self._bound = share * self._most
            ways = [self._look(*self._within(end)) for end in ends[:_WAYS]]
            starts = {
                id(seen): seen
                for seen in (self._start, self._shallowest, best, *sorted(ways, key=_energy)[:1])
            }
            ends_of = [*map(self._descend, starts.values()), best]
            better = (end for end in ends_of if not end.collisions.exceeds(self._start.collisions))
            best = min(better, key=_energy)
            if not best.collisions.colliding:
                break
        if not best.collisions.colliding:
            nearer = pull_back(self._check, self._problem, best.latent)
            return nearer if self.is_within(nearer) else best.latent
        return best.latent

    def push_out(
        self, finish: Callable[[FloatArray], FloatArray], known: FloatArray | None
    ) -> FloatArray | None:
        """Return the nearest free pose to Z* that steps out of contact reach, or None.

        A step may add overlap, as when a limb has to pass through another part; steps that must
        lose energy would end there. Once a free pose is known, the number of faces checked bounds
        the steps.

        Parameters
        ----------
        finish : turns a free pose into the free pose to compare, as by putting its feet back
        known : (D,) free pose; None is returned if no nearer one is found

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        self._bound, problem = self._most, self._problem
        self._looks_left = max(_LOOKS, _FACES // self._check.space.topology.n_faces)
        best = known

        def pushed(start: _Seen, reach: float) -> FloatArray | None:
            free = self._pushed(start, reach, best)
            if free is None or self.nearer(best, free) is best:
                return best
            return self.nearer(best, finish(free))

        began: dict[tuple[float, float], FloatArray] = {}
        for share, reach in (*_BACK, *_OUT, *_BACK):
            if self._looks_left <= 0:
                break
            start = self._start
            if share:
                if best is None or began.get((share, reach)) is best:
                    continue
                began[share, reach] = best
                between = problem.target + share * (best - problem.target)
                start = self._look(np.clip(between, problem.low, problem.high))
            best = pushed(start, reach)
        return None if best is known else best

    def nearer(self, pose_a: FloatArray | None, pose_b: FloatArray | None) -> FloatArray | None:
        """Return which of two (D,) poses moves the vertices less, the first if they tie."""
        both = [pose for pose in (pose_a, pose_b) if pose is not None]
        return min(both, key=self.mean_change, default=None)

    def _pushed(self, here: _Seen, reach: float, known: FloatArray | None) -> FloatArray | None:
        """Return the free pose that steps of length `reach` out of contact lead to, pulled back.

        None if they end in contact, or lead much farther than to a known free pose.
        """
        check, problem, best = self._check, self._problem, here
        most = np.inf if known is None else _FARTHER * self.mean_change(known)
        for _ in range(_PUSHES):
            goal = self._goal(here, _GAP) if here.collisions.colliding else None
            if goal is None or self._looks_left <= 0 or problem.deadline.expired:
                break
            self._looks_left -= known is not None
            if float(self._lengths(here.decoded).mean()) > most:
                return None
            there, _ = self._on_the_way(here, goal, reach)
            here = self._look(*self._within(there))
            if _energy(here) < _energy(best):
                best = here
        self._shallowest = min(self._shallowest, best, key=_energy)
        free = polish(check, problem, best.latent) if best.collisions.colliding else best.latent
        if free is None:
            return None
        nearer = pull_back(check, problem, free)
        return nearer if self.is_within(nearer) else None

    def _look(self, latent: FloatArray, decoded: FloatArray | None = None) -> _Seen:
        self._problem.deadline.poll()
        if decoded is None:
            decoded = self._check.decode(latent)[0]
        return _Seen(latent, decoded, self._check.find(self._check.exported(decoded)))

    def mean_change(self, latent: FloatArray) -> float:
        """Return the mean vertex displacement of a (D,) pose, in normalised length."""
        # Not by the metric of codes, which is that of the rest pose.
        return float(self._lengths(self._check.decode(latent)[0]).mean())

    def _lengths(self, decoded: FloatArray) -> FloatArray:
        lengths: FloatArray = np.linalg.norm(decoded - self._start.decoded, axis=1)
        return lengths

    def _within(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the last pose within the bound on the way to a (D,) pose, and its vertices."""
        return self._on_the_way(self._start, latent, self._bound)

    def _on_the_way(
        self, here: _Seen, goal: FloatArray, most: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the pose on the way to a goal at which a vertex has moved by `most`, or the goal.

        Also return its decoded vertices.
        """
        share = 1.0
        for _ in range(_SHRINKS):
            there = here.latent + share * (goal - here.latent)
            decoded = self._check.decode(there)[0]
            change = float(np.linalg.norm(decoded - here.decoded, axis=1).max())
            if change <= most:
                return there, decoded
            share *= _WITHIN * most / change
        return here.latent, here.decoded

    def _descend(self, here: _Seen) -> _Seen:
        """Return the last pose of a descent that does not exceed Z*, or else the start."""
        last = here
        for _ in range(_ROUNDS):
            if not here.collisions.colliding or self._problem.deadline.expired:
                break
            goal = self._goal(here)
            if goal is None:
                break
            for halving in range(_HALVINGS):
                way = 0.5**halving * (goal - here.latent)
                trial = self._look(*self._within(here.latent + way))
                if _energy(trial) < (1.0 - _LEAST_GAIN) * _energy(here):
                    break
            else:
                break
            here = trial
            if not here.collisions.exceeds(self._start.collisions):
                last = here
        return last

    def _goal(self, here: _Seen, gap: float = 0.0) -> FloatArray | None:
        """Return the codes that minimise the contacts, or part them by a gap, to first order.

        Each contact of two body parts is one residual: the root of its energy.
        """
        space, collisions, problem = self._check.space, here.collisions, self._problem
        regions = ContactRegions.of(space, collisions)
        residuals = np.sqrt(regions.squared_depth)
        weights = collisions.penetration_depth / residuals[regions.of_pair]
        moved = here.decoded - self._start.decoded
        lengths = self._lengths(here.decoded)
        order = np.flatnonzero(lengths > _NEARLY * self._bound)
        order = order[np.argsort(-lengths[order], kind="stable")]
        _, first = np.unique(space.vertex_domain[order], return_index=True)
        farthest = order[np.sort(first)[:_BOUNDED]]
        by_vertices = np.zeros((len(residuals) + len(farthest), *moved.shape))
        faces, apart = space.topology.faces[collisions.pairs], self._check.clearance > 0.0
        add_slopes(by_vertices, regions.of_pair, faces, here.decoded, weights, has_clearance=apart)
        bounds = np.arange(len(residuals), len(by_vertices))
        by_vertices[bounds, farthest] = moved[farthest] / lengths[farthest, None]
        by_codes = space.pull_back(here.latent, by_vertices)
        rows, normals = np.split(by_codes, [len(residuals)])
        hessian, metric = rows.T @ rows, problem.metric
        if not np.trace(hessian) > 0.0:
            return None
        hessian += _DAMPING * np.trace(hessian) / np.trace(metric) * metric
        offsets = normals @ here.latent + self._bound - lengths[farthest]
        return least_step(
            hessian,
            rows.T @ (residuals + gap),
            here.latent,
            problem.low,
            problem.high,
            normals,
            offsets,
        )


FAR = 0.02
"""Normalised mean displacement of a free pose from which a nearer one is looked for at length."""

_DRAWS = 20_000_000
"""Budget of draws near a pose that is far, in faces of all drawn poses: about two seconds."""

_LEAST_DRAWS, _MOST_DRAWS, _ROUND = 100, 3000, 200
_GAIN = 0.01
"""Share of the cost that a round of draws must gain for another one."""

_SHARES = (0.03, 0.1, 0.3)
"""Shares of the codes that a draw moves, besides one at least."""

_TOWARDS, _SIDEWAYS = 0.5, (0.01, 0.03, 0.1)
"""Share of draws towards Z*, and the sizes of the others, in the unit of the codes."""

_SPARED = 0.05
"""Share of the cost that may be lost by putting groups of codes back that gain little."""

_FARTHEST = 0.5
"""Weight of the farthest vertex beside the mean of all."""


def draw_nearer(
    check: ExactCheck,
    problem: ResolveProblem,
    free: FloatArray,
    standing: Standing | None = None,
    still_domains: frozenset[int] = frozenset(),
    seed: int = 0,
) -> FloatArray:
    """Draw poses near a free one, and go to each that is free and moves the vertices less.

    A draw moves some codes towards Z* or at random. Slides along contacts, and limbs put back one
    by one, end early where there is contact all round, as in clothes. At the end, groups of codes
    that gain little are put back to the bit.

    Parameters
    ----------
    check, problem : of the pose
    free : (D,) float64 array, collision-free
    standing : the parts that should stay on the ground; with each draw, the body is shifted there
    still_domains : body parts that go no farther from their places
    seed : of the draws

    Returns
    -------
    latent : (D,) float64 array, collision-free

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    generator, movable, target = np.random.default_rng(seed), problem.movable, problem.target
    original, decoded = check.decode(np.stack([target, free]))
    if standing is not None and not standing.can_shift(check):
        standing = None
    still = np.isin(check.space.vertex_domain, sorted(still_domains))
    lengths = np.linalg.norm(decoded - original, axis=1)
    slip = lengths[still].max(initial=0.0)

    def cost_of(decoded: FloatArray) -> float:
        lengths = np.linalg.norm(decoded - original, axis=1)
        if lengths[still].max(initial=0.0) > slip:
            return np.inf
        cost = float(lengths.mean() + _FARTHEST * lengths.max())
        if standing is None:
            return cost
        return cost + float(lengths[standing.points].mean()) + max(0.0, standing.below(decoded))

    def better(tried: FloatArray, limit: float) -> tuple[FloatArray, float]:
        """Return a pose and its cost, if it is free and costs less; else the last ones."""
        decoded = check.decode(tried)[0]
        if standing is not None:
            way = (original - decoded)[standing.points].mean(axis=0)
            shifted = check.space.shifted(tried, way)
            if np.array_equal(shifted, np.clip(shifted, problem.low, problem.high)):
                tried, decoded = shifted, decoded + way
        tried_cost = cost_of(decoded)
        is_better = tried_cost < limit and check.is_free(tried)
        return (tried, tried_cost) if is_better else (free, cost)

    most = np.clip(_DRAWS // check.space.topology.n_faces, _LEAST_DRAWS, _MOST_DRAWS)
    cost = before = cost_of(decoded)
    for draw in range(int(most * min(1.0, lengths.mean() / FAR))):
        if draw and draw % _ROUND == 0:
            if cost > (1.0 - _GAIN) * before:
                break
            before = cost
        problem.deadline.poll()
        if problem.deadline.expired:
            break
        is_towards = generator.random() < _TOWARDS
        codes = np.flatnonzero(movable & (free != target) if is_towards else movable)
        if not len(codes):
            continue
        chosen = codes[generator.random(len(codes)) < generator.choice(_SHARES)]
        chosen = chosen if len(chosen) else generator.choice(codes, 1)
        tried = free.copy()
        if is_towards:
            tried[chosen] += generator.random() * (target - free)[chosen]
        else:
            tried[chosen] += generator.choice(_SIDEWAYS) * generator.standard_normal(len(chosen))
        free, cost = better(np.clip(tried, problem.low, problem.high), cost)
    limit = (1.0 + _SPARED) * cost
    turned = np.abs(free - target)
    for codes in sorted(_code_groups(check), key=lambda codes: turned[codes].max(initial=0.0)):
        problem.deadline.poll()
        if (free[codes] != target[codes]).any():
            free, cost = better(_with_codes(free, codes, target), limit)
    return free


_DRAGS, _MOST_STANDING_EVENTS = 6, 20
"""Most drags, of one vertex each, and most events of a drag."""

_NEAR = 0.002
"""Normalised distance up to which a vertex counts as back in its place."""


@dataclass(frozen=True, eq=False)
class Standing:
    """The parts of a pose that stand on the ground.

    Attributes
    ----------
    up : (3,) unit vector
    points : (n,) int64 array, standing vertices, a few of each limb, far apart
    decoded : (V, 3) float64 array, the pose's vertices in normalised length
    """

    up: FloatArray
    points: npt.NDArray[np.int64]
    decoded: FloatArray

    @classmethod
    def of(cls, check: ExactCheck, latent: FloatArray, up: FloatArray) -> Standing:
        """Find the standing parts of a (D,) pose: ends of limbs as low as its lowest point."""
        decoded, limbs = check.decode(latent)[0], check.space.limbs
        stands = limbs.standing(decoded, up, limbs.root).values()
        points = np.concatenate([*stands, np.empty(0)]).astype(np.int64)
        return cls(up, points, decoded)

    def domains(self, check: ExactCheck) -> frozenset[int]:
        """Return the body parts that stand."""
        return frozenset(check.space.vertex_domain[self.points].tolist())

    def put_back(
        self,
        check: ExactCheck,
        problem: ResolveProblem,
        free: FloatArray,
    ) -> FloatArray:
        """Bring standing parts back to the ground, and lift parts that sank below it.

        The body is shifted as a whole, then limbs are dragged; finally the body is lifted until
        nothing is below the ground.

        Parameters
        ----------
        check, problem : of the pose that this describes; codes that the problem locks stay
        free : (D,) float64 array, collision-free

        Returns
        -------
        latent : (D,) float64 array, collision-free; `free` if nothing stood, or if the codes hold
            no position

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        if not self.can_shift(check):
            return free
        away = (self.decoded - check.decode(free)[0])[self.points]
        latent = _shifted(check, problem, free, away.mean(axis=0))
        dragger = PoseDragger(check, self.up)
        locked = frozenset(np.flatnonzero(~problem.movable).tolist())
        options = DragOptions(locked_codes=locked, clearance=check.clearance, strength=0.0)
        for _ in range(_DRAGS):
            vertex, place = self._farthest(check.decode(latent)[0])
            if vertex < 0:
                break
            step = dragger.begin(latent, Grip.at(vertex), options=options)
            goal = place * check.body_size
            latent = _dragged(dragger, step, problem, goal, _MOST_STANDING_EVENTS).latent.copy()
        return self.lifted(check, problem, latent)

    def lifted(self, check: ExactCheck, problem: ResolveProblem, latent: FloatArray) -> FloatArray:
        """Return a (D,) pose, free or not, lifted as a whole until nothing is below the ground.

        A free pose that would then collide is returned unchanged.
        """
        below = self.below(check.decode(latent)[0])
        if not self.can_shift(check) or below <= 0.0:
            return latent
        moved = np.clip(check.space.shifted(latent, below * self.up), problem.low, problem.high)
        return moved if check.is_free(moved) or not check.is_free(latent) else latent

    def can_shift(self, check: ExactCheck) -> bool:
        """Return whether something stands, and the codes hold the body's position."""
        return check.space.limbs.is_relative and len(self.points) > 0

    def below(self, decoded: FloatArray) -> float:
        """Return how far the lowest vertex is below the ground, in normalised length."""
        return self._ground - float((decoded @ self.up).min())

    @cached_property
    def _ground(self) -> float:
        return float((self.decoded @ self.up).min())

    def _farthest(self, decoded: FloatArray) -> tuple[int, FloatArray]:
        """Return the vertex farthest from its place, and that place; -1 if all are near theirs.

        Candidates are the standing vertices and the lowest one, whose place is on the ground.
        """
        heights = decoded @ self.up
        lowest = int(heights.argmin())
        standing_points = np.append(self.points, lowest)
        raised = decoded[lowest] + max(0.0, self._ground - heights[lowest]) * self.up
        places = np.concatenate([self.decoded[self.points], raised[None]])
        away = np.linalg.norm(places - decoded[standing_points], axis=1)
        first = int(away.argmax())
        return (int(standing_points[first]) if away[first] > _NEAR else -1), places[first]


def _shifted(
    check: ExactCheck, problem: ResolveProblem, free: FloatArray, way: FloatArray
) -> FloatArray:
    """Shift a free pose as a whole, unless rounding makes touching parts collide."""
    moved = np.clip(check.space.shifted(free, way), problem.low, problem.high)
    return moved if check.is_free(moved) else free


STARTS = 3
"""Number of known free poses, the nearest ones, to start from."""

_MOST_DRAG_EVENTS = 60
"""Most events of a drag, each of a few steps: far more than it takes to cross the space."""


def step_towards(
    check: ExactCheck,
    problem: ResolveProblem,
    free_latents: FloatArray,
) -> FloatArray | None:
    """Drag the codes from known free poses to Z*, with the contacts as constraints.

    Parameters
    ----------
    check, problem : of the pose
    free_latents : (F, D) float64 array of poses known to be free; those that collide with the
        locked codes of Z* are left out

    Returns
    -------
    latent : (D,) float64 array, the nearest collision-free pose to Z* that was reached, or None if
        all known poses collide

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    dragger = PoseDragger(check)
    locked = frozenset(np.flatnonzero(~problem.movable).tolist())
    options = DragOptions(solid=True, locked_codes=locked, clearance=check.clearance)

    def reach(end: FloatArray) -> FloatArray | None:
        step = dragger.begin(end, None, options=options)
        if not step.exactly_free:
            return None
        step = _dragged(dragger, step, problem, problem.target, _MOST_DRAG_EVENTS)
        return step.latent.copy()

    return _nearest_reached(problem, free_latents, STARTS, reach)


def _dragged(
    dragger: PoseDragger, step: DragStep, problem: ResolveProblem, target: FloatArray, most: int
) -> DragStep:
    """Move towards a target until the drag settles, or for `most` events."""
    for _ in range(most):
        problem.deadline.poll()
        step = dragger.move(target)
        if step.settled or problem.deadline.expired:
            break
    return step
