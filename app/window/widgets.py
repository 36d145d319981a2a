"""Widgets shared by panels and dialogs, such as sliders and number boxes; mnemonics."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import partial
from html import escape
from typing import TypeVar

from PySide6.QtCore import (
    QEvent,
    QPoint,
    QPointF,
    QRect,
    QRectF,
    QSignalBlocker,
    QSize,
    Qt,
    Signal,
)
from PySide6.QtGui import (
    QAction,
    QColor,
    QContextMenuEvent,
    QEnterEvent,
    QGuiApplication,
    QIcon,
    QKeyEvent,
    QKeySequence,
    QMouseEvent,
    QPainter,
    QPaintEvent,
    QPen,
    QPixmap,
    QResizeEvent,
    QValidator,
    QWheelEvent,
)
from PySide6.QtWidgets import (
    QBoxLayout,
    QDoubleSpinBox,
    QFrame,
    QHBoxLayout,
    QLabel,
    QLayout,
    QMenu,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QSlider,
    QToolTip,
    QVBoxLayout,
    QWidget,
)

from app.view.shading import CONTACT
from app.view.theme import CLOSE, NORMAL, ROW_HEIGHT, WIDE, current_theme, pixmap, visible_colour
from lcollision_core.tasks.words import with_capital

HANDLE = 7.0
"""Radius of a slider's handle, in device-independent pixels."""

LEAST_TRACK = 60
"""Minimum width of a slider, in device-independent pixels."""

SWATCH = 12
"""Side of a body part's colour swatch, in device-independent pixels."""

signals_blocked = QSignalBlocker
"""Block a widget's signals while it follows the document: ``with signals_blocked(widget):``."""

Margins = tuple[int, int, int, int]
Box = TypeVar("Box", QHBoxLayout, QVBoxLayout)
Widget = TypeVar("Widget", bound=QWidget)

_NONE: Margins = (0, 0, 0, 0)

NAME_SHARE = 9
"""Stretch factor of a row's name, to 1 of its slider or bar."""

_FINE = 0.1
"""Fraction of the pointer's motion by which a handle moves while Ctrl or Shift is held."""

_FINE_KEYS = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier


class Card(QFrame):
    """A framed group of widgets, one below the other.

    Parameters
    ----------
    name : "card", or "exact" for the exact check
    """

    def __init__(self, name: str = "card") -> None:
        super().__init__()
        self.setObjectName(name)
        self.column = vbox(margins=(CLOSE, NORMAL - 2, CLOSE, NORMAL - 2))
        self.setLayout(self.column)

    def add(self, *items: QWidget | QLayout | None) -> None:
        """Add widgets and layouts at the bottom; None is a stretch."""
        _fill(self.column, items)


class ElidedLabel(QLabel):
    """A label that elides each line to its width and shows the whole text as a tool tip.

    Parameters
    ----------
    text : to show
    cut : where the text is elided

    Attributes
    ----------
    more : text of the tool tip below the label's own, shown even if nothing is elided
    """

    def __init__(self, text: str, cut: Qt.TextElideMode = Qt.TextElideMode.ElideRight) -> None:
        super().__init__(text)
        self._cut, self.more = cut, ""
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)

    def setText(self, text: str, more: str = "") -> None:  # noqa: N802
        """Show another text."""
        self.more = more
        super().setText(text)
        self._offer_whole()

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802
        """Check whether the text fits."""
        super().resizeEvent(event)
        self._offer_whole()

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """Allow any width."""
        return QSize(0, super().minimumSizeHint().height())

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802
        """Draw the elided text."""
        painter = QPainter(self)
        painter.setPen(self.palette().color(self.foregroundRole()))
        painter.drawText(self.rect(), int(self.alignment()), self.fitting())

    def fitting(self) -> str:
        """Return the text as elided to the width."""
        return "\n".join(map(self._cut_line, self.text().split("\n")))

    def _cut_line(self, line: str) -> str:
        return self.fontMetrics().elidedText(line, self._cut, self.width())

    def _offer_whole(self) -> None:
        is_whole = self.fitting() == self.text() and not self.more
        self.setToolTip("" if is_whole else plain_tip(f"{self.text()}\n{self.more}".strip()))


_LEAST_BODY = 3
"""Length up to which an elided body name, in characters, says nothing and is left out."""


class NameLabel(ElidedLabel):
    """The name of a body part or a slider, "body: name" in a scene of several bodies.

    The body's name is elided first, and left out if too little of it would remain.
    """

    def _cut_line(self, line: str) -> str:
        metrics = self.fontMetrics()
        body, colon, name = line.partition(": ")
        if colon and metrics.horizontalAdvance(line) > self.width():
            room = self.width() - metrics.horizontalAdvance(colon + name)
            body = metrics.elidedText(body, Qt.TextElideMode.ElideRight, room)
            line = f"{body}{colon}{name}" if len(body) > _LEAST_BODY else with_capital(name)
        return super()._cut_line(line)


def longest_name(widget: QWidget, names: Iterable[str]) -> int:
    """Return the width of the longest name in a widget's font."""
    advances = (widget.fontMetrics().horizontalAdvance(name) for name in names)
    return max(advances, default=0) + 1


def hbox(
    *items: QWidget | QLayout | None,
    wide: QWidget | None = None,
    spacing: int = CLOSE,
    margins: Margins = _NONE,
) -> QHBoxLayout:
    """Return a layout of widgets side by side.

    Parameters
    ----------
    items : from left to right; None is a stretch
    wide : the item that takes the remaining space
    spacing : between items, in device-independent pixels
    margins : left, top, right and bottom
    """
    layout = _filled(QHBoxLayout(), items, spacing, margins)
    if wide is not None:
        layout.setStretchFactor(wide, 1)
    return layout


def vbox(
    *items: QWidget | QLayout | None, spacing: int = CLOSE, margins: Margins = _NONE
) -> QVBoxLayout:
    """Return a layout of widgets one below the other; see `hbox`."""
    return _filled(QVBoxLayout(), items, spacing, margins)


def _filled(
    layout: Box, items: Iterable[QWidget | QLayout | None], spacing: int, margins: Margins
) -> Box:
    layout.setSpacing(spacing)
    layout.setContentsMargins(*margins)
    _fill(layout, items)
    return layout


def _fill(layout: QBoxLayout, items: Iterable[QWidget | QLayout | None]) -> None:
    for item in items:
        if isinstance(item, QWidget):
            layout.addWidget(item)
        elif item is not None:
            layout.addLayout(item)
        else:
            layout.addStretch()


def widget_of(layout: QLayout) -> QWidget:
    """Return a widget that holds a layout, without margins."""
    holder = QWidget()
    layout.setContentsMargins(0, 0, 0, 0)
    holder.setLayout(layout)
    return holder


def described(widget: Widget, tip: str, name: str = "") -> Widget:
    """Set a widget's tool tip, and its name for assistive technologies; return the widget."""
    widget.setToolTip(tip)
    widget.setAccessibleName(name)
    return widget


def push_button(
    text: str, tip: str = "", clicked: Callable[[], object] | None = None
) -> QPushButton:
    """Return a button that Enter presses only if it has the focus.

    Parameters
    ----------
    tip : its tool tip
    clicked : connected to the signal of this name
    """
    button = described(QPushButton(text, autoDefault=False), tip)
    if clicked is not None:
        button.clicked.connect(clicked)
    return button


def dialog_vbox(*items: QWidget | QLayout | None) -> QVBoxLayout:
    """Return the layout of a dialog, its items one below the other."""
    return vbox(*items, spacing=WIDE, margins=(WIDE + 4, WIDE + 4, WIDE + 4, WIDE))


def title_row(title: str | QLabel, source: ElidedLabel) -> QHBoxLayout:
    """Return a card's title row, with the source of its facts at the right."""
    source.setObjectName("caption")
    source.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
    named = labelled(title, "title") if isinstance(title, str) else title
    return hbox(named, source, wide=source)


def swatch_icon(colour: str, side: int, device_pixel_ratio: float = 1.0) -> QIcon:
    """Return a square of a colour, with an outline so that white shows on white.

    Parameters
    ----------
    colour : "#rrggbb"
    side : in device-independent pixels
    device_pixel_ratio : physical pixels per device-independent pixel
    """
    picture = QPixmap(QSize(side, side) * device_pixel_ratio)
    picture.setDevicePixelRatio(device_pixel_ratio)
    picture.fill(Qt.GlobalColor.transparent)
    painter = QPainter(picture)
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    painter.setPen(QColor(current_theme().muted))
    painter.setBrush(QColor(colour))
    painter.drawRoundedRect(QRectF(0.5, 0.5, side - 1, side - 1), 3, 3)
    painter.end()
    return QIcon(picture)


class HoverRow(QWidget):
    """A row of a domain that signals when the pointer is on it.

    Signals
    -------
    hovered : int, the row's domain; None when the pointer leaves
    menu_wanted : the two values of `menu_of`, and QPoint, the menu's position on the screen

    Parameters
    ----------
    domain : index from 0, None for the whole body
    colour : "#rrggbb" of the swatch, "" for none
    swatch_left : left edge of the swatch; None paints neither swatch nor highlight

    Attributes
    ----------
    menu_of : domain and code that the menu is for, each None for none
    """

    hovered = Signal(object)
    menu_wanted = Signal(object, object, QPoint)

    def __init__(
        self, domain: int | None, colour: str = "", swatch_left: int | None = None
    ) -> None:
        super().__init__()
        self.domain = domain
        self.menu_of: tuple[int | None, int | None] = (domain, None)
        self.is_lit = False
        self._colour, self._swatch_left = colour, swatch_left

    def set_lit(self, lit: bool) -> None:
        """Show whether the viewport's pointer is on this domain."""
        if lit != self.is_lit:
            self.is_lit = lit
            self.update()

    def contextMenuEvent(self, event: QContextMenuEvent) -> None:  # noqa: N802
        """Request the context menu."""
        self.menu_wanted.emit(*self.menu_of, event.globalPos())

    def enterEvent(self, event: QEnterEvent) -> None:  # noqa: N802
        """Signal the domain."""
        self.hovered.emit(self.domain)
        self.update()
        super().enterEvent(event)

    def leaveEvent(self, event: QEvent) -> None:  # noqa: N802
        """Signal that the pointer left."""
        self.hovered.emit(None)
        self.update()
        super().leaveEvent(event)

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802
        """Draw the swatch, and a wash of its colour under the pointer."""
        if self._swatch_left is None:
            return
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setPen(Qt.PenStyle.NoPen)
        if self.is_lit or self.underMouse():
            wash = QColor(self._colour or current_theme().accent)
            wash.setAlpha(60 if self.is_lit else 36)
            painter.setBrush(wash)
            painter.drawRoundedRect(self.rect(), 5, 5)
        if self._colour:
            area = QRectF(self._swatch_left, self.height() / 2 - 6, SWATCH, SWATCH)
            fill_area(painter, area, self._colour, 3)


class ThemedIcon(QLabel):
    """An icon that follows the theme.

    Parameters
    ----------
    size : side in device-independent pixels

    Attributes
    ----------
    name : of the icon shown
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.setFixedSize(size, size)
        self.name, self._ink = "wait", "waiting"

    def show_icon(self, name: str, ink: str) -> None:
        """Show an icon in a colour of the theme."""
        self.name, self._ink = name, ink
        colour = getattr(current_theme(), ink)
        self.setPixmap(pixmap(name, colour, self.width(), self.devicePixelRatioF()))

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802
        """Draw it again in the new theme."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.StyleChange:
            self.show_icon(self.name, self._ink)


class Slider(QSlider):
    """A custom-drawn horizontal slider whose bar grows from `origin`.

    The wheel moves it only when it has the focus.

    Signals
    -------
    drag_abandoned : Escape ended a drag; `sliderReleased` is not emitted

    Parameters
    ----------
    colour : "#rrggbb" of the bar, None for the theme's accent

    Attributes
    ----------
    contact_position : fraction of the groove at which contact stops the value; None for none
    """

    drag_abandoned = Signal()

    contact_position: float | None = None

    def __init__(self, colour: str | None = None) -> None:
        super().__init__(Qt.Orientation.Horizontal)
        self._colour = colour
        self._pointer = self._exact_value = 0.0
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setMinimumWidth(LEAST_TRACK)

    @property
    def origin(self) -> float:
        """Start of the bar, as a fraction of the groove from its left end."""
        return 0.0

    @property
    def value_range(self) -> tuple[float, float]:
        """Values at the ends of the groove."""
        return float(self.minimum()), float(self.maximum())

    @property
    def place(self) -> float:
        """Value at the handle."""
        return float(self.value())

    def move_to(self, place: float) -> None:
        """Move the handle as the user would, with signals."""
        self.setValue(round(place))

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for one row's height."""
        return QSize(110, ROW_HEIGHT - 4)

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Leave the wheel to the panel's scrolling unless focused."""
        wheel_if_focused(self, event, super().wheelEvent)

    def event(self, event: QEvent) -> bool:
        """Take Escape during a drag before the window's shortcut does."""
        is_escape = isinstance(event, QKeyEvent) and event.key() == Qt.Key.Key_Escape
        if is_escape and self.isSliderDown():
            event.accept()
            if event.type() is QEvent.Type.KeyPress:
                with signals_blocked(self):
                    self.setSliderDown(False)
                self.drag_abandoned.emit()
            return True
        return super().event(event)

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Grab the handle, moving it first if the groove was pressed."""
        if event.button() is not Qt.MouseButton.LeftButton:
            event.ignore()
            return
        self.setFocus(Qt.FocusReason.MouseFocusReason)
        x = event.position().x()
        self.setSliderDown(True)
        if abs(x - self._handle_x()) > HANDLE + 2:
            low, high = self.value_range
            fraction = (x - HANDLE) / max(self.width() - 2 * HANDLE, 1.0)
            self.move_to(low + fraction * (high - low))
        self._pointer, self._exact_value = x, self.place

    def mouseMoveEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Move the handle with the pointer, ten times finer while Ctrl or Shift is held."""
        if not self.isSliderDown():
            return
        x = event.position().x()
        low, high = self.value_range
        way = (x - self._pointer) * (high - low) / max(self.width() - 2 * HANDLE, 1.0)
        if event.modifiers() & _FINE_KEYS:
            way *= _FINE
        # Add increments, so that the handle does not jump when the key is pressed or released.
        self._pointer = x
        self._exact_value += way
        self.move_to(self._exact_value)

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:  # noqa: ARG002, N802
        """Release the handle."""
        if self.isSliderDown():
            self.setSliderDown(False)

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802
        """Draw the groove, the bar from its origin, and the handle."""
        theme = current_theme()
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setPen(Qt.PenStyle.NoPen)
        middle = self.height() / 2
        left, right = HANDLE, self.width() - HANDLE
        painter.setBrush(QColor(theme.track))
        painter.drawRoundedRect(QRectF(left, middle - 2, right - left, 4), 2, 2)
        start = left + (right - left) * self.origin
        if self.origin > 0.0:
            painter.setBrush(QColor(theme.muted))
            painter.drawRect(QRectF(start - 0.5, middle - 5, 1, 10))
        handle = self._handle_x()
        reached = (
            handle
            if self.contact_position is None
            else left + (right - left) * self.contact_position
        )
        enabled = self.isEnabled()
        filled = self._colour or theme.accent if enabled else theme.track
        bar = QRectF(min(start, reached), middle - 2.5, abs(reached - start), 5)
        if bar.width() > 0.0:
            fill_area(painter, bar, filled, 0.0)
        if self.hasFocus():
            halo = QColor(theme.accent)
            halo.setAlpha(90)
            painter.setBrush(halo)
            painter.drawEllipse(QPointF(handle, middle), HANDLE + 3, HANDLE + 3)
        painter.setBrush(QColor("#ffffff" if enabled else theme.window))
        bright = enabled and (self.hasFocus() or self.underMouse())
        rim = theme.accent if bright else theme.muted if enabled else theme.border
        painter.setPen(QPen(QColor(rim), 1.6))
        painter.drawEllipse(QPointF(handle, middle), HANDLE - 1.2, HANDLE - 1.2)
        if self.contact_position is not None:
            # Drawn last, to stay visible over the handle.
            painter.setPen(QPen(QColor(theme.card), 1.0))
            painter.setBrush(QColor(CONTACT))
            painter.drawRoundedRect(QRectF(reached - 2.5, middle - 8.5, 5, 17), 2, 2)

    def _handle_x(self) -> float:
        low, high = self.value_range
        fraction = (self.place - low) / ((high - low) or 1.0)
        return HANDLE + (self.width() - 2 * HANDLE) * fraction


def screen_of(window: QWidget) -> QRect:
    """Return the available area of a window's screen.

    Do not use `QWidget.screen`: PySide makes the widget the owner of the application's screen, and
    may delete the screen with the widget.
    """
    screen = QGuiApplication.screenAt(window.frameGeometry().center())
    return (screen or QGuiApplication.primaryScreen()).availableGeometry()


def wheel_if_focused(
    widget: QWidget, event: QWheelEvent, handle: Callable[[QWheelEvent], None]
) -> None:
    """Pass a wheel event to `handle` if focused, else ignore it so that the parent scrolls."""
    if widget.hasFocus():
        handle(event)
    else:
        event.ignore()


def fill_area(painter: QPainter, area: QRectF, colour: str, radius: float) -> None:
    """Fill an area with a body part's colour, outlined if it would not be visible otherwise."""
    edge = visible_colour(colour)
    painter.setBrush(QColor(colour))
    painter.setPen(QPen(edge, 1.0) if edge != QColor(colour) else Qt.PenStyle.NoPen)
    inset = 0.5 if painter.pen().style() is not Qt.PenStyle.NoPen else 0.0
    painter.drawRoundedRect(area.adjusted(inset, inset, -inset, -inset), radius, radius)
    painter.setPen(Qt.PenStyle.NoPen)


def bar_style(colour: str) -> str:
    """Return the style sheet of a progress bar in a body part's colour."""
    return f"""
QProgressBar {{ min-height: 8px; max-height: 8px; border-radius: 4px; }}
QProgressBar::chunk {{
    background: {colour}; border-radius: 4px; border: 1px solid {visible_colour(colour).name()};
}}
"""


def plain_tip(text: str) -> str:
    """Return a tool tip that shows a text literally, even if it looks like HTML."""
    return f"<span>{escape(text)}</span>" if "<" in text else text


def unbroken(text: str) -> str:
    """Keep each number and its unit on one line of a label that wraps."""
    return re.sub(r"(?<=\d) (?=%|mm\b)", "\N{NO-BREAK SPACE}", text)


def labelled(text: str, style: str = "", wraps: bool = False) -> QLabel:
    """Return a plain-text label: a name in the text may look like HTML.

    Parameters
    ----------
    text : of the label
    style : its object name in the style sheet: title, caption, verdict, headline, aside, refusal
    wraps : whether the text wraps
    """
    label = QLabel(text, wordWrap=wraps, textFormat=Qt.TextFormat.PlainText)
    label.setObjectName(style)
    return label


def show_verdict(widget: QWidget, verdict: str) -> None:
    """Style a widget as "free", "colliding", "waiting" or, beside a checked result, "aside"."""
    if widget.property("verdict") != verdict:
        widget.setProperty("verdict", verdict)
        restyle(widget)


def restyle(widget: QWidget) -> None:
    """Apply the style sheet again after a property or the object name of a widget has changed."""
    widget.style().unpolish(widget)
    widget.style().polish(widget)


def scrolling(page: QWidget) -> QScrollArea:
    """Return an area that scrolls a page vertically only."""
    page.setObjectName("page")
    area = QScrollArea(widgetResizable=True)
    area.setWidget(page)
    area.setFrameShape(QFrame.Shape.NoFrame)
    area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    area.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    return area


NATIVE = QKeySequence.SequenceFormat.NativeText


def equip(action: QAction, text: str, shortcut: str, tip: str) -> None:
    """Set the text, shortcuts and tool tip of an action, which may be one of Qt's own."""
    action.setText(text)
    keys = QKeySequence.listFromString(shortcut.replace(", ", "; "))
    action.setShortcuts([key for key in keys if not key.isEmpty()])
    explain(action, tip)
    if text.endswith("…"):
        # Qt would strip the dots from the text on a button.
        action.setIconText(text.replace("&", ""))
    # In a menu an icon would stand where the tick is.
    action.setIconVisibleInMenu(not action.isCheckable())


def explain(action: QAction, tip: str) -> None:
    """Set an action's tool tip and status tip; the tool tip also names the shortcut."""
    keys = action.shortcut().toString(NATIVE)
    action.setToolTip(f"{tip} ({keys})" if keys else tip)
    action.setStatusTip(tip)


_REFUSAL_MILLISECONDS = 8000


class ListMenu(QMenu):
    """A menu whose entries call functions and show their errors.

    Parameters
    ----------
    title : of the menu
    parent : of the widget
    attempt : calls a function and shows its error
    fill : adds the entries each time the menu is about to be shown
    """

    def __init__(
        self,
        title: str,
        parent: QWidget,
        attempt: Callable[[Callable[[], object]], object],
        fill: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(title, parent, toolTipsVisible=True)
        self._attempt = attempt
        if fill is not None:
            self.aboutToShow.connect(self.clear)
            self.aboutToShow.connect(fill)

    def entry(
        self,
        text: str,
        act: Callable[..., object],
        *values: object,
        tip: str = "",
        ticked: bool | None = None,
        enabled: bool = True,
    ) -> QAction:
        """Add an entry that calls `act` with values; it is checkable unless `ticked` is None."""
        action = self.addAction(text)
        action.setToolTip(tip)
        action.setCheckable(ticked is not None)
        action.setChecked(bool(ticked))
        action.setEnabled(enabled)
        action.triggered.connect(lambda: self._attempt(partial(act, *values)))
        return action


class NumberBox(QDoubleSpinBox):
    """A number box that the wheel changes only when it has the focus.

    Signals
    -------
    refused : str, why a typed number is refused; also shown beside the field for some seconds,
        and the field returns to the previous number

    Parameters
    ----------
    decimals : 0 for a whole number
    low, high : limits
    strip_zeros : whether trailing zeros are left out; they always are with more than three decimals
    """

    refused = Signal(str)

    _strip_zeros = False

    def __init__(
        self, decimals: int, low: float, high: float, *, strip_zeros: bool = False
    ) -> None:
        super().__init__()
        self._strip_zeros = strip_zeros or decimals > 3
        self.setDecimals(decimals)
        self.setRange(low, high)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setKeyboardTracking(False)

    def textFromValue(self, value: float) -> str:  # noqa: N802
        """Format a value, without trailing zeros if the box strips them."""
        text = super().textFromValue(value)
        if not self._strip_zeros:
            return text
        return text.rstrip("0").rstrip(self.locale().decimalPoint())

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Leave the wheel to the panel's scrolling unless focused."""
        wheel_if_focused(self, event, super().wheelEvent)

    def event(self, event: QEvent) -> bool:
        """Leave Undo and Redo to the window: a typed number is an undoable step of the pose."""
        if event.type() is QEvent.Type.ShortcutOverride and isinstance(event, QKeyEvent):
            keys = (QKeySequence.StandardKey.Undo, QKeySequence.StandardKey.Redo)
            if any(event.matches(key) for key in keys):
                event.ignore()
                return False
        return super().event(event)

    def validate(self, text: str, position: int) -> tuple[QValidator.State, str, int]:
        """Let any number be typed; its range is checked when it is complete."""
        verdict = super().validate(text, position)
        if verdict[0] is QValidator.State.Invalid and self._is_beyond(text):
            return QValidator.State.Intermediate, text, position
        return verdict

    def fixup(self, text: str) -> str:
        """Report a number beyond the field's range."""
        if not self._is_beyond(text):
            return text
        typed = text.removesuffix(self.suffix()).strip()[:20]
        least, most = map(self.textFromValue, (self.minimum(), self.maximum()))
        sentence = f"{typed} is out of range: type a number from {least} to {most}"
        self.refused.emit(sentence)
        if self.isVisible():
            below = self.mapToGlobal(QPoint(0, self.height() // 2))
            QToolTip.showText(below, sentence, self, self.rect(), _REFUSAL_MILLISECONDS)
        return text

    def _is_beyond(self, text: str) -> bool:
        """Whether a text is a number, in the user's language, beyond the field's range."""
        number, is_number = self.locale().toDouble(text.removesuffix(self.suffix()).strip())
        return is_number and not self.minimum() <= number <= self.maximum()
