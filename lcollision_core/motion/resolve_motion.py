"""Resolve a motion: free its colliding spans smoothly, and leave all else unchanged."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import CancelledError
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.motion.contacts import KeptContacts
from lcollision_core.motion.corrected_frames import CorrectedFrames, MotionProblem, free_pairs
from lcollision_core.motion.frames import Frames, KeptSpan, Reason
from lcollision_core.motion.ground import GroundReport
from lcollision_core.motion.motion import NOMINAL_RATE, Motion, runs
from lcollision_core.motion.spans import Solved, SpanRecord, SpanSolver
from lcollision_core.motion.stuck_pairs import stuck_pairs
from lcollision_core.options import MotionOptions
from lcollision_core.resolve import BodyAlone, PoseResolver
from lcollision_core.resolve.problem import single_torch_thread

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
    with (
        single_torch_thread(),
        ThreadPoolExecutor(workers or available_cores(), "motion frames") as pool,
        ThreadPoolExecutor(workers or available_cores(), "motion spans") as outer,
    ):
        chosen_frames = range(len(motion)) if within is None else within
        work = _Work(
            resolver, up, options or MotionOptions(), chosen_frames, pool, outer, job, stop
        )
        problem = work.problem(motion, work.until_stop, Job(checking))
        bodies = [body for body in resolver.bodies if not body.is_locked(work.options.frame)]
        is_plain = motion.placements is None and motion.hidden is None and motion.contacts is None
        if len(bodies) > 1 and is_plain and (problem.colliding | problem.apart).any():
            resolved = _resolved_by_bodies(work, problem, bodies, workers, done, keep)
            if resolved is not None:
                return resolved
            done = keep = None
        return _Resolution(work, problem, SpanRecord(job, done, keep)).result()


@dataclass(frozen=True, eq=False)
class _Work:
    """What all stages of resolving a motion share.

    Attributes
    ----------
    resolver, up, options, within, job, stop : see `resolve_motion`
    pool, outer : run the work of frames, and of spans
    """

    resolver: PoseResolver
    up: npt.ArrayLike
    options: MotionOptions
    within: range
    pool: Executor
    outer: Executor
    job: Job
    stop: Job | None

    @property
    def is_stopped(self) -> bool:
        """Whether the work is to end early."""
        return self.stop is not None and self.stop.cancelled

    @property
    def until_stop(self) -> Job:
        """A job that a stop cancels too."""
        return self.job.part() if self.stop is None else Job(None, self.job, self.stop)

    def problem(
        self, motion: Motion, job_of_check: Job, checking: Job = UNWATCHED
    ) -> MotionProblem:
        """Check a motion; finished frames are judged after a stop too."""
        frames = Frames(
            motion.two_turns() if motion.is_cycle else motion,
            self.resolver,
            replace(self.options.frame, largest_change=None),
            self.pool,
            job_of_check,
            self.options.continuous,
            largest_change=self.options.frame.largest_change,
            kept_contacts=_contacts_of(motion, self.options),
        )
        problem = MotionProblem.of(motion, frames, self.options, self.within, self.up, checking)
        guard = replace(problem.guard, frames=replace(frames, job=self.job.part()))
        return replace(problem, frames=replace(frames, job=self.until_stop), guard=guard)


def _resolved_by_bodies(
    work: _Work,
    problem: MotionProblem,
    bodies: Sequence[BodyAlone],
    workers: int | None,
    done: Mapping[int, Solved] | None,
    keep: Callable[[int, Solved], None] | None,
) -> ResolvedMotion | None:
    """Resolve each body of a scene, then what is left of them together.

    None if that makes a frame worse.
    """
    reports = _Reports(work.job, len(bodies) + 1)
    each, is_rough = _each_by_itself(work, problem.motion, bodies, workers, reports)
    job = work.job.part(reports.of(len(bodies)))
    # Where bodies meet, poses that contacts allow came back, and ended in jerks.
    together = _Resolution(
        work, work.problem(each, work.job.part()), SpanRecord(job, done, keep), cuts_off=True
    )
    both = together.result()
    resolved = _Resolution(work, problem).judged(both)
    if resolved is None:
        return None
    is_rough[[frame for span in both.rough for frame in span]] = True
    moved = (resolved.motion.codes != problem.motion.codes).any(axis=1)
    return replace(resolved, rough=tuple(runs(is_rough & moved)))


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
    work: _Work,
    motion: Motion,
    bodies: Sequence[BodyAlone],
    workers: int | None,
    reports: _Reports,
) -> tuple[Motion, npt.NDArray[np.bool_]]:
    """Return the motion of a scene with the self-collisions of each body resolved.

    Also return (T,) whether each frame is rough: see `ResolvedMotion`. Most collisions are within
    one body, and alone it is cheaper to decode, search and solve. Bodies that a stop leaves
    unchecked stay unchanged. Equal motions of one body, as in a crowd, are resolved once.
    """
    options, up, space_at = work.options, work.up, motion.space_at
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
                work.job.part(reports.of(numbers[0])),
                within=work.within,
                stop=work.stop,
            )
        except CancelledError:
            if work.job.cancelled:
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
    """Resolves a motion in rounds, until nothing is worse than it was.

    Attributes
    ----------
    work, problem : what is to be done
    record : of the frames that are done
    cuts_off : see `SpanProgram`
    is_rest : whether this is what is left of another resolution, without its stuck pairs
    corrected : the frames so far
    substeps : (n,) number of poses that are checked after each frame
    contacts : that are still kept
    unfinished : spans, or ends of spans, that were stopped
    is_rough : (n,) frames that a stop left before they were smooth
    """

    work: _Work
    problem: MotionProblem
    record: SpanRecord = field(default_factory=SpanRecord)
    cuts_off: bool = False
    is_rest: bool = False
    corrected: CorrectedFrames = field(init=False)
    substeps: npt.NDArray[np.intp] = field(init=False)
    contacts: KeptContacts | None = field(init=False)
    unfinished: list[range] = field(default_factory=list)
    is_rough: npt.NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        problem = self.problem
        self.corrected = CorrectedFrames(problem)
        self.substeps = np.full(problem.n, problem.options.substeps)
        self.contacts = problem.frames.kept_contacts
        self.is_rough = np.zeros(problem.n, dtype=np.bool_)

    def result(self) -> ResolvedMotion:
        """Solve all spans, until none is worse than the original."""
        corrected, is_continuous = self.corrected, self.problem.options.continuous
        todo, touching, n_rounds = corrected.spans(), np.empty(0, dtype=np.intp), 0
        self.record.job.report(0, sum(map(len, todo)))
        while todo:
            self._solve_all(todo, _EXTRA_CLEARANCES[n_rounds])
            self.record.done = {}
            todo = self._without_faults(todo)
            if todo or self.unfinished or not is_continuous:
                continue
            touching = self._touching()
            if not len(touching) or n_rounds == len(_EXTRA_CLEARANCES) - 1:
                break
            n_rounds += 1
            todo = self._denser(touching)
        if not self.work.is_stopped:
            try:
                self._free_other_pairs()
                corrected.soften()
            except CancelledError:
                if self.record.job.cancelled:
                    raise
        return self._resolved(tuple(touching.tolist()) if is_continuous else None)

    def _solve_all(self, spans: Sequence[range], extra_clearance: float) -> None:
        """Solve spans in parallel; keep the finished part of a span that is stopped."""
        self.record.add(sum(map(len, spans)))
        problem, corrected = self.problem, self.corrected
        frames = replace(
            problem.frames, extra_clearance=extra_clearance, kept_contacts=self.contacts
        )
        solvers = [
            SpanSolver(
                corrected,
                problem.with_still_feet(frames, span),
                span,
                self.substeps,
                self.record,
                self.cuts_off,
            )
            for span in spans
        ]
        tasks = [self.work.outer.submit(solver.solve) for solver in solvers]
        for solver, task in zip(solvers, tasks, strict=True):
            try:
                task.result()
            except CancelledError:
                if self.record.job.cancelled:
                    raise
                rest = solver.keep_finished()
                own = problem.own(rest)
                self.is_rough[own] = True
                corrected.bar(own, Reason.STOPPED)
                if corrected.is_left[own].any():
                    self.unfinished.append(rest)

    def _without_faults(self, spans: Sequence[range]) -> list[range]:
        """Put back spans that are worse than the original, and bar the frames that made them so.

        Returns
        -------
        spans : the rest of them, to be solved again
        """
        problem, corrected = self.problem, self.corrected
        is_open = np.zeros(problem.n, dtype=np.bool_)
        for span in spans:
            own = problem.own(span)
            if not corrected.is_changed[own].any():
                continue
            faults = corrected.faults(span) or self._jerk(span)
            if not faults:
                continue
            corrected.put_back(span)
            is_open[own] = True
            if not self._drop_contacts(span, faults):
                self._bar_faults(span, faults)
        return [span for span in corrected.spans() if is_open[problem.own(span)].any()]

    def _bar_faults(self, span: range, faults: Mapping[int, Reason]) -> None:
        """Bar the colliding frames of a span that are nearest to faults."""
        own, places = self.problem.own(span), self.problem.places(span)
        corrected = self.corrected
        inside = runs((corrected.colliding & ~corrected.barred)[own])
        for at, reason in faults.items():
            ends = (at, (at + 1) % self.problem.n) if reason is Reason.BETWEEN else (at,)
            eased = [end for end in ends if end in places and not corrected.colliding[end]]
            if eased:
                # They need not change.
                corrected.bar(np.array(eased), reason)
                continue
            # A pose before the span belongs to its first frame.
            place = places.get(at, 0)
            if inside:
                nearest = min(inside, key=lambda run: max(run.start - place, place - run.stop + 1))
                corrected.bar(own[nearest.start : nearest.stop], reason)

    def _jerk(self, span: range) -> dict[int, Reason]:
        """Return the colliding frame nearest to the worst jerk that correcting a span adds."""
        problem, motion = self.problem, self.problem.motion
        if not problem.easing:
            # The motion jumps at both ends of each span.
            return {}
        at = np.arange(span.start - 2, span.stop + 2)
        at = at % problem.n if problem.is_cycle else at[(at >= 0) & (at < problem.n)]
        # At the ends of the frames that may change, the motion may have to jump.
        at = at[problem.may_change[at]]
        before, after = (
            np.sqrt(np.einsum("td,de,te->t", bends, problem.frames.metric, bends))
            for bends in (
                np.diff(codes[at], 2, axis=0) for codes in (motion.codes, self.corrected.codes)
            )
        )
        colliding = np.flatnonzero(self.corrected.colliding[at])
        most = max(_JERK * (NOMINAL_RATE / motion.rate) ** 2, _JERKIER * before.max(initial=0))
        if not len(colliding) or after.max(initial=0.0) <= most:
            return {}
        nearest = colliding[np.abs(colliding - 1 - after.argmax()).argmin()]
        return {int(at[nearest]): Reason.JERKS}

    def _drop_contacts(self, span: range, faults: Iterable[int]) -> bool:
        """Drop the kept contacts near faults of a span; return whether there were any."""
        problem, contacts, easing = self.problem, self.contacts, self.problem.easing
        if contacts is None:
            return False
        own, places = problem.own(span), problem.places(span)
        near = {
            int(own[place])
            for fault in (places.get(at, 0) for at in faults)
            for place in range(max(0, fault - easing), min(len(own), fault + easing + 1))
        }
        near = {at for at in near if contacts.touches[at]}
        if not near:
            return False
        self.corrected.apart[list(near)] = False
        both = near | ({at + problem.n for at in near} if problem.is_cycle else set())
        self.contacts = contacts.without(both)
        return True

    def _touching(self) -> npt.NDArray[np.intp]:
        """Return the changed frames that touch something on the linear path to the next."""
        problem, again, corrected = self.problem, self.problem.all_frames, self.corrected
        pairs = free_pairs(corrected.is_free[again], problem.within)
        is_changed = corrected.is_changed
        pairs = pairs[is_changed[pairs] | is_changed[again[pairs + 1]]]
        return pairs[problem.guard.frames.touch_between(pairs, corrected.codes[again])]

    def _denser(self, touching: npt.NDArray[np.intp]) -> list[range]:
        """Check more poses after frames that touch, and return the spans around them."""
        corrected, again = self.corrected, self.problem.all_frames
        more = np.minimum(2 * self.substeps[touching] + 1, _MOST_BETWEEN)
        self.substeps[touching] = np.maximum(self.substeps[touching], more)
        corrected.colliding[again[np.concatenate([touching, touching + 1])]] = True
        return [
            span for span in corrected.spans() if np.isin(touching, self.problem.own(span)).any()
        ]

    def _free_other_pairs(self) -> None:
        """Resolve what is left without the pairs that are stuck, where that makes nothing worse."""
        problem, corrected, work = self.problem, self.corrected, self.work
        left = np.flatnonzero(corrected.colliding & (corrected.barred | ~corrected.is_free))
        if self.is_rest or not len(left):
            return
        current = replace(problem.motion, codes=corrected.codes[problem.all_frames])
        pairs, codes_of_pairs = stuck_pairs(replace(problem.frames, motion=current), left.tolist())
        if not pairs:
            return
        resolver = work.resolver.with_check(work.resolver.check.without_pairs(pairs))
        # First, lock what is stuck; move it too if that frees nothing.
        for locked in (codes_of_pairs.tolist(), list[int]()):
            locks = work.options.frame.locked_codes.union(locked)
            options = replace(work.options, frame=replace(work.options.frame, locked_codes=locks))
            of_rest = replace(work, resolver=resolver, options=options)
            rest = of_rest.problem(current, work.job.part())
            resolved = _Resolution(
                of_rest, rest, SpanRecord(work.job.part()), is_rest=True
            ).result()
            codes = resolved.motion.codes[: problem.n]
            moved = runs((codes != corrected.codes).any(axis=1))
            faults = [corrected.take(span, codes[span.start : span.stop]) for span in moved]
            if not all(faults):
                break

    def _resolved(self, touching: tuple[int, ...] | None = None) -> ResolvedMotion:
        """Return the current state as a result."""
        problem, corrected, again = self.problem, self.corrected, self.problem.all_frames
        corrected.put_back_unmoved()
        return ResolvedMotion(
            replace(problem.motion, codes=corrected.codes[again]),
            problem.before,
            corrected.is_free[again],
            tuple(runs(corrected.is_changed[again])),
            problem.standing,
            touching,
            tuple(self.unfinished),
            tuple(runs((self.is_rough & corrected.is_moved)[again])),
            corrected.kept(),
        )

    def judged(self, other: ResolvedMotion) -> ResolvedMotion | None:
        """Return another result for the motion; None if it makes a frame worse.

        After a stop, only the frames that it makes worse stay as they were.
        """
        problem, corrected, n = self.problem, self.corrected, self.problem.n
        targets, codes, is_free = (
            problem.motion.codes[:n],
            other.motion.codes[:n],
            other.after[:n].copy(),
        )
        faults = problem.guard.faults(range(n), codes, is_free, problem.fractions)
        if not faults:
            spans = tuple(runs((other.motion.codes != problem.motion.codes).any(axis=1)))
            return replace(other, before=problem.before, spans=spans, standing=problem.standing)
        if not self.work.is_stopped:
            return None
        moved = (codes != targets).any(axis=1)
        is_worse = np.isin(np.arange(n), list(faults))
        for span in runs(moved | is_worse):
            places = [at for at in span if moved[at] and is_free[at] and not is_worse[at]]
            corrected.fit(span, {at - span.start: codes[at] - targets[at] for at in places})
        left = corrected.is_left
        corrected.bar(np.flatnonzero(left), Reason.STOPPED)
        self.unfinished += runs(left)
        return self._resolved()


def _contacts_of(motion: Motion, options: MotionOptions) -> KeptContacts | None:
    """Return the contacts to keep, for two turns of a cycle."""
    contacts = motion.contacts() if options.keep_contacts and motion.contacts is not None else None
    if contacts is None or not motion.is_cycle:
        return contacts
    return contacts.at([*range(len(motion) - 1)] * 2)
