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
    from lcollision_core.meshes import Topology

_NO_ESTIMATE = "Only a learned model with a predictor has an estimate"
_NO_LOOK = "Only a character from a file has colours and textures of its own"


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
            "ghost": lambda: document.history.show_ghost(ghost.isChecked()),
            "reset_camera": viewport.show_whole,
        }
        self._topology: Topology | None = None
        self.shadings = make_choices(SHADINGS, viewport.shading, self._choose_shading, window)
        self.cameras = make_choices(CAMERA_ACTIONS, None, viewport.set_camera, window)
        self.shading_menu = make_menu("C&olour by", self.shadings, window)
        self.camera_menu = make_menu("&Camera view", self.cameras, window)
        viewport.shading_changed.connect(self._on_shading)
        document.model_changed.connect(self._on_model)
        document.history.ghost_changed.connect(self._on_ghost)
        document.history.show_ghost(settings["show_ghost"])
        ghost.setChecked(settings["show_ghost"])
        self._on_model()

    @Slot()
    def _on_model(self) -> None:
        """Offer what can be shown of the model; another body begins as its kind did last."""
        document = self._document
        missing = "" if document.has_model else NO_BODY
        lacking = {}
        if document.has_model and not document.model.has_predictor:
            lacking[Shading.PREDICTED] = _NO_ESTIMATE
        if document.has_model and document.model.appearance is None:
            lacking[Shading.TEXTURED] = _NO_LOOK
        for action in (*self.shadings, *self.cameras):
            spec = SHADINGS.get(action.data()) or CAMERA_ACTIONS[action.data()]
            allow_action(action, spec.tip, missing or lacking.get(action.data(), ""))
        for key, action in (("ghost", self._ghost), ("reset_camera", self._reset_camera)):
            allow_action(action, ACTIONS[key].tip, missing)
        topology = document.model.topology if document.has_model else None
        if topology is not self._topology or topology is None:
            self._topology = topology
            self._viewport.set_shading(Shading[self._settings[self._remembered].upper()])

    @property
    def _remembered(self) -> str:
        """The setting of the shading: characters with a look of their own have another."""
        document = self._document
        look = document.model.appearance if document.has_model else None
        return "shading" if look is None or look.is_plain else "character_shading"

    @Slot()
    def _on_ghost(self) -> None:
        with silent(self._ghost):
            self._ghost.setChecked(self._document.history.ghost_shown)
        self._settings["show_ghost"] = self._document.history.ghost_shown

    def _choose_shading(self, shading: Shading) -> None:
        """Colour the body as the user wants it, also the next one of its kind."""
        key = "character_shading" if shading is Shading.TEXTURED else self._remembered
        self._settings[key] = shading.name.lower()
        self._viewport.set_shading(shading)

    @Slot(object)
    def _on_shading(self, shading: Shading) -> None:
        for action in self.shadings:
            action.setChecked(action.data() is shading)
