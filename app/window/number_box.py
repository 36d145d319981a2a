"""Fields for numbers: what is typed is taken as it is, or refused in a sentence that is seen."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QPoint, Qt, Signal
from PySide6.QtGui import QKeyEvent, QKeySequence, QValidator, QWheelEvent
from PySide6.QtWidgets import QAbstractSpinBox, QDoubleSpinBox, QSpinBox, QToolTip

from app.window.widgets import wheel_if_focused

_TOLD_MILLISECONDS = 8000


class QuietSpinBox(QDoubleSpinBox):
    """A number that the wheel changes only when it has the focus.

    Signals
    -------
    refused : str, why a number that was typed is not taken; it stands beside the field for some
        seconds too, and the field shows the number before
    """

    refused = Signal(str)

    def __init__(self) -> None:
        super().__init__()
        _make_quiet(self)

    def textFromValue(self, value: float) -> str:  # noqa: N802
        """Write many decimals only where they say something."""
        text = super().textFromValue(value)
        if self.decimals() <= 3:
            return text
        return text.rstrip("0").rstrip(self.locale().decimalPoint())

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Leave the wheel to the panel's scrolling unless focused."""
        wheel_if_focused(self, event, super().wheelEvent)

    def event(self, event: QEvent) -> bool:
        """Leave Undo and Redo to the pose: what is typed is a step of it."""
        if event.type() is QEvent.Type.ShortcutOverride and isinstance(event, QKeyEvent):
            kinds = (QKeySequence.StandardKey.Undo, QKeySequence.StandardKey.Redo)
            if any(event.matches(kind) for kind in kinds):
                event.ignore()
                return False
        return super().event(event)

    def validate(self, text: str, place: int) -> tuple[QValidator.State, str, int]:
        """Let any number be typed; whether it can be taken is told when it is there."""
        return _validated(self, super().validate(text, place), text, place)

    def fixup(self, text: str) -> str:
        """Refuse a number beyond the field's range."""
        limits = self.textFromValue(self.minimum()), self.textFromValue(self.maximum())
        _refuse_beyond(self, text, *limits)
        return text


class QuietIntegerBox(QSpinBox):
    """A whole number; else like `QuietSpinBox`."""

    refused = Signal(str)

    def __init__(self) -> None:
        super().__init__()
        _make_quiet(self)

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Leave the wheel to the panel's scrolling unless focused."""
        wheel_if_focused(self, event, super().wheelEvent)

    def validate(self, text: str, place: int) -> tuple[QValidator.State, str, int]:
        """Let any number be typed; whether it can be taken is told when it is there."""
        return _validated(self, super().validate(text, place), text, place)

    def fixup(self, text: str) -> str:
        """Refuse a number beyond the field's range."""
        limits = self.textFromValue(self.minimum()), self.textFromValue(self.maximum())
        _refuse_beyond(self, text, *limits)
        return text


def _make_quiet(field: QAbstractSpinBox) -> None:
    field.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
    field.setKeyboardTracking(False)


def _is_beyond(field: QuietSpinBox | QuietIntegerBox, text: str) -> bool:
    """Whether a text is a number, in the user's language, beyond the field's range."""
    number, is_number = field.locale().toDouble(text.removesuffix(field.suffix()).strip())
    return is_number and not field.minimum() <= number <= field.maximum()


def _validated(
    field: QuietSpinBox | QuietIntegerBox,
    found: tuple[QValidator.State, str, int],
    text: str,
    place: int,
) -> tuple[QValidator.State, str, int]:
    """Turn Qt's refusal of a key into a wait for the rest, where the text is a number."""
    if found[0] is QValidator.State.Invalid and _is_beyond(field, text):
        return QValidator.State.Intermediate, text, place
    return found


def _refuse_beyond(field: QuietSpinBox | QuietIntegerBox, text: str, least: str, most: str) -> None:
    if not _is_beyond(field, text):
        return
    typed = text.removesuffix(field.suffix()).strip()[:20]
    sentence = f"{typed} is outside what can be typed here: type a number from {least} to {most}"
    field.refused.emit(sentence)
    if field.isVisible():
        below = field.mapToGlobal(QPoint(0, field.height() // 2))
        QToolTip.showText(below, sentence, field, field.rect(), _TOLD_MILLISECONDS)
