# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators for poses, and helpers of all operators."""

from collections.abc import Generator

import bpy
import numpy as np

from . import results
from .keys import check_keyable, unkeyable_bones
from .link import OpenCharacter, Steps, open_steps, wait_for
from .results import Shown, array
from .scene import Caution, Rigged, SceneError
from .steps import ModalOperator

LEVELS = ((0.0, 0.0), (0.03, 1.0), (0.1, 2.0))
"""Pairs of the overshoot, as a share of the correction, and the extra clearance, in remaining
depths; the next pair is tried when one no longer improves Blender's meshes."""

LEAST_CHANGE = 5e-4
"""Bones whose turns together move no vertex by more than this, in body sizes, are not turned."""

MOST_STEPS, _MOST_NAMED = 10, 3

_ROUNDING = 1e-6
"""Difference of depths, in body sizes, that counts as rounding."""


def is_worse(after: dict, before: dict) -> bool:
    """Return whether a check finds more or deeper pairs than another."""
    return after["pairs"] > before["pairs"] or after["deepest"] > before["deepest"] + _ROUNDING


def open_character(
    rigged: Rigged, settings: bpy.types.PropertyGroup, poses: np.ndarray | None = None
) -> Generator[str, None, OpenCharacter]:
    """Open the present character, and list its groups in the panel."""
    results.clear()
    character = yield from open_steps(rigged, settings.chosen_rules(rigged), poses)
    settings.of, settings.left_out = rigged.armature.name, rigged.left_out_lines()
    settings.rules = character.answer["in_words"]
    settings.groups.clear()
    for name in _group_names(character.answer["groups"]):
        settings.groups.add().name = name
    return character


def _group_names(by_kind: dict[str, list[str]]) -> list[str]:
    """List the groups of all kinds, without names that differ from another kind's only by case."""
    names: dict[str, None] = {}
    for kind in by_kind.values():
        known = {name.casefold() for name in names}
        names |= {name: None for name in kind if name.casefold() not in known}
    return list(names)


def turning(rigged: Rigged, settings: bpy.types.PropertyGroup) -> list[str] | None:
    """Return the bones that may turn, None for all.

    Bones in a mirror's plane, bones without a control, if controls are used, and bones that are
    not selected, if the panel says so, may not.

    Raises
    ------
    SceneError : no deforming bone is selected.
    """
    bones, controls, mirrored = rigged.armature.pose.bones, rigged.controls, rigged.in_mirrors()
    chosen = [name for name in rigged.bones if name not in mirrored]
    if controls is not None:
        able = {rigged.bones[joint] for joint in controls.joints}
        chosen = [name for name in chosen if name in able]
    if not settings.only_selected:
        return chosen if controls is not None or mirrored else None
    number = {name: joint for joint, name in enumerate(rigged.bones)}
    chosen = [
        name
        for name in chosen
        if any(_is_selected(bones[one]) for one in (name, *rigged.writers(number[name])))
    ]
    if not chosen:
        raise SceneError("No deforming bone is selected: select some in Pose Mode")
    return chosen


def _is_selected(bone: bpy.types.PoseBone) -> bool:
    # An attribute of the pose bone since Blender 5.0.
    return bone.select if hasattr(bone, "select") else bone.bone.select


def counted(n: int, noun: str) -> str:
    """Return a number with its noun, as in "1 pair" and "2 pairs"."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


class LCOLLISION_OT_check_pose(ModalOperator, bpy.types.Operator):
    """Find self-collisions of the character as shown"""

    bl_idname = "lcollision.check_pose"
    bl_label = "Check Pose"
    # No UNDO: it changes nothing of the user's data.
    bl_options = {"REGISTER"}

    def steps(self, context, settings) -> Steps:
        """Check, and show the result."""
        rigged = Rigged.of(context)
        character = yield from open_character(rigged, settings)
        shown = Shown.of(rigged)
        request = character.check(rigged, character.clearance(rigged), shown)
        reply = yield from wait_for(character.engine, request, "Checking the pose")
        results.show(rigged, reply, shown)
        return settings.verdict


class LCOLLISION_OT_resolve_pose(ModalOperator, bpy.types.Operator):
    """Turn the bones to the nearest pose without self-collisions"""

    bl_idname = "lcollision.resolve_pose"
    bl_label = "Resolve Pose"

    def steps(self, context, settings) -> Steps:
        """Resolve, write the bones, and check the pose as Blender shows it."""
        rigged = Rigged.of(context)
        rigged.ensure_writable()
        is_keyed = context.scene.tool_settings.use_keyframe_insert_auto
        if is_keyed and not rigged.is_driven:
            check_keyable(rigged)
        character = yield from open_character(rigged, settings)
        shown = Shown.of(rigged)
        request = character.check(rigged, character.clearance(rigged), shown)
        first = yield from wait_for(character.engine, request, "Checking the pose")
        if not first["colliding"]:
            results.show(rigged, first, shown)
            return f"{settings.verdict}: nothing was changed"
        points, resolving = shown.vertices, None
        controls = rigged.by_controls() if rigged.is_driven else None
        for target in (rigged,) if controls is None else (controls, rigged):
            resolving = _Resolving(target, character, first, shown)
            try:
                is_done = yield from resolving.steps(context, settings, is_keyed)
            except BaseException:
                resolving.take_back()
                raise
            if is_done:
                break
            resolving.take_back()
            context.view_layer.update()
        best, reply, target = resolving.best, resolving.reply, resolving.rigged
        if not is_done:
            results.show(rigged, first, Shown.of(rigged))
            told = f"{settings.verdict}: no better pose was found, nothing was changed"
            return Caution(f"{told}; {reply['note']}".rstrip("; "))
        target.put(resolving.kept)
        context.view_layer.update()
        shown = Shown.of(target)
        results.show(target, best, shown)
        if is_keyed:
            for (name, path), value in resolving.kept.items():
                if value != resolving.basis[name, path]:
                    bone = target.armature.pose.bones[name]
                    bone.keyframe_insert(path, group=name)
        written = f"; {where(target, resolving.by_fk)}" if rigged.is_driven else ""
        if best["colliding"]:
            what = "nearer than that" if settings.clearance else "colliding"
            settings.verdict = f"Still {what}: {counted(best['pairs'], 'pair')} of faces"
            return Caution(f"{settings.verdict}; {_rest(target, reply)}".rstrip("; ") + written)
        moved = np.linalg.norm(shown.vertices - points, axis=1).max()
        change = 100.0 * moved / character.answer["body_size"]
        return (
            f"Resolved {counted(first['pairs'], 'pair')}, checked; moved by {change:.1f} % at most"
            f"{written}"
        )


class _Resolving:
    """A pose that is resolved step by step.

    Parameters
    ----------
    rigged : the character whose bones or controls are turned; baked first if it needs a copy
    first, shown : the check of the original pose, and that pose

    Attributes
    ----------
    rigged : the character that is turned
    basis, kept : its original properties, and the best ones found
    best : the check of `kept`
    reply : the engine's last
    by_fk : limbs that were switched to FK for it
    """

    def __init__(self, rigged: Rigged, character: OpenCharacter, first: dict, shown: Shown) -> None:
        self.rigged, self.best, self.reply = rigged, first, {"note": ""}
        self.basis = self.kept = None
        self.by_fk: set[str] = set()
        self._original, self._character = rigged, character
        self._first, self._shown = first, shown

    def take_back(self) -> None:
        """Restore everything as it was before."""
        if self.rigged is not self._original:
            self.rigged.remove_copy()
        elif self.basis is not None:
            self.rigged.put(self.basis)

    def steps(
        self, context: bpy.types.Context, settings: bpy.types.PropertyGroup, is_keyed: bool
    ) -> Generator[str, None, bool]:
        """Repeat from what Blender shows until free or no better; return if it has improved."""
        character, first = self._character, self._first
        clearance = character.clearance(self.rigged)
        locked = set(self.rigged.locked())
        if is_keyed and not self.rigged.is_copied:
            locked |= unkeyable_bones(self.rigged).keys()
        asked = {
            "transforms": self._shown.transforms,
            "vertices": self._shown.vertices,
            "keep_feet": settings.keep_feet,
            "locked": sorted(locked),
            "turning": turning(self.rigged, settings),
            "least_change": LEAST_CHANGE,
        }
        # The starting point of the next step.
        start, begun, level = asked, None, 0
        for _ in range(MOST_STEPS):
            progress: list[int] = []
            beyond, margin = LEVELS[level]
            request = character.send(
                "resolve_pose",
                lambda *told, into=progress: into.extend(told),
                beyond=beyond,
                clearance=clearance + margin * self.best["deepest"],
                **start,
            )
            self.reply = reply = yield from wait_for(
                character.engine, request, "Resolving the pose, step", progress
            )
            if self.basis is None:
                # Nothing is written before the engine has answered.
                if not np.array_equal(self.rigged.transforms(), asked["transforms"]):
                    raise SceneError("The pose has changed meanwhile; nothing was written")
                if self.rigged.is_copied:
                    self.rigged = self.rigged.baked_copy()
                self.basis = begun = self.kept = self.rigged.state()
            self.rigged.put(begun)
            by_fk = self.rigged.turn(
                start["transforms"], array(reply["joints"]).tolist(), array(reply["turns"])
            )
            context.view_layer.update()
            shown = Shown.of(self.rigged)
            request = character.check(self.rigged, clearance, shown)
            after = yield from wait_for(character.engine, request, "Checking the result")
            if is_worse(after, first) or _cost(after) >= _cost(self.best):
                level += 1
                if level == len(LEVELS):
                    break
                start, begun = asked, self.basis
                continue
            self.best, self.kept, level = after, self.rigged.state(), 0
            self.by_fk = by_fk if start is asked else self.by_fk | by_fk
            if not after["colliding"]:
                break
            # Modifiers and scales move the mesh differently from the engine: continue from there.
            now = {"transforms": shown.transforms, "vertices": shown.vertices}
            start, begun = asked | now, self.kept
        if self._original.controls is not None and self.best["colliding"] and reply["free"]:
            # If the controls cannot reproduce the engine's result, a baked copy may.
            return False
        return self.best is not first


def _cost(check: dict) -> tuple:
    """Return the cost of a check, as a tuple to compare."""
    return check["pairs"], check["deepest"]


def where(rigged: Rigged, by_fk: set[str]) -> str:
    """Return where the result for a rig with constraints or drivers was written."""
    if rigged.controls is None:
        return f"written to a baked copy, {rigged.armature.name}"
    limbs = ", ".join(name.replace("_parent", "") for name in sorted(by_fk))
    return "written to the controls" + (f"; posed by FK now: {limbs}" if limbs else "")


def _rest(rigged: Rigged, reply: dict) -> str:
    """Return why a pose still collides: influences on the meshes besides the bones' turns."""
    others = rigged.moved_besides()
    if not others:
        return reply["note"]
    further = f" and {len(others) - _MOST_NAMED} more" if len(others) > _MOST_NAMED else ""
    return f"the remaining collisions come from {', '.join(others[:_MOST_NAMED])}{further}"


_CLASSES = (LCOLLISION_OT_check_pose, LCOLLISION_OT_resolve_pose)

register, unregister = bpy.utils.register_classes_factory(_CLASSES)
