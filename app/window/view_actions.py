"""What the menu View does to the picture: ways to colour the body, camera views, the ghost."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QWidget

from app.view.shading import Shading
from app.window.actions import (
    ACTIONS,
    CAMERA_ACTIONS,
    NO_BODY,
    SHADINGS,
    allow_action,
    make_choices,
    make_menu,
)
from app.window.widgets import silent

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from app.view.viewport import Viewport

_NO_ESTIMATE = "Only a learned model with a predictor has an estimate"


class ViewActions(QObject):
    """Chooses how the body is looked at.

    Parameters
    ----------
    window : that the actions belong to
    document : shows or hides its ghost
    settings : remember the shading and whether there is a ghost
    viewport : coloured and turned
    ghost, reset_camera : actions of the window

    Attributes
    ----------
    acts : callables by the actions' keys
    shadings, cameras : actions, in order
    camera_menu, shading_menu : of them
    """

    def __init__(
        self,
        window: QWidget,
        document: PoseDocument,
        settings: Settings,
        viewport: Viewport,
        ghost: QAction,
        reset_camera: QAction,
    ) -> None:
        super().__init__(window)
        self._document, self._settings = document, settings
        self._viewport, self._ghost, self._reset_camera = viewport, ghost, reset_camera
        self.acts: dict[str, Callable[[], object]] = {
            "ghost": lambda: document.show_ghost(ghost.isChecked()),
            "reset_camera": viewport.show_whole,
        }
        shading = Shading[settings["shading"].upper()]
        self.shadings = make_choices(SHADINGS, shading, self._choose_shading, window)
        self.cameras = make_choices(CAMERA_ACTIONS, None, viewport.set_camera, window)
        self.shading_menu = make_menu("C&olour by", self.shadings, window)
        self.camera_menu = make_menu("&Camera view", self.cameras, window)
        viewport.shading_changed.connect(self._on_shading)
        document.model_changed.connect(self._update_actions)
        document.ghost_changed.connect(self._on_ghost)
        viewport.set_shading(shading)
        document.show_ghost(settings["show_ghost"])
        ghost.setChecked(settings["show_ghost"])
        self._update_actions()

    @Slot()
    def _update_actions(self) -> None:
        document = self._document
        missing = "" if document.has_model else NO_BODY
        for action in (*self.shadings, *self.cameras):
            shading = action.data()
            untrained = shading is Shading.PREDICTED and not document.has_predictor
            reason = missing or (_NO_ESTIMATE if untrained else "")
            spec = SHADINGS.get(shading) or CAMERA_ACTIONS[shading]
            allow_action(action, spec.tip, reason)
        for key, action in (("ghost", self._ghost), ("reset_camera", self._reset_camera)):
            allow_action(action, ACTIONS[key].tip, missing)

    @Slot()
    def _on_ghost(self) -> None:
        with silent(self._ghost):
            self._ghost.setChecked(self._document.ghost_shown)
        self._settings["show_ghost"] = self._document.ghost_shown

    def _choose_shading(self, shading: Shading) -> None:
        """Colour the body as the user wants it, also the next time."""
        self._settings["shading"] = shading.name.lower()
        self._viewport.set_shading(shading)

    @Slot(object)
    def _on_shading(self, shading: Shading) -> None:
        for action in self.shadings:
            action.setChecked(action.data() is shading)
