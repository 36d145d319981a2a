"""The Pose menu: drags, pins and Resolve."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt

from app.editing.live_pose import RADIUS_STEP
from app.window.command import (
    Decorator,
    EditorWindow,
    Menu,
    called,
    greyed,
    ticked,
    unless,
    without_body,
)
from app.window.dialogs.forms import resolve_form

if TYPE_CHECKING:
    from app.editing.live_pose import PoseMotion
    from app.editing.settings import Settings

POSE = Menu("&Pose")

_FEET = re.compile(r"\b(foot|feet)\b")
_HANDS = re.compile(r"\bhands?\b")
_NO_PREDICTOR = "This model has no predictor to resolve with"


def set_up_drags(motion: PoseMotion, settings: Settings) -> None:
    """Restore the settings of drags, and store later changes."""
    motion.drag_strength = settings["drag_strength"]
    motion.standing = settings["standing"]
    motion.set_solid(settings["solid"])
    motion.set_clearance(settings["clearance"])

    def remember() -> None:
        settings["solid"], settings["clearance"] = motion.solid, motion.clearance

    motion.solid_changed.connect(remember)
    motion.clearance_changed.connect(remember)


def _pins_here(window: EditorWindow) -> list[bool]:
    """Return, for each pin under the pointer, whether it keeps the orientation too."""
    vertex = window.viewport.pointed_vertex
    return [bool(pin.frame) for pin in window.document.history.pose.pins if pin.vertex == vertex]


_NOT_POINTED = "Point at the body first"


def _is_pointed(window: EditorWindow) -> bool:
    return window.viewport.pointed_vertex is not None


_where_pointed = unless(_is_pointed, _NOT_POINTED)


def _parts(window: EditorWindow, limb: re.Pattern[str]) -> list[int]:
    names = window.document.model.domain_names
    return [k for k, name in enumerate(names) if limb.search(name.casefold())]


def _where_named(limb: re.Pattern[str], limbs: str) -> Decorator:
    return unless(lambda w: _parts(w, limb), f"No body part of this model has {limbs} in its name")


def _pin_ends(window: EditorWindow, limb: re.Pattern[str], label: str) -> None:
    """Pin the far ends of body parts."""
    from lcollision_core.posing import far_end

    document = window.document
    space = document.model.space
    grips = [document.motion.grip_at(far_end(space, domain)) for domain in _parts(window, limb)]
    document.pins.pin(grips, label, oriented=True)


def _why_not_resolved(window: EditorWindow) -> str:
    document = window.document
    if not document.model.can_resolve:
        return _NO_PREDICTOR
    if document.tasks.incoming:
        return f"{document.tasks.incoming}, which will replace this pose"
    return "Wait for Resolve to finish" if document.tasks.solving else ""


@POSE.command("solid", "&Solid", "Ctrl+Alt+S", "Keep the body from moving into itself", "solid")
@ticked(lambda window: window.document.motion.solid)
def _toggle_solid(window: EditorWindow) -> None:
    window.document.motion.set_solid(not window.document.motion.solid)


@POSE.command(
    "standing",
    "Keep feet on the &ground",
    "Ctrl+Alt+G",
    "Keep what stands on the ground in place in drags and in Resolve",
)
@ticked(lambda window: window.document.motion.standing)
def _toggle_standing(window: EditorWindow) -> None:
    motion = window.document.motion
    motion.standing = window.settings["standing"] = not motion.standing


def _has_ground(window: EditorWindow) -> bool:
    scene = window.document.scene
    return scene is not None and any(member.is_ground for member in scene.members)


@POSE.command(
    "ground",
    "Collide with groun&d",
    "Ctrl+Shift+G",
    "Check collisions with the ground under the rest pose, in drags, Resolve and motions",
)
@ticked(_has_ground)
@unless(
    lambda window: not window.document.model.is_trained,
    "A learned model has no fixed ground; open a character",
)
def _toggle_ground(window: EditorWindow) -> None:
    window.files.toggle_ground()


@POSE.command(
    "whole_body",
    "Move whole &body",
    "Ctrl+Alt+W",
    "Let drags move the whole body, not only the limb under the pointer, until the editor closes",
)
@ticked(lambda window: window.document.motion.whole_body)
def _toggle_whole_body(window: EditorWindow) -> None:
    motion = window.document.motion
    motion.whole_body = not motion.whole_body


@POSE.command(
    "arrows",
    "Show a&xes",
    "A",
    "Show arrows to drag the patch under the pointer along the body's axes, or hide them",
)
@unless(lambda window: _is_pointed(window) or window.viewport.has_arrows, _NOT_POINTED)
def _arrows(window: EditorWindow) -> None:
    window.viewport.toggle_arrows()


POSE.line()


@POSE.command("pin", "&Pin", "P", "Hold the patch under the pointer in place")
@_where_pointed
@called(lambda window: "Un&pin" if _pins_here(window) else "&Pin")
def _pin(window: EditorWindow) -> None:
    window.viewport.toggle_pin()


@POSE.command(
    "pin_turn",
    "Pin with &orientation",
    "Ctrl+Shift+P",
    "Hold the patch under the pointer in place and keep its body part's orientation",
)
@_where_pointed
@called(lambda w: "Un&pin" if any(_pins_here(w)) else "Pin with &orientation")
def _pin_turn(window: EditorWindow) -> None:
    window.viewport.toggle_pin(oriented=True)


@POSE.command(
    "pin_feet", "Pin &feet", "Ctrl+Alt+F", "Hold the feet in place, at their current angle"
)
@_where_named(_FEET, "feet")
def _pin_feet(window: EditorWindow) -> None:
    _pin_ends(window, _FEET, "Pin feet")


@POSE.command(
    "pin_hands", "Pin &hands", "Ctrl+Alt+H", "Hold the hands in place, at their current angle"
)
@_where_named(_HANDS, "hands")
def _pin_hands(window: EditorWindow) -> None:
    _pin_ends(window, _HANDS, "Pin hands")


@POSE.command("unpin_all", "&Unpin all", "Shift+P", "Remove all pins")
@unless(lambda window: window.document.history.pose.pins, "Nothing is pinned")
def _unpin_all(window: EditorWindow) -> None:
    window.document.pins.remove_all()


POSE.line()


@POSE.command("smaller", "S&maller patch", "[", "Drag a smaller patch, as small as a single finger")
def _smaller(window: EditorWindow) -> None:
    window.document.motion.set_grip_radius(window.document.motion.grip_radius / RADIUS_STEP)


@POSE.command("larger", "&Larger patch", "]", "Drag a larger patch of the body")
def _larger(window: EditorWindow) -> None:
    window.document.motion.set_grip_radius(window.document.motion.grip_radius * RADIUS_STEP)


_STIFFNESS = POSE.choices("Drag stiff&ness")


def _stiff(strength: float, key: str, text: str, digit: int, tip: str) -> None:
    @_STIFFNESS.command(key, text, f"Ctrl+Alt+{digit}", tip)
    @ticked(lambda window: window.document.motion.drag_strength == strength)
    @without_body
    def stiffen(window: EditorWindow) -> None:
        window.document.motion.drag_strength = window.settings["drag_strength"] = strength


_stiff(
    0.0, "loose", "&Loose", 7, "Let drags stretch limbs and reach poses far from the model's own"
)
_stiff(1.0, "normal", "&Normal", 8, "Keep drags from stretching limbs")
_stiff(4.0, "firm", "&Firm", 9, "Keep drags close to the model's own poses")

POSE.line()


@POSE.command(
    "resolve", "&Resolve", "Ctrl+R", "Find the nearest pose without collisions", "resolve"
)
@greyed(_why_not_resolved)
def _resolve(window: EditorWindow) -> None:
    from lcollision_core.resolve import ResolveOptions

    names = ("metric", "threshold", "time_budget")
    options = {name: window.settings[f"resolve_{name}"] for name in names}
    # The setting is in per cent; 0 stands for any.
    largest = window.settings["resolve_largest_change"] / 100.0 or None
    window.document.tasks.resolve(ResolveOptions(largest_change=largest, **options))


@POSE.command("cancel", "&Cancel", "Escape", "Stop the current computation", "cancel")
@unless(lambda w: w.document.tasks.busy or w.viewport.pictures.busy, "Nothing is being computed")
def _cancel(window: EditorWindow) -> None:
    window.document.tasks.cancel_all()
    window.viewport.pictures.cancel()


@POSE.command("resolve_options", "Resolve &options…", "Ctrl+Shift+R", "Choose how Resolve works")
@unless(lambda window: window.document.model.can_resolve, _NO_PREDICTOR)
def _choose_resolve_options(window: EditorWindow) -> None:
    form = resolve_form(window.settings, window, window.document.model.has_predictor)
    form.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    form.open()
