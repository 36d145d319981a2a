"""Cyclic garbage collection between two events of the GUI thread only."""

from __future__ import annotations

import gc

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
