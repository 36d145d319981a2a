"""Frames of a motion: resolve each alone, check them before, and guard against faults after."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import NearestPair, SelfCollisions
from lcollision_core.devices import block_size, uses_gpu
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.meshes.contact_rules import ExcludedPairs, RuleCounts
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.contacts import ContactReport, KeptContacts, Pulls
from lcollision_core.motion.motion import Motion
from lcollision_core.posing import ExactCheck
from lcollision_core.posing.exact import ContactRegions, Contacts, move_together
from lcollision_core.resolve import PoseResolver, ResolveOptions
from lcollision_core.resolve.problem import ResolveProblem
from lcollision_core.resolve.solvers import polish
from lcollision_core.resolve.steps import LeastOverlap, bisect, slide_back
from lcollision_core.sentences import both, marked, say, say_number

HalfSpacesOfPose = tuple[FloatArray, FloatArray]
"""(C, D) normals and (C,) offsets that separate the contacts of one pose."""


_BISECTIONS = 3
"""Halvings on the way from a free frame to a colliding pose, to find where contacts begin."""

_BLOCK = 8
"""Frames that a thread checks in one go."""

_Frames = TypeVar("_Frames", bound=Sequence[int])


_Verdicts = tuple[npt.NDArray[np.bool_], npt.NDArray[np.floating] | None]
"""(n,) whether each of n frames collides, and maybe their (n, V, 3) vertices."""


def _blocks(frames: _Frames, size: int) -> list[_Frames]:
    return [frames[at : at + size] for at in range(0, len(frames), size)]  # type: ignore[misc]


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a motion; may be shared between threads.

    Attributes
    ----------
    motion : the original
    resolver : of the body's poses
    options : of single frames
    pool : runs the work of single frames
    job : polled for each frame
    continuous : whether poses between frames are also tested with interpolated vertices, not only
        with interpolated codes
    extra_clearance : >= 0, normalised, added to the clearance of poses between frames
    largest_change : of a vertex of a resolved frame, normalised; None for no limit
    kept_contacts : contacts to keep, or None
    """

    motion: Motion
    resolver: PoseResolver
    options: ResolveOptions
    pool: Executor
    job: Job = UNWATCHED
    continuous: bool = False
    extra_clearance: float = 0.0
    largest_change: float | None = None
    kept_contacts: KeptContacts | None = None

    @cached_property
    def _check(self) -> ExactCheck:
        return self.resolver.check.with_clearance(self.options.clearance)

    @cached_property
    def _check_between(self) -> ExactCheck:
        return self.resolver.check.with_clearance(self.options.clearance + self.extra_clearance)

    def check(self, frame: int) -> ExactCheck:
        """Return the exact check of one frame, with the clearance of the options."""
        return self.motion.check(frame, self._check)

    def problem(self, frame: int) -> ResolveProblem:
        """Return the problem of one frame, whose target is the original frame."""
        return self.resolver.problem(self.motion.codes[frame], self.options, self.job)

    @cached_property
    def metric(self) -> FloatArray:
        """(D, D) the cost of a change of the codes."""
        return self.problem(0).metric

    @cached_property
    def inverse_metric(self) -> FloatArray:
        """(D, D) the inverse of `metric`; 0 in the rows and columns of locked codes."""
        movable = np.flatnonzero(self.problem(0).movable)
        inverse = np.zeros_like(self.metric)
        inverse[np.ix_(movable, movable)] = np.linalg.inv(self.metric[np.ix_(movable, movable)])
        return inverse

    def limits(self, frame: int) -> tuple[FloatArray, FloatArray]:
        """Return the (D,) bounds of one frame's codes, which include the original frame."""
        problem = self.problem(frame)
        return problem.low, problem.high

    def distance(self, pose_a: FloatArray, pose_b: FloatArray) -> float:
        """Return the distance of two (D,) poses, the root of the metric's squared distance."""
        moved = pose_a - pose_b
        return math.sqrt(max(float(moved @ self.metric @ moved), 0.0))

    def is_free(self, frame: int, codes: FloatArray) -> bool:
        """Return whether (D,) codes are free at a frame."""
        self.job.check()
        return self.check(frame).is_free(codes)

    def contacts(self, frame: int, codes: FloatArray) -> HalfSpacesOfPose | None:
        """Return half-spaces that separate the contacts of (D,) codes at a frame; None if free."""
        return self._separated(self.check(frame), codes)

    def is_stuck(self, frame: int, share: float = 0.0) -> bool:
        """Whether faces of the original motion collide that no movable code moves apart.

        Parameters
        ----------
        share : fraction of the way to the next frame, of the pose that is checked
        """
        self.job.check()
        start, end = self.motion.codes[[frame, min(frame + 1, len(self.motion) - 1)]]
        codes, check = start + share * (end - start), self.motion.check(frame, self._check, share)
        decoded = check.decode(codes)[0]
        collisions = check.find(check.exported(decoded))
        of_pair = ContactRegions.of(check.space, collisions).of_pair
        faces = check.space.topology.faces[collisions.pairs]
        movable = self.problem(frame).movable
        return any(
            move_together(check.space, codes, decoded, faces[pair], movable)
            for pair in np.unique(of_pair, return_index=True)[1]
        )

    def pulls(self, frame: int, codes: FloatArray) -> Pulls | None:
        """Return the pulls of a frame's kept contacts at (D,) codes; None if it has none."""
        if self.kept_contacts is None or not self.kept_contacts.touches[frame]:
            return None
        self.job.check()
        space = self.motion.space(frame, self.resolver.check.space)
        return self.kept_contacts.pulls(space, frame, codes, space.decode(codes[None])[0])

    def _separated(self, check: ExactCheck, codes: FloatArray) -> HalfSpacesOfPose | None:
        self.job.check()
        contacts = Contacts(check)
        return (contacts.normals, contacts.offsets) if contacts.add(codes) else None

    def contacts_between(
        self, frame: int, share: float, start: FloatArray, end: FloatArray
    ) -> HalfSpacesOfPose | None:
        """Return the half-spaces of `contacts` for a pose between two frames of (D,) codes.

        If a frame is free, they are those that begin last on the way from one to that pose.

        Parameters
        ----------
        share : fraction of the way, in (0, 1)
        """
        for check, codes in self._poses_between(frame, share, start, end):
            self.job.check()
            if check.is_free(codes):
                continue
            # Limbs that cross each other have contacts that push deeper; the first ones do not.
            problem, ends = self.problem(frame), [end for end in (start, end) if check.is_free(end)]
            met = [bisect(check, problem, end, codes, _BISECTIONS)[1] for end in ends]
            first = min(met, key=lambda pose: self.distance(pose, codes), default=codes)
            return self._separated(check, first)
        return None

    def overlap_between(
        self, frame: int, share: float, start: FloatArray, end: FloatArray
    ) -> SelfCollisions | None:
        """Return the collisions of the first pose of `contacts_between` that collides, or None."""
        collisions = (
            check.collisions(codes)
            for check, codes in self._poses_between(frame, share, start, end)
        )
        return next((pose for pose in collisions if pose.colliding), None)

    def _poses_between(
        self, frame: int, share: float, start: FloatArray, end: FloatArray
    ) -> Iterator[tuple[ExactCheck, FloatArray]]:
        """Yield the checks and (D,) codes of the poses on the way from a frame to the next."""
        codes = (1.0 - share) * start + share * end
        motion = self.motion
        check = motion.check(frame, self._check_between, share)
        if motion.placements is None:
            yield check, codes
            if not self.continuous:
                return
        # With placements, or if `continuous`, interpolate the vertices.
        ends = (motion.check(at, self._check_between) for at in (frame, frame + 1))
        first, second = (
            end_check.exported(end_check.decode(row)[0])
            for end_check, row in zip(ends, (start, end), strict=True)
        )
        vertices, place = (1.0 - share) * first + share * second, check.placement
        vertices = vertices if place is None else place.inverse().apply(vertices)
        shaped = check.space.shaped_as(codes, vertices.astype(np.float64) / check.body_size)
        yield replace(check, space=shaped), codes

    def are_free(
        self, frames: Sequence[int], job: Job = UNWATCHED, codes: FloatArray | None = None
    ) -> npt.NDArray[np.bool_]:
        """Return which frames of the original motion, or with (n, D) other codes, are free."""
        motion, parts = self.motion, [np.empty(0, dtype=np.bool_)]
        if codes is not None:
            rows = np.array(motion.codes)
            rows[np.asarray(frames, dtype=np.intp)] = codes
            motion = replace(motion, codes=rows)
        alike = motion.hidden is None and all(
            placement is None or placement.scale == 1.0 for placement in motion.placements or ()
        )

        def are_free(some: Sequence[int]) -> npt.NDArray[np.bool_]:
            self.job.check()
            if alike:
                return ~motion.collide(some, self._check)
            return np.array([self.check(frame).is_free(motion.codes[frame]) for frame in some])

        n_faces, n_done = self._check.space.topology.n_faces, 0
        blocks = _blocks(frames, block_size(len(frames), n_faces, _BLOCK))
        for block in self.pool.map(are_free, blocks):
            parts.append(block)
            n_done += len(block)
            job.report(n_done, len(frames))
        return np.concatenate(parts)

    def collide_between(
        self, frames: npt.NDArray[np.intp], fractions: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return (n,) whether a pose between a frame of the original motion and the next collides.

        Parameters
        ----------
        frames : (n,)
        fractions : of the way to the next frame, of the poses between
        """
        codes = self.motion.codes

        def collides(frame: int) -> bool:
            return any(
                self.overlap_between(frame, share, codes[frame], codes[frame + 1]) is not None
                for share in fractions.tolist()
            )

        return np.fromiter(self.pool.map(collides, frames.tolist()), np.bool_, len(frames))

    def touch_between(
        self, frames: npt.NDArray[np.intp], codes: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return (n,) whether something touches on the linear path from a frame to the next.

        Parameters
        ----------
        frames : (n,), free like the next ones
        codes : (T, D) of all frames
        """

        def touches(frame: int) -> bool:
            self.job.check()
            checks = [self.check(frame), self.check(frame + 1)]
            rows = codes[frame : frame + 2]
            ends = (
                end_check.exported(end_check.decode(row)[0])
                for end_check, row in zip(checks, rows, strict=True)
            )
            both = self.motion.seen(checks[0], range(frame, frame + 2))
            return both.collide_between(*ends)

        return np.fromiter(self.pool.map(touches, frames.tolist()), np.bool_, len(frames))

    def resolved(self, frame: int, correction: FloatArray | None = None) -> FloatArray | None:
        """Return free (D,) codes near a frame, starting from a correction if there is one.

        Returns
        -------
        codes : (D,) pulled back towards the original frame; None if no free ones are found
        """
        check, problem, target = self.check(frame), self.problem(frame), self.motion.codes[frame]
        start = target if correction is None else target + correction
        start = np.clip(start, problem.low, problem.high)
        nearer = polish(check, problem, start)
        for begin in (start, target) if correction is not None else (target,):
            if nearer is None:
                nearer = self.near(frame, begin)
        if nearer is None:
            return None
        freed = slide_back(check, problem, nearer)
        return freed if self.is_near_enough(frame, freed) else None

    def polished(self, frame: int, codes: FloatArray) -> tuple[FloatArray | None, HalfSpacesOfPose]:
        """Return free codes next to a colliding (D,) pose of a frame, and what separates them."""
        check, problem = self.check(frame), self.problem(frame)
        contacts = Contacts(check)
        freed = polish(check, problem, codes, contacts)
        if freed is not None and not self.is_near_enough(frame, freed):
            freed = None
        return freed, (contacts.normals, contacts.offsets)

    def near(self, frame: int, codes: FloatArray) -> FloatArray | None:
        """Return the free codes nearest to (D,) codes at a frame, None if none are near enough."""
        check, resolver = self.check(frame), self.resolver
        # A known free pose may collide with the body's shape in this frame.
        if len(check.hidden) or check.space is not resolver.check.space:
            resolver = resolver.with_check(check)
        result = resolver.resolve(
            codes, self.options, self.job, placement=self.motion.placement(frame)
        )
        is_kept = result.exactly_free and self.is_near_enough(frame, result.latent)
        return result.latent if is_kept else None

    def softened(self, frame: int) -> FloatArray:
        """Return (D,) codes of less overlap within the largest change, else the original ones."""
        check, problem = self.check(frame), self.problem(frame)
        most = math.inf if self.largest_change is None else self.largest_change
        return LeastOverlap(check, problem, most).find(())

    def is_near_enough(self, frame: int, codes: FloatArray) -> bool:
        """Whether (D,) codes move no vertex of a frame farther than the largest change."""
        if self.largest_change is None:
            return True
        space = self.motion.space(frame, self.resolver.check.space)
        old, new = space.decode(np.stack([self.motion.codes[frame], codes]))
        return float(np.linalg.norm(new - old, axis=1).max()) <= self.largest_change


_FLICKER = 10.0
"""Price of the correction's change from frame to frame, relative to that of the correction."""


def chain_corrections(
    frames: Frames,
    runs: Sequence[Sequence[int]],
    before: FloatArray | None,
    freed: dict[int, FloatArray],
) -> dict[int, FloatArray]:
    """Resolve colliding frames of each run in turn, forwards and backwards.

    Each frame is polished from its target plus the correction of its neighbour, so that contacts
    stay on one side. The cheaper of the two directions is returned.

    Parameters
    ----------
    frames : of the motion
    runs : numbers of colliding frames, ascending
    before : (D,) correction of the frame before the first run; None if that is free
    freed : receives the corrections as frames are resolved, in case the work is stopped

    Returns
    -------
    corrections : (D,) by frame, of the frames that were resolved
    """
    ways: list[tuple[Iterable[int], FloatArray | None]] = []
    for number, run in enumerate(runs):
        ways += [(run, None if number else before), (reversed(run), None)]
    chains = list(frames.pool.map(lambda way: _chained(frames, way[0], way[1], freed), ways))
    chosen: dict[int, FloatArray] = {}
    for number, run in enumerate(runs):
        near, (forwards, backwards) = ways[2 * number][1], chains[2 * number : 2 * number + 2]
        is_nearer = _cost(frames, run, forwards, near) <= _cost(frames, run, backwards, near)
        chosen |= forwards if is_nearer else backwards
    freed.update(chosen)
    return chosen


def _chained(
    frames: Frames,
    order: Iterable[int],
    near: FloatArray | None,
    freed: dict[int, FloatArray],
) -> dict[int, FloatArray]:
    chained: dict[int, FloatArray] = {}
    for frame in order:
        free = frames.resolved(frame, near)
        if free is not None:
            chained[frame] = near = free - frames.motion.codes[frame]
            freed.setdefault(frame, near)
    return chained


def _cost(
    frames: Frames,
    run: Sequence[int],
    chain: Mapping[int, FloatArray],
    before: FloatArray | None,
) -> tuple[int, float]:
    still = np.zeros(frames.motion.codes.shape[1])
    first = still if before is None else before
    rows = np.array([first, *(chain.get(frame, still) for frame in run), still])
    cost = sum(
        weight * np.einsum("td,de,te->", moved, frames.metric, moved)
        for weight, moved in ((1.0, rows), (_FLICKER, np.diff(rows, axis=0)))
    )
    return len(run) - len(chain), float(cost)


@dataclass(frozen=True)
class FrameCollisions:
    """The collisions of one frame.

    Attributes
    ----------
    frame : its number, from 0
    seconds : its time
    n_pairs : number of pairs of faces that count
    deepest : penetration depth of the deepest pair, or the most that a pair lacks of a clearance,
        normalised
    domains : pairs of domains, the first no larger than the second, those with most pairs first
    """

    frame: int
    seconds: float
    n_pairs: int
    deepest: float
    domains: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class FrameExclusions:
    """The pairs that the contact rules exclude in one frame.

    Attributes
    ----------
    frame : its number, from 0
    seconds : its time
    counts : numbers of pairs of faces by rule
    deepest : penetration depth of the deepest pair, normalised
    """

    frame: int
    seconds: float
    counts: RuleCounts
    deepest: float


@dataclass(frozen=True, eq=False)
class ScreenedMotion:
    """The exact check of a motion.

    Attributes
    ----------
    colliding : frames that collide, in order
    in_between : numbers of frames that are free like the next, but with a colliding pose between
    collides_between : numbers of frames that are free like the next, but with contact on the linear
        path of the vertices between; None if this was not checked
    least_distance, least_frame : with a clearance, the least signed distance of all frames, and its
        frame; None if no pair is within the search bound
    left_out : summary of the pairs that the contact rules exclude, if these were looked for
    excluded : the excluded pairs of each frame that was searched for them, in order
    """

    colliding: tuple[FrameCollisions, ...]
    in_between: tuple[int, ...]
    collides_between: tuple[int, ...] | None = None
    least_distance: float | None = None
    least_frame: int | None = None
    left_out: ExcludedPairs = field(default_factory=ExcludedPairs)
    excluded: tuple[FrameExclusions, ...] = ()

    @property
    def deepest(self) -> float:
        """The largest depth of all frames, normalised; 0 without collisions."""
        return max((frame.deepest for frame in self.colliding), default=0.0)


def colliding_domains(
    collisions: SelfCollisions, vertex_domain: npt.NDArray[np.intp], faces: npt.NDArray[np.int32]
) -> tuple[tuple[int, int], ...]:
    """Return pairs of colliding domains, the lower index first, those with most pairs first.

    Parameters
    ----------
    collisions : collisions of the mesh
    vertex_domain, faces : see `screen_frames`
    """
    owners = np.sort(vertex_domain[faces[collisions.pairs][:, :, 0]], axis=1)
    n_domains = int(vertex_domain.max()) + 1
    domains, counts = np.unique(owners @ [n_domains, 1], return_counts=True)
    ordered = domains[np.argsort(-counts, kind="stable")].tolist()
    return tuple(divmod(pair, n_domains) for pair in ordered)


@dataclass(frozen=True, eq=False)
class FrameChecks:
    """How the frames of a motion are made and checked; its functions are thread-safe.

    Attributes
    ----------
    mesh : returns (V, 3) vertices of a frame, or of a pose a share of the way to the next
    find : the exact check of vertices, which takes `counted_only`
    measure : returns where vertices come nearest to each other; None if that is not asked
    touches : returns whether a free frame touches itself on the linear path to the next; None if
        that is not asked
    seen : returns the check of one frame, or of two and the poses between, which replaces `find`,
        `measure` and `touches` if frames hide faces
    collide : returns which of several frames, or of poses a share of the way to the next, collide,
        faster than `find`, and maybe their vertices
    """

    mesh: Callable[[int, float], npt.NDArray[np.floating]]
    find: Callable[..., SelfCollisions]
    measure: Callable[[npt.NDArray[np.floating]], NearestPair | None] | None = None
    touches: Callable[[npt.NDArray[np.floating], npt.NDArray[np.floating]], bool] | None = None
    seen: Callable[[range], ExactCheck] | None = None
    collide: Callable[[Sequence[int], float], _Verdicts] | None = None

    def of(self, frames: range) -> FrameChecks:
        """Return the checks without the faces that any of the frames hides."""
        if self.seen is None:
            return self
        check = self.seen(frames)
        return replace(
            self,
            find=check.find,
            measure=self.measure and check.least_distance,
            touches=self.touches and check.collide_between,
        )

    def colliding_after(self, frames: Sequence[int], shares: Sequence[float]) -> list[int]:
        """Return the frames of which a pose, a share of the way to the next, collides."""
        if self.collide is not None:
            hits = [np.compress(self.collide(frames, share)[0], frames) for share in shares]
            return sorted({int(frame) for some in hits for frame in some})

        def collides(frame: int) -> bool:
            find = self.of(range(frame, frame + 2)).find
            return any(find(self.mesh(frame, at), counted_only=True).colliding for at in shares)

        return list(filter(collides, frames))

    def touches_after(self, frame: int) -> bool:
        """Whether something touches on the linear path from a free frame to the next."""
        touches = self.of(range(frame, frame + 2)).touches
        return touches is not None and touches(self.mesh(frame, 0.0), self.mesh(frame + 1, 0.0))


def screen_frames(
    checks: FrameChecks,
    times: npt.NDArray[np.float64],
    vertex_domain: npt.NDArray[np.intp],
    faces: npt.NDArray[np.int32],
    substeps: int = 1,
    workers: int | None = None,
    job: Job = UNWATCHED,
    *,
    estimated_free: npt.NDArray[np.bool_] | None = None,
    counted_only: bool = True,
) -> ScreenedMotion:
    """Check frames exactly, and poses between them.

    Parameters
    ----------
    checks : of the T frames
    times : (T,) of the frames, in seconds
    vertex_domain : (V,) the part that each vertex belongs to
    faces : (F, 3) of the mesh
    substeps : >= 0, number of evenly spaced poses between two free frames
    workers : threads, one for each available core by default
    job : reports (frames done, T); polled for each frame
    estimated_free : (T,) frames taken as free without a check; None for none
    counted_only : whether to leave out the pairs that the contact rules exclude; if not, they are
        looked for in every n-th frame: see `ExcludedPairs.step_for`

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    nearest: dict[int, float] = {}
    searched: dict[int, FrameExclusions] = {}
    step = ExcludedPairs.step_for(len(times))
    shares = (np.arange(1, substeps + 1) / (substeps + 1)).tolist()

    def is_searched(frame: int) -> bool:
        return not counted_only and frame % step == 0

    def screened_block(frames: range) -> list[FrameCollisions | None]:
        left = [at for at in frames if estimated_free is None or not estimated_free[at]]
        quick = [at for at in left if not is_searched(at)] if checks.measure is None else []
        posed: dict[int, npt.NDArray[np.floating]] = {}
        if checks.collide is not None and quick:
            collides, meshes = checks.collide(quick, 0.0)
            free = set(np.compress(~collides, quick).tolist())
            left = [at for at in left if at not in free]
            posed = {} if meshes is None else dict(zip(quick, meshes, strict=True))
        return [screened(at, posed.get(at)) if at in left else None for at in frames]

    def screened(frame: int, vertices: npt.NDArray[np.floating] | None) -> FrameCollisions | None:
        job.check()
        vertices = checks.mesh(frame, 0.0) if vertices is None else vertices
        of_frame, seconds = checks.of(range(frame, frame + 1)), float(times[frame])
        collisions = of_frame.find(vertices, counted_only=not is_searched(frame))
        if is_searched(frame):
            deepest = float(collisions.excluded_depth.max(initial=0.0))
            searched[frame] = FrameExclusions(frame, seconds, collisions.excluded, deepest)
        if of_frame.measure is not None and (pair := of_frame.measure(vertices)) is not None:
            nearest[frame] = pair.distance
        if not collisions.colliding:
            return None
        domains = colliding_domains(collisions, vertex_domain, faces)
        n_pairs = len(collisions.pairs)
        return FrameCollisions(frame, seconds, n_pairs, collisions.deepest, domains)

    def collide_after(frames: Sequence[int]) -> list[int]:
        job.check()
        return checks.colliding_after(frames, shares)

    def touch_after(frames: Sequence[int]) -> list[int]:
        job.check()
        return list(filter(checks.touches_after, frames))

    n, n_threads = len(times), workers or available_cores()
    size = block_size(n, len(faces), max(1, min(_BLOCK, n // (4 * n_threads))))
    verdicts: list[FrameCollisions | None] = []
    with ThreadPoolExecutor(n_threads, "screening") as pool:
        for block in pool.map(screened_block, _blocks(range(n), size)):
            verdicts += block
            job.report(len(verdicts), n)
        free = [at for at in range(n - 1) if verdicts[at] is None and verdicts[at + 1] is None]
        between, on_path = (
            tuple(at for block in pool.map(of, _blocks(free, size)) for at in block)
            for of in (collide_after, touch_after)
        )
    excluded = tuple(searched[frame] for frame in sorted(searched))
    left_out = ExcludedPairs(step=step)
    for frame in excluded:
        left_out = left_out.with_frame(frame.frame, frame.counts, frame.deepest)
    least = min(nearest, key=lambda frame: (nearest[frame], frame), default=None)
    return ScreenedMotion(
        tuple(filter(None, verdicts)),
        between,
        None if checks.touches is None else on_path,
        None if least is None else nearest[least],
        least,
        left_out,
        excluded,
    )


def screen_motion(
    motion: Motion,
    check: ExactCheck,
    substeps: int = 1,
    workers: int | None = None,
    job: Job = UNWATCHED,
    *,
    continuous: bool = False,
    estimated_free: npt.NDArray[np.bool_] | None = None,
    counted_only: bool = True,
) -> ScreenedMotion:
    """Check all frames of a body's motion, and poses between them: see `screen_frames`.

    Parameters
    ----------
    continuous : whether to check the linear paths between frames
    estimated_free, counted_only : see `screen_frames`

    Raises
    ------
    MissingExtraError : ipctk is not installed, which `continuous` needs.
    """
    space = check.space
    unplaced = check if motion.placements is not None else replace(check, placement=None)

    def collide(frames: Sequence[int], share: float) -> _Verdicts:
        if share or uses_gpu(len(frames), space.topology.n_faces):
            return motion.collide(frames, check, share), None
        meshes = motion.meshes(frames, check)
        return ~unplaced.are_free_meshes(meshes), meshes

    checks = FrameChecks(
        lambda frame, share: motion.vertices(frame, check, share),
        check.find,
        check.least_distance if check.clearance > 0.0 else None,
        check.collide_between if continuous else None,
        None if motion.hidden is None else partial(motion.seen, check),
        collide if motion.hidden is None else None,
    )
    return screen_frames(
        checks,
        motion.times,
        space.vertex_domain,
        space.topology.faces,
        substeps,
        workers,
        job,
        estimated_free=estimated_free,
        counted_only=counted_only,
    )


def contact_report(motion: Motion, check: ExactCheck) -> ContactReport | None:
    """Return how far a motion keeps its contacts; None if these are not known."""
    contacts = None if motion.contacts is None else motion.contacts()
    if contacts is None:
        return None
    return ContactReport.of(contacts, lambda frame: motion.decoded(frame, check.space), check.space)


_LITTLE = 0.25
"""Depth that joints remove from a contact, per mean displacement of the body. A limb that moves
alone removes several times the body's mean displacement; if it is less than this, the overlapping
parts move together."""


_ROUNDED = 1.0 + 1e-4
"""Factor of the largest change that allows for single precision in files."""


class Reason(StrEnum):
    """Why frames were not resolved."""

    NO_JOINT = marked("no joint moves them apart")
    TOO_FAR = marked("resolving them would exceed the largest change")
    NOT_FOUND = marked("no collision-free pose was found")
    BETWEEN = marked("resolving them makes in-between poses collide")
    JERKS = marked("resolving them makes the motion jerk")
    AS_WRITTEN = marked("the file format can't store the correction")
    CLIP_STARTS_LATER = marked("the clip of a body that should move starts later")
    STOPPED = marked("resolving was stopped before they were free")


@dataclass(frozen=True)
class KeptSpan:
    """Successive frames of a motion that were not resolved.

    Attributes
    ----------
    frames : the first and the last frame; in a cycle the last may come before the first
    reason : why they were not resolved
    parts : pairs of domains that overlap in the deepest frame of the result, those with most pairs
        first; empty if this was not checked
    deepest : depth of the deepest overlap in the result, normalised
    is_original : whether the frames are unchanged to the bit; else they have the least overlap that
        was found
    """

    frames: tuple[int, int]
    reason: Reason
    parts: tuple[tuple[int, int], ...] = ()
    deepest: float = 0.0
    is_original: bool = True

    def __contains__(self, frame: int) -> bool:
        """Return whether a frame is one of these."""
        first, last = self.frames
        return first <= frame <= last if first <= last else frame >= first or frame <= last

    def to_json(self, part_names: Sequence[str]) -> dict[str, object]:
        """Return the values for reports, with body parts by name."""
        return {
            "frames": list(self.frames),
            "reason": str(self.reason),
            "parts": [[part_names[a], part_names[b]] for a, b in self.parts],
            "deepest": self.deepest,
            "unchanged": self.is_original,
            "sentence": self.sentence(part_names),
        }

    def sentence(self, part_names: Sequence[str]) -> str:
        """Return a sentence on the frames, the overlapping parts and the reason."""
        first, last = self.frames
        ends = {"first": first, "last": last}
        if self.is_original:
            what = say_number(
                1 + (first != last),
                "frame {first} stays as it was",
                "frames {first} to {last} stay as they were",
                **ends,
            )
        else:
            what = say_number(
                1 + (first != last),
                "frame {first} overlaps as little as was found",
                "frames {first} to {last} overlap as little as was found",
                **ends,
            )
        if not self.parts:
            return say("{frames}: {reason}", frames=what, reason=say(self.reason))
        return say(
            "{frames}: {parts}, {depth:.3g} % deep; {reason}",
            frames=what,
            parts=both(*(part_names[part] for part in self.parts[0])),
            depth=100.0 * self.deepest,
            reason=say(self.reason),
        )


@dataclass(frozen=True, eq=False)
class Guard:
    """Judge the corrected frames of a motion against the original motion.

    Attributes
    ----------
    frames : of the motion, two turns of a cycle
    n : number of frames, of one turn
    was_free : (n,) bool
    was_clear_between : (n,) bool, whether a frame and the next were free, and all poses between
    """

    frames: Frames
    n: int
    was_free: npt.NDArray[np.bool_]
    was_clear_between: npt.NDArray[np.bool_]

    def faults(
        self,
        span: range,
        codes: FloatArray,
        free: npt.NDArray[np.bool_],
        fractions: FloatArray,
    ) -> dict[int, Reason]:
        """Return the frames of a span that are worse than the original, and why.

        Parameters
        ----------
        codes : (n, D) corrected
        free : (n,) bool, set for the frames of the span
        fractions : of the way from a frame to the next, of the poses to check
        """
        frame_numbers = [at % self.n for at in span]
        reasons: dict[int, Reason] = {}
        judged = self.frames.pool.map(lambda at: self._judge(at, codes[at]), frame_numbers)
        for at, (is_free, reason) in zip(frame_numbers, judged, strict=True):
            free[at] = is_free
            if reason is not None:
                reasons[at] = reason
        last, nexts = len(self.frames.motion) - 1, (np.arange(self.n) + 1) % self.n
        is_changed = (codes != self.frames.motion.codes[: self.n]).any(axis=1)
        is_freed = free & ~self.was_free
        judged_ways = (is_changed | is_changed[nexts]) & ~(is_freed | is_freed[nexts])
        pairs = [at % self.n for at in range(span.start - 1, span.stop)]
        pairs = [at for at in pairs if at < last and judged_ways[at]]
        worse = self.frames.pool.map(
            lambda at: self._is_worse_between(at, codes, fractions.tolist()), pairs
        )
        for at, is_worse in zip(pairs, worse, strict=True):
            if is_worse:
                reasons.setdefault(at, Reason.BETWEEN)
        return reasons

    def _is_worse_between(self, at: int, codes: FloatArray, shares: Sequence[float]) -> bool:
        """Whether a pose on the way from a frame to the next is worse than all were there."""

        def between(rows: FloatArray) -> list[SelfCollisions]:
            ends = rows[at], rows[(at + 1) % self.n]
            poses = (self.frames.overlap_between(at, share, *ends) for share in shares)
            return [pose for pose in poses if pose is not None]

        new = between(codes)
        if not new or self.was_clear_between[at]:
            return bool(new)
        was = self.frames.motion.codes[: self.n]
        ends = (at, (at + 1) % self.n)
        old = [*between(was), *(self._overlap(end, was[end]) for end in ends)]
        return any(pose.exceeds(*old) for pose in new)

    def _judge(self, at: int, codes: FloatArray) -> tuple[bool, Reason | None]:
        was = self.frames.motion.codes[at]
        if np.array_equal(was, codes):
            return bool(self.was_free[at]), None
        overlap = self._overlap(at, codes)
        if not self.frames.is_near_enough(at, codes):
            return not overlap.colliding, Reason.TOO_FAR
        is_worse = overlap.colliding and (
            self.was_free[at] or overlap.exceeds(self._overlap(at, was))
        )
        return not overlap.colliding, Reason.NOT_FOUND if is_worse else None

    def _overlap(self, at: int, codes: FloatArray) -> SelfCollisions:
        return self.frames.check(at).collisions(codes)

    def kept(self, run: range, codes: FloatArray, reasons: Mapping[int, Reason]) -> KeptSpan | None:
        """Describe a run of frames that collide, or did; None if it is free and was changed.

        Parameters
        ----------
        run : frames
        codes : (n, D) of the result
        reasons : known reasons, by frame
        """
        frame_numbers = [at % self.n for at in run]
        was = self.frames.motion.codes
        is_original = all(np.array_equal(codes[at], was[at]) for at in frame_numbers)
        deepest = self.frames.pool.map(
            lambda at: self._overlap(at, codes[at]).deepest, frame_numbers
        )
        depth, worst = max(zip(deepest, frame_numbers, strict=True))
        if depth == 0.0 and not is_original:
            return None
        overlap = self._overlap(worst, codes[worst])
        space = self.frames.resolver.check.space
        reason = next((reasons[at] for at in frame_numbers if at in reasons), Reason.NOT_FOUND)
        if overlap.colliding and self._is_carried(worst, codes[worst]):
            reason = Reason.NO_JOINT
        parts = colliding_domains(overlap, space.vertex_domain, space.topology.faces)
        return KeptSpan(
            (frame_numbers[0], frame_numbers[-1]), reason, parts, overlap.deepest, is_original
        )

    def _is_carried(self, at: int, codes: FloatArray) -> bool:
        """Whether no motion of the joints opens the deepest contact of a pose much."""
        contacts = self.frames.contacts(at, codes)
        if contacts is None:
            return False
        normals, _ = contacts
        squared = np.einsum("d,de,e->", normals[0], self.frames.inverse_metric, normals[0])
        return bool(squared < _LITTLE**2)


def is_worse(
    check: ExactCheck,
    old: npt.NDArray[np.floating],
    new: npt.NDArray[np.floating],
    largest_change: float | None,
) -> bool:
    """Whether a vertex of a frame moves too far, or there are more or deeper collisions.

    Parameters
    ----------
    check : of the frame
    old, new : (V, 3) exported vertices
    largest_change : of a vertex, normalised; None for no limit
    """
    if largest_change is not None:
        size = check.body_size * (1.0 if check.placement is None else check.placement.scale)
        if np.linalg.norm(new - old, axis=1).max() > largest_change * size * _ROUNDED:
            return True
    overlap = check.find(new)
    return overlap.colliding and overlap.exceeds(check.find(old))


def worse_spans(
    before: Motion,
    after: Motion,
    spans: Sequence[range],
    check: ExactCheck,
    largest_change: float | None,
) -> list[range]:
    """Return the spans in which a frame of a motion is worse than the original.

    Parameters
    ----------
    before, after : motions with the same number of frames
    spans : to check
    check : of the body's poses
    largest_change : see `is_worse`
    """

    def is_frame_worse(frame: int) -> bool:
        old, new = (motion.vertices(frame, check) for motion in (before, after))
        return is_worse(before.check(frame, check), old, new, largest_change)

    return [span for span in spans if any(map(is_frame_worse, span))]
