# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel's buttons do."""

from collections.abc import Generator

import bpy
import numpy as np

from . import found
from .found import Shown
from .keys import check_keyable, unkeyable_bones
from .link import Opened, Steps, opening, waited
from .scene import Caution, Rigged, SceneError
from .steps import Stepped

BEYOND = (0.0, 0.01, 0.03, 0.1)
"""Shares of a correction by which it goes on, where rounding in Blender's bones still collides."""

_LEVELS = ((0.0, 0.0), (0.03, 1.0), (0.1, 2.0))
"""By what shares of a correction a pose goes on beyond it, and by how many of the depths that are
left parts are kept apart, each where the one before brings Blender's meshes no nearer to free."""

_MOST_STEPS, _MOST_NAMED = 10, 3

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
    found.clear()
    character = yield from opening(rigged, settings.chosen_rules(rigged), poses)
    settings.of, settings.left_out = rigged.armature.name, rigged.left_out_lines()
    settings.rules = character.answer["in_words"]
    settings.groups.clear()
    for name in _group_names(character.answer["groups"]):
        settings.groups.add().name = name
    return character


def _group_names(by_kind: dict[str, list[str]]) -> list[str]:
    """List the groups of all kinds, without those that another kind has but for capitals."""
    names: dict[str, None] = {}
    for kind in by_kind.values():
        known = {name.casefold() for name in names}
        names |= {name: None for name in kind if name.casefold() not in known}
    return list(names)


def turning(rigged: Rigged, settings: bpy.types.PropertyGroup) -> list[str] | None:
    """Return the bones that alone may turn, None for all.

    Raises
    ------
    SceneError : none of them deforms.
    """
    if not settings.only_selected:
        return None
    bones = rigged.armature.pose.bones
    chosen = [name for name in rigged.bones if _is_selected(bones[name])]
    if not chosen:
        raise SceneError("No deforming bone is selected: select some in Pose Mode")
    return chosen


def _is_selected(bone: bpy.types.PoseBone) -> bool:
    # Of the pose since Blender 5.0.
    return bone.select if hasattr(bone, "select") else bone.bone.select


def counted(n: int, noun: str) -> str:
    """Return a number with its noun, as in "1 pair" and "2 pairs"."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


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
        shown = Shown.of(rigged)
        request = character.check(rigged, character.clearance(rigged), shown)
        reply = yield from waited(character.engine, request, "Checking the pose")
        found.show(rigged, reply, shown)
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
        shown = Shown.of(rigged)
        asked = {
            "transforms": shown.transforms,
            "vertices": shown.vertices,
            "keep_feet": settings.keep_feet,
            "locked": sorted(locked),
            "turning": turning(rigged, settings),
        }
        request = character.check(rigged, clearance, shown)
        first = yield from waited(engine, request, "Checking the pose")
        if not first["colliding"]:
            found.show(rigged, first, shown)
            return f"{settings.verdict}: nothing was changed"
        original, basis, points = rigged, None, asked["vertices"]
        # What is kept, and where the next step begins.
        best, start, begun, paths = first, asked, None, {}

        def take_back() -> None:
            if rigged is not original:
                rigged.remove_copy()
            elif basis is not None:
                rigged.restore(basis)

        try:
            level = 0
            for _ in range(_MOST_STEPS):
                progress: list[int] = []
                beyond, margin = _LEVELS[level]
                request = character.send(
                    "resolve_pose",
                    lambda *told, into=progress: into.extend(told),
                    beyond=beyond,
                    clearance=clearance + margin * best["deepest"],
                    **start,
                )
                reply = yield from waited(engine, request, "Resolving the pose, step", progress)
                if basis is None:
                    # Nothing is written before the engine has answered.
                    if not np.array_equal(rigged.transforms(), asked["transforms"]):
                        raise SceneError("The pose has changed meanwhile; nothing was written")
                    if rigged.is_driven:
                        rigged = rigged.baked_copy()
                    basis = begun = kept = rigged.basis()
                joints, turns = rigged.in_bones(
                    start["transforms"], array(reply["joints"]).tolist(), array(reply["turns"])
                )
                rigged.restore(begun)
                rigged.turn(joints, [begun[at] for at in joints], turns)
                context.view_layer.update()
                shown = Shown.of(rigged)
                request = character.check(rigged, clearance, shown)
                after = yield from waited(engine, request, "Checking the result")
                if is_worse(after, first) or _cost(after) >= _cost(best):
                    level += 1
                    if level == len(_LEVELS):
                        break
                    start, begun = asked, basis
                    continue
                paths |= dict.fromkeys(rigged.turned_paths(joints, turns))
                best, kept, level = after, rigged.basis(), 0
                if not after["colliding"]:
                    break
                # Modifiers and scales move otherwise than the engine says: go on from there.
                now = {"transforms": shown.transforms, "vertices": shown.vertices}
                start, begun = asked | now, kept
        except BaseException:
            take_back()
            raise
        if best is first:
            take_back()
            context.view_layer.update()
            found.show(original, first, Shown.of(original))
            told = f"{settings.verdict}: no better pose was found, nothing was changed"
            return Caution(f"{told}; {reply['note']}".rstrip("; "))
        rigged.restore(kept)
        context.view_layer.update()
        shown = Shown.of(rigged)
        found.show(rigged, best, shown)
        if is_keyed:
            for bone, path in paths:
                bone.keyframe_insert(path, group=bone.name)
        if best["colliding"]:
            what = "nearer than that" if settings.clearance else "colliding"
            settings.verdict = f"Still {what}: {counted(best['pairs'], 'pair')} of faces"
            return Caution(f"{settings.verdict}; {_rest(rigged, reply)}".rstrip("; "))
        moved = np.linalg.norm(shown.vertices - points, axis=1).max()
        change = 100.0 * moved / character.answer["body_size"]
        return (
            f"Resolved {counted(first['pairs'], 'pair')}, checked; moved by {change:.1f} % at most"
        )


def _cost(check: dict) -> tuple:
    """Return what is less of the better of two checks."""
    return check["pairs"], check["deepest"]


def _rest(rigged: Rigged, reply: dict) -> str:
    """Say why a pose still collides: what moves the meshes besides the turns of bones."""
    others = rigged.moved_besides()
    if not others:
        return reply["note"]
    further = f" and {len(others) - _MOST_NAMED} more" if len(others) > _MOST_NAMED else ""
    return f"the rest is moved by {', '.join(others[:_MOST_NAMED])}{further}"


_CLASSES = (LCOLLISION_OT_check_pose, LCOLLISION_OT_resolve_pose)


def register() -> None:
    """Add the operators."""
    for one in _CLASSES:
        bpy.utils.register_class(one)


def unregister() -> None:
    """Take them away."""
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
