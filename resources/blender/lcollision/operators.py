# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel's buttons do."""

from collections.abc import Generator

import bpy
import numpy as np

from . import live
from .keys import check_keyable, unkeyable_bones
from .link import Opened, Steps, opening, waited
from .scene import Caution, Rigged, SceneError
from .steps import Stepped

BEYOND = (0.0, 0.01, 0.03, 0.1)
"""Shares of a correction by which it goes on, where rounding in Blender's bones still collides."""

_ROUNDING = 1e-6
"""Of the body's size: a depth that differs by less is the same."""


def array(values: dict) -> np.ndarray:
    """Return an array of the engine's answer."""
    return np.frombuffer(values["data"], values["dtype"]).reshape(values["shape"])


def is_worse(after: dict, before: dict) -> bool:
    """Return whether a check finds more pairs than another, or deeper ones."""
    return after["pairs"] > before["pairs"] or after["deepest"] > before["deepest"] + _ROUNDING


def open_character(
    rigged: Rigged, settings: bpy.types.PropertyGroup, poses: np.ndarray | None = None
) -> Generator[str, None, Opened]:
    """Open a character as it is now, and list its groups in the panel."""
    character = yield from opening(rigged, settings.chosen_rules(), poses)
    answer = character.answer
    settings.rules, settings.left_out = answer["in_words"], rigged.left_out_lines()
    settings.groups.clear()
    for name in dict.fromkeys(name for kind in answer["groups"].values() for name in kind):
        settings.groups.add().name = name
    return character


class LCOLLISION_OT_check_pose(Stepped, bpy.types.Operator):
    """Find where the character as it is shown runs into itself"""

    bl_idname = "lcollision.check_pose"
    bl_label = "Check Pose"
    # It changes nothing of the user's that an undo could bring back.
    bl_options = {"REGISTER"}

    def steps(self, context, settings) -> Steps:
        """Check, and show what was found."""
        rigged = Rigged.of(context)
        character = yield from open_character(rigged, settings)
        request = character.check(rigged, character.clearance(rigged))
        reply = yield from waited(character.engine, request, "Checking the pose")
        live.show(rigged, reply)
        return settings.verdict


class LCOLLISION_OT_resolve_pose(Stepped, bpy.types.Operator):
    """Turn the bones to the nearest pose in which the character does not run into itself"""

    bl_idname = "lcollision.resolve_pose"
    bl_label = "Resolve Pose"

    def steps(self, context, settings) -> Steps:
        """Resolve, write the bones, and check what Blender makes of it."""
        rigged = Rigged.of(context)
        rigged.ensure_writable()
        locked = set(rigged.locked())
        is_keyed = context.scene.tool_settings.use_keyframe_insert_auto
        if is_keyed and not rigged.is_driven:
            check_keyable(rigged)
            locked |= unkeyable_bones(rigged).keys()
        character = yield from open_character(rigged, settings)
        engine, clearance = character.engine, character.clearance(rigged)
        asked = {
            "transforms": rigged.transforms(),
            "vertices": rigged.shown(),
            "locked": sorted(locked),
            "clearance": clearance,
        }
        request = character.check(rigged, clearance)
        first = yield from waited(engine, request, "Checking the pose")
        if not first["colliding"]:
            live.show(rigged, first)
            return f"{settings.verdict}: nothing was changed"
        original, basis = rigged, None

        def take_back() -> None:
            if rigged is not original:
                rigged.remove_copy()
            elif basis is not None:
                rigged.restore(basis)

        try:
            for beyond in BEYOND:
                progress: list[int] = []
                request = character.send(
                    "resolve_pose",
                    lambda *told, into=progress: into.extend(told),
                    beyond=beyond,
                    **asked,
                )
                reply = yield from waited(engine, request, "Resolving the pose, step", progress)
                if basis is None:
                    # Nothing is written before the engine has answered.
                    if not np.array_equal(rigged.transforms(), asked["transforms"]):
                        raise SceneError("The pose has changed meanwhile; nothing was written")
                    if rigged.is_driven:
                        rigged = rigged.baked_copy()
                    basis = rigged.basis()
                joints, turns = rigged.in_bones(
                    asked["transforms"], array(reply["joints"]).tolist(), array(reply["turns"])
                )
                rigged.restore(basis)
                rigged.turn(joints, [basis[at] for at in joints], turns)
                context.view_layer.update()
                request = character.check(rigged, clearance)
                after = yield from waited(engine, request, "Checking the result")
                if not after["colliding"] or not reply["free"]:
                    break
        except BaseException:
            take_back()
            raise
        if is_worse(after, first):
            take_back()
            context.view_layer.update()
            live.show(original, first)
            return Caution(f"{settings.verdict}: no better pose was found, nothing was changed")
        live.show(rigged, after)
        if is_keyed:
            for bone, path in rigged.turned_paths(joints, turns):
                bone.keyframe_insert(path, group=bone.name)
        if after["colliding"]:
            what = "nearer than that" if settings.clearance else "colliding"
            settings.verdict = f"Still {what}: {after['pairs']} pairs of faces"
            return Caution(f"{settings.verdict}; {reply['note']}".rstrip("; "))
        change = 100.0 * reply["largest_change"]
        return f"Resolved {first['pairs']} pairs, checked; moved by {change:.1f} % at most"


class LCOLLISION_OT_ignore_pair(bpy.types.Operator):
    """Do not count pairs of faces of these two groups"""

    bl_idname = "lcollision.ignore_pair"
    bl_label = "Ignore These Pairs"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set:
        """Add the pair."""
        settings = context.scene.lcollision
        if not settings.first or not settings.second:
            self.report({"ERROR"}, "Choose two groups; Check Pose lists them")
            return {"CANCELLED"}
        pair = settings.ignored.add()
        pair.first, pair.second = settings.first, settings.second
        return {"FINISHED"}


class LCOLLISION_OT_count_pair(bpy.types.Operator):
    """Count these pairs of faces again"""

    bl_idname = "lcollision.count_pair"
    bl_label = "Count Again"
    bl_options = {"REGISTER", "UNDO"}

    number: bpy.props.IntProperty()

    def execute(self, context: bpy.types.Context) -> set:
        """Remove the pair."""
        context.scene.lcollision.ignored.remove(self.number)
        return {"FINISHED"}


_CLASSES = (
    LCOLLISION_OT_check_pose,
    LCOLLISION_OT_resolve_pose,
    LCOLLISION_OT_ignore_pair,
    LCOLLISION_OT_count_pair,
)


def register() -> None:
    """Add the operators."""
    for one in _CLASSES:
        bpy.utils.register_class(one)


def unregister() -> None:
    """Take them away."""
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
