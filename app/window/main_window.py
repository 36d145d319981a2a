"""The editor's window: the viewport in the middle, panels round it, menus above."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PySide6.QtCore import QEvent, QSize, Qt, QTimer, Signal, Slot
from PySide6.QtGui import (
    QAction,
    QActionGroup,
    QCloseEvent,
    QDragEnterEvent,
    QDropEvent,
    QGuiApplication,
    QResizeEvent,
    QShowEvent,
)
from PySide6.QtWidgets import (
    QApplication,
    QDialog,
    QMainWindow,
    QMenu,
    QWidget,
)

from app.editing.settings import Settings
from app.view.icons import icon, program_icon
from app.view.shading import Shading
from app.view.theme import apply_theme, wanted_theme
from app.view.viewport import Viewport
from app.window.action_handlers import ActionHandlers
from app.window.actions import (
    ACTIONS,
    CAMERA_ACTIONS,
    DOCKS,
    SHADINGS,
    THEMES,
    ActionSpec,
    equip_action,
    explain_action,
    make_action,
)
from app.window.body_menu import BodyMenu
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.failure import FailureDialog
from app.window.file_actions import FileActions
from app.window.library_actions import LibraryActions
from app.window.menus import fill_menus, make_bar, refresh_bar
from app.window.panels.collision import CollisionPanel
from app.window.panels.dock import Panel
from app.window.panels.library import LibraryPanel
from app.window.panels.part_menu import PartMenus
from app.window.panels.randomise import RandomiseCard
from app.window.panels.sliders import SlidersPanel
from app.window.panels.widgets import silent
from app.window.shortcuts import WindowShortcuts
from app.window.status_bar import StatusBar
from app.wording import menu_text, one_line
from app.work.preparing import Preparing
from app.work.threads import Failure
from lcollision_core.errors import LCollisionError

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.recovery import Autosave, LostPose

_log = logging.getLogger(__name__)

_LAYOUT_VERSION = 1
_SIZE = QSize(1440, 900)
_SIDE_SHARES = {"sliders": (0.25, 344, 460), "collision": (0.22, 312, 380)}
"""Of the window's width, at least and at most, in device-independent pixels."""
_NARROW = 1100
"""A window narrower than this has no room for the poses between the panels at its sides."""
_VIEW_WIDTH = 400
"""Of the view, before the panels beside it get more than they need."""
_AREAS = {
    "sliders": Qt.DockWidgetArea.LeftDockWidgetArea,
    "collision": Qt.DockWidgetArea.RightDockWidgetArea,
    "library": Qt.DockWidgetArea.BottomDockWidgetArea,
}


class MainWindow(QMainWindow):
    """Everything that the user sees of one document.

    Parameters
    ----------
    document : may have no model yet
    settings : of the user

    Signals
    -------
    ready : once, when the first model is in and its pose is on the screen
    """

    ready = Signal()

    def __init__(self, document: PoseDocument, settings: Settings) -> None:
        super().__init__()
        # A closed window must not wait for the garbage collector, which takes its widgets apart in
        # any order: Qt then reads what is freed.
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.document = document
        self.settings = settings
        self._autosave: Autosave | None = None
        self._announced = self._unasked = False
        self.setObjectName("editor")
        self.setWindowIcon(program_icon())
        self.setAcceptDrops(True)
        self.setDockNestingEnabled(True)
        for corner in (Qt.Corner.TopLeftCorner, Qt.Corner.BottomLeftCorner):
            self.setCorner(corner, Qt.DockWidgetArea.LeftDockWidgetArea)
        self.setCorner(Qt.Corner.TopRightCorner, Qt.DockWidgetArea.RightDockWidgetArea)

        self.files = FileActions(self, document, settings, self.attempt)
        self.viewport = Viewport(document)
        self.viewport.setMinimumSize(160, 120)
        self.setCentralWidget(self.viewport)
        self.actions_by_key = {key: self._action(key, spec) for key, spec in ACTIONS.items()}
        self._shadings = self._choices(
            SHADINGS, Shading[settings["shading"].upper()], self._on_shading_chosen
        )
        self._themes = self._choices(THEMES, settings["theme"], self._on_theme_chosen)
        self._cameras = {name: make_action(spec, self) for name, spec in CAMERA_ACTIONS.items()}
        for name, action in self._cameras.items():
            action.setData(name)
            action.triggered.connect(self._on_camera_chosen)

        act = self.actions_by_key
        self.sliders = SlidersPanel(document)
        self.randomise = RandomiseCard(act["randomise"], settings["randomise_amount"])
        self.sliders.add_card(self.randomise)
        self.collision = CollisionPanel(document, act["resolve"])
        self.library = LibraryPanel(document, act["keep"], act["update"], act["add"])
        self.library_actions = LibraryActions(self, document, self.library, self.files, act)
        self.docks = {
            "sliders": self._dock("sliders", "Sliders", self.sliders),
            "collision": self._dock("collision", "Collisions", self.collision),
            "library": self._dock("library", "Poses", self.library),
        }
        self._camera_menu = self._submenu("&Camera view", self._cameras.values())
        self._body_menu = BodyMenu(self, self._shadings.values(), self._camera_menu)
        self._theme_menu = self._submenu("&Theme", self._themes.values())
        self.menus = fill_menus(
            self,
            act,
            {
                "shading": self._shadings.values(),
                "docks": [dock.toggleViewAction() for dock in self.docks.values()],
            },
            {
                "recent": self.files.recent_menu,
                "models": self.files.models_menu,
                "cameras": self._camera_menu,
                "themes": self._theme_menu,
            },
        )
        self._bar = make_bar(act, self._shadings.values(), self._camera_menu)
        self.addToolBar(self._bar)
        self._handlers = ActionHandlers(self)
        self.part_menus = PartMenus(self)
        WindowShortcuts(self)
        self._status = StatusBar()
        self.setStatusBar(self._status)
        self._preparing = Preparing(self)
        self._connect()
        self.viewport.set_shading(Shading[settings["shading"].upper()])
        document.show_ghost(settings["show_ghost"])
        act["ghost"].setChecked(settings["show_ghost"])
        self._restore()
        self._on_model()

    # What others may do to it.

    def attempt(self, act: Callable[[], object]) -> object:
        """Do something, and show what a user can fix of what goes wrong.

        Returns
        -------
        value : what `act` returned; None where it went wrong
        """
        try:
            return act()
        except LCollisionError as error:
            _log.info("shown to the user: %s", error, exc_info=True)
            self.show_failure(Failure.of(error))
            return None

    def set_autosave(self, autosave: Autosave) -> None:
        """Take charge of an autosave: its failures are shown, and it ends with the window."""
        self._autosave = autosave
        autosave.failed.connect(self.show_failure)

    def recover(self, lost: LostPose) -> None:
        """Go on with a pose that a crash left."""
        if self._autosave is not None:
            self._autosave.recover(lost)

    @Slot(object)
    def show_failure(self, failure: Failure) -> None:
        """Tell what went wrong, in a dialog that leaves all else running; once while it is open."""
        told = [held for held in self.findChildren(FailureDialog) if held.isVisible()]
        if failure.headline in [held.failure.headline for held in told]:
            return
        dialog = FailureDialog(failure, self)
        dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        dialog.open()

    def set_theme(self, choice: str) -> None:
        """Take on a theme: "system", "light" or "dark"."""
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        self.settings["theme"] = choice
        apply_theme(application, wanted_theme(choice))
        for key, spec in ACTIONS.items():
            if spec.icon:
                self.actions_by_key[key].setIcon(icon(spec.icon))
        for name, action in self._cameras.items():
            action.setIcon(icon(CAMERA_ACTIONS[name].icon))
        refresh_bar(self._bar)
        self.collision.refresh_icons()
        self.randomise.refresh_icons()
        self.library.redraw()

    def show_in_sliders(self, domain: int) -> None:
        """Open a body part's sliders and bring them into sight."""
        self.docks["sliders"].show()
        self.docks["sliders"].raise_()
        self.sliders.show_domain(domain)

    def edit_parts(self, domain: int | None = None, what: str = "") -> None:
        """Show the dialog of the body parts.

        Parameters
        ----------
        domain : the one to begin with, None for the first
        what : "name" or "colour" of it to change at once, "" for neither
        """
        from app.work.jobs import is_bundled
        from lcollision_core.model import list_models

        document = self.document
        taken = [model.name for model in list_models()]
        dialog = BodyPartsDialog(document.model, is_bundled(document.model_file), taken, self)
        dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        dialog.edited.connect(document.edit_parts)
        # Of another model these are other parts.
        document.model_changed.connect(dialog.reject)
        dialog.open()
        if domain is not None:
            dialog.choose(domain)
        if what == "name":
            dialog.edit_name()
        elif what == "colour":
            dialog.choose_colour()

    def reset_layout(self) -> None:
        """Put all panels back to their places."""
        for key, dock in self.docks.items():
            dock.setFloating(False)
            self.addDockWidget(_AREAS[key], dock)
            dock.show()
        self._size_docks()

    # Qt's.

    def showEvent(self, event: QShowEvent) -> None:  # noqa: N802 - Qt's name
        """Give the panels their widths, which only a shown window keeps."""
        super().showEvent(event)
        if not event.spontaneous():
            # Or else the first button of the tool bar would look chosen.
            self.viewport.setFocus()
        if self.settings["window_layout"].isEmpty():
            QTimer.singleShot(0, self, self._size_docks)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Let the poses have the corner where the window is narrow."""
        super().resizeEvent(event)
        self._share_corner()

    def close_unasked(self) -> None:
        """Close at once; what is not saved is offered at the next start."""
        self._unasked = True
        for widget in QApplication.topLevelWidgets():
            if isinstance(widget, QDialog):
                widget.reject()
        self.close()

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """See what another editor has kept meanwhile, as the user comes back to this one."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.ActivationChange and self.isActiveWindow():
            self.document.refresh_library()

    def closeEvent(self, event: QCloseEvent) -> None:  # noqa: N802 - Qt's name
        """Settle unsaved changes, then end all work before the view goes."""

        def settle() -> bool:
            self.document.finish_exports()
            return self._unasked or self.files.may_lose_changes()

        may_close = self.attempt(settle)
        # `close_unasked` takes an open question away, but cannot close what is closing.
        if not (may_close or self._unasked):
            event.ignore()
            return
        self.settings["window_geometry"] = self.saveGeometry()
        self.settings["window_layout"] = self.saveState(_LAYOUT_VERSION)
        self.settings["randomise_amount"] = self.randomise.amount.value() / 100
        self._preparing.close()
        # What takes long to end need not be looked at.
        for held in (self, *self.findChildren(QWidget)):
            if held.isWindow():
                held.hide()
        if self._autosave is not None:
            self._autosave.close(keep=self._unasked)
        if not self.document.close():
            _log.warning("a thread was still busy when the window closed")
        self._status.clearMessage()
        self.library.stop()
        self.viewport.shut_down()
        super().closeEvent(event)

    def dragEnterEvent(self, event: QDragEnterEvent) -> None:  # noqa: N802 - Qt's name
        """Welcome files."""
        if any(url.isLocalFile() for url in event.mimeData().urls()):
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent) -> None:  # noqa: N802 - Qt's name
        """Open a file that is dropped, of several the first that can be opened."""
        paths = [Path(url.toLocalFile()) for url in event.mimeData().urls() if url.isLocalFile()]
        if not paths:
            return
        event.acceptProposedAction()
        # The program that is dragged from waits until this returns.
        QTimer.singleShot(0, self, lambda: self.attempt(lambda: self.files.open_dropped(paths)))

    # Building.

    def _action(self, key: str, spec: ActionSpec) -> QAction:
        action = make_action(spec, self)
        action.setObjectName(key)
        action.triggered.connect(self._on_action)
        return action

    def _choices(
        self, specs: Mapping[Any, ActionSpec], chosen: Any, slot: Callable[[], None]
    ) -> dict[Any, QAction]:
        """Make actions of which one is on; each carries its key as data."""
        group = QActionGroup(self)
        actions = {}
        for key, spec in specs.items():
            action = make_action(spec, self)
            action.setData(key)
            action.setChecked(key == chosen)
            action.triggered.connect(slot)
            group.addAction(action)
            actions[key] = action
        return actions

    def _submenu(self, title: str, actions: Iterable[QAction]) -> QMenu:
        menu = QMenu(title, self)
        menu.addActions(list(actions))
        return menu

    def _dock(self, key: str, title: str, content: QWidget) -> Panel:
        dock = Panel(key, title, content, self)
        equip_action(dock.toggleViewAction(), DOCKS[key])
        self.addDockWidget(_AREAS[key], dock)
        return dock

    def _connect(self) -> None:
        document = self.document
        for panel in (self.sliders, self.collision):
            panel.domain_hovered.connect(self.viewport.highlight_domain)
        for rows in (self.sliders, self.collision.prediction):
            rows.menu_wanted.connect(self.part_menus.show_menu)
        self.viewport.domain_hovered.connect(self.sliders.light_domain)
        self.viewport.domain_hovered.connect(self.collision.prediction.light_domain)
        self.viewport.shading_changed.connect(self._on_shading)
        self.viewport.menu_wanted.connect(self._body_menu.open)
        self.collision.resolve.options_wanted.connect(self._handlers.choose_resolve_options)
        self.randomise.wanted.connect(document.randomise)
        self.randomise.refused.connect(self._status.tell)
        document.model_changed.connect(self._on_model)
        document.frame_changed.connect(self._on_frame)
        document.file_changed.connect(self._update_title)
        document.modified_changed.connect(self._update_title)
        document.locks_changed.connect(self._update_actions)
        document.ghost_changed.connect(self._on_ghost)
        document.solve_started.connect(self._update_actions)
        document.solve_finished.connect(self._update_actions)
        document.busy_changed.connect(self._on_busy)
        self.viewport.pictures.busy_changed.connect(self._on_busy)
        # What was told of the pose before is past.
        document.pose_loaded.connect(self._status.clearMessage)
        document.message.connect(self._status.tell)
        document.failed.connect(self.show_failure)
        self._preparing.begun.connect(self._status.explain)
        self._preparing.begun.connect(self.viewport.waiting.explain)
        stack = document.undo_stack
        stack.indexChanged.connect(self._update_actions)
        QGuiApplication.styleHints().colorSchemeChanged.connect(self._on_system_theme)

    def _restore(self) -> None:
        screen = QGuiApplication.primaryScreen().availableGeometry().size()
        self.resize(_SIZE.boundedTo(screen))
        self.restoreGeometry(self.settings["window_geometry"])
        self.restoreState(self.settings["window_layout"], _LAYOUT_VERSION)
        self._share_corner()

    def _share_corner(self) -> None:
        corner, area = Qt.Corner.BottomRightCorner, Qt.DockWidgetArea.RightDockWidgetArea
        if self.width() < _NARROW:
            area = Qt.DockWidgetArea.BottomDockWidgetArea
        if self.corner(corner) is not area:
            self.setCorner(corner, area)

    @Slot()
    def _size_docks(self) -> None:
        sides = [self.docks[key] for key in _SIDE_SHARES]
        widths = [
            round(min(max(share * self.width(), least), most))
            for share, least, most in _SIDE_SHARES.values()
        ]
        if sum(widths) + _VIEW_WIDTH > self.width():
            widths = [side.minimumSizeHint().width() for side in sides]
        self.resizeDocks(sides, widths, Qt.Orientation.Horizontal)
        self.resizeDocks(
            [self.docks["library"]],
            [self.docks["library"].sizeHint().height()],
            Qt.Orientation.Vertical,
        )

    # Following the document.

    @Slot()
    def _on_model(self) -> None:
        has_model = self.document.has_model
        for dock in self.docks.values():
            dock.widget().setEnabled(has_model)
        if has_model:
            model = self.document.model
            self._status.show_facts(f"{model.name} · {model.n_vertices} vertices")
        self._update_title()
        self._update_actions()

    @Slot()
    def _on_frame(self) -> None:
        if self._announced or self.document.frame is None:
            return
        self._announced = True
        self.ready.emit()
        # Pictures only once the pose itself has been drawn.
        QTimer.singleShot(300, self.library, self.library.allow_pictures)

    @Slot()
    def _update_title(self) -> None:
        document = self.document
        if not document.has_model:
            self.setWindowTitle("LCollision")
            return
        name = document.pose_name + ", changed" * document.changed
        file = f" — {document.file.name}" if document.file is not None else ""
        self.setWindowTitle(one_line(f"{name}{file}[*] — {document.model.name}"))
        self.setWindowModified(document.modified)

    @Slot()
    def _update_actions(self) -> None:
        document, stack = self.document, self.document.undo_stack
        has_model = document.has_model
        allowed = {
            "undo": stack.canUndo(),
            "redo": stack.canRedo(),
            "mirror": document.can_mirror,
            "unlock": bool(document.locked_domains),
            "resolve": document.can_resolve and not (document.solving or document.incoming),
            "resolve_options": document.can_resolve,
            "cancel": bool(self._busy),
        }
        waits = f"{document.incoming}: it replaces this pose"
        tip = waits if document.incoming else ACTIONS["resolve"].tip
        explain_action(self.actions_by_key["resolve"], tip)
        always = ("open_model", "quit", "reset_layout", "full_screen", "shortcuts", "log", "about")
        for key, action in self.actions_by_key.items():
            if key not in self.library_actions.acts:
                action.setEnabled(key in always or (has_model and allowed.get(key, True)))
        for key, name, text in (
            ("undo", "Undo", stack.undoText()),
            ("redo", "Redo", stack.redoText()),
        ):
            self.actions_by_key[key].setText(
                f"&{name} {menu_text(text[:1].lower() + text[1:])}".rstrip()
            )
        for action in (*self._shadings.values(), *self._cameras.values()):
            action.setEnabled(has_model)
        self._shadings[Shading.PREDICTED].setEnabled(document.can_resolve)

    @Slot(object)
    def _on_shading(self, shading: Shading) -> None:
        self._shadings[shading].setChecked(True)
        self.settings["shading"] = shading.name.lower()

    @Slot()
    def _on_ghost(self) -> None:
        with silent(self.actions_by_key["ghost"]):
            self.actions_by_key["ghost"].setChecked(self.document.ghost_shown)
        self.settings["show_ghost"] = self.document.ghost_shown

    @property
    def _busy(self) -> str:
        """What is being done that can be cancelled, or "" where there is nothing."""
        return self.document.busy or self.viewport.pictures.busy

    @Slot()
    def _on_busy(self) -> None:
        self._status.show_busy(self._busy)
        self._update_actions()

    @Slot()
    def _on_system_theme(self) -> None:
        if self.settings["theme"] == "system":
            self.set_theme("system")

    @Slot()
    def _on_action(self) -> None:
        action = self.sender()
        if isinstance(action, QAction):
            self.attempt(self._handlers.acts[action.objectName()])

    @Slot()
    def _on_shading_chosen(self) -> None:
        self.viewport.set_shading(self._sender_data())

    @Slot()
    def _on_theme_chosen(self) -> None:
        self.set_theme(self._sender_data())

    @Slot()
    def _on_camera_chosen(self) -> None:
        self.viewport.set_camera(self._sender_data())

    def _sender_data(self) -> Any:
        action = self.sender()
        assert isinstance(action, QAction)
        return action.data()
