"""One number of the pose: its name, a slider, the number itself."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QKeyEvent, QMouseEvent, QResizeEvent

from app.editing.live_pose import code_name
from app.view.theme import CLOSE, ROW_HEIGHT, TIGHT
from app.window.number_box import NumberBox
from app.window.widgets import (
    LEAST_TRACK,
    NAME_SHARE,
    ElidedLabel,
    HoverRow,
    Slider,
    hbox,
    plain_tip,
    show_verdict,
    silent,
)
from app.wording import heading

if TYPE_CHECKING:
    from app.editing.document import PoseDocument

_OF_CODES = 1000.0
"""What a bare code counts in its slider's whole numbers, which assistive technologies read."""

_KEYS: dict[int, float] = {
    **dict.fromkeys((Qt.Key.Key_Right, Qt.Key.Key_Up), 0.01),
    **dict.fromkeys((Qt.Key.Key_Left, Qt.Key.Key_Down), -0.01),
    Qt.Key.Key_PageUp: 0.1,
    Qt.Key.Key_PageDown: -0.1,
}
"""What keys move a handle by, as fractions of the range."""

_DECIMALS, _DECIMALS_OF_UNITS = 3, 1
"""Of bare codes, and of degrees and per cent."""

_FIELD_WIDTH, _ARROWS_WIDTH, _NARROW = 56, 22, 270
"""Widths of a number of seven characters, of its arrows, and of a row that has no space for these,
in device-independent pixels."""

_BEYOND = 1.5
"""Widths of a slider's range that a number may be typed beyond either end of it."""


class CodeSlider(Slider):
    """A slider whose bar grows from zero to its handle.

    Arrow keys, page keys, Home and End move it, Delete and a double click reset it; the wheel
    moves it only when it has the focus. Ctrl or Shift makes a drag ten times finer.

    Signals
    -------
    drag_started, drag_ended : around a drag, unless Escape ends it: see `Slider`
    click_unwanted : of a double click, whose first press may have moved the handle
    reset_wanted : to zero
    number_wanted : float, by mouse, keys or an assistive technology

    Parameters
    ----------
    low, high : range of the number, the first below 0 and the second above
    shown : people are shown the number times this, as degrees, which `value` rounds
    colour : "#rrggbb" of the bar, None for that of the theme
    """

    drag_started = Signal()
    drag_ended = Signal()
    click_unwanted = Signal()
    reset_wanted = Signal()
    number_wanted = Signal(float)

    def __init__(self, low: float, high: float, shown: float, colour: str | None) -> None:
        super().__init__(colour)
        self._shown = _OF_CODES if shown == 1.0 else shown
        self._low, self._high = low * self._shown, high * self._shown
        self._place = 0.0
        self.setRange(math.floor(self._low), math.ceil(self._high))
        self.setSingleStep(max(1, round((self._high - self._low) / 100)))
        self.setPageStep(max(1, round((self._high - self._low) / 10)))
        self.valueChanged.connect(self.move_to)
        self.show_number(0.0)

    @property
    def ends(self) -> tuple[float, float]:
        """The range, as it is shown."""
        return self._low, self._high

    @property
    def place(self) -> float:
        """The number, as it is shown, between two whole ones too."""
        return self._place

    @property
    def number(self) -> float:
        """The number that the handle stands for."""
        return self._place / self._shown

    def move_to(self, place: float) -> None:
        """Move the handle, and ask for its number."""
        self._show(place)
        self.number_wanted.emit(self.number)

    def show_number(self, number: float) -> None:
        """Move the handle without any signal; beyond the range it stays at the end."""
        self._show(number * self._shown)

    def _show(self, place: float) -> None:
        self._place = min(max(place, self._low), self._high)
        with silent(self):
            self.setValue(round(self._place))
        self.update()

    def show_held(self, number: float | None) -> None:
        """Mark where contact holds the number, although the handle is elsewhere; None for none."""
        span = self._high - self._low
        held = None
        if number is not None:
            held = min(max((number * self._shown - self._low) / span, 0.0), 1.0)
        if held != self.held_at:
            self.held_at = held
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

    def mouseDoubleClickEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Reset."""
        if event.button() is Qt.MouseButton.LeftButton:
            self.click_unwanted.emit()
            self.reset_wanted.emit()

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802
        """Reset, or move as any slider does."""
        if event.key() in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            self.reset_wanted.emit()
        elif event.key() in _KEYS:
            self.move_to(self._place + _KEYS[event.key()] * (self._high - self._low))
        else:
            super().keyPressEvent(event)


class CodeRow(HoverRow):
    """Name, slider and number of one code.

    Signals
    -------
    asked : float, the number that the user wants; what comes may be less, where contact holds

    Parameters
    ----------
    document : changed
    code : index from 0 in the latent
    index : from 0 in its group
    domain : of its group, None for the whole body's
    name_width : width of the name before the slider gets more than its least

    Attributes
    ----------
    number : of the pose that is shown, NaN while the user changes it
    """

    asked = Signal(float)

    def __init__(
        self, document: PoseDocument, code: int, index: int, domain: int | None, name_width: int
    ) -> None:
        model = document.model
        moved = model.code_effects[code].domain if domain is None else domain
        super().__init__(moved)
        self._document = document
        self.menu_of = (domain, code)
        self.code = code
        self._name = name = heading(model.code_names[code])
        space = model.latent_space
        self._range = low, high = float(space.low[code]), float(space.high[code])
        self._is_trained = model.is_trained
        # What the field shows of a code: degrees, for example.
        self._shown, self._unit = float(space.shown[code]), space.units[code]
        # Its end tells what the part does.
        label = ElidedLabel(name, Qt.TextElideMode.ElideMiddle)
        label.setMaximumWidth(name_width)
        self.slider = CodeSlider(
            low, high, float(space.shown[code]), model.card.domain_colours[moved]
        )
        self._explained: tuple[bool, bool] | None = None
        beyond = _BEYOND * (high - low)
        self._limits = self._field_limits = low - beyond, high + beyond
        decimals = _DECIMALS if self._shown == 1.0 else _DECIMALS_OF_UNITS
        least, most = (self._shown * limit for limit in self._limits)
        self.field = NumberBox(decimals, least, most)
        self.field.setSuffix(self._unit)
        self.field.setObjectName("code")
        self.field.setSingleStep(self._shown * (high - low) / 100)
        self.field.setAlignment(Qt.AlignmentFlag.AlignRight)
        self.field.setFixedWidth(_FIELD_WIDTH + _ARROWS_WIDTH)
        source = f"motion {index + 1}"
        if not model.is_trained:
            source = next(g for g in space.groups if code < g.codes.stop).code_names[index]
        full = heading(code_name(document.model, code))
        self.slider.setAccessibleName(full)
        self.field.setAccessibleName(f"{full}, number")
        self.slider.setToolTip(
            plain_tip(
                f"{name} ({source}): drag to move, hold Ctrl to move ten times finer, "
                "double-click to reset"
            )
        )
        line = hbox(label, self.slider, self.field, wide=self.slider, margins=(TIGHT, 0, TIGHT, 0))
        line.setStretchFactor(label, NAME_SHARE)
        self.setLayout(line)
        self.setFixedHeight(ROW_HEIGHT)
        self.show_number(float(document.history.latent[code]))
        self._n_steps = 0
        self.slider.drag_started.connect(self._on_drag_started)
        self.slider.click_unwanted.connect(self._on_click_unwanted)
        self.slider.drag_ended.connect(self._on_drag_ended)
        self.slider.drag_abandoned.connect(document.motion.cancel_gesture)
        self.slider.number_wanted.connect(self._move)
        self.slider.reset_wanted.connect(lambda: document.motion.reset_code(code))
        self.field.valueChanged.connect(lambda shown: self._move(shown / self._shown))
        self.field.refused.connect(lambda told: document.message.emit(f"{name}: {told}"))

    @staticmethod
    def width_beside(name: int) -> int:
        """Return the least width of a row whose name has this width and is not cut."""
        return name + LEAST_TRACK + _FIELD_WIDTH + _ARROWS_WIDTH + 2 * CLOSE + 2 * TIGHT

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Leave the arrows of a narrow row's number to its name."""
        super().resizeEvent(event)
        kinds = NumberBox.ButtonSymbols
        is_narrow = self.width() < _NARROW
        self.field.setButtonSymbols(kinds.NoButtons if is_narrow else kinds.UpDownArrows)
        self.field.setFixedWidth(_FIELD_WIDTH + (0 if is_narrow else _ARROWS_WIDTH))

    def show_number(self, number: float) -> None:
        """Follow the document, also beyond what can be typed; a handle that is held stays."""
        self.number = number
        if not self.slider.isSliderDown():
            self.slider.show_number(number)
        low, high = self._limits
        with silent(self.field):
            limits = min(low, number), max(high, number)
            if limits != self._field_limits:
                # Each time, Qt lays out the panel anew.
                self.field.setRange(*(self._shown * limit for limit in limits))
                self._field_limits = limits
            self.field.setValue(self._shown * number)
        # With its unit, and finer than the slider's own value.
        self.slider.setAccessibleDescription(self.field.text())
        self._explain(number)

    def _move(self, number: float) -> None:
        # Whatever the pose gets, which may stop before at contact, is shown again.
        self.number = np.nan
        self.asked.emit(number)
        self._document.motion.set_code(self.code, number)

    def _explain(self, number: float) -> None:
        """Mark a number outside the slider's range, and say what can be typed."""
        low, high = self._range
        # Half of the last digit, as the end of the range is seldom a round number.
        slack = 0.5 * 10.0 ** -self.field.decimals() / self._shown
        outside = not low - slack <= number <= high + slack
        held = bool(self.field.property("held"))
        if (outside, held) == self._explained:
            return
        self._explained = outside, held
        show_verdict(self.field, "outside" if outside else "")
        least, most, *limits = (
            self.field.textFromValue(self._shown * number) + self._unit
            for number in (low, high, *self._limits)
        )
        words = f"type a number from {limits[0]} to {limits[1]}"
        if outside:
            kind = "trained range" if self._is_trained else "joint's range"
            words += f"; this one is outside the {kind}, {least} to {most}"
        if held:
            words = f"stopped by contact; {words}"
        self.field.setToolTip(plain_tip(f"{self._name}: {words}"))

    def show_held(self, number: float | None) -> None:
        """Mark where contact holds the number, although another was asked for; None for nowhere."""
        self.slider.show_held(number)
        self.field.setProperty("held", number is not None)
        self._explain(self.field.value() / self._shown)

    def _on_drag_started(self) -> None:
        document = self._document
        document.motion.begin_gesture(f"Move {code_name(document.model, self.code)}")
        self._n_steps = document.history.undo_stack.index()

    def _on_click_unwanted(self) -> None:
        document = self._document
        if document.motion.moving or document.history.undo_stack.index() > self._n_steps:
            document.history.undo()

    def _on_drag_ended(self) -> None:
        self._document.motion.end_gesture()
        self.slider.show_number(float(self._document.history.latent[self.code]))

    def edit_number(self) -> None:
        """Give the field the keyboard, to type a number."""
        self.field.setFocus(Qt.FocusReason.OtherFocusReason)
        self.field.selectAll()
