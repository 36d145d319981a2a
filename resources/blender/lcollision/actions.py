# SPDX-License-Identifier: GPL-3.0-or-later
"""Actions: which frames collide, and copies of them with new keys where that is resolved."""

import re
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import bpy
import numpy as np
from mathutils import Matrix

from .found import MARKER, clear, clear_frames
from .keys import curves_of, rekey, unkeyable_bones
from .link import Opened, Steps, waited
from .operators import BEYOND, array, is_worse, open_character, turning
from .scene import OFF_RIG, Basis, Caution, Rigged, SceneError
from .steps import Stepped

TOLERANCE = 5e-4
"""By how much linear keys may be off, and a bone that stays: radians (0.03 degrees), for locations
lengths of the longest bone. Where that collides, all that turns is keyed in every frame."""

_SAME = 1e-6
"""What has turned by no more there stays too, as it is rounding."""

_ROUGHER, _JUMP = 3.0, 0.1
"""A span in which a bone's velocity changes more than it did, by this factor, and by more than this
share of the skeleton's size from a frame to the next, is worse than it was."""

_FREE = ".free"
_IN_FLIGHT = 4
_BESIDE = 2
"""Frames on each side of a range by which it is known how the motion goes on."""
_POSES_A_SECOND, _MOST_POSES = 10, 300


@dataclass
class Frames:
    """What is shown frame by frame.

    Attributes
    ----------
    numbers : of the frames
    within : places, from 0, of those that count and may change; the others are beside them
    transforms : of each (J, 4, 4) of the bones
    vertices : of each (W, 3)
    basis : of each, the deforming bones' own turns
    matrices : of each, all bones' transforms by name, where they are to be baked
    found : the engine's checks
    """

    numbers: list[int]
    within: range
    transforms: list[np.ndarray] = field(default_factory=list)
    vertices: list[np.ndarray] = field(default_factory=list)
    basis: list[list[Basis]] = field(default_factory=list)
    matrices: list[dict[str, Matrix]] = field(default_factory=list)
    found: list[dict] = field(default_factory=list)

    @property
    def colliding(self) -> list[int]:
        """The places, from 0, of frames that collide."""
        return [at for at in self.within if self.found[at]["colliding"]]

    @property
    def not_counted(self) -> str:
        """Say what the contact rules leave out of the frames; empty where that is nothing."""
        replies = [self.found[at] for at in self.within if self.found[at]["not_counted"]]
        if not replies:
            return ""
        n_pairs = sum(sum(reply["excluded_pairs"].values()) for reply in replies)
        deepest = 100.0 * max(reply["excluded_deepest"] for reply in replies)
        return (
            f"Not counted: {n_pairs} pair{'s' if n_pairs != 1 else ''} in {len(replies)} "
            f"frame{'s' if len(replies) != 1 else ''}, up to {deepest:.2f} % deep"
        )

    def in_words(self) -> str:
        """Name the frames that collide."""
        runs: list[list[int]] = []
        for number in (self.numbers[at] for at in self.colliding):
            if runs and number == runs[-1][-1] + 1:
                runs[-1][1:] = [number]
            else:
                runs.append([number])
        named = ", ".join("-".join(map(str, run)) for run in runs)
        return f"frame{'s' if len(self.colliding) != 1 else ''} {named}"


def action_of(rigged: Rigged) -> bpy.types.Action | None:
    """Return the armature's action."""
    data = rigged.armature.animation_data
    return None if data is None else data.action


def frame_range(rigged: Rigged, scene: bpy.types.Scene) -> list[int]:
    """Return the frames that the panel says, else those of `whole_range`.

    Raises
    ------
    SceneError : the last comes before the first.
    """
    settings = scene.lcollision
    if not settings.use_range:
        return whole_range(rigged, scene)
    if settings.last_frame < settings.first_frame:
        raise SceneError("The frame range ends before it starts")
    return list(range(settings.first_frame, settings.last_frame + 1))


def whole_range(rigged: Rigged, scene: bpy.types.Scene) -> list[int]:
    """Return the frames of the armature's action, of the scene where it has none."""
    first, last, action = scene.frame_start, scene.frame_end, action_of(rigged)
    if action is not None:
        first, last = (round(one) for one in action.frame_range)
    return list(range(first, last + 1))


def with_neighbours(numbers: list[int], whole: list[int]) -> tuple[list[int], range]:
    """Return frames with those of the whole motion beside them, and the places of the former.

    A correction fades towards these, which stay as they are.
    """
    first = max(numbers[0] - _BESIDE, min(whole[0], numbers[0]))
    last = min(numbers[-1] + _BESIDE, max(whole[-1], numbers[-1]))
    start = numbers[0] - first
    return list(range(first, last + 1)), range(start, start + len(numbers))


def read_frames(
    context: bpy.types.Context,
    rigged: Rigged,
    character: Opened,
    clearance: float,
    numbers: list[int],
    keep: bool,
    within: range | None = None,
) -> Iterator[str]:
    """Go through frames step by step, check each as it is shown, and return `Frames`.

    Parameters
    ----------
    keep : whether vertices and the bones' own turns are kept
    """
    frames = Frames(numbers, within or range(len(numbers)))
    waiting, scene = deque(), context.scene
    before = scene.frame_current
    try:
        for number in numbers:
            yield f"Checking frame {number} of {numbers[-1]}"
            scene.frame_set(number)
            frames.transforms.append(rigged.transforms())
            if keep:
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
    clear_frames(scene)
    for at in frames.colliding:
        found = frames.found[at]
        markers.new(MARKER, frame=frames.numbers[at])
        item = settings.frames.add()
        item.frame, item.pairs = frames.numbers[at], found["pairs"]
        item.deepest = found["deepest"]
        item.parts = " and ".join(dict.fromkeys(found["parts"][0]))


def verdict(frames: Frames, settings: bpy.types.PropertyGroup) -> str:
    """Say how many frames collide."""
    n, bad = len(frames.within), len(frames.colliding)
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
        clear()
        settings.verdict, settings.details = verdict(frames, settings), frames.not_counted
        return ". ".join(filter(None, (settings.verdict, settings.details)))


class LCOLLISION_OT_resolve_action(Stepped, bpy.types.Operator):
    """Copy the action and key the copy where the character runs into itself, as smooth as it was"""

    bl_idname = "lcollision.resolve_action"
    bl_label = "Resolve Action"

    def steps(self, context, settings) -> Steps:
        """Read, resolve, write a copy of the action, and check what Blender makes of it."""
        rigged, scene = Rigged.of(context), context.scene
        rigged.ensure_writable()
        if action_of(rigged) is None and not rigged.is_driven:
            raise SceneError(f"{rigged.armature.name} has no action; make one active")
        numbers, unkeyable = frame_range(rigged, scene), {}
        every, within = with_neighbours(numbers, whole_range(rigged, scene))
        if not rigged.is_driven:
            check_action(rigged)
            unkeyable = unkeyable_bones(rigged, every)
        character = yield from open_character(rigged, settings)
        clearance = character.clearance(rigged)
        frames = yield from read_frames(context, rigged, character, clearance, every, True, within)
        fps = scene.render.fps / scene.render.fps_base
        yield "Opening the character with its motion"
        step = max(1, round(fps / _POSES_A_SECOND), -(-len(every) // _MOST_POSES))
        character = yield from open_character(rigged, settings, np.array(frames.transforms[::step]))
        asked = {
            "transforms": np.array(frames.transforms),
            "times": np.array(every) / fps,
            "within": [within.start, within.stop],
            "keep_feet": settings.keep_feet,
            "locked": sorted({*rigged.locked(), *unkeyable}),
            "turning": turning(rigged, settings),
            "clearance": clearance,
        }
        if max(one["off_rig"] for one in frames.found) > OFF_RIG:
            asked["vertices"] = np.array(frames.vertices)
        written: Written | None = None
        # Of each span the best that was found, and what Blender shows of it.
        best: dict[range, Attempt] = {}
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
                spans = _spans(reply)
                if not spans:
                    break
                if written is None:
                    written = Written(rigged, frames)
                for tolerance in (TOLERANCE, 0.0):
                    tried = {
                        one: Turned(
                            rigged, frames.transforms[one.start : one.stop], reply, rows, tolerance
                        )
                        for one, rows in spans.items()
                        if one not in best or best[one].colliding
                    }
                    turned = {one: each.turned for one, each in best.items()} | tried
                    again = yield from written.shown(context, character, clearance, turned)
                    for one, each in tried.items():
                        attempt = Attempt.of(each, frames, again, one, rigged.lengths())
                        if one not in best or attempt.cost < best[one].cost:
                            best[one] = attempt
                # Frames that the engine has not freed, no further step of these frees.
                known = set(reply["colliding_frames"])
                if all(known.issuperset(one.colliding) for one in best.values()):
                    break
            kept = {
                one: each.turned
                for one, each in best.items()
                if not each.is_worse and each.turned.is_any
            }
            if kept:
                again = yield from written.shown(context, character, clearance, kept)
        except BaseException:
            if written is not None:
                written.take_back()
            raise
        if not kept:
            if written is not None:
                written.take_back()
            list_frames(scene, frames)
            clear()
            settings.verdict, settings.details = verdict(frames, settings), frames.not_counted
            if not frames.colliding:
                return f"{settings.verdict}: nothing was changed"
            return Caution(
                f"{frames.in_words()} could not be freed, nothing was changed{_why(unkeyable)}"
            )
        list_frames(scene, again)
        clear()
        settings.of = written.rigged.armature.name
        settings.verdict, settings.details = verdict(again, settings), again.not_counted
        written.finish()
        told = _told(written, frames, again, reply["report"]["acceleration_ratio"])
        if again.not_counted:
            told += f". {again.not_counted}"
        return Caution(f"{told}{_why(unkeyable)}") if again.colliding else told


def _told(written: "Written", frames: Frames, again: Frames, acceleration: float) -> str:
    """Say what has become of an action."""
    left = len(again.colliding)
    told = (
        f"{written.action.name}: {len(frames.colliding)} of {len(frames.within)} frames collided, "
        f"{left or 'none'} {'do' if left > 1 else 'does'} now; "
    )
    if left:
        told += f"{again.in_words()} could not be freed; "
    if written.old is not None:
        told += f"{written.old.name} is kept; "
    return f"{told}acceleration ratio {acceleration:.2f}"


def _why(unkeyable: dict[str, str]) -> str:
    """Say which bones did not turn, and why."""
    return "".join(f"; {name} stays ({why})" for name, why in unkeyable.items())


def _spans(reply: dict) -> dict[range, slice]:
    """Return the places of frames that the engine may have changed, and where its turns are.

    Spans that touch are one: there is no frame between them that stays.
    """
    found: list[range] = []
    for start, stop in reply["spans"]:
        if found and found[-1].stop == start:
            found[-1] = range(found[-1].start, stop)
        else:
            found.append(range(start, stop))
    ends = np.cumsum([len(one) for one in found]).tolist()
    return {one: slice(end - len(one), end) for one, end in zip(found, ends, strict=True)}


class Turned:
    """What turns in a span of frames.

    Parameters
    ----------
    rigged : whose bones these are
    transforms : of each frame (J, 4, 4) of the bones as they were
    reply : the engine's
    rows : of the reply, which the span has
    tolerance : as `TOLERANCE`

    Attributes
    ----------
    joints, turns : numbers of n bones, and of each frame their (n, 4, 4) turns
    tolerance : as given
    """

    def __init__(
        self,
        rigged: Rigged,
        transforms: list[np.ndarray],
        reply: dict,
        rows: slice,
        tolerance: float,
    ) -> None:
        self.joints, self.turns = rigged.frames_in_bones(
            transforms, array(reply["joints"]).tolist(), array(reply["turns"])[rows]
        )
        self.tolerance = tolerance

    @property
    def is_any(self) -> bool:
        """Whether anything turns."""
        return bool((self.turns != np.eye(4)).any())


@dataclass(frozen=True)
class Attempt:
    """A span as Blender shows it with what turns there.

    Attributes
    ----------
    turned : that
    colliding : places of frames that collide
    is_worse : whether a frame has more pairs than it had, or deeper ones, or bones jump
    pairs : of all frames
    """

    turned: Turned
    colliding: list[int]
    is_worse: bool
    pairs: int

    @classmethod
    def of(
        cls, turned: Turned, before: Frames, after: Frames, span: range, lengths: np.ndarray
    ) -> "Attempt":
        """Compare what is shown in a span now with what was."""
        around = slice(max(span.start - 2, 0), span.stop + 2)
        jumps = [_jump(np.array(one.transforms[around]), lengths) for one in (before, after)]
        found = after.found
        return cls(
            turned,
            [at for at in span if found[at]["colliding"]],
            jumps[1] > max(_ROUGHER * jumps[0], _JUMP)
            or any(is_worse(found[at], before.found[at]) for at in span),
            sum(found[at]["pairs"] for at in span),
        )

    @property
    def cost(self) -> tuple:
        """What is less of the better of two."""
        return self.is_worse, len(self.colliding), self.pairs


def _jump(transforms: np.ndarray, lengths: np.ndarray) -> float:
    """Return the largest change of velocity of a bone's ends, in sizes of the skeleton.

    Parameters
    ----------
    transforms : (T, J, 4, 4) of the bones
    lengths : (J,) of these
    """
    heads = transforms[..., :3, 3]
    ends = [heads + lengths[:, None] * transforms[..., :3, axis] for axis in range(2)]
    points = np.concatenate([heads, *ends], axis=1)
    if len(points) < 3:
        return 0.0
    size = np.linalg.norm(np.ptp(points[0], axis=0))
    return float(np.linalg.norm(np.diff(points, 2, axis=0), axis=-1).max() / max(size, 1e-30))


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
    old : the user's, which stays
    """

    def __init__(self, rigged: Rigged, frames: Frames) -> None:
        self.old = action_of(rigged)
        self.rigged, self._frames = rigged, frames
        self._original, self._pose, self._basis = rigged, rigged.basis(), frames.basis
        self._shown = frames
        self._turned: dict[range, Turned] | None = None
        self._name = _free_name((self.old or rigged.armature).name)
        if rigged.is_driven:
            self._bake()
        data = self.rigged.armature.animation_data
        slot = getattr(data, "action_slot", None)
        self._slot = None if slot is None else slot.identifier
        self._source, self.action = data.action, None

    def _assign(self, action: bpy.types.Action) -> None:
        """Give the armature an action, by the slot that it had of the old one."""
        data = self.rigged.armature.animation_data
        data.action = action
        if self._slot is not None:
            data.action_slot = next(one for one in action.slots if one.identifier == self._slot)

    def take_back(self) -> None:
        """Leave everything as it was before."""
        if self.rigged is self._original:
            self._assign(self._source)
            self.rigged.restore(self._pose)
        else:
            self.rigged.remove_copy()
            bpy.data.actions.remove(self._source)
        if self.action is not None:
            bpy.data.actions.remove(self.action)
        scene = bpy.context.scene
        scene.frame_set(scene.frame_current)

    def finish(self) -> None:
        """Keep the new action, and the old one in the file though nothing uses it."""
        if self.rigged is not self._original:
            bpy.data.actions.remove(self._source)
        elif self._source.library is None:
            self._source.use_fake_user = True
        self.action.name = self._name

    def _bake(self) -> None:
        """Key all bones of a copy in all frames as they are shown."""
        self.rigged = copy = self.rigged.baked_copy()
        action = bpy.data.actions.new(self._name)
        copy.armature.animation_data_create().action = action
        self._basis = []
        for number, matrices in zip(self._frames.numbers, self._frames.matrices, strict=True):
            copy.place(matrices)
            for bone in copy.armature.pose.bones:
                for path in ("location", copy.rotation_path(bone), "scale"):
                    bone.keyframe_insert(path, frame=number, group=bone.name)
            self._basis.append(copy.basis())
        self._pose = copy.basis()

    def shown(
        self,
        context: bpy.types.Context,
        character: Opened,
        clearance: float,
        turned: dict[range, Turned],
    ) -> Iterator[str]:
        """Write step by step what turns, and return all frames as Blender shows them.

        Parameters
        ----------
        turned : of each span that changes; spans in which it is what was written last are not
            checked again
        """
        if self._turned is None:
            places = list(range(len(self._shown.found)))
        else:
            known = self._turned
            spans = [one for one in {**known, **turned} if known.get(one) is not turned.get(one)]
            places = sorted(at for span in spans for at in span)
        if not places:
            return self._shown
        self._turn(turned)
        numbers = [self._frames.numbers[at] for at in places]
        again = yield from read_frames(context, self.rigged, character, clearance, numbers, False)
        found, transforms = list(self._shown.found), list(self._shown.transforms)
        for row, at in enumerate(places):
            found[at], transforms[at] = again.found[row], again.transforms[row]
        self._turned = dict(turned)
        self._shown = replace(self._shown, found=found, transforms=transforms)
        return self._shown

    def _turn(self, turned: dict[range, Turned]) -> None:
        """Write a new copy of the action in which bones turn in some spans."""
        self._renew()
        scale = self.rigged.longest_bone
        # Of each property of a bone its values as they were, as they are to be, and the spans.
        properties: dict[tuple[int, str], tuple[np.ndarray, np.ndarray, list]] = {}
        for span, one in sorted(turned.items(), key=lambda item: item[0].start):
            values: dict[tuple[int, str], list] = {}
            paths = self.rigged.turned_paths(one.joints, one.turns)
            numbers = {self.rigged.bones[joint]: joint for joint in one.joints}
            for at, turns in zip(span, one.turns, strict=True):
                before = [self._basis[at][joint] for joint in one.joints]
                self.rigged.turn(one.joints, before, turns)
                for bone, path in paths:
                    values.setdefault((numbers[bone.name], path), []).append(getattr(bone, path)[:])
            for (joint, path), rows in values.items():
                old = self._before(joint, path)
                new = np.array(rows, np.float32)
                unit = scale if path == "location" else 1.0
                least = max(_SAME, one.tolerance) * unit
                if np.abs(new - old[span.start : span.stop]).max() > least:
                    known = properties.setdefault((joint, path), (old, old.copy(), []))
                    known[1][span.start : span.stop] = new
                    known[2].append((span, one.tolerance * unit))
        self.rigged.restore(self._pose)
        for (joint, path), (old, new, spans) in properties.items():
            bone = self.rigged.armature.pose.bones[self.rigged.bones[joint]]
            curves, is_new = self._curves(bone, path, old.shape[1])
            rekey(curves, is_new, self._frames.numbers, old, new, spans)
        self.action.update_tag()

    def _renew(self) -> None:
        """Copy the action as it was."""
        past = self.action
        self.action = self._source.copy()
        self._assign(self.action)
        if past is not None:
            bpy.data.actions.remove(past)
        self.action.name = self._name

    def _before(self, joint: int, path: str) -> np.ndarray:
        """Return the (T, C) float32 values of a bone's property as they were."""
        if path == "location":
            return np.array([basis[joint][0].translation[:] for basis in self._basis], np.float32)
        return np.array([basis[joint][1] for basis in self._basis], np.float32)

    def _curves(
        self, bone: bpy.types.PoseBone, path: str, n: int
    ) -> tuple[list[bpy.types.FCurve], list[bool]]:
        """Return the curves of a bone's property, and which of them were made for this."""
        item, own = self.rigged.armature, bone.path_from_id(path)

        def existing() -> dict[int, bpy.types.FCurve]:
            curves = curves_of(self.action, item)
            return {one.array_index: one for one in curves if one.data_path == own}

        missing = [at for at in range(n) if at not in existing()]
        for at in missing:
            bone.keyframe_insert(path, index=at, frame=self._frames.numbers[0], group=bone.name)
        found = existing()
        if len(found) != n:
            raise SceneError(f"{bone.name}: Blender gives its {path} no keys in {self.action.name}")
        return [found[at] for at in range(n)], [at in missing for at in range(n)]


def check_action(rigged: Rigged) -> None:
    """Refuse an action whose keys are not what is shown, before anything is computed.

    Raises
    ------
    SceneError : it is edited or blended in the NLA.
    """
    name, data = rigged.armature.name, rigged.armature.animation_data
    if data.use_tweak_mode:
        raise SceneError(
            f"{name} is in the NLA's tweak mode, in which no other action can be given to it; "
            "leave it (Tab in the NLA editor), and make the action active"
        )
    blend, influence = data.action_blend_type, data.action_influence
    if data.use_nla and len(data.nla_tracks) and (blend, influence) != ("REPLACE", 1.0):
        raise SceneError(
            f"{name} shows a blend of its action with NLA strips ({blend.capitalize()}, influence "
            f"{influence:.2f}); set Replace and 1 in the NLA editor, or bake the action first"
        )


def _free_name(name: str) -> str:
    """Return the name of a copy; that of a copy of a copy is no longer."""
    return re.sub(rf"({re.escape(_FREE)}(\.\d+)?)*$", "", name) + _FREE


_CLASSES = (LCOLLISION_OT_check_action, LCOLLISION_OT_resolve_action)


def register() -> None:
    """Add the operators."""
    for one in _CLASSES:
        bpy.utils.register_class(one)


def unregister() -> None:
    """Take them away."""
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
