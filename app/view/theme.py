"""The look of the window: light and dark theme, icons and the busy ring.

Fusion with an explicit palette looks the same everywhere, and can be dark even if the desktop's
own style cannot. The colours for "free" and "colliding" differ in hue for colour-blind readers
too, and are never the only sign.
"""

from __future__ import annotations

from dataclasses import asdict
from string import Template

import numpy as np
from PySide6.QtCore import QByteArray, QObject, QRectF, QSize, Qt, QTimer, Slot
from PySide6.QtGui import (
    QAction,
    QColor,
    QFontInfo,
    QGuiApplication,
    QIcon,
    QPainter,
    QPaintEvent,
    QPalette,
    QPen,
    QPixmap,
    QPixmapCache,
)
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtWidgets import QAbstractButton, QApplication, QWidget

from app.view.shading import DARK, LIGHT, Theme, rgb
from lcollision_core.bundled import bundled_file

TIGHT, CLOSE, NORMAL, WIDE = 4, 8, 12, 16
"""The spacings of the window, in device-independent pixels."""

ROW_HEIGHT = 26
"""Height of the row of a slider or a domain, in device-independent pixels."""


_DARKEST = 42.0
"""Least CIELAB lightness at which a bar is visible in the dark theme's groove."""

_current = LIGHT


def current_theme() -> Theme:
    """Return the theme applied last."""
    return _current


def wanted_theme(choice: str) -> Theme:
    """Return the theme for a choice.

    Parameters
    ----------
    choice : "light", "dark", or "system" for the desktop's preference; light if it has none
    """
    if choice == "system":
        is_dark = QGuiApplication.styleHints().colorScheme() is Qt.ColorScheme.Dark
        return DARK if is_dark else LIGHT
    return {"light": LIGHT, "dark": DARK}[choice]


def apply_theme(application: QApplication, theme: Theme) -> None:
    """Apply a theme to the whole application; widgets get a ``changeEvent`` if it is another."""
    global _current
    _current = theme
    style_sheet = _style_sheet(theme)
    if style_sheet == application.styleSheet():
        return
    # Set the style by name: Qt deletes a style object made here, and PySide would then mistake
    # another object at its address for it.
    application.setStyle("Fusion")
    application.setPalette(_palette(theme))
    application.setStyleSheet(style_sheet)


def _palette(theme: Theme) -> QPalette:
    # Qt derives colours that are not set below from these two.
    palette = QPalette(QColor(theme.card), QColor(theme.window))
    role, disabled = QPalette.ColorRole, QPalette.ColorGroup.Disabled
    for colour, roles in {
        theme.text: (role.WindowText, role.Text, role.ButtonText, role.ToolTipText),
        theme.field: (role.Base,),
        theme.card: (role.ToolTipBase, role.Light),
        theme.window: (role.AlternateBase,),
        theme.border: (role.Midlight, role.Mid, role.Dark),
        theme.muted: (role.PlaceholderText,),
        theme.accent: (role.Highlight, role.Accent, role.Link, role.LinkVisited),
        theme.on_accent: (role.HighlightedText,),
    }.items():
        for which in roles:
            palette.setColor(which, QColor(colour))
    faded = mixed(theme.text, theme.window, 0.55)
    for which in (role.WindowText, role.Text, role.ButtonText, role.HighlightedText):
        palette.setColor(disabled, which, faded)
    palette.setColor(disabled, role.Highlight, QColor(theme.track))
    return palette


def mixed(colour: str, other: str, fraction: float) -> QColor:
    """Return a colour mixed with a fraction of another."""
    one, two = rgb(colour).astype(float), rgb(other).astype(float)
    return QColor(*np.round(one + fraction * (two - one)).astype(int).tolist())


def visible_colour(colour: str) -> QColor:
    """Return a domain's colour, lightened in the dark theme if it would not be visible."""
    from lcollision_core.bodies.names import cielab

    shade = QColor(colour)
    for fraction in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        if not _current.is_dark or cielab(shade.name())[0] >= _DARKEST:
            break
        shade = mixed(colour, "#ffffff", fraction)
    return shade


def _style_sheet(theme: Theme) -> str:
    text = bundled_file("editor.qss").read_text(encoding="utf-8")
    size = QFontInfo(QApplication.font()).pixelSize()
    return Template(text).substitute(
        asdict(theme),
        tick=bundled_file("icons", f"tick-{theme.name}.svg").as_posix(),
        hover=mixed(theme.card, theme.accent, 0.10).name(),
        pressed=mixed(theme.card, theme.accent, 0.22).name(),
        faded=mixed(theme.text, theme.window, 0.55).name(),
        deeper=mixed(theme.accent, theme.text, 0.18).name(),
        headline=f"{round(size * 7 / 6)}px",
        aside=f"{round(size * 11 / 12)}px",
    )


ICON_SIZE = 20
"""Side of an icon in tool bars, in device-independent pixels."""

_SHARPNESSES = (1.0, 1.5, 2.0, 3.0)
"""Device pixel ratios that an icon is drawn for; Qt uses the nearest."""


def icon(name: str, colour: str | None = None) -> QIcon:
    """Draw an icon of ``resources/icons`` in the current theme.

    Parameters
    ----------
    name : of the file, without its extension
    colour : "#rrggbb"; the text colour by default
    """
    theme = current_theme()
    drawn = QIcon()
    for mode, ink in (
        (QIcon.Mode.Normal, colour or theme.text),
        (QIcon.Mode.Disabled, mixed(theme.text, theme.window, 0.65).name()),
    ):
        for device_pixel_ratio in _SHARPNESSES:
            drawn.addPixmap(pixmap(name, ink, ICON_SIZE, device_pixel_ratio), mode)
    return drawn


def give_icon(holder: QAction | QAbstractButton, name: str, ink: str = "text") -> None:
    """Give an action or a button an icon that follows the theme; see `redraw_icons`.

    Parameters
    ----------
    name : of the file, without its extension
    ink : name of a colour of the theme
    """
    holder.setProperty("drawing", f"{name} {ink}")
    holder.setIcon(icon(name, getattr(current_theme(), ink)))


def redraw_icons(root: QObject) -> None:
    """Redraw the icons of all descendants of an object in the current theme."""
    for holder in root.findChildren(QObject):
        drawing = holder.property("drawing")
        if isinstance(drawing, str) and isinstance(holder, QAction | QAbstractButton):
            give_icon(holder, *drawing.split())


def pixmap(name: str, colour: str, size: int, device_pixel_ratio: float = 1.0) -> QPixmap:
    """Draw an icon at one size, or return it from the cache.

    Parameters
    ----------
    name : of the file, without its extension
    colour : "#rrggbb"
    size : side in device-independent pixels
    device_pixel_ratio : physical pixels per device-independent pixel
    """
    key = f"{name} {colour} {size} {device_pixel_ratio}"
    canvas = QPixmap()
    if QPixmapCache.find(key, canvas):
        return canvas
    drawing = bundled_file("icons", f"{name}.svg").read_text().replace("currentColor", colour)
    renderer = QSvgRenderer(QByteArray(drawing.encode()))
    side = round(size * device_pixel_ratio)
    canvas = QPixmap(QSize(side, side))
    canvas.fill(Qt.GlobalColor.transparent)
    painter = QPainter(canvas)
    renderer.render(painter, QRectF(0, 0, side, side))
    painter.end()
    canvas.setDevicePixelRatio(device_pixel_ratio)
    QPixmapCache.insert(key, canvas)
    return canvas


def program_icon() -> QIcon:
    """Return the icon of the program's windows."""
    return QIcon(str(bundled_file("icons", "lcollision.svg")))


_TURN_MILLISECONDS, _DEGREES_PER_STEP = 100, 33
"""Each step recomposes the whole window; without a graphics card that takes processor time from
the work in progress, so steps are few."""

_ARC = 100
_SIDE_PER_WIDTH = 11.0


class Ring(QWidget):
    """A turning ring, or a warning sign while stopped.

    Parameters
    ----------
    side : in device-independent pixels
    """

    def __init__(self, side: int) -> None:
        super().__init__()
        self.setFixedSize(side, side)
        self._angle = 0
        self._timer = QTimer(self, interval=_TURN_MILLISECONDS)
        self._timer.timeout.connect(self._on_turn)

    @property
    def turns(self) -> bool:
        """Whether the ring is turning."""
        return self._timer.isActive()

    def start(self) -> None:
        """Start turning."""
        self._timer.start()

    def stop(self) -> None:
        """Stop turning."""
        self._timer.stop()
        self.update()

    @Slot()
    def _on_turn(self) -> None:
        self._angle = (self._angle + _DEGREES_PER_STEP) % 360
        self.update()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the ring or the sign."""
        theme, painter, side = current_theme(), QPainter(self), self.width()
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        if not self.turns:
            sign = pixmap("warning", theme.colliding, side, self.devicePixelRatioF())
            painter.drawPixmap(0, 0, sign)
            return
        width = side / _SIDE_PER_WIDTH
        inset = 0.5 * width
        ring = QRectF(self.rect()).adjusted(inset, inset, -inset, -inset)
        painter.setPen(QPen(QColor(theme.track), width))
        painter.drawEllipse(ring)
        painter.setPen(
            QPen(QColor(theme.accent), width, Qt.PenStyle.SolidLine, Qt.PenCapStyle.RoundCap)
        )
        painter.drawArc(ring, -16 * self._angle, 16 * _ARC)
