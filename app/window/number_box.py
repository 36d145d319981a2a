"""A field for a number: what is typed is taken unchanged, or refused with a visible reason."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QPoint, Qt, Signal
from PySide6.QtGui import QKeyEvent, QKeySequence, QValidator, QWheelEvent
from PySide6.QtWidgets import QDoubleSpinBox, QToolTip

from app.window.widgets import wheel_if_focused

_TOLD_MILLISECONDS = 8000


class NumberBox(QDoubleSpinBox):
    """A number that the wheel changes only when it has the focus.

    Signals
    -------
    refused : str, why a number that was typed is not taken; it stands beside the field for some
        seconds too, and the field shows the number before

    Parameters
    ----------
    decimals : behind the point, 0 for a whole number
    low, high : limits
    trims : whether zeros at the end are left out; more than three decimals always are
    """

    refused = Signal(str)

    _trims = False

    def __init__(self, decimals: int, low: float, high: float, *, trims: bool = False) -> None:
        super().__init__()
        self._trims = trims or decimals > 3
        self.setDecimals(decimals)
        self.setRange(low, high)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setKeyboardTracking(False)

    def textFromValue(self, value: float) -> str:  # noqa: N802
        """Write many decimals only if they carry information."""
        text = super().textFromValue(value)
        if not self._trims:
            return text
        return text.rstrip("0").rstrip(self.locale().decimalPoint())

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Leave the wheel to the panel's scrolling unless focused."""
        wheel_if_focused(self, event, super().wheelEvent)

    def event(self, event: QEvent) -> bool:
        """Leave Undo and Redo to the pose: what is typed is a step of it."""
        if event.type() is QEvent.Type.ShortcutOverride and isinstance(event, QKeyEvent):
            keys = (QKeySequence.StandardKey.Undo, QKeySequence.StandardKey.Redo)
            if any(event.matches(key) for key in keys):
                event.ignore()
                return False
        return super().event(event)

    def validate(self, text: str, position: int) -> tuple[QValidator.State, str, int]:
        """Let any number be typed; its value is checked when it is complete."""
        found = super().validate(text, position)
        if found[0] is QValidator.State.Invalid and self._is_beyond(text):
            return QValidator.State.Intermediate, text, position
        return found

    def fixup(self, text: str) -> str:
        """Refuse a number beyond the field's range."""
        if not self._is_beyond(text):
            return text
        typed = text.removesuffix(self.suffix()).strip()[:20]
        least, most = map(self.textFromValue, (self.minimum(), self.maximum()))
        sentence = f"{typed} is out of range: type a number from {least} to {most}"
        self.refused.emit(sentence)
        if self.isVisible():
            below = self.mapToGlobal(QPoint(0, self.height() // 2))
            QToolTip.showText(below, sentence, self, self.rect(), _TOLD_MILLISECONDS)
        return text

    def _is_beyond(self, text: str) -> bool:
        """Whether a text is a number, in the user's language, beyond the field's range."""
        number, is_number = self.locale().toDouble(text.removesuffix(self.suffix()).strip())
        return is_number and not self.minimum() <= number <= self.maximum()
