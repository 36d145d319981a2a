"""Dock widgets of the panels, docked or floating beside the body."""

from __future__ import annotations

from dataclasses import dataclass

from PySide6.QtCore import QEvent, QPoint, QRect, Qt, QTimer, Slot
from PySide6.QtWidgets import QDockWidget, QMainWindow, QWidget

from app.view.theme import CLOSE
from app.window.widgets import equip, screen_of


@dataclass(frozen=True)
class Docking:
    """How a panel is docked; the class attribute `docking` of each panel.

    Attributes
    ----------
    key : of the panel in the stored layout
    text, shortcut, tip : of the action that shows or hides it
    area : default area
    width : default width of a side panel: a fraction of the window's width, and its minimum and
        maximum in device-independent pixels
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
