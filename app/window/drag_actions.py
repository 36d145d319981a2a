"""The actions of dragging: Solid, pins, the size of the patch that is taken."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, Slot
from PySide6.QtGui import QAction

from app.view.mouse import RADIUS_STEP
from app.window.actions import (
    ACTIONS,
    DRAG_STRENGTHS,
    NO_BODY,
    allow_action,
    make_choices,
    make_menu,
)
from app.window.widgets import silent

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from app.view.viewport import Viewport

_LIMBS = {"pin_feet": ("feet", r"\b(foot|feet)\b"), "pin_hands": ("hands", r"\bhands?\b")}
"""By the actions' keys: what they pin, and which body parts have one."""


class DragActions(QObject):
    """What can be done with the body besides dragging it.

    Parameters
    ----------
    document : changed
    settings : remember whether the body is solid, and how strongly drags keep to natural poses
    viewport : knows what is under the pointer
    actions : by key; whether they can be chosen follows the document and the pointer

    Attributes
    ----------
    acts : callables by the actions' keys
    strengths_menu : how strongly drags keep to natural poses
    """

    def __init__(
        self,
        document: PoseDocument,
        settings: Settings,
        viewport: Viewport,
        actions: Mapping[str, QAction],
    ) -> None:
        super().__init__(viewport)
        self._document, self._settings = document, settings
        self._viewport, self._actions = viewport, actions
        self.acts: dict[str, Callable[[], object]] = {
            "solid": lambda: document.motion.set_solid(actions["solid"].isChecked()),
            "standing": lambda: self._choose("standing"),
            "whole_body": lambda: self._choose("whole_body"),
            "arrows": viewport.toggle_arrows,
            "pin": viewport.toggle_pin,
            "pin_turn": lambda: viewport.toggle_pin(oriented=True),
            "unpin_all": document.pins.remove_all,
            "pin_feet": lambda: self._pin("pin_feet"),
            "pin_hands": lambda: self._pin("pin_hands"),
            "smaller": lambda: document.motion.set_grip_radius(
                document.motion.grip_radius / RADIUS_STEP
            ),
            "larger": lambda: document.motion.set_grip_radius(
                document.motion.grip_radius * RADIUS_STEP
            ),
        }
        document.motion.drag_strength = settings["drag_strength"]
        strengths = make_choices(
            DRAG_STRENGTHS, document.motion.drag_strength, self._set_strength, viewport
        )
        self.strengths_menu = make_menu("Drag stiff&ness", strengths, viewport)
        document.motion.set_solid(settings["solid"])
        document.motion.standing, document.motion.whole_body = (
            settings["standing"],
            settings["whole_body"],
        )
        for key in ("standing", "whole_body"):
            actions[key].setChecked(settings[key])
        document.motion.solid_changed.connect(self._on_solid)
        for changed in (document.model_changed, document.history.pins_changed, viewport.pointed):
            changed.connect(self._update_actions)
        self._on_solid()
        self._update_actions()

    def _choose(self, key: str) -> None:
        """Let later drags do what an action is about, or not."""
        is_on = self._settings[key] = self._actions[key].isChecked()
        setattr(self._document.motion, key, is_on)

    def _set_strength(self, strength: float) -> None:
        self._document.motion.drag_strength = self._settings["drag_strength"] = strength

    @Slot()
    def _on_solid(self) -> None:
        solid = self._document.motion.solid
        with silent(self._actions["solid"]):
            self._actions["solid"].setChecked(solid)
        self._settings["solid"] = solid

    @Slot()
    def _update_actions(self) -> None:
        document, actions = self._document, self._actions
        why_not = dict.fromkeys(self.acts, "" if document.has_model else NO_BODY)
        if document.has_model:
            vertex = self._viewport.pointed_vertex
            frames = [bool(pin.frame) for pin in document.history.pose.pins if pin.vertex == vertex]
            for key, is_pinned in (("pin", bool(frames)), ("pin_turn", any(frames))):
                actions[key].setText("Un&pin" if is_pinned else ACTIONS[key].text)
            pointed = "Point at the body first" if vertex is None else ""
            why_not |= dict.fromkeys(("pin", "pin_turn", "arrows"), pointed)
            why_not["unpin_all"] = "" if document.history.pose.pins else "Nothing is pinned"
            for key, (limbs, _) in _LIMBS.items():
                missing = f"No body part of this model is named after {limbs}"
                why_not[key] = "" if self._domains(key) else missing
        for key, reason in why_not.items():
            allow_action(actions[key], ACTIONS[key].tip, reason)

    def _domains(self, key: str) -> list[int]:
        """Return the body parts that an action pins."""
        names = self._document.model.domain_names
        return [k for k, name in enumerate(names) if re.search(_LIMBS[key][1], name.casefold())]

    def _pin(self, key: str) -> None:
        """Pin the far ends of body parts."""
        from lcollision_core.posing import far_end

        document = self._document
        space = document.model.space
        grips = [document.motion.grip_at(far_end(space, domain)) for domain in self._domains(key)]
        document.pins.pin(grips, f"Pin {_LIMBS[key][0]}", oriented=True)
