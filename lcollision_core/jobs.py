"""Progress and cancellation of long work."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

from lcollision_core.errors import CancelledError

Progress = Callable[[int, int], None]
"""Called with (done, total), in items of the work's own unit, from the thread that works."""


def no_progress(done: int, total: int) -> None:
    """Report to nobody: the default of functions that take a `Progress`."""


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class CancelToken:
    """A flag that one thread sets and another polls; safe to share between threads."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def cancel(self) -> None:
        """Ask the work to stop at its next checkpoint."""
        self._event.set()

    @property
    def cancelled(self) -> bool:
        """Whether `cancel` has been called."""
        return self._event.is_set()

    def raise_if_cancelled(self) -> None:
        """Raise `CancelledError` once `cancel` has been called."""
        if self.cancelled:
            raise CancelledError("cancelled on request")
