"""Progress, cancellation and threads of long work."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from lcollision_core.errors import CancelledError

Progress = Callable[[int, int], None]
"""Called with (done, total), in items of the work's own unit, from the thread that works."""


def no_progress(*_: object) -> None:
    """Ignore the progress: the default of functions that report theirs."""


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class CancelToken:
    """A flag that one thread sets and another polls; safe to share between threads.

    Parameters
    ----------
    others : tokens that set this one too
    """

    def __init__(self, *others: CancelToken) -> None:
        self._event, self._others = threading.Event(), others

    def cancel(self) -> None:
        """Ask the work to stop at its next checkpoint."""
        self._event.set()

    @property
    def cancelled(self) -> bool:
        """Whether `cancel` has been called, of this one or of those that set it."""
        return self._event.is_set() or any(other.cancelled for other in self._others)

    def raise_if_cancelled(self) -> None:
        """Raise `CancelledError` once `cancel` has been called."""
        if self.cancelled:
            raise CancelledError("cancelled on request")


def for_blocks(
    work: Callable[[int, int], None],
    n_items: int,
    block: int,
    n_threads: int | None = None,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> None:
    """Call `work(start, stop)` for every block of the items, on threads where there are several.

    The blocks do not depend on the number of threads, so neither do their results.

    Parameters
    ----------
    work : must release the interpreter lock to gain from threads
    n_items, block : how many items there are, and how many a block has
    n_threads : one for each core by default
    progress : called with (items done, items in all), in their order
    cancel : polled before each block

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    starts = range(0, n_items, block)

    def run(start: int) -> int:
        if cancel is not None:
            cancel.raise_if_cancelled()
        stop = min(start + block, n_items)
        work(start, stop)
        return stop

    n_threads = min(available_cores() if n_threads is None else n_threads, len(starts))
    if n_threads <= 1:
        for stop in map(run, starts):
            progress(stop, n_items)
        return
    pool = ThreadPoolExecutor(n_threads)
    try:
        for stop in pool.map(run, starts):
            progress(stop, n_items)
    finally:
        pool.shutdown(cancel_futures=True)
