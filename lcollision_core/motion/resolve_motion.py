"""Resolve a motion: colliding spans free and as smooth as they were, all else unchanged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import CancelledError
from lcollision_core.jobs import CancelToken, Progress, available_cores, no_progress
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.chain import chain_corrections
from lcollision_core.motion.frames import Frames
from lcollision_core.motion.motion import NOMINAL_RATE, Motion
from lcollision_core.motion.span_program import SMOOTHNESS, SpanProgram
from lcollision_core.motion.spans import colliding_spans, runs, windows
from lcollision_core.motion.standing import standing_parts
from lcollision_core.options.motion import MotionOptions
from lcollision_core.resolve import PoseResolver
from lcollision_core.resolve.threads import single_torch_thread

WINDOW, OVERLAP = 120, 24
"""Frames at 30 a second that are resolved together at most, and how many of them a second time in
the next window: the program's cost grows with the square of the frames."""

_SPARE, _MOST_BETWEEN = (0.0, 0.0, 0.002, 0.004, 0.008), 7
"""Of each time that a span is solved because something touches between its frames: how much farther
poses between frames are to stay apart, normalised; and up to how many of them are looked at."""


@dataclass(frozen=True, eq=False)
class ResolvedMotion:
    """Where the resolution of a motion ended.

    Attributes
    ----------
    motion : the frames, those outside `spans` unchanged to the bit
    before, after : (T,) bool, which frames were free, and are, by the exact check; True of frames
        that were not looked at
    spans : of frames that may have changed
    standing : (T, K) bool, the body parts that were kept on the ground in each frame
    touching : numbers of frames that may have changed and are free, and so is the next, with
        contact on the linear path of the vertices between; None where that was not asked for
    unfinished : spans that were not done when the work was stopped, and are as they were
    """

    motion: Motion
    before: npt.NDArray[np.bool_]
    after: npt.NDArray[np.bool_]
    spans: tuple[range, ...]
    standing: npt.NDArray[np.bool_]
    touching: tuple[int, ...] | None = None
    unfinished: tuple[range, ...] = ()


Solved = tuple[FloatArray, bool]
"""The (D,) codes of a frame, and whether it is free with them."""


def resolve_motion(
    resolver: PoseResolver,
    motion: Motion,
    up: npt.ArrayLike,
    options: MotionOptions | None = None,
    workers: int | None = None,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
    *,
    within: range | None = None,
    done: Mapping[int, Solved] | None = None,
    keep: Callable[[int, Solved], None] | None = None,
    stop: CancelToken | None = None,
) -> ResolvedMotion:
    """Resolve the self-collisions of a motion.

    Each colliding span, of frames that collide or have a pose between them that does, with frames
    on both sides over which its correction fades, is one program: of all corrections that keep its
    frames free, and the poses between them, the ones that are smallest and change the motion's
    acceleration least. Long spans are resolved window by window, so that memory does not grow with
    the motion. A cycle, whose last frame is the first again, stays one: spans go on across its
    seam. With `continuous` in the options, spans in which something touches on the linear path of
    the vertices between two frames are solved again with more poses there, until nothing does.

    Parameters
    ----------
    resolver : of the body's poses
    motion : T frames
    up : (3,) unit vector, for what stands on the ground
    options : the defaults if None
    workers : threads, one for each available core by default; results do not depend on it
    progress : called with (frames of colliding spans done, all of them), first with 0
    cancel : polled for each frame
    within : the frames that may change and are looked at; all if None
    done : frames of an earlier run; windows of which all frames are there are not computed again
    keep : called with each frame of a further window as soon as that is done, from one thread at a
        time
    stop : polled as `cancel` is; once it is set, spans that are not done stay as they were, and
        the others are returned

    Returns
    -------
    result : ResolvedMotion; a frame that cannot be freed is not free in `after`, and the others
        are as if it were

    Raises
    ------
    CancelledError : `cancel` was set, or `stop` before it was known which frames collide.
    MissingExtraError : ipctk is not installed, which `continuous` needs.
    """
    chosen = options or MotionOptions()
    n_workers = workers or available_cores()
    with (
        single_torch_thread(),
        ThreadPoolExecutor(n_workers, "motion frames") as pool,
        ThreadPoolExecutor(n_workers, "motion spans") as outer,
    ):
        is_cycle = motion.is_cycle
        unrolled = motion.two_turns() if is_cycle else motion
        either = CancelToken(*filter(None, (cancel, stop)))
        frames = Frames(unrolled, resolver, chosen.frame, pool, either, chosen.continuous)
        chosen_frames = range(len(motion)) if within is None else within
        before = np.ones(len(motion), dtype=np.bool_)
        before[chosen_frames.start : chosen_frames.stop] = frames.are_free(chosen_frames)
        if is_cycle:
            before[[0, -1]] = before[[0, -1]].all()
        # A cycle's last frame is frame 0, which numbers from n on mean again.
        n = len(motion) - 1 if is_cycle else len(motion)
        again, substeps = np.arange(len(motion)) % n, np.full(n, chosen.substeps)
        seen = np.isin(np.arange(len(motion)), chosen_frames)

        def free_pairs(free: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
            usable = free[again] & seen
            return np.flatnonzero(usable[:-1] & usable[1:])

        pairs = free_pairs(before)
        hit = frames.collide_between(pairs, _fractions(chosen.substeps))
        if chosen.continuous:
            hit |= frames.touch_between(pairs, motion.codes)
        pairs, colliding = pairs[hit], ~before[:n]
        colliding[np.concatenate([pairs, pairs + 1]) % n] = True
        easing = motion.in_frames(chosen.easing) if chosen.easing else 0
        spans = colliding_spans(colliding, easing, chosen_frames, is_cycle)
        standing = _standing(motion, resolver, up, chosen, bool(spans))
        codes, after, guard = motion.codes[:n].copy(), before[:n].copy(), Lock()
        is_changed = np.zeros(n, dtype=np.bool_)
        n_frames, n_done, n_rounds = sum(map(len, spans)), 0, 0
        unfinished: list[range] = []
        progress(0, n_frames)

        def solve(span: range) -> None:
            try:
                either.raise_if_cancelled()
                solve_windows(span)
            except CancelledError:
                if cancel is not None and cancel.cancelled:
                    raise
                rows = np.asarray(span) % n
                codes[rows], after[rows] = motion.codes[rows], before[rows]
                is_changed[rows] = False
                unfinished.append(span)

        def solve_windows(span: range) -> None:
            nonlocal n_done
            is_changed[np.asarray(span) % n] = True
            feet = np.flatnonzero(standing[np.asarray(span) % n].any(axis=0)).tolist()
            still = chosen.frame.still_domains.union(feet)
            one = replace(
                frames,
                options=replace(chosen.frame, still_domains=still),
                spare=_SPARE[n_rounds],
            )
            for window in windows(span, motion.in_frames(WINDOW), motion.in_frames(OVERLAP)):
                kept = done if done and n_rounds == 0 else {}
                known = [kept[at % n] for at in window if at % n in kept]
                is_new = len(known) < len(window)
                if is_new:
                    between = [_fractions(substeps[at % n]) for at in window]
                    known = _solve_window(one, window, span, codes, before, between, is_cycle)
                for at, solved in zip(window, known, strict=True):
                    codes[at % n], after[at % n] = solved
                    if keep is not None and is_new:
                        with guard:
                            keep(at % n, solved)
                with guard:
                    n_done += len(window)
                    progress(min(n_done, n_frames), n_frames)

        todo, touching = spans, np.empty(0, dtype=np.intp)
        while True:
            for solved in [outer.submit(solve, span) for span in todo]:
                solved.result()
            if not chosen.continuous or unfinished:
                break
            pairs = free_pairs(after)
            pairs = pairs[is_changed[pairs] | is_changed[again[pairs + 1]]]
            touching = pairs[frames.touch_between(pairs, codes[again])]
            if not len(touching) or n_rounds == len(_SPARE) - 1:
                break
            n_rounds += 1
            more = np.minimum(2 * substeps[touching] + 1, _MOST_BETWEEN)
            substeps[touching] = np.maximum(substeps[touching], more)
            colliding[again[np.concatenate([touching, touching + 1])]] = True
            spans = colliding_spans(colliding, easing, chosen_frames, is_cycle)
            todo = [span for span in spans if np.isin(touching, np.asarray(span) % n).any()]
            n_frames, n_done = sum(map(len, todo)), 0
    return ResolvedMotion(
        replace(motion, codes=codes[again]),
        before,
        after[again],
        tuple(runs(is_changed[again])),
        standing,
        tuple(touching.tolist()) if chosen.continuous else None,
        tuple(unfinished),
    )


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


def _solve_window(
    frames: Frames,
    window: range,
    span: range,
    codes: FloatArray,
    is_free: npt.NDArray[np.bool_],
    fractions: Sequence[FloatArray],
    is_cycle: bool,
) -> list[Solved]:
    """Resolve some frames of a span, those before them being done."""
    motion, n = frames.motion, len(codes)
    is_round = is_cycle and len(span) == n

    def corrections(first: int) -> FloatArray:
        """Return those of two frames: done ones of the span, beyond its ends none."""
        two = np.arange(first, first + 2)
        inside = [is_round or at in span for at in two.tolist()]
        return np.where(np.array(inside)[:, None], codes[two % n] - motion.codes[two % n], 0.0)

    # Beyond the ends of a span, and of what of it is done, the corrections are known.
    begins, ends = window.start == span.start, window.stop == span.stop
    is_open = begins if is_round else not is_cycle and window.start == 0
    before = None if is_open else corrections(window.start - 2)
    is_open = begins if is_round else not is_cycle and window.stop == n
    after = corrections(window.stop) if ends and not is_open else None
    start = np.zeros((len(window), motion.codes.shape[1]))
    known = is_free[np.asarray(window) % n].copy()
    for run in runs(~known):
        frames_of_run = range(window.start + run.start, window.start + run.stop)
        near = before[1] if before is not None and run.start == 0 else None
        for frame, correction in chain_corrections(frames, frames_of_run, near).items():
            start[frame - window.start], known[frame - window.start] = correction, True
    smoothness = SMOOTHNESS * (motion.rate / NOMINAL_RATE) ** 4
    program = SpanProgram(
        frames,
        window,
        start,
        known,
        before,
        after,
        smoothness,
        fractions,
        is_round and len(window) == n,
    )
    found, free = program.solve()
    targets = motion.codes[window.start : window.stop]
    # Adding nothing is to change no bit.
    moved = np.where(found != 0.0, targets + found, targets)
    return list(zip(moved, free.tolist(), strict=True))
