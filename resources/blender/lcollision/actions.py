# SPDX-License-Identifier: GPL-3.0-or-later
"""Actions: which frames collide, and copies of them with new keys where that is resolved."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import bpy
import numpy as np
from mathutils import Matrix

from .link import Opened, Steps, waited
from .operators import BEYOND, array, open_character
from .scene import OFF_RIG, Basis, Rigged, SceneError
from .steps import Stepped

_MARKER = "collides"
_IN_FLIGHT = 4
_POSES_A_SECOND, _MOST_POSES = 10, 300


@dataclass
class Frames:
    """What is shown frame by frame.

    Attributes
    ----------
    numbers : of the frames
    transforms : of each (J, 4, 4) of the bones
    vertices : of each (W, 3)
    basis : of each, the deforming bones' own turns
    matrices : of each, all bones' transforms by name, where they are to be baked
    found : the engine's checks
    """

    numbers: list[int]
    transforms: list[np.ndarray] = field(default_factory=list)
    vertices: list[np.ndarray] = field(default_factory=list)
    basis: list[list[Basis]] = field(default_factory=list)
    matrices: list[dict[str, Matrix]] = field(default_factory=list)
    found: list[dict] = field(default_factory=list)

    @property
    def colliding(self) -> list[int]:
        """The places, from 0, of frames that collide."""
        return [at for at, one in enumerate(self.found) if one["colliding"]]


def action_of(rigged: Rigged) -> bpy.types.Action | None:
    """Return the armature's action."""
    data = rigged.armature.animation_data
    return None if data is None else data.action


def frame_range(rigged: Rigged, scene: bpy.types.Scene) -> list[int]:
    """Return the frames of the armature's action, of the scene where it has none."""
    first, last, action = scene.frame_start, scene.frame_end, action_of(rigged)
    if action is not None:
        first, last = (round(one) for one in action.frame_range)
    return list(range(first, last + 1))


def read_frames(
    context: bpy.types.Context,
    rigged: Rigged,
    character: Opened,
    clearance: float,
    numbers: list[int],
    keep: bool,
) -> Iterator[str]:
    """Go through frames step by step, check each as it is shown, and return `Frames`.

    Parameters
    ----------
    keep : whether bones and vertices are kept
    """
    frames, waiting, scene = Frames(numbers), deque(), context.scene
    before = scene.frame_current
    try:
        for number in numbers:
            yield f"Checking frame {number} of {numbers[-1]}"
            scene.frame_set(number)
            if keep:
                frames.transforms.append(rigged.transforms())
                frames.vertices.append(rigged.shown().astype(np.float32))
                frames.basis.append(rigged.basis())
                if rigged.is_driven:
                    frames.matrices.append(rigged.matrices())
            waiting.append(character.check(rigged, clearance))
            if len(waiting) > _IN_FLIGHT:
                reply = yield from waited(character.engine, waiting.popleft(), "Checking")
                frames.found.append(reply)
        for request in waiting:
            reply = yield from waited(character.engine, request, "Checking")
            frames.found.append(reply)
    finally:
        scene.frame_set(before)
    return frames


def list_frames(scene: bpy.types.Scene, frames: Frames) -> None:
    """Put markers on the timeline, and the frames that collide into the panel's list."""
    markers, settings = scene.timeline_markers, scene.lcollision
    for marker in [one for one in markers if one.name == _MARKER]:
        markers.remove(marker)
    settings.frames.clear()
    for at in frames.colliding:
        found = frames.found[at]
        markers.new(_MARKER, frame=frames.numbers[at])
        item = settings.frames.add()
        item.frame, item.pairs = frames.numbers[at], found["pairs"]
        item.deepest = found["deepest"]
        item.parts = " and ".join(dict.fromkeys(found["parts"][0]))


def verdict(frames: Frames, settings: bpy.types.PropertyGroup) -> str:
    """Say how many frames collide."""
    n, bad = len(frames.numbers), len(frames.colliding)
    if not bad:
        return f"{settings.kept()} in {n} frames ({settings.checked()})"
    verb, rest = ("come", " too near") if settings.clearance else ("collide", "")
    return f"{bad} of {n} frames {verb}{'s' if bad == 1 else ''}{rest}"


class LCOLLISION_OT_check_action(Stepped, bpy.types.Operator):
    """Find the frames of the action in which the character runs into itself"""

    bl_idname = "lcollision.check_action"
    bl_label = "Check Action"

    def steps(self, context, settings) -> Steps:
        """Check frame by frame, and list what was found."""
        rigged = Rigged.of(context)
        character = yield from open_character(rigged, settings)
        numbers, clearance = frame_range(rigged, context.scene), character.clearance(rigged)
        frames = yield from read_frames(context, rigged, character, clearance, numbers, False)
        list_frames(context.scene, frames)
        settings.verdict, settings.details = verdict(frames, settings), ""
        return settings.verdict


class LCOLLISION_OT_resolve_action(Stepped, bpy.types.Operator):
    """Copy the action and key the copy where the character runs into itself, as smooth as it was"""

    bl_idname = "lcollision.resolve_action"
    bl_label = "Resolve Action"

    def steps(self, context, settings) -> Steps:
        """Read, resolve, write a copy of the action, and check what Blender makes of it."""
        rigged, scene = Rigged.of(context), context.scene
        if action_of(rigged) is None and not rigged.is_driven:
            raise SceneError(f"{rigged.armature.name} has no action; make one active")
        character = yield from open_character(rigged, settings)
        numbers, clearance = frame_range(rigged, scene), character.clearance(rigged)
        frames = yield from read_frames(context, rigged, character, clearance, numbers, True)
        fps = scene.render.fps / scene.render.fps_base
        yield "Opening the character with its motion"
        step = max(1, round(fps / _POSES_A_SECOND), -(-len(numbers) // _MOST_POSES))
        character = yield from open_character(rigged, settings, np.array(frames.transforms[::step]))
        asked = {
            "transforms": np.array(frames.transforms),
            "times": np.array(numbers) / fps,
            "keep_feet": settings.keep_feet,
            "locked": rigged.locked(),
            "clearance": clearance,
        }
        if max(one["off_rig"] for one in frames.found) > OFF_RIG:
            asked["vertices"] = np.array(frames.vertices)
        written: Written | None = None
        try:
            for beyond in BEYOND:
                progress: list[int] = []
                request = character.send(
                    "resolve_motion",
                    lambda *told, into=progress: into.extend(told),
                    beyond=beyond,
                    **asked,
                )
                reply = yield from waited(character.engine, request, "Resolving frames", progress)
                if not reply["spans"]:
                    list_frames(scene, frames)
                    settings.verdict = verdict(frames, settings)
                    return f"{settings.verdict}: nothing was changed"
                if written is None:
                    written = Written(rigged, frames)
                written.turn(reply)
                again = yield from read_frames(
                    context, written.rigged, character, clearance, numbers, False
                )
                if not again.colliding or reply["colliding_frames"]:
                    break
        except BaseException:
            if written is not None:
                written.take_back()
            raise
        list_frames(scene, again)
        settings.verdict, settings.details = verdict(again, settings), ""
        before = len(frames.colliding)
        report = reply["report"]
        return (
            f"{written.action.name}: {before} of {len(numbers)} frames collided, "
            f"{len(again.colliding) or 'none'} {'do' if again.colliding else 'does'} now; "
            f"acceleration ratio {report['acceleration_ratio']:.2f}"
        )


class Written:
    """A copy of an action, with other keys where bones are turned.

    Parameters
    ----------
    rigged : with the action; one that constraints or drivers move is copied and baked
    frames : as they are

    Attributes
    ----------
    rigged : what has the new action
    action : that
    """

    def __init__(self, rigged: Rigged, frames: Frames) -> None:
        self._old = old = action_of(rigged)
        self.rigged, self._frames = rigged, frames
        self._original, self._pose, self._basis = rigged, rigged.basis(), frames.basis
        if rigged.is_driven:
            self._bake(f"{(old or rigged.armature).name}.free")
            return
        data = rigged.armature.animation_data
        slot = getattr(data, "action_slot", None)
        self._slot = None if slot is None else slot.identifier
        self.action = old.copy()
        self.action.name = f"{old.name}.free"
        self._assign(self.action)

    def _assign(self, action: bpy.types.Action) -> None:
        """Give the armature an action, by the slot that it had of the old one."""
        data = self.rigged.armature.animation_data
        data.action = action
        if self._slot is not None:
            data.action_slot = next(one for one in action.slots if one.identifier == self._slot)

    def take_back(self) -> None:
        """Leave everything as it was before."""
        if self.rigged is self._original:
            self._assign(self._old)
            self.rigged.restore(self._pose)
        else:
            self.rigged.remove_copy()
        bpy.data.actions.remove(self.action)
        scene = bpy.context.scene
        scene.frame_set(scene.frame_current)

    def _bake(self, name: str) -> None:
        """Key all bones of a copy in all frames as they are shown."""
        self.rigged = copy = self.rigged.baked_copy()
        self.action = bpy.data.actions.new(name)
        copy.armature.animation_data_create().action = self.action
        self._basis = []
        for number, matrices in zip(self._frames.numbers, self._frames.matrices, strict=True):
            copy.place(matrices)
            for bone in copy.armature.pose.bones:
                for path in ("location", copy.rotation_path(bone), "scale"):
                    bone.keyframe_insert(path, frame=number, group=bone.name)
            self._basis.append(copy.basis())

    def turn(self, reply: dict) -> None:
        """Key the bones that turn, in the spans and, as they were, a frame on either side of each.

        Those go first: they cut the curves while these still have their shape.
        """
        inside = [at for start, stop in reply["spans"] for at in range(start, stop)]
        joints, turns = self.rigged.frames_in_bones(
            [self._frames.transforms[at] for at in inside],
            array(reply["joints"]).tolist(),
            array(reply["turns"]),
        )
        paths = self.rigged.turned_paths(joints, turns)
        numbers, still = self._frames.numbers, np.broadcast_to(np.eye(4), turns.shape[1:])
        beside = {at for start, stop in reply["spans"] for at in (start - 1, stop)}
        beside = sorted(beside.intersection(range(len(numbers))).difference(inside))
        self._keep_shapes(joints)
        for at, own in (*((at, still) for at in beside), *zip(inside, turns, strict=True)):
            self.rigged.turn(joints, [self._basis[at][joint] for joint in joints], own)
            for bone, path in paths:
                bone.keyframe_insert(path, frame=numbers[at], group=bone.name)
        keyed = {numbers[at] for at in inside} | {numbers[at] for at in beside if at + 1 in inside}
        for curve in self._curves(joints):
            for key in curve.keyframe_points:
                if key.co.x in keyed:
                    key.interpolation = "LINEAR"

    def _keep_shapes(self, joints: list[int]) -> None:
        """Let curves keep their shape outside of new keys, whose neighbours else move handles."""
        for curve in self._curves(joints):
            for key in curve.keyframe_points:
                key.handle_left_type = key.handle_right_type = "FREE"

    def _curves(self, joints: list[int]) -> list[bpy.types.FCurve]:
        bones = self.rigged.armature.pose.bones
        own = {
            bones[self.rigged.bones[joint]].path_from_id(name)
            for joint in joints
            for name in ("location", "rotation_quaternion", "rotation_euler", "rotation_axis_angle")
        }
        return [one for one in curves_of(self.action, self.rigged.armature) if one.data_path in own]


def curves_of(action: bpy.types.Action, item: bpy.types.Object) -> list[bpy.types.FCurve]:
    """Return the curves of an object's action, in any version of Blender."""
    slot = getattr(item.animation_data, "action_slot", None)
    if slot is None:
        return list(getattr(action, "fcurves", ()))
    # Where there are slots, an action's own curves, if it has any, are those of the first alone.
    strips = (strip for layer in action.layers for strip in layer.strips)
    bags = (strip.channelbag(slot) for strip in strips)
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]


_CLASSES = (LCOLLISION_OT_check_action, LCOLLISION_OT_resolve_action)


def register() -> None:
    """Add the operators."""
    for one in _CLASSES:
        bpy.utils.register_class(one)


def unregister() -> None:
    """Take them away."""
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
