"""Long-running work: jobs that report progress and can be cancelled, and threads."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from lcollision_core.errors import CancelledError


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def limit_library_threads() -> None:
    """Keep the threads of libraries off the cores of ours; call it before NumPy and torch load.

    Small matrix products take microseconds, and distributing them takes longer. Torch's threads
    wait for the next operation by spinning, which by default takes our threads' cores for
    milliseconds.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")


class Job:
    """Link between the thread that does long work and those that watch it.

    Parameters
    ----------
    report : called in the working thread with (done, total) in the unit of the work, or with its
        status if it has one
    others : jobs whose cancellation cancels this one too
    note : called with sentences for the user, such as what was left out; by default the `note` of
        the first of `others`

    Attributes
    ----------
    report, note : as given
    """

    def __init__(
        self,
        report: Callable[..., None] | None = None,
        *others: Job,
        note: Callable[[str], None] | None = None,
    ) -> None:
        self.report: Callable[..., None] = report or _nothing
        self.note: Callable[[str], None] = note or (others[0].note if others else _nothing)
        self._event, self._others = threading.Event(), others

    def __repr__(self) -> str:
        """Return a text without an address, for signatures in documentation."""
        return "Job()"

    def cancel(self) -> None:
        """Ask the work to stop at its next call of `check`."""
        self._event.set()

    @property
    def cancelled(self) -> bool:
        """Whether this job or one of the others was cancelled."""
        return self._event.is_set() or any(other.cancelled for other in self._others)

    def check(self) -> None:
        """Raise `CancelledError` once the job is cancelled."""
        if self.cancelled:
            raise CancelledError("cancelled on request")

    def part(self, report: Callable[..., None] | None = None) -> Job:
        """Return a job for a part of this work, with its own `report` or none."""
        return Job(report, self)


def _nothing(*_: object) -> None:
    pass


def at_most_every(
    seconds: float, report: Callable[..., None], *, at_once: bool = True
) -> Callable[..., None]:
    """Return `report` throttled: calls within `seconds` of the last one that passed are dropped.

    Without `at_once`, calls within `seconds` of now are dropped too.
    """
    last = -math.inf if at_once else time.monotonic()

    def reported(*status: Any) -> None:
        nonlocal last
        if time.monotonic() - last >= seconds:
            last = time.monotonic()
            report(*status)

    return reported


UNWATCHED = Job()
"""A job that nobody watches or cancels: the default of functions that take one."""


def for_blocks(
    work: Callable[[int, int], None],
    n_items: int,
    block: int,
    n_threads: int | None = None,
    job: Job = UNWATCHED,
) -> None:
    """Call `work(start, stop)` for every block of the items, in several threads if possible.

    The blocks do not depend on the number of threads, so neither do the results.

    Parameters
    ----------
    work : must release the interpreter lock to gain from threads
    n_items, block : number of items, in all and per block
    n_threads : one per core by default
    job : reports (items done, all items) in order; checked before each block

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    starts = range(0, n_items, block)

    def run(start: int) -> int:
        job.check()
        stop = min(start + block, n_items)
        work(start, stop)
        return stop

    n_threads = min(available_cores() if n_threads is None else n_threads, len(starts))
    if n_threads <= 1:
        for stop in map(run, starts):
            job.report(stop, n_items)
        return
    pool = ThreadPoolExecutor(n_threads)
    try:
        for stop in pool.map(run, starts):
            job.report(stop, n_items)
    finally:
        pool.shutdown(cancel_futures=True)
