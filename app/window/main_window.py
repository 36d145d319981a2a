"""The editor's main window: viewport, panels and menus."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QEvent, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QCloseEvent, QGuiApplication, QShowEvent, QStatusTipEvent
from PySide6.QtWidgets import QApplication, QDialog, QWidget

from app.editing.settings import Settings
from app.view.theme import program_icon
from app.view.viewport import Viewport
from app.window.bars import StatusBar, make_bar
from app.window.body_menus import BodyMenus
from app.window.command import Commands, EditorWindow
from app.window.commands.edit import EDIT
from app.window.commands.file import FILE
from app.window.commands.help import HELP
from app.window.commands.library import LIBRARY
from app.window.commands.motion import MOTION, choose_joints
from app.window.commands.pose import POSE, set_up_drags
from app.window.commands.view import VIEW, remembered_shading, set_up_ghost
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.questions import wait_for_exports
from app.window.event_filters import FileDrops, PaintGate, WindowShortcuts
from app.window.file_actions import FileActions
from app.window.hidden_meshes import HiddenMeshes
from app.window.layout import Layout, Panel
from app.window.learning_actions import LearningActions
from app.window.panels.bodies import BodiesPanel
from app.window.panels.collision import CollisionPanel
from app.window.panels.library import LibraryPanel
from app.window.panels.sliders import RandomiseRow, SlidersPanel
from app.window.panels.timeline import TimelinePanel
from app.work.preparing import Preparing
from lcollision_core.tasks.words import counted, one_line, say

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from app.editing.document import PoseDocument
    from app.editing.recovery import Autosave
    from lcollision_core.meshes import Topology

_log = logging.getLogger(__name__)


class MainWindow(EditorWindow):
    """Show and edit one document.

    Parameters
    ----------
    document : may have no model yet
    settings : the user's settings

    Signals
    -------
    ready : emitted once, when the first model is open and its pose is on the screen
    """

    ready = Signal()

    def __init__(self, document: PoseDocument, settings: Settings) -> None:
        super().__init__()
        # Delete on close: the garbage collector destroys widgets in any order, and Qt then reads
        # freed memory.
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.document = document
        self.settings = settings
        self.autosave: Autosave | None = None
        self._unasked = False
        self.setObjectName("editor")
        self.setWindowIcon(program_icon())
        FileDrops(self).dropped.connect(self._on_dropped)
        self.viewport = Viewport(document)
        self.viewport.follows = settings["camera_follows"]
        self.viewport.setMinimumSize(160, 120)
        self.setCentralWidget(self.viewport)
        self.commands = Commands(self, (FILE, EDIT, POSE, MOTION, LIBRARY, VIEW, HELP))
        self.actions_by_key = self.commands.actions
        self.sliders = SlidersPanel(document)
        self.randomise = RandomiseRow(
            document, self.actions_by_key["randomise"], settings["randomise_amount"]
        )
        self.sliders.add_below(self.randomise)
        self.collision = CollisionPanel(document, self.actions_by_key)
        self.library = LibraryPanel(document, self.actions_by_key)
        self.timeline = TimelinePanel(document, self.actions_by_key)
        self.commands.add_to(self.viewport, self.timeline)
        self.bodies = BodiesPanel(document)
        panels = (self.bodies, self.sliders, self.collision, self.library, self.timeline)
        self.docks = {panel.docking.key: Panel(panel, panel.docking, self) for panel in panels}
        self._layout = Layout(self, self.docks, settings)
        self.files = FileActions(self, document, settings, self.viewport, self.attempt)
        self._status = StatusBar()
        self.setStatusBar(self._status)
        self.meshes = HiddenMeshes(
            self,
            document,
            settings,
            self._hide_faces,
            self.attempt,
        )
        self.learning = LearningActions(self, document, self.files, self._status, self.attempt)
        set_up_drags(document.motion, settings)
        set_up_ghost(document.history, settings)
        self._topology: Topology | None = None
        self.commands.fill()
        self.menus = self.commands.menus
        self.addToolBar(make_bar(self.commands))
        self._body_menus = BodyMenus(self)
        WindowShortcuts(self)
        self._preparing = Preparing(self)
        self._paint_gate = PaintGate(self, document.motion)
        self._connect()
        self._layout.restore()
        self.timeline.follow_motion()
        self._on_model()

    # Overridden from Qt.

    def showEvent(self, event: QShowEvent) -> None:  # noqa: N802 - Qt's name
        """Size the panels once the window is shown."""
        super().showEvent(event)
        if not event.spontaneous():
            # Otherwise the first button of the tool bar has the focus and looks selected.
            self.viewport.setFocus()
        QTimer.singleShot(0, self, self._layout.apply_sizes)

    def close_unasked(self) -> None:
        """Close without asking; unsaved changes are offered at the next start."""
        self._unasked = True
        for widget in QApplication.topLevelWidgets():
            if isinstance(widget, QDialog):
                widget.reject()
        self.close()

    def event(self, event: QEvent) -> bool:
        """Keep a message that Qt would clear when the pointer leaves a button."""
        if isinstance(event, QStatusTipEvent):
            self._status.show_tip(event.tip())
            return True
        return super().event(event)

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Refresh the pose library when activated: another editor may have changed it."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.ActivationChange and self.isActiveWindow():
            self.document.library.refresh()

    def closeEvent(self, event: QCloseEvent) -> None:  # noqa: N802 - Qt's name
        """Settle unsaved changes, then end all work before the view is destroyed."""

        def settle() -> bool:
            written = wait_for_exports(self, self.document, self.viewport.pictures)
            return written and (self._unasked or self.files.confirm_losing_changes())

        may_close = self.attempt(settle)
        # `close_unasked` dismisses an open question but cannot close a window that is closing.
        if not (may_close or self._unasked):
            event.ignore()
            return
        self._layout.save()
        self.settings["randomise_amount"] = self.randomise.amount.value() / 100
        self._preparing.close()
        self._paint_gate.close()
        self.learning.close()
        # Hide the window while long work ends.
        for widget in (self, *self.findChildren(QWidget)):
            if widget.isWindow():
                widget.hide()
        if self.autosave is not None:
            self.autosave.close(keep=self._unasked)
        if not self.document.close():
            _log.warning("a thread was still busy when the window closed")
        self._status.clearMessage()
        self.library.stop()
        self.viewport.shut_down()
        super().closeEvent(event)

    # Building.

    def _connect(self) -> None:
        document = self.document
        self.bodies.hidden_changed.connect(self._hide_faces)
        self.bodies.save_wanted.connect(lambda: self.attempt(self.files.save_scene))
        self.bodies.clip_wanted.connect(
            lambda *wanted: self.attempt(partial(self.files.play_clip, *wanted))
        )
        self.bodies.removal_wanted.connect(
            lambda name: self.attempt(partial(self.files.remove_from_scene, name))
        )
        for rows in (self.sliders, self.collision.prediction):
            rows.domain_hovered.connect(self.viewport.highlight_domain)
            rows.menu_wanted.connect(self._body_menus.open_on_part)
            self.viewport.domain_hovered.connect(rows.light_domain)
        for card in (self.collision.exact, self.collision.proposal):
            card.faces_selected.connect(self.viewport.tint_faces)
        self.collision.exact.points_selected.connect(self.viewport.look_at)
        self.viewport.follow_menu(self.menus[POSE.title])
        self.viewport.waiting.open_wanted.connect(self.actions_by_key["open_model"].trigger)
        document.model_changed.connect(self._on_model)
        document.motion.frame_changed.connect(self._on_frame)
        document.history.file_changed.connect(self._update_title)
        document.history.modified_changed.connect(self._update_title)
        document.tasks.busy_changed.connect(self._on_busy)
        self.viewport.pictures.busy_changed.connect(self._on_busy)
        self._status.cancel.clicked.connect(document.tasks.cancel_exports)
        self._status.cancel.clicked.connect(self.viewport.pictures.cancel)
        # Messages about the previous pose are outdated.
        document.history.pose_loaded.connect(self._status.clearMessage)
        document.message.connect(self._status.tell)
        self.viewport.hinted.connect(self._status.show_hint)
        document.tasks.progressed.connect(self._status.show_progress)
        document.failed.connect(self.show_failure)
        self._preparing.begun.connect(self._status.explain)
        self._preparing.begun.connect(self.viewport.waiting.explain)
        QGuiApplication.styleHints().colorSchemeChanged.connect(self._on_system_theme)
        self.library.menu_wanted.connect(
            lambda position: self.commands.popup(LIBRARY.title, position)
        )
        history, motion, tasks = document.history, document.motion, document.tasks
        document.timeline.joints_unsure.connect(partial(choose_joints, self))
        self.commands.follow(
            (
                *(document.model_changed, document.library.changed, motion.locks_changed),
                *(history.pins_changed, history.file_poses_changed, history.ghost_changed),
                motion.solid_changed,
                *(tasks.solve_started, tasks.solve_finished, tasks.busy_changed),
                *(self.viewport.pointed, self.viewport.shading_changed),
                *(self.viewport.pictures.busy_changed, self.library.chosen_changed),
                self.learning.runs.changed,
                *(document.timeline.opened, document.timeline.playback.changed),
                *(document.timeline.options_changed, document.timeline.onion_changed),
                *(document.timeline.trail_changed, history.moment_entered),
            ),
            of_steps=(history.undo_stack.indexChanged, history.file_changed),
        )

    # Following the document.

    @Slot()
    def _on_model(self) -> None:
        has_model = self.document.has_model
        for dock in self.docks.values():
            dock.widget().setEnabled(has_model)
        # A single body needs no list.
        n_bodies = self.bodies.n_bodies
        self.docks["bodies"].toggleViewAction().setVisible(n_bodies > 1)
        if n_bodies < 2 and self.docks["bodies"].isAncestorOf(self.focusWidget()):
            # Otherwise the search field gets the focus, and takes the keys of the view.
            self.viewport.setFocus()
        self.docks["bodies"].setVisible(n_bodies > 1)
        # The new model's names may be longer.
        self._layout.fit()
        if has_model:
            model = self.document.model
            name = counted(n_bodies, "body", "bodies") if n_bodies > 1 else model.name
            self._status.show_facts(f"{name} · {model.n_vertices} vertices")
        topology = self.document.model.topology if has_model else None
        if topology is not self._topology or topology is None:
            # Start another body with the shading last used for its kind.
            self._topology = topology
            self.viewport.set_shading(remembered_shading(self))
        if self.document.scene is not None:
            # For a single body, `HiddenMeshes` decides what is drawn.
            self._hide_faces(self.bodies.hidden_faces)
        self._update_title()

    @Slot(object)
    def _hide_faces(self, hidden: npt.NDArray[np.bool_] | None) -> None:
        """Hide faces, a (F,) bool array or None, in the view and in thumbnails."""
        self.viewport.hide_faces(hidden)
        self.library.hide_faces(hidden)

    @Slot()
    def _on_frame(self) -> None:
        if self.document.motion.frame is None:
            return
        self.document.motion.frame_changed.disconnect(self._on_frame)
        self.ready.emit()
        # Draw the thumbnails only once the pose itself has been drawn.
        QTimer.singleShot(300, self.library, self.library.allow_pictures)

    @Slot()
    def _update_title(self) -> None:
        document = self.document
        if not document.has_model:
            self.setWindowTitle("LCollision")
            return
        name = document.history.pose.name
        if document.history.changed:
            name = say("{pose}, changed", pose=name)
        file = f" — {document.history.file.name}" if document.history.file is not None else ""
        self.setWindowTitle(one_line(f"{name}{file}[*] — {document.model.name}"))
        self.setWindowModified(document.history.modified)

    @Slot(object)
    def _on_dropped(self, paths: list[Path]) -> None:
        self.attempt(lambda: self.files.open_dropped(paths))

    @Slot()
    def _on_busy(self) -> None:
        tasks, pictures = self.document.tasks, self.viewport.pictures
        may_cancel = bool(tasks.n_exports or pictures.busy)
        self._status.show_busy(tasks.busy or pictures.busy, may_cancel=may_cancel)
        for dialog in self.findChildren(BodyPartsDialog):
            dialog.save.setEnabled(not self.document.tasks.changing_model)

    @Slot()
    def _on_system_theme(self) -> None:
        if self.settings["theme"] == "system":
            self.set_theme("system")
