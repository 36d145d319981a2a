"""The clock of a motion that plays: which frame is due, and how many are shown in time."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QObject, Qt, QTimer, Signal, Slot

if TYPE_CHECKING:
    from lcollision_core.motion import Motion

_RATE_SECONDS = 1.0
"""Over which the rate that is reached is measured."""


class Playback(QObject):
    """Tells which frame of a motion is due, by the wall clock.

    Attributes
    ----------
    loops : it begins again at the first frame
    speed : 1 for the motion's own rate
    n_dropped : frames left out since it began, as they were not ready in time
    rate : frames a second that are shown

    Signals
    -------
    due : int, the frame whose time has come
    changed : it plays now, or no longer, or otherwise
    """

    due = Signal(int)
    changed = Signal()

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self.loops, self.speed = True, 1.0
        self.n_dropped, self.rate = 0, 0.0
        self._motion: Motion | None = None
        self._first = self._last = self._from = self._shown = 0
        self._began = 0.0
        self._times: list[float] = []
        self._tick = QTimer(self, timerType=Qt.TimerType.PreciseTimer)
        self._tick.timeout.connect(self._on_tick)

    @property
    def playing(self) -> bool:
        """Whether it plays."""
        return self._tick.isActive()

    def play(self, motion: Motion, start: int, first: int, last: int) -> None:
        """Play from a frame on, between two others."""
        self._motion, self._first, self._last = motion, first, last
        self.n_dropped, self.rate, self._times = 0, 0.0, []
        self._begin(start)
        # Twice in a frame, so that none is late by more than half of one.
        self._tick.start(max(1, int(500.0 / (motion.rate * self.speed))))
        self.changed.emit()

    def pause(self) -> None:
        """Stop the clock."""
        if self.playing:
            self._tick.stop()
            self.changed.emit()

    def set_speed(self, speed: float) -> None:
        """Play at so many times the motion's own rate, from where it is."""
        self.speed = speed
        if self.playing and self._motion is not None:
            self.play(self._motion, self._shown, self._first, self._last)
        self.changed.emit()

    def set_loops(self, loops: bool) -> None:
        """Choose whether it begins again."""
        self.loops = loops
        self.changed.emit()

    def note_shown(self, frame: int) -> None:
        """Count a frame that is shown, and those that were left out before it."""
        self.n_dropped += max(0, frame - self._shown - 1)
        self._shown = frame
        now = time.perf_counter()
        self._times = [at for at in self._times if now - at < _RATE_SECONDS] + [now]
        if len(self._times) > 1:
            self.rate = (len(self._times) - 1) / (self._times[-1] - self._times[0])

    def _begin(self, start: int) -> None:
        self._began, self._from, self._shown = time.perf_counter(), start, start

    @Slot()
    def _on_tick(self) -> None:
        assert self._motion is not None
        times = self._motion.times
        now = times[self._from] + (time.perf_counter() - self._began) * self.speed
        frame = int(np.searchsorted(times, now, "right")) - 1
        if now > times[self._last]:
            if not self.loops:
                self.pause()
                self.due.emit(self._last)
                return
            # The last frame of a cycle is its first.
            self._begin(self._first)
            frame = self._first
        elif frame == self._shown:
            return
        self.due.emit(frame)
