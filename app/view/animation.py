"""What moves by itself for a moment: the mesh after Resolve, and the camera."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QAbstractAnimation, QEasingCurve, QObject, QVariantAnimation, Signal


class Animation(QVariantAnimation):
    """Leads once from one state to another, slowly at both ends.

    Parameters
    ----------
    milliseconds : how long it takes
    parent : of the object

    Signals
    -------
    moved : what the function that was given to `begin` returns
    """

    moved = Signal(object)

    def __init__(self, milliseconds: int, parent: QObject) -> None:
        super().__init__(parent, startValue=0.0, endValue=1.0, duration=milliseconds)
        self.setEasingCurve(QEasingCurve.Type.InOutCubic)
        self._at: Callable[[float], object] = lambda _: None

    @property
    def is_running(self) -> bool:
        """Whether the end has not been reached."""
        return self.state() is not QAbstractAnimation.State.Stopped

    def begin(self, at: Callable[[float], object]) -> None:
        """Start anew; `at` returns what is between the states at a fraction from 0 to 1."""
        self.stop()
        self._at = at
        self.start()

    def updateCurrentValue(self, fraction: float) -> None:  # noqa: N802 - Qt's name
        """Tell of the next state."""
        if self.is_running:
            self.moved.emit(self._at(fraction))
