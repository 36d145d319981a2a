"""What a click with the right button on the body, or beside it, offers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QPoint, Qt, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QMenu

if TYPE_CHECKING:
    from app.window.main_window import MainWindow


class BodyMenu(QObject):
    """Opens the menu of the body part under the pointer, which stays outlined meanwhile.

    Parameters
    ----------
    window : whose own actions stand in the menu
    shadings : its ways to colour the body
    cameras : its menu of places to look from
    """

    def __init__(self, window: MainWindow, shadings: Iterable[QAction], cameras: QMenu) -> None:
        super().__init__(window)
        self._window = window
        self._shadings = tuple(shadings)
        self._cameras = cameras

    @Slot(object, QPoint)
    def open(self, domain: int | None, place: QPoint) -> None:
        """Open the menu at a place of the screen.

        Parameters
        ----------
        domain : of the part that was clicked, None beside the body
        """
        window = self._window
        menu = QMenu(window) if domain is None else window.part_menus.menu(domain, None)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        if domain is not None:
            menu.addSeparator()
            window.viewport.highlight_domain(domain)
            menu.aboutToHide.connect(self._on_hidden)
        colours = menu.addMenu("C&olour by")
        colours.addActions(self._shadings)
        menu.addMenu(self._cameras)
        actions = window.actions_by_key
        menu.addActions([actions["reset_camera"], actions["ghost"]])
        menu.addSeparator()
        menu.addActions([actions[key] for key in ("resolve", "reset", "undo")])
        menu.popup(place)

    @Slot()
    def _on_hidden(self) -> None:
        self._window.viewport.highlight_domain(None)
