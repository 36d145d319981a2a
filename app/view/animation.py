"""Short animations: of the mesh after Resolve, and of the camera."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QAbstractAnimation, QEasingCurve, QObject, QVariantAnimation, Signal


class Animation(QVariantAnimation):
    """Animates once from one state to another, eased at both ends.

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
        """Whether it is running."""
        return self.state() is not QAbstractAnimation.State.Stopped

    def begin(self, at: Callable[[float], object]) -> None:
        """Start again; `at` returns the state at a fraction from 0 to 1."""
        self.stop()
        self._at = at
        self.start()

    def updateCurrentValue(self, fraction: float) -> None:  # noqa: N802 - Qt's name
        """Emit the next state."""
        if self.is_running:
            self.moved.emit(self._at(fraction))
