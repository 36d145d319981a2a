"""Paint the window once for a slider and the mesh that follows it an instant later."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QCoreApplication, QEvent, QObject, Qt, Slot
from PySide6.QtWidgets import QWidget

from app.work.threads import single_shot

if TYPE_CHECKING:
    from app.editing.live_pose import PoseMotion

_PATIENCE_MILLISECONDS = 16
"""Longest time that painting waits for a frame: one refresh of a 60 Hz screen."""


class PaintGate(QObject):
    """Defer painting a window while a quick frame of the pose is expected.

    Painting the window twice would cost more than all else. Nothing blocks meanwhile.

    Parameters
    ----------
    window : top-level
    motion : the source of the frames
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
        """Hold back the window's update request while a frame is expected."""
        if event.type() is not QEvent.Type.UpdateRequest or not self._motion.expects_frame:
            return super().eventFilter(watched, event)
        self._is_held = True
        if not self._patience.isActive():
            self._patience.start(_PATIENCE_MILLISECONDS)
        return True

    def close(self) -> None:
        """Stop deferring."""
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
