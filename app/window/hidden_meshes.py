"""Hide meshes of a character, such as other weapons: they are neither drawn nor checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Slot
from PySide6.QtWidgets import QWidget

from app.window.widgets import ListMenu
from lcollision_core.tasks.words import menu_text, say

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from lcollision_core.meshes import FaceGroup

_MOST_REMEMBERED = 500
_SHOWN = "Ticked: drawn and checked. Hidden meshes are still posed and exported"


class HiddenMeshes(QObject):
    """Hide meshes in the view, and exclude them from the check by the contact rules.

    The hidden meshes are remembered for each character. A mesh that the contact rules count
    again is shown again.

    Parameters
    ----------
    window : parent of the menu
    document : its model's rules are changed
    settings : store the hidden meshes
    draw : called with the mask of hidden faces, or None
    attempt : calls a function and shows its error

    Attributes
    ----------
    menu : of all meshes, ticked if shown
    """

    def __init__(
        self,
        window: QWidget,
        document: PoseDocument,
        settings: Settings,
        draw: Callable[[npt.NDArray[np.bool_] | None], None],
        attempt: Callable[[Callable[[], object]], object],
    ) -> None:
        super().__init__(window)
        self._document, self._settings, self._draw = document, settings, draw
        self.menu = ListMenu("Mes&hes", window, attempt, self._fill)
        document.model_changed.connect(self._follow)
        self._follow()

    @property
    def meshes(self) -> tuple[FaceGroup, ...]:
        """The meshes of a character; empty for another body or a single mesh."""
        model = self._document.model if self._document.has_model else None
        if model is None or model.character is None:
            return ()
        mesh_groups = tuple(group for group in model.character.groups if not group.is_material)
        return mesh_groups if len(mesh_groups) > 1 else ()

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of the hidden meshes."""
        if not self.meshes:
            return ()
        remembered, model = set(self._settings["hidden_meshes"]), self._document.model
        return tuple(
            group.name
            for group in self.meshes
            if self._key(group.name) in remembered and group.name in model.rules.left_out
        )

    def mesh_at(self, vertex: int) -> str | None:
        """Return the name of the mesh of a vertex, None if meshes cannot be hidden."""
        faces = self._document.model.faces
        return next(
            (group.name for group in self.meshes if (faces[group.faces] == vertex).any()), None
        )

    @property
    def can_hide(self) -> bool:
        """Whether another mesh can be hidden: one stays visible, and rules change one at a time."""
        has_two_visible = len(self.hidden) < len(self.meshes) - 1
        return has_two_visible and not self._document.tasks.changing_model

    def hide(self, name: str, hidden: bool = True) -> None:
        """Hide a mesh and exclude it from the check, or show it and check it again."""
        model, key = self._document.model, self._key(name)
        others = [known for known in self._settings["hidden_meshes"] if known != key]
        self._settings["hidden_meshes"] = (*others, *(key,) * hidden)[-_MOST_REMEMBERED:]
        text = say("{mesh} is shown and checked", mesh=name)
        if hidden:
            text = say(
                "{mesh} is hidden and not checked; it is still posed and exported", mesh=name
            )
        self._document.tasks.set_rules(model.rules.leaving_out(name, hidden), text)

    def _key(self, name: str) -> str:
        return f"{self._document.model.fingerprint} {name}"

    @Slot()
    def _follow(self) -> None:
        """Let the view and the thumbnails draw the faces that are not hidden."""
        hidden = self.hidden
        self.menu.menuAction().setEnabled(bool(self.meshes))
        faces: npt.NDArray[np.bool_] | None = None
        if hidden:
            faces = np.zeros(len(self._document.model.faces), dtype=np.bool_)
            for group in self.meshes:
                if group.name in hidden:
                    faces[group.faces] = True
        self._draw(faces)

    def _fill(self) -> None:
        hidden = self.hidden
        for group in self.meshes:
            is_hidden = group.name in hidden
            self.menu.entry(
                menu_text(group.name),
                self.hide,
                group.name,
                not is_hidden,
                tip=_SHOWN,
                ticked=not is_hidden,
                enabled=self.can_hide or (is_hidden and not self._document.tasks.changing_model),
            )
