"""The docks of the panels, and their positions and widths, stored as the user left them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from PySide6.QtCore import QEvent, QObject, QPoint, QRect, QSize, Qt, QTimer, Slot
from PySide6.QtGui import QGuiApplication
from PySide6.QtWidgets import QDockWidget, QMainWindow, QTabWidget, QWidget

from app.view.theme import CLOSE
from app.window.widgets import equip, screen_of

if TYPE_CHECKING:
    from app.editing.settings import Settings


@dataclass(frozen=True)
class Docking:
    """How a panel is docked; the class attribute `docking` of each panel.

    Attributes
    ----------
    key : of the panel in the stored layout
    text, shortcut, tip : of the action that shows or hides it
    area : default area
    width : default width of a side panel: a fraction of the window's width, and its minimum and
        maximum in device-independent pixels; a width that the user sets is stored as "<key>_width"
        of `SETTINGS`
    """

    key: str
    text: str
    shortcut: str
    tip: str
    area: Qt.DockWidgetArea
    width: tuple[float, int, int] | None = None


class Panel(QDockWidget):
    """A dock that floats beside its window, or else where it hides the least of the body.

    If it is dragged off, it stays under the pointer.

    Parameters
    ----------
    content : of the panel
    docking : how it is docked
    window : its parent
    """

    def __init__(self, content: QWidget, docking: Docking, window: QMainWindow) -> None:
        super().__init__(docking.text.replace("&", ""), window)
        self._window, self.docking = window, docking
        self._dragged = False
        self.setObjectName(docking.key)
        self.setWidget(content)
        equip(self.toggleViewAction(), docking.text, docking.shortcut, docking.tip)
        self.topLevelChanged.connect(self._on_floating)

    def event(self, event: QEvent) -> bool:
        """Notice whether the pointer drags the panel."""
        if event.type() in (QEvent.Type.MouseMove, QEvent.Type.NonClientAreaMouseMove):
            self._dragged = True
        elif event.type() in (QEvent.Type.MouseButtonPress, QEvent.Type.MouseButtonDblClick):
            self._dragged = False
        return super().event(event)

    @Slot(bool)
    def _on_floating(self, floating: bool) -> None:
        if floating and not self._dragged:
            # Wait until the panel has its frame and the view its new size.
            QTimer.singleShot(0, self, self._place_beside)

    @Slot()
    def _place_beside(self) -> None:
        view = self._window.centralWidget()
        if view is None or not (self.isFloating() and self.isVisible()):
            return
        screen = screen_of(self._window)
        # Take the middle half of the view as the area of the body.
        body = QRect(0, 0, view.width() // 2, view.height())
        body.moveCenter(QRect(view.mapToGlobal(QPoint(0, 0)), view.size()).center())
        frame = self.frameGeometry()
        position = beside(frame, self._window.frameGeometry(), body, screen)
        self.move(position)


def bring_up(content: QWidget) -> None:
    """Show the panel that contains a widget, and raise its tab."""
    dock = content.parentWidget()
    if dock is not None:
        dock.show()
        dock.raise_()


def beside(panel: QRect, window: QRect, body: QRect, screen: QRect) -> QPoint:
    """Find a position for a panel where it hides neither its window nor the body in it.

    Parameters
    ----------
    panel : current frame of the panel
    window : the window's frame
    body : area of the body in the window
    screen : its available area

    Returns
    -------
    corner : top left corner: right of the window, left, below or above it, if there is space;
        else at the edge of the screen where the panel hides the least of the body
    """
    right, bottom = screen.right() + 1 - panel.width(), screen.bottom() + 1 - panel.height()
    top = max(screen.top(), min(panel.top(), bottom))
    left = max(screen.left(), min(panel.left(), right))
    outside = (
        QPoint(window.right() + CLOSE, top),
        QPoint(window.left() - CLOSE - panel.width(), top),
        QPoint(left, window.bottom() + CLOSE),
        QPoint(left, window.top() - CLOSE - panel.height()),
    )
    for corner in outside:
        if screen.contains(QRect(corner, panel.size())):
            return corner
    edges = [QPoint(max(right, screen.left()), top), QPoint(screen.left(), top)]
    edges += [QPoint(left, max(bottom, screen.top())), QPoint(left, screen.top())]

    def hidden(corner: QPoint) -> int:
        over = QRect(corner, panel.size()).intersected(body)
        return over.width() * over.height() if over.isValid() else 0

    return min(edges, key=hidden)


_VERSION = 1
_SIZE = QSize(1440, 900)
_NARROW = 1100
"""Window width below which the poses do not fit between the side panels."""
_LINE = 5
"""Width of the separator beside a panel, as in the style sheet."""
_VIEW_WIDTH, _LEAST_VIEW_WIDTH = 768, 400
"""Least widths of the view: beside panels of their default widths, and of the user's widths."""


class Layout(QObject):
    """Place the panels of a window, and remember the widths that the user gives them.

    A window too narrow for these widths reduces them only until it is wide again.

    Parameters
    ----------
    window : of the panels
    docks : panels by key
    settings : store the positions, and the widths in device-independent pixels
    """

    def __init__(self, window: QMainWindow, docks: Mapping[str, Panel], settings: Settings) -> None:
        super().__init__(window)
        self._window, self._docks, self._settings = window, docks, settings
        self._pressed: dict[str, int] = {}
        window.setDockNestingEnabled(True)
        for corner in (Qt.Corner.TopLeftCorner, Qt.Corner.BottomLeftCorner):
            window.setCorner(corner, Qt.DockWidgetArea.LeftDockWidgetArea)
        window.setCorner(Qt.Corner.TopRightCorner, Qt.DockWidgetArea.RightDockWidgetArea)
        window.setTabPosition(Qt.DockWidgetArea.BottomDockWidgetArea, QTabWidget.TabPosition.North)
        self._place()
        for dock in docks.values():
            for moved in (dock.visibilityChanged, dock.topLevelChanged, dock.dockLocationChanged):
                moved.connect(self._limit)
        # The separators between panels are drawn by the window and have no signal.
        window.installEventFilter(self)

    def _place(self) -> None:
        """Put all panels in their default places, those below the view as tabs."""
        below: list[Panel] = []
        for dock in self._docks.values():
            self._window.addDockWidget(dock.docking.area, dock)
            if dock.docking.area is Qt.DockWidgetArea.BottomDockWidgetArea:
                below.append(dock)
        for first, second in pairwise(below):
            self._window.tabifyDockWidget(first, second)

    def restore(self) -> None:
        """Restore the window's size and the panels' positions from the settings."""
        screen = QGuiApplication.primaryScreen().availableGeometry().size()
        self._window.resize(_SIZE.boundedTo(screen))
        self._window.restoreGeometry(self._settings["window_geometry"])
        self._window.restoreState(self._settings["window_layout"], _VERSION)

    @Slot()
    def apply_sizes(self) -> None:
        """Size the panels; only a window that is shown keeps the sizes."""
        self.fit()
        if self._settings["window_layout"].isEmpty():
            self._fit_poses()

    def save(self) -> None:
        """Store the window's size and the panels' positions."""
        self._settings["window_geometry"] = self._window.saveGeometry()
        self._settings["window_layout"] = self._window.saveState(_VERSION)

    def reset(self) -> None:
        """Put all panels back in their default places, with their default widths."""
        for dock in self._docks.values():
            dock.setFloating(False)
        self._place()
        for key, dock in self._docks.items():
            dock.setVisible(dock.toggleViewAction().isVisible())
            if dock.docking.width is not None:
                self._settings[f"{key}_width"] = 0
        self.fit()
        self._fit_poses()

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Follow the window's size, and the separators between its panels."""
        if event.type() is QEvent.Type.Resize:
            self.fit()
        elif event.type() is QEvent.Type.MouseButtonPress:
            self._pressed = self._widths()
        elif event.type() is QEvent.Type.MouseButtonRelease:
            # Wait until the separator has its final position.
            QTimer.singleShot(0, self, self._remember_widths)
        return super().eventFilter(watched, event)

    @Slot()
    def fit(self) -> None:
        """Set the widths of the side panels; in a narrow window, give the poses the corner."""
        window = self._window
        corner, area = Qt.Corner.BottomRightCorner, Qt.DockWidgetArea.RightDockWidgetArea
        if window.width() < _NARROW:
            area = Qt.DockWidgetArea.BottomDockWidgetArea
        if window.corner(corner) is not area:
            window.setCorner(corner, area)
        suiting = self._widths_beside_view(
            {key: self._default_width(key) for key in self._widths()}, _VIEW_WIDTH
        )
        panel_widths = {key: int(self._settings[f"{key}_width"] or suiting[key]) for key in suiting}
        widths = self._widths_beside_view(panel_widths, _LEAST_VIEW_WIDTH)
        docks = [self._docks[key] for key in widths]
        window.resizeDocks(docks, list(widths.values()), Qt.Orientation.Horizontal)
        self._limit()

    def _widths_beside_view(self, wanted: Mapping[str, int], view: int) -> dict[str, int]:
        """Return the widths of panels beside a view of this width, none below its minimum."""
        least = {key: self._docks[key].minimumSizeHint().width() for key in wanted}
        spare = self._window.width() - view - sum(least.values()) - len(wanted) * _LINE
        more = {key: max(wanted[key] - least[key], 0) for key in wanted}
        share = min(max(spare, 0) / max(sum(more.values()), 1), 1.0)
        return {key: int(least[key] + share * more[key]) for key in wanted}

    @Slot()
    def _limit(self) -> None:
        """Limit the window's width by the view and the side panels, not by the poses."""
        sides = [self._docks[key].minimumSizeHint().width() + _LINE for key in self._widths()]
        view = self._window.centralWidget()
        self._window.setMinimumWidth(sum(sides) + (view.minimumWidth() if view else 0))

    def _fit_poses(self) -> None:
        below = Qt.DockWidgetArea.BottomDockWidgetArea
        docks = [
            dock
            for dock in self._docks.values()
            if dock.docking.area is below and not dock.isHidden()
        ]
        heights = [dock.sizeHint().height() for dock in docks]
        self._window.resizeDocks(docks, heights, Qt.Orientation.Vertical)

    def _default_width(self, key: str) -> int:
        """Return the default width of a panel for the window and its content."""
        width = self._docks[key].docking.width
        assert width is not None
        fraction, least, most = width
        suits = max(fraction * self._window.width(), self._docks[key].sizeHint().width(), least)
        return int(min(suits, most))

    def _widths(self) -> dict[str, int]:
        """Return the widths of the visible side panels docked in their default areas."""
        return {
            key: dock.width()
            for key, dock in self._docks.items()
            if dock.docking.width is not None
            and not dock.isFloating()
            and dock.isVisible()
            and self._window.dockWidgetArea(dock) is dock.docking.area
        }

    @Slot()
    def _remember_widths(self) -> None:
        for key, width in self._widths().items():
            if width != self._pressed.get(key, width):
                self._settings[f"{key}_width"] = width
