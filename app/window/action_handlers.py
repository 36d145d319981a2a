"""What the window's actions do, by the actions' keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Qt, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QDialog, QMenu

from app.view.camera import CAMERAS
from app.window.dialogs.failure import open_log_file
from app.window.dialogs.forms import resolve_form
from app.window.dialogs.help import AboutDialog, ShortcutsDialog

if TYPE_CHECKING:
    from app.window.main_window import MainWindow


class ActionHandlers(QObject):
    """One callable for each key of `app.window.actions.ACTIONS`.

    Each may raise `LCollisionError`, for the window to show.

    Parameters
    ----------
    window : with all its panels

    Attributes
    ----------
    acts : callables by key
    """

    def __init__(self, window: MainWindow) -> None:
        super().__init__(window)
        self._window = window
        self._document = document = window.document
        files = window.files
        window.viewport.waiting.open_wanted.connect(window.actions_by_key["open_model"].trigger)
        self.acts: dict[str, Callable[[], object]] = {
            "new": files.new_pose,
            "open": files.open,
            "open_model": files.open_model,
            "save": files.save,
            "save_as": files.save_as,
            "import": files.import_mesh,
            "export": files.export,
            "upright": files.turn_upright,
            "screenshot": lambda: files.screenshot(window.viewport),
            "turntable": lambda: files.turntable(window.viewport),
            "quit": window.close,
            "undo": document.undo,
            "redo": document.redo,
            "reset": document.reset_all,
            "randomise": window.randomise.draw,
            "mirror": document.mirror,
            "filter": self._find_slider,
            "unlock": self._unlock,
            "parts": window.edit_parts,
            "resolve": self._resolve,
            "cancel": self._cancel,
            "resolve_options": self.choose_resolve_options,
            **window.library_actions.acts,
            "ghost": self._toggle_ghost,
            "reset_camera": lambda: window.viewport.set_camera(CAMERAS[0]),
            "full_screen": self._toggle_full_screen,
            "reset_layout": window.reset_layout,
            "shortcuts": self._show_shortcuts,
            "log": open_log_file,
            "about": self._show_about,
        }

    @Slot()
    def choose_resolve_options(self) -> None:
        """Ask how Resolve is to work."""
        self._open(resolve_form(self._window.settings, self._window))

    def _find_slider(self) -> None:
        dock = self._window.docks["sliders"]
        dock.show()
        dock.raise_()
        field = self._window.sliders.filter
        field.setFocus(Qt.FocusReason.ShortcutFocusReason)
        field.selectAll()

    def _unlock(self) -> None:
        for domain in self._document.locked_domains:
            self._document.set_locked(domain, False)

    def _resolve(self) -> None:
        from lcollision_core.resolve import ResolveOptions

        settings = self._window.settings
        self._document.resolve(
            ResolveOptions(
                metric=settings["resolve_metric"],
                threshold=settings["resolve_threshold"],
                time_budget=settings["resolve_time_budget"],
            )
        )

    def _cancel(self) -> None:
        self._document.cancel_all()
        self._window.viewport.pictures.cancel()

    def _toggle_ghost(self) -> None:
        self._document.show_ghost(self._window.actions_by_key["ghost"].isChecked())

    def _toggle_full_screen(self) -> None:
        if self._window.isFullScreen():
            self._window.showNormal()
        else:
            self._window.showFullScreen()

    def _show_shortcuts(self) -> None:
        listed = [
            (title.replace("&", ""), _with_shortcuts(menu))
            for title, menu in self._window.menus.items()
        ]
        self._open(ShortcutsDialog(listed, self._window))

    def _show_about(self) -> None:
        lines = []
        if self._document.has_model:
            model = self._document.model
            lines = [
                f"{model.name}: {model.n_vertices} vertices, {len(model.domain_names)} body parts, "
                f"{model.latent_size} sliders",
                f"trained on {model.card.source}, licence {model.card.licence}",
            ]
        self._open(AboutDialog(lines, self._window))

    @staticmethod
    def _open(dialog: QDialog) -> None:
        dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        dialog.open()


def _with_shortcuts(menu: QMenu) -> list[QAction]:
    """Return the actions of a menu and its submenus that have a shortcut."""
    found = []
    for action in menu.actions():
        submenu = action.menu()
        if isinstance(submenu, QMenu):
            found.extend(_with_shortcuts(submenu))
        elif not action.shortcut().isEmpty():
            found.append(action)
    return found
