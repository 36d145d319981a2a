"""Long work: a job that reports and can be cancelled, and threads."""

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


class Job:
    """Long work between the thread that does it and those that watch it.

    Parameters
    ----------
    report : called in the thread that works: with (done, total) in the work's own unit, or with a
        status where the work has one
    others : jobs whose cancellation cancels this one too
    note : called with sentences that people should read, as of what was left out; those of the
        first of the others by default

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

    def cancel(self) -> None:
        """Ask the work to stop at its next check."""
        self._event.set()

    @property
    def cancelled(self) -> bool:
        """Whether `cancel` has been called, of this job or of one of the others."""
        return self._event.is_set() or any(other.cancelled for other in self._others)

    def check(self) -> None:
        """Raise `CancelledError` once the job is cancelled."""
        if self.cancelled:
            raise CancelledError("cancelled on request")

    def part(self, report: Callable[..., None] | None = None) -> Job:
        """Return the job of a part of this work, which reports otherwise, or not at all."""
        return Job(report, self)


def _nothing(*_: object) -> None:
    pass


def at_most_every(
    seconds: float, report: Callable[..., None], *, at_once: bool = True
) -> Callable[..., None]:
    """Return a report that leaves out those that come sooner after the one before.

    Without `at_once` the first comes no sooner after the call of this function either.
    """
    last = -math.inf if at_once else time.monotonic()

    def reported(*status: Any) -> None:
        nonlocal last
        if time.monotonic() - last >= seconds:
            last = time.monotonic()
            report(*status)

    return reported


UNWATCHED = Job()
"""The job of work that nobody watches or cancels: the default of functions that take one."""


def for_blocks(
    work: Callable[[int, int], None],
    n_items: int,
    block: int,
    n_threads: int | None = None,
    job: Job = UNWATCHED,
) -> None:
    """Call `work(start, stop)` for every block of the items, on threads where there are several.

    The blocks do not depend on the number of threads, so neither do their results.

    Parameters
    ----------
    work : must release the interpreter lock to gain from threads
    n_items, block : how many items there are, and how many a block has
    n_threads : one for each core by default
    job : reports (items done, items in all), in their order; checked before each block

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
