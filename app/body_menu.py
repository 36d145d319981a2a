"""What a click with the right button on the body, or beside it, offers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QPoint, Qt, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QMenu

from app.wording import heading

if TYPE_CHECKING:
    from app.main_window import MainWindow


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
        self._domain = 0

    @Slot(object, QPoint)
    def open(self, domain: int | None, place: QPoint) -> None:
        """Open the menu at a place of the screen.

        Parameters
        ----------
        domain : of the part that was clicked, None beside the body
        """
        window = self._window
        menu = QMenu(window)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        if domain is not None:
            self._add_part(menu, domain)
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

    def _add_part(self, menu: QMenu, domain: int) -> None:
        document = self._window.document
        self._domain = domain
        name = document.model.domain_names[domain].replace("&", "&&")
        is_locked = domain in document.locked_domains
        menu.addAction(heading(name)).setEnabled(False)
        lock = menu.addAction(f"{'Un&lock' if is_locked else '&Lock'} {name}")
        lock.triggered.connect(self._on_lock)
        reset = menu.addAction(f"&Reset {name}")
        reset.setEnabled(not is_locked)
        reset.triggered.connect(self._on_reset)
        menu.addAction(f"Show the &sliders of {name}").triggered.connect(self._on_sliders)
        menu.addSeparator()

    @Slot()
    def _on_lock(self) -> None:
        document = self._window.document
        document.set_locked(self._domain, self._domain not in document.locked_domains)

    @Slot()
    def _on_reset(self) -> None:
        self._window.document.reset_domain(self._domain)

    @Slot()
    def _on_sliders(self) -> None:
        dock = self._window.docks["sliders"]
        dock.show()
        dock.raise_()
        self._window.sliders.show_domain(self._domain)

    @Slot()
    def _on_hidden(self) -> None:
        self._window.viewport.highlight_domain(None)
