"""Solve a span of a motion: window by window, so that memory does not grow with the span."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Lock
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import CancelledError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.corrected_frames import (
    CorrectedFrames,
    added,
    fractions_of,
)
from lcollision_core.motion.frames import Frames, chain_corrections
from lcollision_core.motion.motion import knots_of, runs, windows
from lcollision_core.motion.span_program import SpanProgram

WINDOW, OVERLAP = 120, 24
"""Most frames, at 30 a second, that are resolved together, and the number of these that the next
window resolves again: the program's cost grows with the square of the frames."""

_SPACING = 4
"""Distance of the frames, at 30 a second, that are resolved first."""

Solved = tuple[FloatArray, bool]
"""The (D,) codes of a frame, and whether they are free."""


class SpanRecord:
    """Which frames of spans are done: those of an earlier run, and new ones; thread-safe.

    Parameters
    ----------
    job : reports (frames done, all of them)
    done : frames of an earlier run
    keep : called with each new frame once it is done

    Attributes
    ----------
    job, done : as given; `done` may be replaced
    """

    def __init__(
        self,
        job: Job = UNWATCHED,
        done: Mapping[int, Solved] | None = None,
        keep: Callable[[int, Solved], None] | None = None,
    ) -> None:
        self.job, self.done = job, done or {}
        self._keep, self._lock, self._n_frames, self._n_done = keep, Lock(), 0, 0.0

    def add(self, n_frames: int) -> None:
        """Count frames that are to be solved."""
        self._n_frames += n_frames

    def report_of(self, n_frames: int) -> Callable[[float], None]:
        """Return the report of the share of some frames that is done, in [0, 1]; it never falls."""
        reported = 0.0

        def report(share: float) -> None:
            nonlocal reported
            with self._lock:
                self._n_done += n_frames * max(0.0, share - reported)
                reported = max(reported, share)
                self.job.report(min(round(self._n_done), self._n_frames), self._n_frames)

        return report

    def keep(self, frame: int, solved: Solved) -> None:
        """Keep a frame that is done."""
        if self._keep is not None:
            with self._lock:
                self._keep(frame, solved)


@dataclass(eq=False)
class SpanSolver:
    """Solve one span of a motion.

    Attributes
    ----------
    corrected : the frames of the motion; receives the codes
    frames : of the motion, as this span is to be solved
    span : of frames
    substeps : (n,) number of poses that are checked after each frame of the motion
    record : of all spans
    cuts_off : see `SpanProgram`
    n_solved : number of frames in finished windows
    freed : (D,) corrections that free frames of the unfinished window, by frame
    """

    corrected: CorrectedFrames
    frames: Frames
    span: range
    substeps: npt.NDArray[np.intp]
    record: SpanRecord
    cuts_off: bool
    n_solved: int = 0
    freed: dict[int, FloatArray] = field(default_factory=dict)

    def solve(self) -> None:
        """Correct all frames of the span."""
        self.frames.job.check()
        corrected, problem, span = self.corrected, self.corrected.problem, self.span
        corrected.is_changed[problem.own(span)] = True
        in_frames, reached, done = problem.motion.in_frames, span.start, self.record.done
        for window in windows(span, in_frames(WINDOW), in_frames(OVERLAP)):
            own = problem.own(window).tolist()
            known = [done[at] for at in own if at in done]
            is_new = len(known) < len(window)
            # Frames that the next window corrects again count once.
            report = self.record.report_of(window.stop - reached)
            if is_new:
                self.freed = {}
                known = _Window(self, window, *self._beyond(window), report).solved()
            for at, solved in zip(own, known, strict=True):
                corrected.codes[at], corrected.is_free[at] = solved
                if is_new:
                    self.record.keep(at, solved)
            report(1.0)
            reached = window.stop
            self.n_solved = reached - span.start

    def _beyond(self, window: range) -> tuple[FloatArray | None, FloatArray | None]:
        """Return the corrections of two frames on either side of a window, None where it is open.

        Those beyond the ends of the span, 0, and of its finished windows are known.
        """
        problem, span, codes = self.corrected.problem, self.span, self.corrected.codes
        targets, n, is_round = problem.motion.codes, problem.n, problem.is_round(span)

        def corrections(first: int) -> FloatArray:
            two = np.arange(first, first + 2)
            inside = [is_round or at in span for at in two.tolist()]
            return np.where(np.array(inside)[:, None], codes[two % n] - targets[two % n], 0.0)

        begins, ends = window.start == span.start, window.stop == span.stop
        is_open = begins if is_round else not problem.is_cycle and window.start == 0
        before = None if is_open else corrections(window.start - 2)
        is_open = begins if is_round else not problem.is_cycle and window.stop == n
        return before, corrections(window.stop) if ends and not is_open else None

    def keep_finished(self) -> range:
        """Keep what a stop left finished and makes nothing worse; return the rest of the span.

        That is the finished beginning, up to free frames over which the correction fades, and the
        frames that were freed after it.
        """
        rest = self._without_beginning()
        freed = self._freed_in(rest)
        if fixed := {at: freed[frame] for at, frame in enumerate(rest) if frame in freed}:
            self.corrected.fit(rest, fixed)
        return rest

    def _without_beginning(self) -> range:
        corrected, problem, span = self.corrected, self.corrected.problem, self.span
        own = problem.own(span)
        moved, is_wanted = corrected.codes[own] - problem.motion.codes[own], corrected.wanted[own]
        corrected.put_back(span)
        if problem.is_round(span):
            return span
        for run in reversed(runs(is_wanted[: self.n_solved])):
            after = is_wanted[run.stop : run.stop + problem.easing]
            n_fading = int([*after, True].index(True))
            if not n_fading:
                continue
            part = range(span.start, span.start + run.stop + n_fading)
            share = np.arange(1, n_fading + 1)[:, None] / (n_fading + 1)
            corrections = moved[: len(part)].copy()
            corrections[run.stop :] = (1.0 - share**2 * (3.0 - 2.0 * share)) * moved[run.stop - 1]
            if not corrected.take(part, problem.applied(part, corrections)):
                return range(part.stop, span.stop)
        return span

    def _freed_in(self, rest: range) -> dict[int, FloatArray]:
        """Return the freed frames and, polished from their corrections, those between them."""
        freed, problem = self.freed, self.corrected.problem
        if not freed:
            return freed
        frames = problem.with_still_feet(problem.guard.frames, self.span)
        known, targets, wanted = sorted(freed), frames.motion.codes, self.corrected.wanted
        inside = [at for at in rest if known[0] < at < known[-1] and at not in freed]
        between = [at for at in inside if wanted[at % problem.n]]
        ways = np.array([freed[at] for at in known]).T
        starts = [targets[at] + [np.interp(at, known, way) for way in ways] for at in between]
        polished = frames.pool.map(frames.polished, between, starts)
        return freed | {
            at: codes - targets[at]
            for at, (codes, _) in zip(between, polished, strict=True)
            if codes is not None
        }


class _Solution(NamedTuple):
    """Corrections of the frames of a window.

    Attributes
    ----------
    corrections : (n, D)
    is_free : (n,) whether each frame is free with them
    freed : (D,) corrections of frames that another search can begin from, by place in the window
    is_good : whether all frames are free, near enough and move smoothly
    worth : sort key, less is better: the number of frames that are left or move too far, what
        could not be freed, and the cost
    """

    corrections: FloatArray
    is_free: npt.NDArray[np.bool_]
    freed: dict[int, FloatArray]
    is_good: bool
    worth: tuple[int, float, int, float]


@dataclass(frozen=True, eq=False)
class _Window:
    """A window of a span whose earlier windows are done.

    Attributes
    ----------
    solver : of the span; receives corrections that free frames, in case the work is stopped
    window : of frames
    before, after, report : see `SpanProgram`
    """

    solver: SpanSolver
    window: range
    before: FloatArray | None
    after: FloatArray | None
    report: Callable[[float], None]

    @property
    def _own(self) -> npt.NDArray[np.intp]:
        return self.solver.corrected.problem.own(self.window)

    @property
    def _was_free(self) -> npt.NDArray[np.bool_]:
        return self.solver.corrected.problem.before[self._own]

    def solved(self) -> list[Solved]:
        """Return the best of up to three solutions."""
        motion = self.solver.frames.motion
        few = knots_of(self._was_free, motion.in_frames(_SPACING))
        every = np.ones_like(few)
        # Few frames first; else all, from those that are free; else all, each resolved first.
        solutions = [self._solution(few, {})]
        if not solutions[0].is_good and solutions[0].freed:
            solutions.append(self._solution(every, solutions[0].freed))
        if not solutions[-1].is_good and not few.all():
            solutions.append(self._solution(every, {}))
        best = min(solutions, key=lambda solution: solution.worth)
        targets = motion.codes[self.window.start : self.window.stop]
        return list(zip(added(targets, best.corrections), best.is_free.tolist(), strict=True))

    def _solution(self, knots: npt.NDArray[np.bool_], begin: Mapping[int, FloatArray]) -> _Solution:
        """Resolve the knots first, beginning from corrections that free some frames."""
        solver, first, was_free = self.solver, self.window.start, self._was_free
        frames, problem = solver.frames, solver.corrected.problem
        start = np.zeros((len(was_free), frames.motion.codes.shape[1]))
        known = was_free.copy()
        for at, correction in begin.items():
            start[at], known[at] = correction, True
        near = self.before[1] if self.before is not None and not was_free[0] else None
        colliding = [[first + at for at in run if knots[at]] for run in runs(~known)]
        for frame, correction in chain_corrections(frames, colliding, near, solver.freed).items():
            start[frame - first], known[frame - first] = correction, True
        program = SpanProgram(
            frames,
            self.window,
            start,
            known,
            self.before,
            self.after,
            problem.smoothness,
            [fractions_of(solver.substeps[at]) for at in self._own],
            knots,
            solver.cuts_off,
            problem.is_round(self.window),
            self.report,
        )
        try:
            corrections, free = program.solve()
        except CancelledError:
            solver.freed.update({first + at: moved for at, moved in program.so_far().items()})
            raise
        far, is_jerky = self._too_far(corrections), program.is_jerky(corrections)
        moved = program.is_free_now & ~was_free & ~far & (not is_jerky)
        return _Solution(
            corrections,
            free,
            {at: corrections[at] for at in np.flatnonzero(moved).tolist()},
            program.is_settled and not is_jerky and not far.any(),
            (int((~free | far).sum()), *program.rank, program.cost(corrections)),
        )

    def _too_far(self, corrections: FloatArray) -> npt.NDArray[np.bool_]:
        """Return (n,) which (n, D) corrections exceed the largest change."""
        frames = self.solver.corrected.problem.guard.frames
        targets = frames.motion.codes
        near = frames.pool.map(
            lambda at, moved: not moved.any() or frames.is_near_enough(at, targets[at] + moved),
            self.window,
            corrections,
        )
        return ~np.array(list(near))
