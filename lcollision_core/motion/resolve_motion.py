"""Resolve a motion: free its colliding spans smoothly, and leave all else unchanged."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import compress
from threading import Lock
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import CancelledError
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.contacts import KeptContacts
from lcollision_core.motion.frames import Frames, Guard, KeptSpan, Reason, chain_corrections
from lcollision_core.motion.ground import GroundReport
from lcollision_core.motion.motion import (
    NOMINAL_RATE,
    Motion,
    colliding_spans,
    knots_of,
    runs,
    standing_parts,
    windows,
)
from lcollision_core.motion.span_program import SMOOTHNESS, SpanProgram, TimeKernel
from lcollision_core.motion.stuck_pairs import DomainPair, stuck_pairs
from lcollision_core.options import MotionOptions
from lcollision_core.resolve import BodyAlone, PoseResolver
from lcollision_core.resolve.problem import single_torch_thread

WINDOW, OVERLAP = 120, 24
"""Most frames, at 30 a second, that are resolved together, and the number of these that the next
window resolves again: the program's cost grows with the square of the frames."""

_SPACING = 4
"""Distance of the frames, at 30 a second, that are resolved first."""

_SOFT_ROUNDS = 6
"""Most rounds of smoothing corrections that remove overlap, each without the frames that became
worse."""

_JERK, _JERKIER = 0.03, 3.0
"""Second difference of successive frames at 30 a second, as root mean square over the vertices in
normalised length, from which a correction jerks, unless the original bends a third as much."""

_EXTRA_CLEARANCES, _MOST_BETWEEN = (0.0, 0.0, 0.002, 0.004, 0.008), 7
"""Normalised distance added between parts in poses between frames, for each round of solving spans
that touch there, and the most such poses per frame."""


@dataclass(frozen=True, eq=False)
class ResolvedMotion:
    """The result of resolving a motion.

    Attributes
    ----------
    motion : the frames; those outside `spans` are unchanged to the bit
    before, after : (T,) bool, whether each frame was and is free by the exact check; True for
        frames that were not checked
    spans : of frames that may have changed
    standing : (T, K) bool, the body parts that were kept on the ground in each frame
    touching : numbers of frames in `spans` that are free like the next, but with contact on the
        linear path of the vertices between; None if this was not checked
    unfinished : spans, or ends of spans, of which a stop has left frames colliding
    rough : spans, or ends of spans, that a stop has left freed frame by frame, not yet smooth
    kept : frames that were not resolved, and why
    ground : how the motion stands on the ground of its scene; None if this was not measured
    """

    motion: Motion
    before: npt.NDArray[np.bool_]
    after: npt.NDArray[np.bool_]
    spans: tuple[range, ...]
    standing: npt.NDArray[np.bool_]
    touching: tuple[int, ...] | None = None
    unfinished: tuple[range, ...] = ()
    rough: tuple[range, ...] = ()
    kept: tuple[KeptSpan, ...] = ()
    ground: GroundReport | None = None


_BeginWithout = Callable[[Sequence[DomainPair], Sequence[int], Motion], "_Resolution"]

Solved = tuple[FloatArray, bool]
"""The (D,) codes of a frame, and whether they are free."""


def resolve_motion(
    resolver: PoseResolver,
    motion: Motion,
    up: npt.ArrayLike,
    options: MotionOptions | None = None,
    workers: int | None = None,
    job: Job = UNWATCHED,
    *,
    within: range | None = None,
    done: Mapping[int, Solved] | None = None,
    keep: Callable[[int, Solved], None] | None = None,
    stop: Job | None = None,
    checking: Callable[[int, int], None] | None = None,
) -> ResolvedMotion:
    """Resolve the self-collisions of a motion.

    Each span of frames that collide, or have a colliding pose between them, with frames on both
    sides over which its correction fades, is one program. Of all corrections that keep its frames
    and the poses between them free, it finds those that are smallest and change the motion's
    acceleration least. Long spans are resolved window by window, so that memory does not grow with
    the motion. A cycle, whose last frame repeats the first, stays one: spans continue across its
    seam. With `continuous` in the options, spans in which something touches on the linear path of
    the vertices between two frames are solved again with more poses there, until nothing does.

    No frame gets more pairs or deeper ones than it had, no free frame collides, no vertex moves
    farther than the largest change, and no correction jerks. Poses between two frames, neither of
    which is freed, get no more pairs or deeper ones than there were from one to the next. Frames
    that cannot be resolved within these limits are left out, and the frames around them are
    resolved without them. They then get the least overlap found within the limits, or stay
    unchanged to the bit.

    In a scene, each body is resolved separately first, and then the spans that still collide, as
    where bodies meet. If that makes a frame worse, all bodies are resolved together from the start.

    Parameters
    ----------
    resolver : of the body's poses
    motion : T frames
    up : (3,) unit vector, to find parts that stand on the ground
    options : the defaults if None
    workers : threads, one for each available core by default; results do not depend on it
    job : reports (frames of colliding spans done, all of them), first with 0 done; the total grows
        when spans are computed again; polled for each frame
    within : the frames that are checked and may change; all if None
    done : frames of an earlier run; windows whose frames are all done are not computed again
    keep : called with each frame of a new window once that is done, from one thread at a time
    stop : ends the work early, polled like `job`: the result has the finished spans, the finished
        windows of long ones, and the frames that were freed in others, where that makes none worse
    checking : called with (frames checked, frames to check) before spans are known

    Returns
    -------
    result : ResolvedMotion; a frame that cannot be resolved is False in `after`, and does not
        affect the others

    Raises
    ------
    CancelledError : the job was cancelled, or `stop` before all frames were checked.
    MissingExtraError : ipctk is not installed, which `continuous` needs.
    """
    chosen = options or MotionOptions()
    n_workers = workers or available_cores()
    with (
        single_torch_thread(),
        ThreadPoolExecutor(n_workers, "motion frames") as pool,
        ThreadPoolExecutor(n_workers, "motion spans") as outer,
    ):
        watched = job.part() if stop is None else Job(None, job, stop)

        def begin(
            motion: Motion,
            job_of_check: Job,
            checking: Job = UNWATCHED,
            options: MotionOptions = chosen,
            resolver: PoseResolver = resolver,
        ) -> _Resolution:
            is_cycle = motion.is_cycle
            frames = Frames(
                motion.two_turns() if is_cycle else motion,
                resolver,
                replace(options.frame, largest_change=None),
                pool,
                job_of_check,
                options.continuous,
                largest_change=options.frame.largest_change,
                kept_contacts=_contacts_of(motion, options),
            )
            chosen_frames = range(len(motion)) if within is None else within
            run = _Resolution.begin(motion, frames, options, chosen_frames, up, checking)
            # Finished frames are judged after a stop too.
            run.guard = replace(run.guard, frames=replace(frames, job=job.part()))
            run.frames, run.outer = replace(frames, job=watched), outer
            run.job, run.stop, run.done, run.keep = job, stop, done or {}, keep
            run.begin_without = begin_without
            return run

        def begin_without(
            domain_pairs: Sequence[DomainPair], locked: Sequence[int], motion: Motion
        ) -> _Resolution:
            check = resolver.check.without_pairs(domain_pairs)
            locks = chosen.frame.locked_codes.union(locked)
            options = replace(chosen, frame=replace(chosen.frame, locked_codes=locks))
            rest = begin(motion, job.part(), UNWATCHED, options, resolver.with_check(check))
            rest.job, rest.done, rest.keep, rest.begin_without = job.part(), {}, None, None
            return rest

        run = begin(motion, watched, Job(checking))
        bodies = [body for body in resolver.bodies if not body.is_locked(chosen.frame)]
        is_plain = motion.placements is None and motion.hidden is None and motion.contacts is None
        if len(bodies) > 1 and is_plain and run.wanted.any():
            reports = _Reports(job, len(bodies) + 1)
            each, is_rough = _each_by_itself(run, bodies, up, workers, reports)
            together = begin(each, job.part())
            # Where bodies meet, poses that contacts allow came back, and ended in jerks.
            together.cuts_off = True
            together.job = job.part(reports.of(len(bodies)))
            both = together.result()
            resolved = run.judged(both)
            if resolved is not None:
                is_rough[[frame for span in both.rough for frame in span]] = True
                moved = (resolved.motion.codes != motion.codes).any(axis=1)
                return replace(resolved, rough=tuple(runs(is_rough & moved)))
            run.done, run.keep = {}, None
        return run.result()


class _Reports:
    """Progress of several stages as one: frames done, and all frames known so far."""

    def __init__(self, job: Job, n_stages: int) -> None:
        self._job, self._counts, self._lock = job, [(0, 0)] * n_stages, Lock()

    def of(self, stage: int) -> Callable[[int, int], None]:
        """Return the report of one stage."""

        def report(n_done: int, n_frames: int) -> None:
            with self._lock:
                self._counts[stage] = n_done, n_frames
                self._job.report(*map(sum, zip(*self._counts, strict=True)))

        return report


def _each_by_itself(
    run: _Resolution,
    bodies: Sequence[BodyAlone],
    up: npt.ArrayLike,
    workers: int | None,
    reports: _Reports,
) -> tuple[Motion, npt.NDArray[np.bool_]]:
    """Return the motion of a scene with the self-collisions of each body resolved.

    Also return (T,) whether each frame is rough: see `ResolvedMotion`. Most collisions are within
    one body, and alone it is cheaper to decode, search and solve. Bodies that a stop leaves
    unchecked stay unchanged. Equal motions of one body, as in a crowd, are resolved once.
    """
    motion, options, space_at = run.motion, run.options, run.motion.space_at
    codes, is_rough = np.array(motion.codes), np.zeros(len(motion), dtype=np.bool_)
    alike: dict[Hashable, list[int]] = {}
    for number, body in enumerate(bodies):
        shape = None if space_at is None else number
        own = motion.codes[:, body.codes].tobytes(), body.own_domains(options.feet)
        key = id(body.resolver), shape, *own, body.options(options.frame), *body.up(up)
        alike.setdefault(key, []).append(number)

    def resolve(numbers: Sequence[int]) -> None:
        body = bodies[numbers[0]]
        own, feet = body.space_in, body.own_domains(options.feet)
        of_body = replace(
            motion,
            codes=motion.codes[:, body.codes],
            space_at=None if space_at is None else lambda time: own(space_at(time)),
        )
        of_options = replace(
            options,
            frame=body.options(options.frame),
            feet=feet,
            keep_feet=options.keep_feet and (not options.feet or bool(feet)),
        )
        try:
            resolved = resolve_motion(
                body.resolver,
                of_body,
                body.up(up),
                of_options,
                workers,
                run.job.part(reports.of(numbers[0])),
                within=run.within,
                stop=run.stop,
            )
        except CancelledError:
            if run.job.cancelled:
                raise
            return
        for number in numbers:
            codes[:, bodies[number].codes] = resolved.motion.codes
        is_rough[[frame for span in resolved.rough for frame in span]] = True

    with ThreadPoolExecutor(workers or available_cores(), "bodies of a motion") as pool:
        for _ in pool.map(resolve, alike.values()):
            pass
    return replace(motion, codes=codes), is_rough


@dataclass(eq=False)
class _Resolution:
    """The state of resolving a motion; frame t of a cycle is frame t modulo n.

    Attributes
    ----------
    motion, frames, options, within : of the motion
    is_cycle, n : whether it is a cycle, and its number of frames without the repeated one
    before : (T,) whether each frame was free
    colliding : (n,) frames that collide, or are next to a colliding pose between frames
    apart : (n,) frames in which patches that should touch do not
    guard : judges the solved frames
    standing : (T, K)
    substeps : (n,) number of poses that are checked after each frame
    codes, after : (n, D) and (n,), the current codes and whether they are free
    is_changed : (n,) frames of solved spans
    barred : (n,) frames that stay unchanged, unless some overlap can be removed
    reasons : why frames are barred
    unfinished : spans, or ends of spans, that were stopped
    is_rough : (n,) frames that a stop left before they were smooth
    solved : for a span, the number of its frames in finished windows
    freed : for a span, the corrections that free frames of its unfinished window, by frame
    n_frames, n_done : number of frames of spans, and of those that are done
    cuts_off : see `SpanProgram`
    begin_without : begins again without some pairs of domains, some codes locked, on a motion
    """

    motion: Motion
    frames: Frames
    options: MotionOptions
    within: range
    is_cycle: bool
    n: int
    before: npt.NDArray[np.bool_]
    colliding: npt.NDArray[np.bool_]
    apart: npt.NDArray[np.bool_]
    guard: Guard
    standing: npt.NDArray[np.bool_]
    substeps: npt.NDArray[np.intp]
    codes: FloatArray = field(init=False)
    after: npt.NDArray[np.bool_] = field(init=False)
    is_changed: npt.NDArray[np.bool_] = field(init=False)
    is_rough: npt.NDArray[np.bool_] = field(init=False)
    barred: npt.NDArray[np.bool_] = field(init=False)
    reasons: dict[int, Reason] = field(default_factory=dict)
    unfinished: list[range] = field(default_factory=list)
    solved: dict[range, int] = field(default_factory=dict)
    freed: dict[range, dict[int, FloatArray]] = field(default_factory=dict)
    job: Job = UNWATCHED
    stop: Job | None = None
    done: Mapping[int, Solved] = field(default_factory=dict)
    keep: Callable[[int, Solved], None] | None = None
    outer: Executor = field(init=False)
    lock: Lock = field(default_factory=Lock)
    n_frames: int = 0
    n_done: float = 0.0
    cuts_off: bool = False
    begin_without: _BeginWithout | None = None

    @classmethod
    def begin(
        cls,
        motion: Motion,
        frames: Frames,
        options: MotionOptions,
        within: range,
        up: npt.ArrayLike,
        checking: Job,
    ) -> _Resolution:
        """Check the original motion, and return the initial state."""
        is_cycle = motion.is_cycle
        n = len(motion) - 1 if is_cycle else len(motion)
        before = np.ones(len(motion), dtype=np.bool_)
        before[within.start : within.stop] = frames.are_free(within, checking)
        if is_cycle:
            before[[0, -1]] = before[[0, -1]].all()
        again = np.arange(len(motion)) % n
        pairs = _free_pairs(before[:n], again, within)
        hit = frames.collide_between(pairs, _fractions(options.substeps))
        was_clear_between = np.zeros(n, dtype=np.bool_)
        was_clear_between[pairs[~hit]] = True
        if options.continuous:
            hit |= frames.touch_between(pairs, motion.codes)
        pairs, colliding = pairs[hit], ~before[:n]
        colliding[np.concatenate([pairs, pairs + 1]) % n] = True
        apart = np.zeros(n, dtype=np.bool_)
        if frames.kept_contacts is not None:
            own = range(max(within.start, 0), min(within.stop, n))
            pulls = frames.pool.map(frames.pulls, own, motion.codes[own.start : own.stop])
            apart[own.start : own.stop] = [pull is not None and pull.n_apart > 0 for pull in pulls]
        any_span = bool((colliding | apart).any())
        standing = _standing(motion, frames.resolver, up, options, any_span)
        self = cls(
            motion,
            frames,
            options,
            within,
            is_cycle,
            n,
            before,
            colliding,
            apart,
            Guard(frames, n, before[:n], was_clear_between),
            standing,
            np.full(n, options.substeps),
        )
        self.codes, self.after = motion.codes[:n].copy(), before[:n].copy()
        self.is_changed, self.barred, self.is_rough = np.zeros((3, n), dtype=np.bool_)
        if options.frame.locked_domains or options.frame.locked_codes:
            self._bar_stuck(pairs)
        return self

    def _bar_stuck(self, pairs: npt.NDArray[np.intp]) -> None:
        """Bar frames in which the locked codes alone place faces that collide.

        Parameters
        ----------
        pairs : frames that are free like the next, but with a colliding pose between
        """
        places = [(at, 0.0) for at in np.flatnonzero(~self.before[: self.n]).tolist()]
        places += [(at, share) for at in pairs.tolist() for share in self._fractions[at].tolist()]
        stuck = self.frames.pool.map(lambda place: self.frames.is_stuck(*place), places)
        for at, share in compress(places, stuck):
            ends = [at, at + 1] if share else [at]
            self._bar(np.array(ends) % self.n, Reason.NO_JOINT)

    def result(self) -> ResolvedMotion:
        """Solve all spans, until none is worse than the original."""
        again = np.arange(len(self.motion)) % self.n
        todo, touching = self._spans(), np.empty(0, dtype=np.intp)
        n_rounds = 0
        self.job.report(0, sum(map(len, todo)))
        while todo:
            self._solve_all(todo, _EXTRA_CLEARANCES[n_rounds])
            self.done = {}
            todo = self._exclude_faults(todo)
            if todo or self.unfinished or not self.options.continuous:
                continue
            pairs = _free_pairs(self.after, again, self.within)
            pairs = pairs[self.is_changed[pairs] | self.is_changed[again[pairs + 1]]]
            touching = pairs[self.guard.frames.touch_between(pairs, self.codes[again])]
            if not len(touching) or n_rounds == len(_EXTRA_CLEARANCES) - 1:
                break
            n_rounds += 1
            more = np.minimum(2 * self.substeps[touching] + 1, _MOST_BETWEEN)
            self.substeps[touching] = np.maximum(self.substeps[touching], more)
            self.colliding[again[np.concatenate([touching, touching + 1])]] = True
            spans = self._spans()
            todo = [span for span in spans if np.isin(touching, np.asarray(span) % self.n).any()]
        if not self._is_stopped:
            self._improve_rest()
        return self._resolved(tuple(touching.tolist()) if self.options.continuous else None)

    def _resolved(self, touching: tuple[int, ...] | None = None) -> ResolvedMotion:
        """Return the current state as a result."""
        again = np.arange(len(self.motion)) % self.n
        self._put_back_unmoved()
        return ResolvedMotion(
            replace(self.motion, codes=self.codes[again]),
            self.before,
            self.after[again],
            tuple(runs(self.is_changed[again])),
            self.standing,
            touching,
            tuple(self.unfinished),
            tuple(runs((self.is_rough & self._is_moved)[again])),
            self._kept(),
        )

    def judged(self, other: ResolvedMotion) -> ResolvedMotion | None:
        """Return another result for the motion; None if it makes a frame worse.

        After a stop, only the frames that it makes worse stay as they were.
        """
        codes, after = other.motion.codes[: self.n], other.after[: self.n].copy()
        faults = self.guard.faults(range(self.n), codes, after, self._fractions)
        if not faults:
            spans = tuple(runs((other.motion.codes != self.motion.codes).any(axis=1)))
            return replace(other, before=self.before, spans=spans, standing=self.standing)
        if not self._is_stopped:
            return None
        moved = (codes != self.motion.codes[: self.n]).any(axis=1)
        is_worse = np.isin(np.arange(self.n), list(faults))
        for span in runs(moved | is_worse):
            places = [at for at in span if moved[at] and after[at] and not is_worse[at]]
            self._fit(span, {at - span.start: codes[at] - self.motion.codes[at] for at in places})
        left = self.wanted & ~(self.after & self._is_moved)
        self._bar(np.flatnonzero(left), Reason.STOPPED)
        self.unfinished += runs(left)
        return self._resolved()

    @property
    def _is_stopped(self) -> bool:
        return self.stop is not None and self.stop.cancelled

    @property
    def _easing(self) -> int:
        easing = self.options.easing
        return self.motion.in_frames(easing) if easing else 0

    @property
    def _smoothness(self) -> float:
        return SMOOTHNESS * (self.motion.rate / NOMINAL_RATE) ** 4

    @property
    def wanted(self) -> npt.NDArray[np.bool_]:
        """(n,) frames that should change."""
        return self.colliding | self.apart

    def _spans(self) -> list[range]:
        return colliding_spans(self.wanted, self._easing, self.within, self.is_cycle, self.barred)

    def _own(self, span: range) -> npt.NDArray[np.intp]:
        """Return the indices of a span's frames, modulo n."""
        return np.asarray(span) % self.n

    def _put_back_unmoved(self) -> None:
        for span in runs(self.is_changed):
            if np.array_equal(
                self.codes[span.start : span.stop], self.motion.codes[self._own(span)]
            ):
                self._put_back(span)

    def _put_back(self, span: range) -> None:
        own = self._own(span)
        self.codes[own], self.after[own] = self.motion.codes[own], self.before[own]
        self.is_changed[own] = False

    def _solve_all(self, spans: Sequence[range], extra_clearance: float) -> None:
        """Solve spans in parallel; keep the finished part of a span that is stopped."""
        self.n_frames += sum(map(len, spans))
        frames = replace(self.frames, extra_clearance=extra_clearance)
        tasks = [(span, self.outer.submit(self._solve, frames, span)) for span in spans]
        for span, task in tasks:
            try:
                task.result()
            except CancelledError:
                if self.job.cancelled:
                    raise
                rest = self._without_finished(span)
                freed = self._filled(span, rest, self.freed.pop(span, {}))
                if fixed := {at: freed[frame] for at, frame in enumerate(rest) if frame in freed}:
                    self._fit(rest, fixed)
                own = self._own(rest)
                self.is_rough[own] = True
                self._bar(own, Reason.STOPPED)
                if (self.wanted & ~(self.after & self._is_moved))[own].any():
                    self.unfinished.append(rest)

    def _filled(
        self, span: range, rest: range, freed: dict[int, FloatArray]
    ) -> dict[int, FloatArray]:
        """Free frames of a span's rest between those freed before a stop.

        Each is polished from the interpolated correction.
        """
        if not freed:
            return freed
        frames, known = self._with_still_feet(self.guard.frames, span), sorted(freed)
        between = [
            at
            for at in rest
            if known[0] < at < known[-1] and at not in freed and self.wanted[at % self.n]
        ]
        ways = np.array([freed[at] for at in known]).T
        starts = [
            frames.motion.codes[at] + [np.interp(at, known, way) for way in ways] for at in between
        ]
        polished = frames.pool.map(frames.polished, between, starts)
        return freed | {
            at: codes - frames.motion.codes[at]
            for at, (codes, _) in zip(between, polished, strict=True)
            if codes is not None
        }

    def _with_still_feet(self, frames: Frames, span: range) -> Frames:
        feet = np.flatnonzero(self.standing[self._own(span)].any(axis=0)).tolist()
        still = frames.options.still_domains.union(feet)
        return replace(frames, options=replace(frames.options, still_domains=still))

    def _without_finished(self, span: range) -> range:
        """Keep the finished beginning of a stopped span; return the rest, which is put back.

        The beginning ends with free frames over which the correction fades, if that makes nothing
        worse.
        """
        own, n_solved = self._own(span), self.solved.pop(span, 0)
        targets, solutions = self.motion.codes[own], self.codes[own]
        collides = self.wanted[own]
        self._put_back(span)
        if self.is_cycle and len(span) == self.n:
            return span
        for run in reversed(runs(collides[:n_solved])):
            after = collides[run.stop : run.stop + self._easing]
            n_fading = int([*after, True].index(True))
            if not n_fading:
                continue
            part = range(span.start, span.start + run.stop + n_fading)
            kept, was = own[: len(part)], targets[: len(part)]
            share = np.arange(1, n_fading + 1)[:, None] / (n_fading + 1)
            corrections = solutions[: len(part)] - was
            last = corrections[run.stop - 1]
            corrections[run.stop :] = (1.0 - share**2 * (3.0 - 2.0 * share)) * last
            bounds = [self.frames.limits(at) for at in kept.tolist()]
            low, high = (np.array(side) for side in zip(*bounds, strict=True))
            self.codes[kept] = _added(was, np.clip(was + corrections, low, high) - was)
            self.is_changed[kept] = True
            if not self.guard.faults(part, self.codes, self.after, self._fractions):
                return range(part.stop, span.stop)
            self._put_back(part)
        return span

    def _solve(self, frames: Frames, span: range) -> None:
        frames.job.check()
        self.is_changed[self._own(span)] = True
        frames = self._with_still_feet(frames, span)
        reached = span.start
        for window in windows(span, self.motion.in_frames(WINDOW), self.motion.in_frames(OVERLAP)):
            known = [self.done[at] for at in self._own(window).tolist() if at in self.done]
            is_new = len(known) < len(window)
            # Frames that the next window corrects again count once.
            report = self._report_of(window.stop - reached)
            if is_new:
                known = self._solve_window(frames, window, span, report)
            for at, solved in zip(self._own(window).tolist(), known, strict=True):
                self.codes[at], self.after[at] = solved
                if self.keep is not None and is_new:
                    with self.lock:
                        self.keep(at, solved)
            report(1.0)
            reached = window.stop
            self.solved[span] = reached - span.start

    def _report_of(self, n_frames: int) -> Callable[[float], None]:
        """Return the report of the share of some frames that is done, in [0, 1]; it never falls."""
        reported = 0.0

        def report(share: float) -> None:
            nonlocal reported
            with self.lock:
                self.n_done += n_frames * max(0.0, share - reported)
                reported = max(reported, share)
                self.job.report(min(round(self.n_done), self.n_frames), self.n_frames)

        return report

    def _solve_window(
        self, frames: Frames, window: range, span: range, tell: Callable[[float], None]
    ) -> list[Solved]:
        """Resolve a window of a span, whose earlier windows are done."""
        motion, n, codes = frames.motion, self.n, self.codes
        is_round = self.is_cycle and len(span) == n

        def corrections(first: int) -> FloatArray:
            """Return the corrections of two frames: 0 beyond the ends of the span."""
            two = np.arange(first, first + 2)
            inside = [is_round or at in span for at in two.tolist()]
            return np.where(np.array(inside)[:, None], codes[two % n] - motion.codes[two % n], 0.0)

        # The corrections beyond the ends of the span, and of its finished windows, are known.
        begins, ends = window.start == span.start, window.stop == span.stop
        is_open = begins if is_round else not self.is_cycle and window.start == 0
        before = None if is_open else corrections(window.start - 2)
        is_open = begins if is_round else not self.is_cycle and window.stop == n
        after = corrections(window.stop) if ends and not is_open else None
        was_free = self.before[self._own(window)]
        near = before[1] if before is not None and not was_free[0] else None
        freed = self.freed[span] = {}
        fractions = [_fractions(self.substeps[at]) for at in self._own(window)]

        def solution(knots: npt.NDArray[np.bool_], begin: Mapping[int, FloatArray]) -> _Solution:
            """Resolve the knots first, beginning from corrections that free some frames."""
            start, known = np.zeros((len(window), motion.codes.shape[1])), was_free.copy()
            for at, correction in begin.items():
                start[at], known[at] = correction, True
            colliding = [[window.start + at for at in run if knots[at]] for run in runs(~known)]
            for frame, correction in chain_corrections(frames, colliding, near, freed).items():
                start[frame - window.start], known[frame - window.start] = correction, True
            program = SpanProgram(
                frames,
                window,
                start,
                known,
                before,
                after,
                self._smoothness,
                fractions,
                knots,
                self.cuts_off,
                is_round and len(window) == n,
                tell,
            )
            try:
                corrections, free = program.solve()
            except CancelledError:
                freed.update({window.start + at: moved for at, moved in program.so_far().items()})
                raise
            far, is_jerky = self._too_far(window, corrections), program.is_jerky(corrections)
            moved = program.is_free_now & ~was_free & ~far & (not is_jerky)
            return _Solution(
                corrections,
                free,
                {at: corrections[at] for at in np.flatnonzero(moved).tolist()},
                program.is_settled and not is_jerky and not far.any(),
                (int((~free | far).sum()), *program.rank, program.cost(corrections)),
            )

        few = knots_of(was_free, motion.in_frames(_SPACING))
        every = np.ones_like(few)
        # Few frames first; else all, from those that are free; else all, each resolved first.
        solutions = [solution(few, {})]
        if not solutions[0].is_good and solutions[0].freed:
            solutions.append(solution(every, solutions[0].freed))
        if not solutions[-1].is_good and not few.all():
            solutions.append(solution(every, {}))
        best = min(solutions, key=lambda solution: solution.worth)
        targets = motion.codes[window.start : window.stop]
        return list(zip(_added(targets, best.corrections), best.is_free.tolist(), strict=True))

    def _too_far(self, window: range, corrections: FloatArray) -> npt.NDArray[np.bool_]:
        """Return (n,) which (n, D) corrections of a window exceed the largest change."""
        frames, targets = self.guard.frames, self.frames.motion.codes
        near = frames.pool.map(
            lambda at, moved: not moved.any() or frames.is_near_enough(at, targets[at] + moved),
            window,
            corrections,
        )
        return ~np.array(list(near))

    def _bar(self, frames: npt.NDArray[np.intp], reason: Reason) -> None:
        self.barred[frames] = True
        self.reasons |= dict.fromkeys(frames.tolist(), reason)

    def _exclude_faults(self, spans: Sequence[range]) -> list[range]:
        """Put back spans that are worse than the original, and bar the frames that made them so.

        Returns
        -------
        spans : the rest of them, to be solved again
        """
        is_open = np.zeros(self.n, dtype=np.bool_)
        for span in spans:
            own = self._own(span)
            if not self.is_changed[own].any():
                continue
            faults = self.guard.faults(span, self.codes, self.after, self._fractions)
            faults = faults or self._jerk(span)
            if not faults:
                continue
            self._put_back(span)
            is_open[own] = True
            places = {at: number for number, at in enumerate(own.tolist())}
            if self._drop_contacts(span, [places.get(at, 0) for at in faults]):
                continue
            inside = runs((self.colliding & ~self.barred)[own])
            for at, reason in faults.items():
                ends = (at, (at + 1) % self.n) if reason is Reason.BETWEEN else (at,)
                eased = [end for end in ends if end in places and not self.colliding[end]]
                if eased:
                    # They need not change.
                    self._bar(np.array(eased), reason)
                    continue
                # A pose before the span belongs to its first frame.
                place = places.get(at, 0)
                nearest = min(inside, key=lambda run: max(run.start - place, place - run.stop + 1))
                self._bar(own[nearest.start : nearest.stop], reason)
        return [span for span in self._spans() if is_open[self._own(span)].any()]

    def _jerk(self, span: range) -> dict[int, Reason]:
        """Return the colliding frame nearest to the worst jerk that correcting a span adds."""
        if not self._easing:
            # The motion jumps at both ends of each span.
            return {}
        at = np.arange(span.start - 2, span.stop + 2)
        at = at % self.n if self.is_cycle else at[(at >= 0) & (at < self.n)]
        # At the ends of the frames that may change, the motion may have to jump.
        at = at[np.isin(at, np.asarray(self.within) % self.n)]
        before, after = (
            np.sqrt(np.einsum("td,de,te->t", bends, self.frames.metric, bends))
            for bends in (
                np.diff(codes[at], 2, axis=0) for codes in (self.motion.codes, self.codes)
            )
        )
        colliding = np.flatnonzero(self.colliding[at])
        most = max(_JERK * (NOMINAL_RATE / self.motion.rate) ** 2, _JERKIER * before.max(initial=0))
        if not len(colliding) or after.max(initial=0.0) <= most:
            return {}
        nearest = colliding[np.abs(colliding - 1 - after.argmax()).argmin()]
        return {int(at[nearest]): Reason.JERKS}

    def _drop_contacts(self, span: range, faults: Sequence[int]) -> bool:
        """Drop the kept contacts near faults of a span; return whether there were any.

        Parameters
        ----------
        faults : positions in the span
        """
        contacts, own = self.frames.kept_contacts, self._own(span)
        if contacts is None:
            return False
        near = {
            int(own[place])
            for at in faults
            for place in range(max(0, at - self._easing), min(len(own), at + self._easing + 1))
        }
        near = {at for at in near if contacts.touches[at]}
        if not near:
            return False
        self.apart[list(near)] = False
        both = near | ({at + self.n for at in near} if self.is_cycle else set())
        self.frames = replace(self.frames, kept_contacts=contacts.without(both))
        return True

    @property
    def _fractions(self) -> list[FloatArray]:
        return [_fractions(self.options.substeps)] * self.n

    def _improve_rest(self) -> None:
        """Resolve or soften what is left, until a stop."""
        try:
            self._free_other_pairs()
            self._soften()
        except CancelledError:
            if self.job.cancelled:
                raise

    def _free_other_pairs(self) -> None:
        """Resolve what is left without the pairs that are stuck, where that makes nothing worse."""
        left = np.flatnonzero(self.colliding & (self.barred | ~self.after)).tolist()
        if self.begin_without is None or not left:
            return
        current = replace(self.motion, codes=self.codes[np.arange(len(self.motion)) % self.n])
        stuck, held = stuck_pairs(replace(self.frames, motion=current), left)
        if not stuck:
            return
        # First, lock what is stuck; move it too if that frees nothing.
        for locked in (held.tolist(), list[int]()):
            codes = self.begin_without(stuck, locked, current).result().motion.codes[: self.n]
            moved = runs((codes != self.codes).any(axis=1))
            takes = [self._takes(span, codes[span.start : span.stop]) for span in moved]
            if any(takes):
                break

    def _takes(self, span: range, codes: FloatArray) -> bool:
        """Set the (len(span), D) codes of a span unless that makes something worse."""
        own = slice(span.start, span.stop)
        before = self.codes[own].copy(), self.after[own].copy(), self.is_changed[own].copy()
        self.codes[own], self.is_changed[own] = codes, True
        if not self.guard.faults(span, self.codes, self.after, self._fractions):
            return True
        self.codes[own], self.after[own], self.is_changed[own] = before
        return False

    def _soften(self) -> None:
        """Reduce the overlap of frames that stayed, where that makes nothing worse."""
        self._put_back_unmoved()
        left = self.colliding & ~self.is_changed
        for run in colliding_spans(left, 0, None, self.is_cycle):
            span = self._eased(run)
            own = self._own(span)
            wanted = np.zeros(self.motion.codes[own].shape)
            inside = [number for number, at in enumerate(own) if self.colliding[at]]
            softened = self.frames.pool.map(lambda at: self.frames.softened(int(at)), own[inside])
            for number, codes in zip(inside, softened, strict=True):
                wanted[number] = codes - self.motion.codes[own[number]]
            self._fit(span, {}, wanted)

    def _fit(
        self, span: range, fixed: Mapping[int, FloatArray], wanted: FloatArray | None = None
    ) -> None:
        """Correct a span smoothly where that makes nothing worse.

        Parameters
        ----------
        fixed : (D,) corrections of some frames, by their place in the span; others ease to them
        wanted : (len(span), D) corrections to come near to; 0 if None
        """
        own, pinned = self._own(span), dict(fixed)
        targets = self.motion.codes[own]
        bounds = [self.frames.limits(at) for at in own.tolist()]
        low, high = (np.array(side) for side in zip(*bounds, strict=True))
        places = {at: number for number, at in enumerate(own.tolist())}
        for _ in range(_SOFT_ROUNDS):
            smooth = self._smoothed(
                span, np.zeros(targets.shape) if wanted is None else wanted, pinned
            )
            if not smooth.any():
                break
            self.codes[own] = _added(targets, np.clip(targets + smooth, low, high) - targets)
            self.is_changed[own] = True
            faults = self.guard.faults(span, self.codes, self.after, self._fractions)
            if not faults:
                break
            self._put_back(span)
            # Keep the faults still, and smooth the others around them.
            still = {places.get(at, -1) for fault in faults for at in (fault, (fault + 1) % self.n)}
            pinned |= dict.fromkeys(still - {-1}, np.zeros(targets.shape[1]))

    def _smoothed(
        self, span: range, wanted: FloatArray, pinned: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return smooth (len(span), D) corrections near the wanted ones, with some given."""
        size = wanted.shape[1]
        is_round = self.is_cycle and len(span) == self.n
        is_open = not self.is_cycle and span.start == 0, not self.is_cycle and span.stop == self.n
        before, after = (
            None if is_end_open or is_round else np.zeros((2, size)) for is_end_open in is_open
        )
        kernel = TimeKernel.of(
            len(span), self._smoothness, before, after, pinned, size, is_cycle=is_round
        )
        return kernel.spread @ wanted + kernel.mean

    def _eased(self, run: range) -> range:
        """Extend a run by the frames on both sides over which its correction may fade."""
        may_ease = ~(self.is_changed | self.colliding)
        may_ease &= np.isin(np.arange(self.n), np.asarray(self.within) % self.n)

        def steps(places: range) -> int:
            inside = [at for at in places if self.is_cycle or 0 <= at < self.n]
            usable = [bool(may_ease[at % self.n]) for at in inside]
            return [*usable, False].index(False)

        first, easing = run.start, min(self._easing, (self.n - len(run)) // 2)
        before = steps(range(first - 1, first - 1 - easing, -1))
        return range(first - before, run.stop + steps(range(run.stop, run.stop + easing)))

    @property
    def _is_moved(self) -> npt.NDArray[np.bool_]:
        moved: npt.NDArray[np.bool_] = (self.codes != self.motion.codes[: self.n]).any(axis=1)
        return moved

    def _kept(self) -> tuple[KeptSpan, ...]:
        is_moved = self._is_moved
        is_left = (self.barred & self.colliding & ~(self.after & is_moved)) | ~self.after
        spans = [
            self.guard.kept(run, self.codes, self.reasons)
            for side in (is_left & is_moved, is_left & ~is_moved)
            for run in colliding_spans(side, 0, None, self.is_cycle)
        ]
        return tuple(sorted(filter(None, spans), key=lambda span: span.frames))


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


def _contacts_of(motion: Motion, options: MotionOptions) -> KeptContacts | None:
    """Return the contacts to keep, for two turns of a cycle."""
    contacts = motion.contacts() if options.keep_contacts and motion.contacts is not None else None
    if contacts is None or not motion.is_cycle:
        return contacts
    return contacts.at([*range(len(motion) - 1)] * 2)


def _added(targets: FloatArray, corrections: FloatArray) -> FloatArray:
    """Add corrections to frames; adding 0 changes no bit."""
    return np.where(corrections != 0.0, targets + corrections, targets)


def _free_pairs(
    free: npt.NDArray[np.bool_], again: npt.NDArray[np.intp], within: range
) -> npt.NDArray[np.intp]:
    """Return the frames that, like the next one, are free and within a range."""
    usable = free[again] & np.isin(np.arange(len(again)), within)
    return np.flatnonzero(usable[:-1] & usable[1:])


def _fractions(substeps: int) -> FloatArray:
    return np.arange(1, substeps + 1) / (substeps + 1)


def _standing(
    motion: Motion,
    resolver: PoseResolver,
    up: npt.ArrayLike,
    options: MotionOptions,
    any_span: bool,
) -> npt.NDArray[np.bool_]:
    standing = np.zeros((len(motion), resolver.check.space.n_domains), dtype=np.bool_)
    if options.keep_feet and any_span:
        if options.feet:
            standing[:, sorted(options.feet)] = True
        else:
            standing = standing_parts(motion, resolver.check, up)
    return standing
