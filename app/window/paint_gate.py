"""Draws the window once where a slider and the mesh that follows it come an instant apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QCoreApplication, QEvent, QObject, Qt, Slot
from PySide6.QtWidgets import QWidget

from app.work.threads import single_shot

if TYPE_CHECKING:
    from app.editing.live_pose import PoseMotion

_PATIENCE_MILLISECONDS = 16
"""The longest that drawing waits for a frame: one picture of a screen that draws 60 a second."""


class PaintGate(QObject):
    """Puts off drawing a window while a quick frame of the pose is on its way.

    Drawing the window twice would cost the most of all. Nothing waits meanwhile.

    Parameters
    ----------
    window : at the top level
    motion : brings the frames
    """

    def __init__(self, window: QWidget, motion: PoseMotion) -> None:
        super().__init__(window)
        self._window, self._motion = window, motion
        self._is_held = False
        self._patience = single_shot(self, _PATIENCE_MILLISECONDS, self._on_late)
        self._patience.setTimerType(Qt.TimerType.PreciseTimer)
        window.installEventFilter(self)
        motion.frame_changed.connect(self._open)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Hold the window's request to be drawn, unless it has been held for long."""
        if event.type() is not QEvent.Type.UpdateRequest or not self._motion.expects_frame:
            return super().eventFilter(watched, event)
        self._is_held = True
        if not self._patience.isActive():
            self._patience.start(_PATIENCE_MILLISECONDS)
        return True

    def close(self) -> None:
        """Hold nothing any more."""
        self._window.removeEventFilter(self)
        self._motion.frame_changed.disconnect(self._open)
        self._patience.stop()

    @Slot()
    def _on_late(self) -> None:
        self._motion.stop_expecting()
        self._open()

    @Slot()
    def _open(self) -> None:
        if self._is_held and not self._motion.expects_frame:
            self._is_held = False
            self._patience.stop()
            update = QEvent(QEvent.Type.UpdateRequest)
            QCoreApplication.postEvent(
                self._window, update, Qt.EventPriority.LowEventPriority.value
            )
