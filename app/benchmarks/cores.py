"""Speed-up of loops over poses and frames on all cores against one thread.

The fields of a row:

what : the loop
items : poses, rows or frames in it
ms_one, ms_all : milliseconds per item on one thread and on all cores, medians of alternating runs
    of at least a second
ratio : of these
cpu_ratio : processor time on all cores against one thread; above 1, threads wait for memory or spin
serial : share of the processor time on all cores that the calling thread takes, alone
switches : voluntary context switches per item on all cores
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from app.benchmarks.measures import Row
from app.benchmarks.motion import motions_of
from lcollision_core.bodies import Body, LearnedBody
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.labels import Labeller
from lcollision_core.labels.labelling_run import label_locally
from lcollision_core.motion import screen_motion

_ROUNDS, _SECONDS = 5, 1.0
"""Runs on each number of threads, and least time of a run on all cores."""

Loop = Callable[[int], object]
"""A loop, called with the number of threads."""


def loops_of(body: Body, n_items: int, data: Path | None) -> dict[str, tuple[int, Loop]]:
    """Return loops over a body's poses by name, each with its number of items.

    Parameters
    ----------
    n_items : poses to draw
    data : the file of the motion to screen: see `motions_of`
    """
    codes = body.sample(n_items, np.random.default_rng(0))
    vertices = body.decode(codes).astype(np.float32)
    motion, check, detector = motions_of(body, data)[0], body.exact_check(), body.detector
    near = check.with_clearance(0.002)
    loops: dict[str, tuple[int, Loop]] = {
        "decode": (n_items, lambda n: body.decode(codes, n)),
        "any pair": (n_items, lambda n: detector.are_colliding(vertices, workers=n)),
        "all pairs": (n_items, lambda n: detector.detect_batch(vertices, workers=n)),
        "screening": (len(motion), lambda n: screen_motion(motion, check, 0, n)),
        "screening, half steps": (len(motion), lambda n: screen_motion(motion, check, 1, n)),
        "with a clearance": (len(motion), lambda n: screen_motion(motion, near, 0, n)),
    }
    if body.has_predictor:
        labeller = LearnedBody.load(body.name).labeller()
        loops["labels"] = (n_items, lambda n: _label(labeller, n_items, n))
    return loops


def _label(labeller: Labeller, n_rows: int, n_threads: int) -> None:
    for _ in label_locally(labeller, 0, [range(n_rows)], n_threads, lambda _: None, UNWATCHED):
        pass


def time_cores(loops: dict[str, tuple[int, Loop]], n_threads: int, job: Job) -> list[Row]:
    """Time loops alternately on one thread and on several; `job` reports loops."""
    rows = []
    for done, (name, (n_items, loop)) in enumerate(loops.items(), 1):
        loop(n_threads)  # Compiles.
        repeats = math.ceil(_SECONDS / _measured(loop, n_threads, 1)[0])
        runs: dict[int, list[tuple[float, ...]]] = {1: [], n_threads: []}
        for count in (1, n_threads) * _ROUNDS:
            job.check()
            runs[count].append(_measured(loop, count, repeats))
        (one, cpu_one, *_), (several, cpu_several, serial, switches) = (
            [statistics.median(figures) / repeats for figures in zip(*runs[count], strict=True)]
            for count in (1, n_threads)
        )
        rows.append(
            {
                "what": name,
                "items": n_items,
                "ms_one": 1e3 * one / n_items,
                "ms_all": 1e3 * several / n_items,
                "ratio": one / several,
                "cpu_ratio": cpu_several / cpu_one,
                "serial": serial / cpu_several,
                "switches": switches / n_items,
            }
        )
        job.report(done, len(loops))
    return rows


def _measured(loop: Loop, n_threads: int, repeats: int) -> tuple[float, ...]:
    """Return the seconds, those of the processor and of this thread on it, and the switches."""
    began = time.perf_counter(), time.process_time(), time.thread_time(), _waits()
    for _ in range(repeats):
        loop(n_threads)
    ended = time.perf_counter(), time.process_time(), time.thread_time(), _waits()
    return tuple(end - begin for begin, end in zip(began, ended, strict=True))


def _waits() -> int:
    """Return the voluntary context switches of this process so far."""
    import resource  # Not available on Windows.

    return resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw
