"""One number of the pose: its name, a slider, the number itself."""

from __future__ import annotations

from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QKeyEvent, QMouseEvent
from PySide6.QtWidgets import QHBoxLayout, QWidget

from app.view.theme import CLOSE, ROW_HEIGHT, TIGHT
from app.window.number_box import QuietSpinBox
from app.window.widgets import (
    NAME_SHARE,
    ElidedLabel,
    HoverRow,
    Slider,
    plain_tip,
    show_verdict,
    silent,
)

_STEPS = 1000

_FIELD_WIDTH = 78
"""Of a number of seven signs and its two arrows, in device-independent pixels."""

_BEYOND = 1.5
"""Widths of a slider's range that a number may be typed beyond either end of it."""


class CodeSlider(Slider):
    """A slider whose bar grows from zero to its handle.

    Arrow keys, page keys, Home and End move it, Delete and a double click reset it; the wheel
    moves it only when it has the focus. Ctrl or Shift makes a drag ten times finer.

    Signals
    -------
    drag_started, drag_ended, drag_abandoned : around a drag; the last where Escape ended it
    reset_wanted : to zero

    Parameters
    ----------
    low, high : range of the number, the first below 0 and the second above
    colour : "#rrggbb" of the bar, None for that of the theme
    """

    drag_started = Signal()
    drag_ended = Signal()
    drag_abandoned = Signal()
    reset_wanted = Signal()

    def __init__(self, low: float, high: float, colour: str | None) -> None:
        super().__init__(colour)
        self._low, self._high = low, high
        self.setRange(0, _STEPS)
        self.setSingleStep(_STEPS // 100)
        self.setPageStep(_STEPS // 10)
        self.show_number(0.0)

    @property
    def number(self) -> float:
        """The number that the handle stands for."""
        return self._low + (self._high - self._low) * self.value() / _STEPS

    def show_number(self, number: float) -> None:
        """Move the handle without any signal; beyond the range it stays at the end."""
        share = (number - self._low) / (self._high - self._low)
        with silent(self):
            self.setValue(round(min(max(share, 0.0), 1.0) * _STEPS))
        self.update()

    @property
    def origin(self) -> float:
        """Zero."""
        return -self._low / (self._high - self._low)

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Begin a drag before the handle jumps to the pointer."""
        if event.button() is Qt.MouseButton.LeftButton:
            self.drag_started.emit()
        super().mousePressEvent(event)

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """End the drag, unless Escape did."""
        dragged = self.isSliderDown()
        super().mouseReleaseEvent(event)
        if dragged:
            self.drag_ended.emit()

    def mouseDoubleClickEvent(self, event: QMouseEvent) -> None:  # noqa: ARG002, N802
        """Reset."""
        self.reset_wanted.emit()

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802
        """Reset, abandon a drag, or move as any slider does."""
        if event.key() in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            self.reset_wanted.emit()
        elif event.key() == Qt.Key.Key_Escape and self.isSliderDown():
            self.setSliderDown(False)
            self.drag_abandoned.emit()
        else:
            super().keyPressEvent(event)


class CodeRow(HoverRow):
    """Name, slider and number of one code.

    Signals
    -------
    number_changed : int and float, the code and its number, by the slider or in the field
    reset_wanted : int, the code
    refused : str, why a number that was typed is not taken

    Parameters
    ----------
    code : index from 0 in the latent
    name : what it does
    number : what it is called by its place, in the tool tip
    domain : that it moves
    low, high : range of the slider
    colour : of the bar
    name_width : room that the name takes before the slider gets any but the least
    """

    number_changed = Signal(int, float)
    reset_wanted = Signal(int)
    refused = Signal(str)

    def __init__(
        self,
        code: int,
        name: str,
        number: str,
        domain: int,
        low: float,
        high: float,
        colour: str | None,
        name_width: int,
    ) -> None:
        super().__init__(domain)
        self.code = code
        # Its end tells what the part does.
        label = ElidedLabel(name, Qt.TextElideMode.ElideMiddle)
        label.setMaximumWidth(name_width)
        self.slider = CodeSlider(low, high, colour)
        self.field = QuietSpinBox()
        self.field.setObjectName("code")
        self.field.setDecimals(3)
        beyond = _BEYOND * (high - low)
        self._limits = low - beyond, high + beyond
        self.field.setRange(*self._limits)
        self.field.setSingleStep((high - low) / 100)
        self.field.setAlignment(Qt.AlignmentFlag.AlignRight)
        self.field.setFixedWidth(_FIELD_WIDTH)
        self.slider.setAccessibleName(name)
        self.field.setAccessibleName(f"{name}, number")
        self.slider.setToolTip(
            plain_tip(
                f"{name} ({number}): drag to move, hold Ctrl to move ten times finer, double-click "
                f"to reset"
            )
        )
        self._name = name
        self._trained = low, high
        self._explain(0.0)
        row = QHBoxLayout(self)
        row.setContentsMargins(TIGHT, 0, TIGHT, 0)
        row.setSpacing(CLOSE)
        row.addWidget(label, NAME_SHARE)
        row.addWidget(self.slider, 1)
        row.addWidget(self.field)
        self.setFixedHeight(ROW_HEIGHT)
        self.slider.valueChanged.connect(self._on_slider)
        self.slider.reset_wanted.connect(self._on_reset)
        self.field.valueChanged.connect(self._on_field)
        self.field.refused.connect(self._on_refused)

    def show_number(self, number: float) -> None:
        """Follow the document, also beyond what can be typed."""
        self.slider.show_number(number)
        low, high = self._limits
        with silent(self.field):
            self.field.setRange(min(low, number), max(high, number))
            self.field.setValue(number)
        self._explain(number)

    @property
    def is_outside(self) -> bool:
        """Whether the number is outside the range that the slider reaches."""
        return bool(self.field.property("verdict") == "outside")

    def _explain(self, number: float) -> None:
        """Mark a number outside the trained range, and say what can be typed."""
        low, high = self._trained
        # Half of the last digit, as the end of the range is seldom a round number.
        slack = 0.5 * 10.0 ** -self.field.decimals()
        outside = not low - slack <= number <= high + slack
        if outside == self.is_outside and self.field.toolTip():
            return
        show_verdict(self.field, "outside" if outside else "")
        least, most, *limits = map(self.field.textFromValue, (low, high, *self._limits))
        words = f"type a number from {limits[0]} to {limits[1]}"
        if outside:
            words += f"; this one is outside the trained range, {least} to {most}"
        self.field.setToolTip(plain_tip(f"{self._name}: {words}"))

    def edit_number(self) -> None:
        """Give the field the keyboard, to type a number."""
        self.field.setFocus(Qt.FocusReason.OtherFocusReason)
        self.field.selectAll()

    def _on_slider(self) -> None:
        self.number_changed.emit(self.code, self.slider.number)

    def _on_field(self, number: float) -> None:
        self.number_changed.emit(self.code, number)

    def _on_refused(self, sentence: str) -> None:
        self.refused.emit(f"{self._name}: {sentence}")

    def _on_reset(self) -> None:
        self.reset_wanted.emit(self.code)


def tab_order(rows: list[CodeRow], before: QWidget) -> QWidget:
    """Put rows behind a widget in the order of the Tab key; return the last widget."""
    for row in rows:
        QWidget.setTabOrder(before, row.slider)
        QWidget.setTabOrder(row.slider, row.field)
        before = row.field
    return before
