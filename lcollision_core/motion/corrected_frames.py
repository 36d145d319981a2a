"""The frames of a motion that is resolved: as they were, and as corrected so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress

import numpy as np
import numpy.typing as npt

from lcollision_core.jobs import Job
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.frames import Frames, Guard, KeptSpan, Reason
from lcollision_core.motion.motion import (
    NOMINAL_RATE,
    Motion,
    colliding_spans,
    runs,
    standing_parts,
)
from lcollision_core.motion.span_program import SMOOTHNESS, TimeKernel
from lcollision_core.options import MotionOptions

_SOFT_ROUNDS = 6
"""Most rounds of smoothing corrections that remove overlap, each without the frames that became
worse."""


@dataclass(frozen=True, eq=False)
class MotionProblem:
    """A motion to resolve, and the exact check of it; frame t of a cycle is frame t modulo n.

    Attributes
    ----------
    motion, options : the original, and how to resolve it
    within : the frames that may change
    frames : of the motion, two turns of a cycle; those of the check, of solving and of judging
        differ in their jobs
    n : number of frames, without the repeated one of a cycle
    before : (T,) whether each frame was free
    between : frames that were free like the next, but with a colliding pose between
    apart : (n,) frames in which patches that should touch did not
    guard : judges corrected frames
    stuck : frames in which the locked codes alone place faces that collide
    standing : (T, K) the body parts that stay on the ground
    """

    motion: Motion
    options: MotionOptions
    within: range
    frames: Frames
    n: int
    before: npt.NDArray[np.bool_]
    between: npt.NDArray[np.intp]
    apart: npt.NDArray[np.bool_]
    guard: Guard
    stuck: frozenset[int] = frozenset()
    standing: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), np.bool_))

    @classmethod
    def of(
        cls,
        motion: Motion,
        frames: Frames,
        options: MotionOptions,
        within: range,
        up: npt.ArrayLike,
        checking: Job,
    ) -> MotionProblem:
        """Check the original motion."""
        n = len(motion) - 1 if motion.is_cycle else len(motion)
        before = np.ones(len(motion), dtype=np.bool_)
        before[within.start : within.stop] = frames.are_free(within, checking)
        if motion.is_cycle:
            before[[0, -1]] = before[[0, -1]].all()
        pairs = free_pairs(before, within)
        hit = frames.collide_between(pairs, fractions_of(options.substeps))
        was_clear_between = np.zeros(n, dtype=np.bool_)
        was_clear_between[pairs[~hit]] = True
        if options.continuous:
            hit |= frames.touch_between(pairs, motion.codes)
        apart = np.zeros(n, dtype=np.bool_)
        if frames.kept_contacts is not None:
            own = range(max(within.start, 0), min(within.stop, n))
            pulls = frames.pool.map(frames.pulls, own, motion.codes[own.start : own.stop])
            apart[own.start : own.stop] = [pull is not None and pull.n_apart > 0 for pull in pulls]
        has_locks = options.frame.locked_domains or options.frame.locked_codes
        self = cls(
            motion,
            options,
            within,
            frames,
            n,
            before,
            pairs[hit],
            apart,
            Guard(frames, n, before[:n], was_clear_between),
        )
        stuck = self._stuck_frames() if has_locks else frozenset[int]()
        return replace(self, stuck=stuck, standing=self._standing_parts(up))

    def _stuck_frames(self) -> frozenset[int]:
        places = [(at, 0.0) for at in np.flatnonzero(~self.before[: self.n]).tolist()]
        places += [(at, share) for at in self.between.tolist() for share in self.fractions.tolist()]
        stuck = self.frames.pool.map(lambda place: self.frames.is_stuck(*place), places)
        ends = [(at, at + 1) if share else (at,) for at, share in compress(places, stuck)]
        return frozenset(at % self.n for both in ends for at in both)

    def _standing_parts(self, up: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        check, feet = self.frames.resolver.check, self.options.feet
        standing = np.zeros((len(self.motion), check.space.n_domains), dtype=np.bool_)
        if self.options.keep_feet and (self.colliding | self.apart).any():
            if not feet:
                return standing_parts(self.motion, check, up)
            standing[:, sorted(feet)] = True
        return standing

    @cached_property
    def is_cycle(self) -> bool:
        """Whether the first frame follows the last."""
        return self.motion.is_cycle

    @cached_property
    def colliding(self) -> npt.NDArray[np.bool_]:
        """(n,) frames that collided, or were next to a colliding pose between frames."""
        colliding = ~self.before[: self.n]
        colliding[np.concatenate([self.between, self.between + 1]) % self.n] = True
        return colliding

    @cached_property
    def may_change(self) -> npt.NDArray[np.bool_]:
        """(n,) whether each frame may change."""
        return np.isin(np.arange(self.n), np.asarray(self.within) % self.n)

    @cached_property
    def fractions(self) -> FloatArray:
        """Fractions of the way from a frame to the next of the poses that are checked."""
        return fractions_of(self.options.substeps)

    @property
    def all_frames(self) -> npt.NDArray[np.intp]:
        """(T,) the frames, modulo n."""
        return np.arange(len(self.motion)) % self.n

    @property
    def easing(self) -> int:
        """Number of frames over which a correction fades."""
        easing = self.options.easing
        return self.motion.in_frames(easing) if easing else 0

    @property
    def smoothness(self) -> float:
        """The weight of acceleration: see `SMOOTHNESS`."""
        return SMOOTHNESS * (self.motion.rate / NOMINAL_RATE) ** 4

    def own(self, span: range) -> npt.NDArray[np.intp]:
        """Return the frames of a span, modulo n."""
        return np.asarray(span) % self.n

    def places(self, span: range) -> dict[int, int]:
        """Return the positions of a span's frames in it, by frame modulo n."""
        return {at: place for place, at in enumerate(self.own(span).tolist())}

    def is_round(self, span: range) -> bool:
        """Whether a span is a whole cycle."""
        return self.is_cycle and len(span) == self.n

    def with_still_feet(self, frames: Frames, span: range) -> Frames:
        """Return frames in which the parts that stand in a span stay where they are."""
        feet = np.flatnonzero(self.standing[self.own(span)].any(axis=0)).tolist()
        still = frames.options.still_domains.union(feet)
        return replace(frames, options=replace(frames.options, still_domains=still))

    def applied(self, span: range, corrections: FloatArray) -> FloatArray:
        """Add (len(span), D) corrections to a span, within limits; adding 0 changes no bit."""
        own = self.own(span)
        targets = self.motion.codes[own]
        bounds = [self.frames.limits(at) for at in own.tolist()]
        low, high = (np.array(side) for side in zip(*bounds, strict=True))
        return added(targets, np.clip(targets + corrections, low, high) - targets)

    def smoothed(
        self, span: range, wanted: FloatArray, pinned: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return smooth (len(span), D) corrections near the wanted ones, with some given."""
        size, is_round = wanted.shape[1], self.is_round(span)
        is_open = not self.is_cycle and span.start == 0, not self.is_cycle and span.stop == self.n
        before, after = (
            None if is_end_open or is_round else np.zeros((2, size)) for is_end_open in is_open
        )
        kernel = TimeKernel.of(
            len(span), self.smoothness, before, after, pinned, size, is_cycle=is_round
        )
        return kernel.spread @ wanted + kernel.mean


@dataclass(eq=False)
class CorrectedFrames:
    """The frames of a motion as corrected so far, and those that are still to be corrected.

    Attributes
    ----------
    problem : the original frames, and their check
    codes, is_free : (n, D) and (n,), the current codes and whether they are free
    is_changed : (n,) frames of solved spans
    colliding, apart : (n,) frames that should change, see `MotionProblem`
    reasons : of frames that stay unchanged unless some overlap can be removed
    """

    problem: MotionProblem
    codes: FloatArray = field(init=False)
    is_free: npt.NDArray[np.bool_] = field(init=False)
    is_changed: npt.NDArray[np.bool_] = field(init=False)
    colliding: npt.NDArray[np.bool_] = field(init=False)
    apart: npt.NDArray[np.bool_] = field(init=False)
    reasons: dict[int, Reason] = field(init=False)

    def __post_init__(self) -> None:
        problem = self.problem
        self.codes = problem.motion.codes[: problem.n].copy()
        self.is_free = problem.before[: problem.n].copy()
        self.is_changed = np.zeros(problem.n, dtype=np.bool_)
        self.colliding, self.apart = problem.colliding.copy(), problem.apart.copy()
        self.reasons = dict.fromkeys(problem.stuck, Reason.NO_JOINT)

    @property
    def wanted(self) -> npt.NDArray[np.bool_]:
        """(n,) frames that should change."""
        return self.colliding | self.apart

    @property
    def barred(self) -> npt.NDArray[np.bool_]:
        """(n,) frames that stay unchanged, unless some overlap can be removed."""
        return np.isin(np.arange(self.problem.n), list(self.reasons))

    @property
    def is_moved(self) -> npt.NDArray[np.bool_]:
        """(n,) frames with other codes than before."""
        moved: npt.NDArray[np.bool_] = (
            self.codes != self.problem.motion.codes[: self.problem.n]
        ).any(axis=1)
        return moved

    @property
    def is_left(self) -> npt.NDArray[np.bool_]:
        """(n,) frames that should change, and were not freed."""
        return self.wanted & ~(self.is_free & self.is_moved)

    def spans(self) -> list[range]:
        """Return the spans to solve, with the frames over which their corrections fade."""
        problem = self.problem
        return colliding_spans(
            self.wanted, problem.easing, problem.within, problem.is_cycle, self.barred
        )

    def bar(self, frames: npt.NDArray[np.intp], reason: Reason) -> None:
        """Leave frames out of the spans to solve."""
        self.reasons |= dict.fromkeys(frames.tolist(), reason)

    def put_back(self, span: range) -> None:
        """Make a span what it was."""
        problem, own = self.problem, self.problem.own(span)
        self.codes[own], self.is_free[own] = problem.motion.codes[own], problem.before[own]
        self.is_changed[own] = False

    def put_back_unmoved(self) -> None:
        """Make solved spans, whose codes are what they were, unchanged."""
        is_moved = self.is_moved
        for span in runs(self.is_changed):
            if not is_moved[span.start : span.stop].any():
                self.put_back(span)

    def faults(self, span: range) -> dict[int, Reason]:
        """Return the frames of a span that are worse than the original; update `is_free`."""
        problem = self.problem
        return problem.guard.faults(span, self.codes, self.is_free, problem.fractions)

    def take(self, span: range, codes: FloatArray) -> dict[int, Reason]:
        """Set the (len(span), D) codes of a span, unless that makes frames worse.

        Returns
        -------
        faults : the frames that it would make worse, and why; the span then stays as it was
        """
        own = self.problem.own(span)
        before = self.codes[own], self.is_free[own], self.is_changed[own]
        self.codes[own], self.is_changed[own] = codes, True
        faults = self.faults(span)
        if faults:
            self.codes[own], self.is_free[own], self.is_changed[own] = before
        return faults

    def fit(
        self, span: range, fixed: Mapping[int, FloatArray], wanted: FloatArray | None = None
    ) -> None:
        """Correct a span smoothly where that makes nothing worse.

        Parameters
        ----------
        fixed : (D,) corrections of some frames, by their place in the span; others ease to them
        wanted : (len(span), D) corrections to come near to; 0 if None
        """
        problem, pinned = self.problem, dict(fixed)
        n, size = problem.n, problem.motion.codes.shape[1]
        places = problem.places(span)
        near = np.zeros((len(span), size)) if wanted is None else wanted
        for _ in range(_SOFT_ROUNDS):
            smooth = problem.smoothed(span, near, pinned)
            if not smooth.any():
                break
            faults = self.take(span, problem.applied(span, smooth))
            if not faults:
                break
            # Keep the faults still, and smooth the others around them.
            still = {places.get(at, -1) for fault in faults for at in (fault, (fault + 1) % n)}
            pinned |= dict.fromkeys(still - {-1}, np.zeros(size))

    def soften(self) -> None:
        """Reduce the overlap of frames that stayed, where that makes nothing worse."""
        self.put_back_unmoved()
        problem, frames = self.problem, self.problem.frames
        left = self.colliding & ~self.is_changed
        for run in colliding_spans(left, 0, None, problem.is_cycle):
            span = self._eased(run)
            own = problem.own(span)
            wanted = np.zeros(problem.motion.codes[own].shape)
            inside = [number for number, at in enumerate(own) if self.colliding[at]]
            softened = frames.pool.map(lambda at: frames.softened(int(at)), own[inside])
            for number, codes in zip(inside, softened, strict=True):
                wanted[number] = codes - problem.motion.codes[own[number]]
            self.fit(span, {}, wanted)

    def _eased(self, run: range) -> range:
        """Extend a run by the frames on both sides over which its correction may fade."""
        problem, n = self.problem, self.problem.n
        may_ease = problem.may_change & ~(self.is_changed | self.colliding)

        def steps(places: range) -> int:
            inside = [at for at in places if problem.is_cycle or 0 <= at < n]
            usable = [bool(may_ease[at % n]) for at in inside]
            return [*usable, False].index(False)

        first, easing = run.start, min(problem.easing, (n - len(run)) // 2)
        before = steps(range(first - 1, first - 1 - easing, -1))
        return range(first - before, run.stop + steps(range(run.stop, run.stop + easing)))

    def kept(self) -> tuple[KeptSpan, ...]:
        """Return the frames that were not resolved, and why."""
        is_moved = self.is_moved
        is_left = (self.barred & self.colliding & ~(self.is_free & is_moved)) | ~self.is_free
        spans = [
            self.problem.guard.kept(run, self.codes, self.reasons)
            for side in (is_left & is_moved, is_left & ~is_moved)
            for run in colliding_spans(side, 0, None, self.problem.is_cycle)
        ]
        return tuple(sorted(filter(None, spans), key=lambda span: span.frames))


def added(targets: FloatArray, corrections: FloatArray) -> FloatArray:
    """Add corrections to frames; adding 0 changes no bit."""
    return np.where(corrections != 0.0, targets + corrections, targets)


def free_pairs(is_free: npt.NDArray[np.bool_], within: range) -> npt.NDArray[np.intp]:
    """Return the frames that, like the next one, are free and within a range.

    Parameters
    ----------
    is_free : (T,)
    """
    usable = is_free & np.isin(np.arange(len(is_free)), within)
    return np.flatnonzero(usable[:-1] & usable[1:])


def fractions_of(substeps: int) -> FloatArray:
    """Return the fractions of the way between frames of evenly spaced poses."""
    return np.arange(1, substeps + 1) / (substeps + 1)
