"""The panel of sliders, one for each code of `Body.latent_space`, and the row that randomises."""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QPoint, QSize, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QAction, QKeyEvent, QMouseEvent, QResizeEvent
from PySide6.QtWidgets import QLineEdit, QToolButton, QWidget

from app.editing.live_pose import code_name
from app.view.theme import CLOSE, ICON_SIZE, NORMAL, ROW_HEIGHT, TIGHT, give_icon
from app.window.layout import Docking, bring_up
from app.window.widgets import (
    LEAST_TRACK,
    NAME_SHARE,
    SWATCH,
    HoverRow,
    NameLabel,
    NumberBox,
    Slider,
    described,
    hbox,
    labelled,
    longest_name,
    plain_tip,
    scrolling,
    show_verdict,
    signals_blocked,
    vbox,
)
from lcollision_core.tasks.words import heading, joined, say

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.bodies import LatentGroup


_OF_CODES = 1000.0
"""Integer steps of a slider per unit of a code without a unit; assistive technologies read them."""

_KEYS: dict[int, float] = {
    **dict.fromkeys((Qt.Key.Key_Right, Qt.Key.Key_Up), 0.01),
    **dict.fromkeys((Qt.Key.Key_Left, Qt.Key.Key_Down), -0.01),
    Qt.Key.Key_PageUp: 0.1,
    Qt.Key.Key_PageDown: -0.1,
}
"""Steps of the keys, as fractions of the range."""

_DECIMALS, _DECIMALS_OF_UNITS = 3, 1
"""Decimals of codes without a unit, and of degrees and per cent."""

_FRAME_WIDTH, _ARROWS_WIDTH, _NARROW = 6, 22, 270
"""Widths of a number's frame, of its arrows, and of a row below which the arrows are hidden, in
device-independent pixels."""

_OF_HUNDRED = 4
"""Further width of a number up to 100.0 %."""

_BEYOND = 1.5
"""How far a typed number may be beyond either end of the slider's range, in widths of the range."""


class CodeSlider(Slider):
    """A slider whose bar grows from zero to its handle.

    Arrow keys, page keys, Home and End move it; Delete and a double click reset it. The wheel
    moves it only when it has the focus. Ctrl or Shift makes a drag ten times finer.

    Signals
    -------
    drag_started, drag_ended : around a drag; `drag_abandoned` replaces the latter on Escape
    click_unwanted : emitted on a double click, whose first press may have moved the handle
    reset_wanted : to zero
    number_wanted : float, set by mouse, keys or an assistive technology

    Parameters
    ----------
    low, high : range of the number, the first below 0 and the second above
    shown : factor from the number to the displayed unit, such as degrees; `value` rounds the
        product
    colour : "#rrggbb" of the bar, None for the theme's accent
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
    def value_range(self) -> tuple[float, float]:
        """Range in the displayed unit."""
        return self._low, self._high

    @property
    def place(self) -> float:
        """Number in the displayed unit, not rounded."""
        return self._place

    @property
    def number(self) -> float:
        """Number at the handle."""
        return self._place / self._shown

    def move_to(self, place: float) -> None:
        """Move the handle, and request its number."""
        self._show(place)
        self.number_wanted.emit(self.number)

    def show_number(self, number: float) -> None:
        """Move the handle without a signal; the number is clamped to the range."""
        self._show(number * self._shown)

    def _show(self, place: float) -> None:
        self._place = min(max(place, self._low), self._high)
        with signals_blocked(self):
            self.setValue(round(self._place))
        self.update()

    def show_contact_limit(self, number: float | None) -> None:
        """Mark the number at which contact stopped the handle's; None removes the mark."""
        span = self._high - self._low
        held_span = None
        if number is not None:
            held_span = min(max((number * self._shown - self._low) / span, 0.0), 1.0)
        if held_span != self.contact_position:
            self.contact_position = held_span
            self.update()

    @property
    def origin(self) -> float:
        """Fraction of the groove at zero."""
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
        """Undo the first click of the double click, and reset."""
        if event.button() is Qt.MouseButton.LeftButton:
            self.click_unwanted.emit()
            self.reset_wanted.emit()

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802
        """Reset on Delete or Backspace, or move the handle."""
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
    requested : float, the number that the user wants; contact may stop the pose before it

    Parameters
    ----------
    document : changed by the row
    code : index from 0 in the latent
    index : from 0 in its group
    domain : of its group, None for the whole body's

    Attributes
    ----------
    name : "body: name" in a scene of several bodies
    number : of the pose shown, NaN while the user changes it
    """

    requested = Signal(float)

    def __init__(self, document: PoseDocument, code: int, index: int, domain: int | None) -> None:
        model = document.model
        moved = model.code_effects[code].domain if domain is None else domain
        super().__init__(moved)
        self._document = document
        self.menu_of = (domain, code)
        self.code = code
        is_shape = code >= model.shape_codes.start
        # A shape keeps its name from the file.
        self.name = name = model.code_names[code] if is_shape else heading(model.code_names[code])
        space = model.latent_space
        self._range = low, high = float(space.low[code]), float(space.high[code])
        self._is_trained, self._is_shape = model.is_trained, is_shape
        # Factor and unit in which the field shows a code, such as degrees.
        self._shown, self._unit = float(space.shown[code]), space.units[code]
        self._at_rest = float(space.at_rest[code])
        # The end of a name says how the body part moves; many shapes have the same start, too.
        elide = Qt.TextElideMode.ElideLeft if is_shape else Qt.TextElideMode.ElideMiddle
        self._label = NameLabel(name, elide)
        self.slider = CodeSlider(
            low, high, float(space.shown[code]), model.card.domain_colours[moved]
        )
        self._explained: tuple[bool, bool] | None = None
        beyond = _BEYOND * (high - low)
        self._limits = self._field_limits = low - beyond, high + beyond
        decimals = _DECIMALS if self._shown == 1.0 else _DECIMALS_OF_UNITS
        least, most = map(self._in_field, self._limits)
        self.field = NumberBox(decimals, least, most)
        self.field.setSuffix(self._unit)
        self.field.setObjectName("code")
        self.field.setSingleStep(self._shown * (high - low) / 100)
        self.field.setAlignment(Qt.AlignmentFlag.AlignRight)
        self._field_width = _number_width(self) + (_OF_HUNDRED if is_shape else 0)
        self.field.setFixedWidth(self._field_width + _ARROWS_WIDTH)
        source = f"motion {index + 1}"
        if not model.is_trained:
            source = next(g for g in space.groups if code < g.codes.stop).code_names[index]
        named = f"{name} ({source})" if source != name else name
        full = name if is_shape else heading(code_name(document.model, code))
        tip = f"{named}: drag to move, hold Ctrl to move ten times finer, double-click to reset"
        described(self.slider, plain_tip(tip), full)
        self.field.setAccessibleName(f"{full}, number")
        row = (self._label, self.slider, self.field)
        line = hbox(*row, wide=self.slider, spacing=TIGHT, margins=(TIGHT, 0, TIGHT, 0))
        line.setStretchFactor(self._label, NAME_SHARE)
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
        self.field.valueChanged.connect(lambda value: self._move(self._from_field(value)))
        self.field.refused.connect(lambda reason: document.message.emit(f"{name}: {reason}"))

    @staticmethod
    def width_beside(name: int, number: int) -> int:
        """Return the least width of a row in which names and numbers of these widths are whole."""
        return name + LEAST_TRACK + number + _ARROWS_WIDTH + 4 * TIGHT

    def show_name(self, name: str, width: int) -> None:
        """Show a name, which takes this width before the slider grows beyond its minimum."""
        self._label.setText(name)
        self._label.setMaximumWidth(width)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Hide the arrows of the number in a narrow row, to leave space for the name."""
        super().resizeEvent(event)
        kinds = NumberBox.ButtonSymbols
        is_narrow = self.width() < _NARROW
        self.field.setButtonSymbols(kinds.NoButtons if is_narrow else kinds.UpDownArrows)
        self.field.setFixedWidth(self._field_width + (0 if is_narrow else _ARROWS_WIDTH))

    def show_number(self, number: float) -> None:
        """Show a number of the document, even beyond the typing limits; a held handle stays."""
        self.number = number
        if not self.slider.isSliderDown():
            self.slider.show_number(number)
        low, high = self._limits
        with signals_blocked(self.field):
            limits = min(low, number), max(high, number)
            if limits != self._field_limits:
                # Only if changed: Qt lays out the panel again.
                self.field.setRange(*map(self._in_field, limits))
                self._field_limits = limits
            self.field.setValue(self._in_field(number))
        # The field's text has the unit, and is finer than the slider's value.
        self.slider.setAccessibleDescription(self.field.text())
        self._explain(number)

    def _in_field(self, number: float) -> float:
        """Convert a code to the number in its field."""
        return self._shown * (number + self._at_rest)

    def _from_field(self, value: float) -> float:
        return value / self._shown - self._at_rest

    def _move(self, number: float) -> None:
        # NaN differs from any number, so the pose's number is shown, wherever contact stops it.
        self.number = np.nan
        self.requested.emit(number)
        self._document.motion.set_code(self.code, number)

    def _explain(self, number: float) -> None:
        """Mark a number outside the slider's range, and state the typing limits."""
        low, high = self._range
        # Allow half of the last digit: the end of the range is seldom a round number.
        slack = 0.5 * 10.0 ** -self.field.decimals() / self._shown
        outside = not low - slack <= number <= high + slack
        is_held = bool(self.field.property("held"))
        if (outside, is_held) == self._explained:
            return
        self._explained = outside, is_held
        show_verdict(self.field, "outside" if outside else "")
        least, most, *limits = (
            self.field.textFromValue(self._in_field(number)) + self._unit
            for number in (low, high, *self._limits)
        )
        ends = {"low": least, "high": most}
        words = say("type a number from {low} to {high}", low=limits[0], high=limits[1])
        beyond = ""
        if outside and self._is_trained:
            beyond = say("this one is outside the trained range, {low} to {high}", **ends)
        elif outside and self._is_shape:
            beyond = say("this one is outside the shape's range, {low} to {high}", **ends)
        elif outside:
            beyond = say("this one is outside the joint's range, {low} to {high}", **ends)
        words = joined(("stopped by contact" if is_held else "", words, beyond))
        self.field.setToolTip(plain_tip(f"{self.name}: {words}"))

    def show_contact_limit(self, number: float | None) -> None:
        """Mark the number at which contact stopped the requested one; None removes the mark."""
        self.slider.show_contact_limit(number)
        self.field.setProperty("held", number is not None)
        self._explain(self._from_field(self.field.value()))

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
        """Focus the field, to type a number."""
        self.field.setFocus(Qt.FocusReason.OtherFocusReason)
        self.field.selectAll()


def _number_width(widget: QWidget) -> int:
    """Return the width of a field for seven characters in a widget's font, without arrows."""
    return widget.fontMetrics().horizontalAdvance("000.000") + _FRAME_WIDTH


FloatArray = npt.NDArray[np.float64]

_HEADER_HEIGHT, _ARROW = 28, 16

_MIN_WIDTH = 250
"""Largest minimum width of the panel, in device-independent pixels, for a window 1280 wide."""

_LEAST_HELD = 1e-3
"""Least difference from the requested number that is marked: its last digit."""


class GroupHeader(HoverRow):
    """The header of a group of sliders; a click or Space opens and closes the group.

    Parameters
    ----------
    name : of the group
    colour : of its domain, "" for the whole body
    domain : index from 0, None for the whole body
    """

    def __init__(self, name: str, colour: str, domain: int | None) -> None:
        super().__init__(domain, colour, TIGHT + _ARROW + CLOSE)
        self.button = described(QToolButton(), "", name)
        self.button.setObjectName("arrow")
        self.button.setCheckable(True)
        self.button.setFixedSize(_ARROW, _ARROW)
        self.button.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.button.toggled.connect(self._on_toggled)
        self._on_toggled(False)
        self.setToolTip(plain_tip(f"Show or hide the sliders of {name.lower()}"))
        self.setCursor(Qt.CursorShape.PointingHandCursor)
        self.setFixedHeight(_HEADER_HEIGHT)
        label = NameLabel(name)
        label.setObjectName("title")
        line = hbox(self.button, label, margins=(TIGHT, 0, TIGHT, 0))
        if colour:
            line.insertSpacing(1, SWATCH + CLOSE)
        self.setLayout(line)

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Open or close the group."""
        if event.button() is Qt.MouseButton.LeftButton:
            self.button.setFocus(Qt.FocusReason.MouseFocusReason)
            self.button.toggle()

    @Slot(bool)
    def _on_toggled(self, is_open: bool) -> None:
        give_icon(self.button, "down" if is_open else "right", "muted")


class SliderGroup(QWidget):
    """A group's header and rows; the rows are made when first shown."""

    def __init__(self, panel: SlidersPanel, index: int, group: LatentGroup) -> None:
        super().__init__()
        self._panel = panel
        self._group = group
        n_domains = len(panel.document.model.domain_names)
        self._domain = index - 1 if 0 < index <= n_domains else None
        self._open_before: bool | None = None
        self.rows: list[CodeRow] = []
        self._captions: list[QWidget] = []
        self.header = GroupHeader(heading(group.name), group.colour or "", self._domain)
        self._column = vbox(spacing=0, margins=(0, 0, 0, TIGHT))
        self._body = QWidget()
        self._body.setLayout(self._column)
        self._body.hide()
        self.setLayout(vbox(self.header, self._body, spacing=0))
        self.header.button.toggled.connect(self.set_open)
        self.header.hovered.connect(panel.domain_hovered)
        self.header.menu_wanted.connect(panel.menu_wanted)

    def set_open(self, is_open: bool) -> None:
        """Show or hide the rows."""
        if is_open and not self.rows:
            self._make_rows()
        self._body.setVisible(is_open)
        self.header.button.setChecked(is_open)

    def show_matching(self, words: str) -> bool:
        """Show only the rows that match all of the words; see `Body.code_words`.

        Parameters
        ----------
        words : in lower case; "" shows all rows, and restores whether the group was open

        Returns
        -------
        found : whether any row matches
        """
        names = self._panel.document.model.code_words[self._group.codes]
        matches = [all(word in name for word in words.split()) for name in names]
        if words and self._open_before is None:
            self._open_before = self.header.button.isChecked()
        if words and any(matches):
            self.set_open(True)
        elif not words and self._open_before is not None:
            self.set_open(self._open_before)
            self._open_before = None
        for row, matches_all in zip(self.rows, matches, strict=False):
            row.setVisible(matches_all)
        for caption in self._captions:
            caption.setVisible(not words)
        self._name_rows(names_bodies=bool(words))
        self.setVisible(any(matches))
        return any(matches)

    def _name_rows(self, *, names_bodies: bool) -> None:
        """Show the rows' names, without those of the bodies below captions that name these."""
        names = [row.name for row in self.rows]
        if self._captions and not names_bodies:
            names = [name.rpartition(": ")[2] for name in names]
        width = longest_name(self, names)
        for row, name in zip(self.rows, names, strict=True):
            row.show_name(name, width)

    def _make_rows(self) -> None:
        document, codes = self._panel.document, self._group.codes
        order: list[QWidget] = [self.header.button]
        # In a scene, the sliders of several bodies have the same names.
        names_bodies, body = self._domain is None and document.scene is not None, ""
        for index, code in enumerate(range(codes.start, codes.stop)):
            of_body, colon, _ = document.model.code_names[code].rpartition(": ")
            if names_bodies and colon and of_body != body:
                body, caption = of_body, labelled(of_body, "caption")
                caption.setContentsMargins(TIGHT, TIGHT, 0, 0)
                self._column.addWidget(caption)
                self._captions.append(caption)
            row = CodeRow(document, code, index, self._domain)
            row.hovered.connect(self._panel.domain_hovered)
            row.menu_wanted.connect(self._panel.menu_wanted)
            row.requested.connect(partial(self._panel.remember_request, row))
            self._column.addWidget(row)
            self.rows.append(row)
            order += [row.slider, row.field]
        self._name_rows(names_bodies=False)
        for before, after in pairwise(order):
            QWidget.setTabOrder(before, after)


class SlidersPanel(QWidget):
    """All sliders of the model, below a filter.

    Signals
    -------
    domain_hovered : int or None, the domain of the row under the pointer
    menu_wanted : int or None, int or None and QPoint: the domain and the code that a context menu
        is for, and its position on the screen

    Parameters
    ----------
    document : followed, and changed by the sliders

    Attributes
    ----------
    groups : in the order of the latent: the whole body, each domain, and any others
    """

    domain_hovered = Signal(object)
    menu_wanted = Signal(object, object, QPoint)
    docking = Docking(
        "sliders",
        "&Sliders",
        "Ctrl+Alt+1",
        "Show or hide the sliders",
        Qt.DockWidgetArea.LeftDockWidgetArea,
        (0.25, 344, 460),
    )

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self.document = document
        self.groups: list[SliderGroup] = []
        self._fingerprint = ""
        self._latent_size = self._natural_width = 0
        self._request: tuple[CodeRow, float, FloatArray] | None = None
        self.filter = described(
            QLineEdit(placeholderText="Filter sliders, such as “finger”", clearButtonEnabled=True),
            "Show the sliders of a part or motion, such as “left hand twist”",
            "Filter sliders",
        )
        self._page = QWidget()
        self._nothing = labelled("No matching sliders", "caption")
        self._nothing.setContentsMargins(TIGHT, TIGHT, TIGHT, TIGHT)
        self._nothing.hide()
        self._column = vbox(self._nothing, None, spacing=2, margins=(CLOSE, 0, 0, CLOSE))
        self._page.setLayout(self._column)
        self._area = scrolling(self._page)
        self._bottom = vbox(margins=(NORMAL, 0, NORMAL, CLOSE))
        top = vbox(self.filter, margins=(NORMAL, TIGHT, NORMAL, 0))
        self.setLayout(vbox(top, self._area, self._bottom))
        self.filter.textChanged.connect(self._on_filter)
        document.model_changed.connect(self._on_model)
        document.history.latent_changed.connect(self._on_latent)
        document.motion.frame_changed.connect(self._on_frame)
        if document.has_model:
            self._on_model()

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Ask for the width that shows whole names."""
        return QSize(self._natural_width, super().sizeHint().height())

    def add_below(self, widget: QWidget) -> None:
        """Put a widget below the sliders, where it stays visible."""
        self._bottom.addWidget(widget)

    def light_domain(self, domain: int | None) -> None:
        """Show which domain the viewport's pointer is on."""
        for group in self.groups:
            group.header.set_lit(domain is not None and group.header.domain == domain)

    def find_slider(self) -> None:
        """Focus the filter, to type part of a slider's name."""
        bring_up(self)
        self.filter.setFocus(Qt.FocusReason.ShortcutFocusReason)
        self.filter.selectAll()

    def show_domain(self, domain: int) -> None:
        """Open the sliders of a domain, and scroll to them."""
        bring_up(self)
        self.filter.clear()
        group = self.groups[1 + domain]
        group.set_open(True)
        group.header.button.setFocus(Qt.FocusReason.OtherFocusReason)
        bar = self._area.verticalScrollBar()
        # Wait until the rows have been laid out.
        QTimer.singleShot(0, group, lambda: bar.setValue(group.y()))

    def row_of(self, code: int) -> CodeRow:
        """Open the group of a code and return its row."""
        groups = self.document.model.latent_space.groups
        index = next(k for k, group in enumerate(groups) if code < group.codes.stop)
        self.groups[index].set_open(True)
        return next(row for row in self.groups[index].rows if row.code == code)

    def _on_model(self) -> None:
        self._request = None
        for group in self.groups:
            self._column.removeWidget(group)
            group.deleteLater()
        model = self.document.model
        # If only the names of the same body have changed, keep open groups open.
        opened = [True]
        if model.fingerprint == self._fingerprint:
            opened = [group.header.button.isChecked() for group in self.groups]
        self._fingerprint = model.fingerprint
        groups = model.latent_space.groups
        self.groups = [SliderGroup(self, index, group) for index, group in enumerate(groups)]
        order = [0, *(1 + domain for domain in model.domain_order)]
        groups_in_order = [
            self.groups[index] for index in (*order, *range(len(order), len(groups)))
        ]
        before: QWidget = self.filter
        for index, group in enumerate(groups_in_order):
            self._column.insertWidget(index, group)
            QWidget.setTabOrder(before, group.header.button)
            before = group.header.button
        self._latent_size = model.latent_size
        self._natural_width = self._width_of_names()
        below = self._bottom.minimumSize().width()
        self.setMinimumWidth(max(min(self._natural_width, _MIN_WIDTH), below))
        for group, is_open in zip(self.groups, opened, strict=False):
            group.set_open(is_open)
        self._on_filter(self.filter.text())

    def _width_of_names(self) -> int:
        """Return the width at which no name is elided."""
        name = longest_name(self, map(heading, self.document.model.code_names))
        bar = self._area.verticalScrollBar().sizeHint().width()
        return CodeRow.width_beside(name, _number_width(self)) + CLOSE + bar

    def _on_latent(self) -> None:
        latent = self.document.history.latent
        if len(latent) != self._latent_size:
            return  # a new model: its signal follows
        for group in self.groups:
            for row in group.rows:
                if row.number != latent[row.code]:
                    row.show_number(float(latent[row.code]))

    def remember_request(self, row: CodeRow, number: float) -> None:
        """Remember the requested number, to show where contact stops it."""
        if self._request is not None and self._request[0] is not row:
            self._request[0].show_contact_limit(None)
        self._request = row, number, np.delete(self.document.history.latent, row.code)

    def _on_frame(self) -> None:
        frame, latent = self.document.motion.frame, self.document.history.latent
        if self._request is None or frame is None:
            return
        row, number, others = self._request
        reached = float(latent[row.code])
        is_held = len(frame.contacts) > 0 and abs(number - reached) > _LEAST_HELD
        # If other codes have changed since, the contacts are not those of this request.
        is_held = is_held and np.array_equal(np.delete(latent, row.code), others)
        row.show_contact_limit(reached if is_held else None)
        if frame.settled:
            # Even if the number has not changed: the handle may have.
            row.show_number(reached)

    def _on_filter(self, text: str) -> None:
        words = text.strip().casefold()
        matches = [group.show_matching(words) for group in self.groups]
        self._nothing.setVisible(not any(matches))


_LARGEST_SEED = 999_999


class RandomiseRow(QWidget):
    """The Randomise button with amount and seed; each press increments the seed.

    Parameters
    ----------
    document : changed by the row
    action : triggered by the button
    amount : initial amount, from 0 to 1
    """

    def __init__(self, document: PoseDocument, action: QAction, amount: float) -> None:
        super().__init__()
        self._document = document
        tip = "How far to go to the random pose: 100 % replaces the current pose"
        self.amount = described(Slider(), tip, "Amount")
        self.amount.setRange(1, 100)
        self.amount.setPageStep(10)
        self.amount.setValue(round(100 * amount))
        self._percent = labelled("", "caption")
        self._percent.setMinimumWidth(self.fontMetrics().horizontalAdvance("100 %"))
        self._percent.setContentsMargins(0, 0, TIGHT, 0)
        self._percent.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        tip = "The same seed gives the same random pose; it increases by itself"
        self.seed = described(NumberBox(0, 0, _LARGEST_SEED), tip, "Seed")
        self.seed.setFixedWidth(self.fontMetrics().horizontalAdvance(str(_LARGEST_SEED)) + CLOSE)
        self.seed.setButtonSymbols(NumberBox.ButtonSymbols.NoButtons)
        self.button = QToolButton()
        self.button.setDefaultAction(action)
        self.button.setIconSize(QSize(ICON_SIZE, ICON_SIZE))
        line = hbox(
            *(self.button, self.amount, self._percent, labelled("Seed", "caption"), self.seed),
            wide=self.amount,
            spacing=TIGHT,
        )
        self.setLayout(line)
        self.amount.valueChanged.connect(lambda percent: self._percent.setText(f"{percent} %"))
        self.seed.refused.connect(document.message)
        self.amount.valueChanged.emit(self.amount.value())

    def draw(self) -> None:
        """Draw the next random pose."""
        seed = int(self.seed.value())
        self._document.motion.randomise(self.amount.value() / 100, seed)
        self.seed.setValue((seed + 1) % (_LARGEST_SEED + 1))
