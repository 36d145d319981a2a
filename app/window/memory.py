"""Memory of the process: garbage collection between two events, and freed memory."""

from __future__ import annotations

import ctypes
import gc
import sys

from PySide6.QtCore import QObject, Qt, QTimer, Slot
from PySide6.QtGui import QGuiApplication

_MILLISECONDS = 1000

_MOST_PUT_OFF = 20
"""Most collections in a row that a pressed mouse button defers: Qt may miss a release."""


class GarbageCollector(QObject):
    """Replace Python's automatic collection until closed.

    Python collects wherever something is allocated: in a worker thread, where no widget may be
    destroyed, or while Qt destroys another object, where it deadlocks on Qt's locks.

    Parameters
    ----------
    parent : the application
    """

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        gc.disable()
        self._n_put_off = 0
        self._timer = QTimer(self, interval=_MILLISECONDS)
        self._timer.timeout.connect(self.collect_some)
        self._timer.start()

    @Slot()
    def collect_some(self) -> None:
        """Collect the generations that are due, unless a drag would stutter."""
        is_pressed = QGuiApplication.mouseButtons() != Qt.MouseButton.NoButton
        if is_pressed and self._n_put_off < _MOST_PUT_OFF:
            self._n_put_off += 1
            return
        self._n_put_off = 0
        limits, counts = gc.get_threshold(), gc.get_count()
        due = [generation for generation in range(3) if counts[generation] > limits[generation]]
        if due:
            gc.collect(due[-1])

    def close(self) -> None:
        """Restore Python's automatic collection."""
        self._timer.stop()
        gc.enable()


# As in glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8

_MOST_UNUSED = 32 * 1024 * 1024
"""Freed memory to keep, in bytes. Each paint copies the image of the window, 5 MB at 1440 x 900:
fetching that memory from the system each time took longer than the copy."""

_N_ARENAS = 2


def keep_memory_small() -> None:
    """Return most freed memory to the system, and share memory arenas between threads.

    By default each thread gets its own arena, and memory freed in an arena stays there. Call this
    before the first thread starts. It does nothing unless the C library is glibc.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _N_ARENAS)
        # Blocks above this size are mapped separately and returned when freed.
        mallopt(_M_MMAP_THRESHOLD, _MOST_UNUSED)
        mallopt(_M_TRIM_THRESHOLD, _MOST_UNUSED)
