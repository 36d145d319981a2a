"""What can be done with a slider or a body part: the menu under the pointer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QPoint, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QMenu

from app.wording import heading, menu_text

if TYPE_CHECKING:
    from app.window.main_window import MainWindow


class PartMenus(QObject):
    """Shows the menu of a slider or of a body part.

    Parameters
    ----------
    window : whose actions the menus share
    """

    def __init__(self, window: MainWindow) -> None:
        super().__init__(window)
        self._window = window

    @Slot(object, object, QPoint)
    def show_menu(self, domain: int | None, code: int | None, place: QPoint) -> None:
        """Show the menu of a code, or of a domain; neither is the whole body's."""
        menu = self.menu(domain, code)
        menu.aboutToHide.connect(menu.deleteLater)
        menu.popup(place)

    def menu(self, domain: int | None, code: int | None) -> QMenu:
        """Make the menu.

        Parameters
        ----------
        domain : index from 0, None for the whole body
        code : index from 0 in the latent, None for the part alone
        """
        window, document = self._window, self._window.document
        actions = window.actions_by_key
        menu = QMenu(window)
        menu.setToolTipsVisible(True)
        if code is not None:
            rows = (row for group in window.sliders.groups for row in group.rows)
            row = next(row for row in rows if row.code == code)
            reset = self._add(menu, "&Reset", lambda: document.reset_code(code))
            reset.setEnabled(bool(document.latent[code] != 0.0))
            self._add(menu, "&Type a value…", row.edit_number)
            menu.addSeparator()
        if domain is not None:
            name = menu_text(heading(document.model.domain_names[domain]))
            lock = self._add(menu, f"&Lock {name}", lambda: None)
            lock.setCheckable(True)
            lock.setChecked(domain in document.locked_domains)
            lock.toggled.connect(lambda locked: document.set_locked(domain, locked))
            reset = self._add(menu, f"R&eset {name}", lambda: document.reset_domain(domain))
            reset.setEnabled(domain not in document.locked_domains)
            if code is None:
                self._add(menu, "&Show in sliders", lambda: window.show_in_sliders(domain))
            menu.addSeparator()
            self._add(menu, f"Re&name {name}…", lambda: window.edit_parts(domain, "name"))
            self._add(menu, f"&Colour of {name}…", lambda: window.edit_parts(domain, "colour"))
        menu.addAction(actions["parts"])
        menu.addSeparator()
        for key in ("unlock", "mirror"):
            menu.addAction(actions[key])
        return menu

    def _add(self, menu: QMenu, text: str, act: object) -> QAction:
        action = menu.addAction(text)
        if callable(act):
            action.triggered.connect(lambda: self._window.attempt(act))
        return action
