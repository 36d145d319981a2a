"""The icons of the window: line drawings that take the colour of the text."""

from __future__ import annotations

from PySide6.QtCore import QByteArray, QObject, QRectF, QSize, Qt
from PySide6.QtGui import QAction, QIcon, QPainter, QPixmap, QPixmapCache
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtWidgets import QAbstractButton

from app.view.theme import current_theme, mixed
from lcollision_core.bundled import bundled_file

ICON_SIZE = 20
"""Side of an icon in tool bars, in device-independent pixels."""

_SHARPNESSES = (1.0, 1.5, 2.0, 3.0)
"""Device pixels per pixel that an icon is drawn for; Qt takes the nearest."""


def icon(name: str, colour: str | None = None) -> QIcon:
    """Draw an icon of ``resources/icons`` in the current theme.

    Parameters
    ----------
    name : of the file, without its extension
    colour : "#rrggbb"; that of the text by default
    """
    theme = current_theme()
    drawn = QIcon()
    for mode, ink in (
        (QIcon.Mode.Normal, colour or theme.text),
        (QIcon.Mode.Disabled, mixed(theme.text, theme.window, 0.65).name()),
    ):
        for sharpness in _SHARPNESSES:
            drawn.addPixmap(pixmap(name, ink, ICON_SIZE, sharpness), mode)
    return drawn


def give_icon(holder: QAction | QAbstractButton, name: str, ink: str = "text") -> None:
    """Give an action or a button an icon that follows the theme; see `redraw_icons`.

    Parameters
    ----------
    name : of the file, without its extension
    ink : which colour of the theme
    """
    holder.setProperty("drawing", f"{name} {ink}")
    holder.setIcon(icon(name, getattr(current_theme(), ink)))


def redraw_icons(root: QObject) -> None:
    """Draw the icons of everything below an object in the theme that has come."""
    for holder in root.findChildren(QObject):
        drawing = holder.property("drawing")
        if isinstance(drawing, str) and isinstance(holder, QAction | QAbstractButton):
            give_icon(holder, *drawing.split())


def pixmap(name: str, colour: str, size: int, sharpness: float = 1.0) -> QPixmap:
    """Draw an icon at one size, unless it is known from before.

    Parameters
    ----------
    name : of the file, without its extension
    colour : "#rrggbb"
    size : side in device-independent pixels
    sharpness : device pixels per pixel
    """
    key = f"{name} {colour} {size} {sharpness}"
    canvas = QPixmap()
    if QPixmapCache.find(key, canvas):
        return canvas
    drawing = bundled_file("icons", f"{name}.svg").read_text().replace("currentColor", colour)
    renderer = QSvgRenderer(QByteArray(drawing.encode()))
    side = round(size * sharpness)
    canvas = QPixmap(QSize(side, side))
    canvas.fill(Qt.GlobalColor.transparent)
    painter = QPainter(canvas)
    renderer.render(painter, QRectF(0, 0, side, side))
    painter.end()
    canvas.setDevicePixelRatio(sharpness)
    QPixmapCache.insert(key, canvas)
    return canvas


def program_icon() -> QIcon:
    """Return the icon of the program's windows."""
    return QIcon(str(bundled_file("icons", "lcollision.svg")))
