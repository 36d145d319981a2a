# SPDX-License-Identifier: GPL-3.0-or-later
"""Actions: the frames that collide, and resolved copies with new keys."""

import re
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial

import bpy
import numpy as np
from mathutils import Matrix

from .client import Request
from .controls import State, rotation_path, whole_path
from .keys import curves_of, rekey, unkeyable_bones
from .link import OpenCharacter, Steps, wait_for
from .operators import (
    LEAST_CHANGE,
    LEVELS,
    MOST_STEPS,
    is_worse,
    open_character,
    turning,
    where,
)
from .results import MARKER, Shown, array, clear, clear_frames
from .scene import OFF_RIG, Caution, Rigged, SceneError
from .steps import ModalOperator

TOLERANCE = 5e-4
"""Largest error of curves between keys, and of bones that are not keyed: radians (0.03 degrees), or
for locations lengths of the longest bone. If the result collides, a tenth of it is tried, then
zero, which keys every turned bone in every frame."""

_SAME = 1e-6
"""Smaller turns are rounding and are not keyed either."""

_ROUGHER, _JUMP = 3.0, 0.1
"""A span is worse than before if a bone's change of velocity between frames exceeds both `_ROUGHER`
times the former one and `_JUMP` times the skeleton's size."""

_UNSEEN_BEND, _NOMINAL_RATE = 1e-4, 30.0
"""Second difference at that rate, in sizes of the skeleton, that counts as standing still."""

_FREE = ".free"
_IN_FLIGHT = 8
_BESIDE = 2
"""Frames read on each side of a range, so that the motion's continuation is known."""
_POSES_A_SECOND, _MOST_POSES = 10, 300


@dataclass(frozen=True)
class Wanted:
    """The requirements that frames are checked for.

    Attributes
    ----------
    clearance : to be kept, in body sizes
    subframes : poses between two frames that are checked too, with the linear paths of the vertices
        from each to the next; None to check only frames
    last : the last frame to check
    """

    clearance: float
    subframes: int | None = None
    last: int = 0

    @property
    def asked(self) -> dict:
        """The fields of an engine request for poses between frames."""
        if self.subframes is None:
            return {}
        return {"substeps": self.subframes, "continuous": True}

    def shares_after(self, number: int) -> list[float]:
        """Return the fractions between a frame and the next at which poses are checked."""
        if self.subframes is None or number >= self.last:
            return []
        return [at / (self.subframes + 1) for at in range(1, self.subframes + 2)]


@dataclass
class Frames:
    """The frames of a motion as Blender shows them.

    Attributes
    ----------
    numbers : of the frames
    within : indices of the frames that count and may change; the others are neighbours
    transforms : for each frame (J, 4, 4) of the bones
    vertices : for each frame (W, 3)
    states : for each frame, the properties that are written
    matrices : for each frame, all bones' transforms by name, if they are to be baked
    found : for each frame, the engine's check
    """

    numbers: list[int]
    within: range
    transforms: list[np.ndarray] = field(default_factory=list)
    vertices: list[np.ndarray] = field(default_factory=list)
    states: list[State] = field(default_factory=list)
    matrices: list[dict[str, Matrix]] = field(default_factory=list)
    found: list[dict] = field(default_factory=list)

    @property
    def colliding(self) -> list[int]:
        """The indices of frames that collide."""
        return [at for at in self.within if self.found[at]["colliding"]]

    @property
    def not_counted(self) -> str:
        """A sentence on pairs that the contact rules leave out; empty if there are none."""
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
        """List the frames that collide, as runs."""
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
    """Return the frame range of the panel if it is used, else `whole_range`.

    Raises
    ------
    SceneError : the range ends before it starts.
    """
    settings = scene.lcollision
    if not settings.use_range:
        return whole_range(rigged, scene)
    if settings.last_frame < settings.first_frame:
        raise SceneError("The frame range ends before it starts")
    return list(range(settings.first_frame, settings.last_frame + 1))


def whole_range(rigged: Rigged, scene: bpy.types.Scene) -> list[int]:
    """Return the frames of the armature's action, or of the scene if it has none."""
    first, last, action = scene.frame_start, scene.frame_end, action_of(rigged)
    if action is not None:
        first, last = (round(one) for one in action.frame_range)
    return list(range(first, last + 1))


def with_neighbours(numbers: list[int], whole: list[int]) -> tuple[list[int], range]:
    """Return frames with their neighbours in the whole motion, and the indices of the former.

    A correction fades towards the neighbours, which do not change.
    """
    first = max(numbers[0] - _BESIDE, min(whole[0], numbers[0]))
    last = min(numbers[-1] + _BESIDE, max(whole[-1], numbers[-1]))
    start = numbers[0] - first
    return list(range(first, last + 1)), range(start, start + len(numbers))


def read_frames(
    context: bpy.types.Context,
    rigged: Rigged,
    character: OpenCharacter,
    wanted: Wanted,
    numbers: list[int],
    keep: bool = False,
    within: range | None = None,
    counted_only: bool = True,
) -> Generator[str, None, Frames]:
    """Go through frames step by step, check each as shown, and return `Frames`.

    A collision between a frame and the next counts for the former.

    Parameters
    ----------
    keep : whether to keep vertices
    counted_only : whether to leave out the pairs that do not count, which is faster
    """
    frames = Frames(numbers, within or range(len(numbers)))
    waiting, scene = deque(), context.scene
    before, ahead = scene.frame_current, None
    check = partial(character.check, rigged, wanted.clearance, counted_only=counted_only)
    try:
        for number in numbers:
            yield f"Checking frame {number} of {numbers[-1]}"
            if ahead != number:
                scene.frame_set(number)
                shown = Shown.of(rigged)
                own = check(shown)
            frames.transforms.append(shown.transforms)
            frames.states.append(rigged.state())
            if keep:
                frames.vertices.append(shown.vertices.astype(np.float32))
                if rigged.is_driven:
                    frames.matrices.append(rigged.matrices())
            requests = [own]
            for share in wanted.shares_after(number):
                ahead = number + 1 if share == 1.0 else None
                scene.frame_set(ahead or number, subframe=0.0 if ahead else share)
                start, shown = shown, Shown.of(rigged)
                own = check(shown, start)
                requests.append(own)
            waiting.append(requests)
            if len(waiting) > _IN_FLIGHT:
                frames.found.append((yield from _answers(character, waiting.popleft())))
        for requests in waiting:
            frames.found.append((yield from _answers(character, requests)))
    finally:
        scene.frame_set(before)
    return frames


def with_uncounted(
    context: bpy.types.Context, rigged: Rigged, character: OpenCharacter, frames: Frames
) -> Generator[str, None, Frames]:
    """Return frames as they are shown, with the pairs that do not count.

    Of these only those that penetrate are listed, so no clearance is needed, which is faster.
    """
    numbers = [frames.numbers[at] for at in frames.within]
    again = yield from read_frames(
        context, rigged, character, Wanted(0.0), numbers, counted_only=False
    )
    found = list(frames.found)
    for at, reply in zip(frames.within, again.found, strict=True):
        left_out = ("excluded_pairs", "excluded_deepest", "not_counted")
        found[at] = found[at] | {key: reply[key] for key in left_out}
    return replace(frames, found=found)


def _answers(character: OpenCharacter, requests: list[Request]) -> Generator[str, None, dict]:
    """Return the check of a frame, combined with those of the poses up to the next frame."""
    for request in requests:
        yield from wait_for(character.engine, request, "Checking")
    replies = [request.result() for request in requests]
    # The last pose belongs to the next frame.
    poses = replies[:-1] or replies
    worst = max(poses, key=lambda one: (one["pairs"], one["deepest"]))
    touches = any(one["touches_between"] for one in replies[1:])
    return replies[0] | {
        "colliding": worst["colliding"] or touches,
        "pairs": max(worst["pairs"], int(touches)),
        "deepest": worst["deepest"],
        "parts": worst["parts"],
        "is_between": not replies[0]["colliding"],
    }


def list_frames(scene: bpy.types.Scene, frames: Frames) -> None:
    """List the colliding frames in the panel, and mark them on the timeline."""
    markers, settings = scene.timeline_markers, scene.lcollision
    clear_frames(scene)
    for at in frames.colliding:
        found = frames.found[at]
        markers.new(MARKER, frame=frames.numbers[at])
        item = settings.frames.add()
        item.frame, item.pairs = frames.numbers[at], found["pairs"]
        item.deepest = found["deepest"]
        item.parts = " and ".join(dict.fromkeys(found["parts"][0])) if found["parts"] else ""
        item.parts += f" after frame {item.frame}" * found["is_between"]


def verdict(frames: Frames, settings: bpy.types.PropertyGroup) -> str:
    """Return a sentence on how many frames collide."""
    n, bad = len(frames.within), len(frames.colliding)
    if not bad:
        return f"{settings.kept()} in {n} frames ({settings.checked()})"
    verb, rest = ("come", " too near") if settings.clearance else ("collide", "")
    return f"{bad} of {n} frames {verb}{'s' if bad == 1 else ''}{rest}"


class LCOLLISION_OT_check_action(ModalOperator, bpy.types.Operator):
    """Find the frames of the action with self-collisions"""

    bl_idname = "lcollision.check_action"
    bl_label = "Check Action"

    def steps(self, context, settings) -> Steps:
        """Check frame by frame, and list the results."""
        rigged = Rigged.of(context)
        character = yield from open_character(rigged, settings)
        numbers, wanted = frame_range(rigged, context.scene), Wanted(character.clearance(rigged))
        frames = yield from read_frames(
            context, rigged, character, wanted, numbers, counted_only=False
        )
        list_frames(context.scene, frames)
        clear()
        settings.verdict, settings.details = verdict(frames, settings), frames.not_counted
        return ". ".join(filter(None, (settings.verdict, settings.details)))


class LCOLLISION_OT_resolve_action(ModalOperator, bpy.types.Operator):
    """Copy the action and resolve its self-collisions, keeping it smooth"""

    bl_idname = "lcollision.resolve_action"
    bl_label = "Resolve Action"

    def steps(self, context, settings) -> Steps:
        """Read, resolve, write a copy of the action, and check it as Blender shows it."""
        rigged = Rigged.of(context)
        resolved = yield from resolving(context, rigged, settings)
        frames, written = resolved.frames, resolved.written
        with resolved.taken_back_on_failure():
            now = yield from with_uncounted(
                context, resolved.shown, resolved.character, resolved.now
            )
        list_frames(context.scene, now)
        clear()
        settings.verdict, settings.details = verdict(now, settings), now.not_counted
        if written is None:
            if not frames.colliding:
                return f"{settings.verdict}: nothing was changed"
            told = f"{frames.in_words()} could not be freed, nothing was changed"
            return Caution(told + _why(resolved.unkeyable))
        settings.of = written.rigged.armature.name
        written.finish()
        told = told_of(written, frames)
        if now.not_counted:
            told += f". {now.not_counted}"
        return Caution(told + _why(resolved.unkeyable)) if now.colliding else told


@dataclass
class Resolved:
    """The result of resolving a motion.

    Attributes
    ----------
    rigged : the character that was asked for
    character, wanted : used for checking its frames
    frames : as before
    written : the better action; None if there is none and nothing was changed
    unkeyable : bones that could not turn, and why
    kept : spans that the engine has not freed, with reasons; frames by index
    """

    rigged: Rigged
    character: OpenCharacter
    wanted: Wanted
    frames: Frames
    written: "ActionCopy | None" = None
    unkeyable: dict[str, str] = field(default_factory=dict)
    kept: list[dict] = field(default_factory=list)

    @property
    def now(self) -> Frames:
        """The present frames."""
        return self.frames if self.written is None else self.written.now

    @property
    def shown(self) -> Rigged:
        """The character that shows them."""
        return self.rigged if self.written is None else self.written.rigged

    @contextmanager
    def taken_back_on_failure(self) -> Iterator[None]:
        """Restore everything as it was if the steps inside fail or are stopped."""
        try:
            yield
        except BaseException:
            if self.written is not None:
                self.written.take_back()
            raise


def resolving(
    context: bpy.types.Context,
    rigged: Rigged,
    settings: bpy.types.PropertyGroup,
    gap: float | None = None,
    subframes: int | None = None,
) -> Generator[str, None, Resolved]:
    """Read a motion, resolve it, write a copy of its action, and check it as Blender shows it.

    Parameters
    ----------
    gap : the clearance in the scene's unit; the panel's if None
    subframes : see `Wanted`
    """
    scene = context.scene
    rigged.ensure_writable()
    if action_of(rigged) is None and not rigged.is_driven:
        raise SceneError(f"{rigged.armature.name} has no action; make one active")
    numbers = frame_range(rigged, scene)
    every, within = with_neighbours(numbers, whole_range(rigged, scene))
    targets = _targets(rigged)
    character = yield from open_character(rigged, settings)
    wanted = Wanted(character.clearance(rigged, gap), subframes, numbers[-1])
    frames = yield from read_frames(context, targets[0], character, wanted, every, True, within)
    fps = scene.render.fps / scene.render.fps_base
    yield "Opening the character with its motion"
    step = max(1, round(fps / _POSES_A_SECOND), -(-len(every) // _MOST_POSES))
    character = yield from open_character(rigged, settings, np.array(frames.transforms[::step]))
    asked = wanted.asked | {
        "times": np.array(every) / fps,
        "within": [within.start, within.stop],
        "keep_feet": settings.keep_feet,
        "least_change": LEAST_CHANGE,
    }
    resolved = Resolved(rigged, character, wanted, frames)
    for target in targets if frames.colliding else ():
        resolved.unkeyable = {} if target.is_copied else unkeyable_bones(target, every)
        known = asked | {
            "locked": sorted({*target.locked(), *resolved.unkeyable}),
            "turning": turning(target, settings),
        }
        written = ActionCopy(target, frames)
        try:
            is_done = yield from written.resolve(context, character, wanted, known)
        except BaseException:
            written.take_back()
            raise
        resolved.kept = written.kept
        if is_done:
            resolved.written = written
            break
        written.take_back()
    return resolved


def _targets(rigged: Rigged) -> list[Rigged]:
    """Return the targets that an action may be written to, in the order to try.

    Raises
    ------
    SceneError : the action's keys are not what is shown.
    """
    if not rigged.is_driven:
        check_action(rigged)
        return [rigged]
    controls = None
    if action_of(rigged) is not None:
        with suppress(SceneError):
            check_action(rigged)
            controls = rigged.by_controls()
    return [rigged] if controls is None else [controls, rigged]


def told_of(written: "ActionCopy", frames: Frames) -> str:
    """Return a sentence on the resolved action."""
    again = written.now
    left = len(again.colliding)
    told = (
        f"{written.action.name}: {len(frames.colliding)} of {len(frames.within)} frames collided, "
        f"{left or 'none'} {'do' if left > 1 else 'does'} now; "
    )
    if left:
        told += f"{again.in_words()} could not be freed; "
    if written.old is not None:
        told += f"{written.old.name} is kept; "
    if written.is_of_driven:
        told += f"{where(written.rigged, written.by_fk)}; "
    return f"{told}acceleration ratio {written.acceleration:.2f}"


def _why(unkeyable: dict[str, str]) -> str:
    """Return a list of bones that did not turn, and why."""
    return "".join(f"; {name} stays ({why})" for name, why in unkeyable.items())


def _spans(reply: dict) -> dict[range, slice]:
    """Return the spans, as frame indices, that the engine may have changed, with their reply rows.

    Spans that touch are merged, as no unchanged frame lies between them.
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
    """The engine's turns in a span of frames.

    Parameters
    ----------
    reply : the engine's
    rows : rows of the reply that belong to the span

    Attributes
    ----------
    joints, turns : indices of n joints, and for each frame their (n, 4, 4) turns
    """

    def __init__(self, reply: dict, rows: slice) -> None:
        self.joints, self.turns = array(reply["joints"]).tolist(), array(reply["turns"])[rows]


def _cost(span: range, before: Frames, now: Frames, lengths: np.ndarray) -> tuple:
    """Return the cost of a version of a span, as a tuple to compare.

    First comes whether a frame has more or deeper pairs than before, or bones jump; then the
    numbers of colliding frames and of pairs.

    Parameters
    ----------
    lengths : (J,) of the bones
    """
    around = slice(max(span.start - 2, 0), span.stop + 2)
    jumps = [_jump(np.array(one.transforms[around]), lengths) for one in (before, now)]
    found = now.found
    worse = jumps[1] > max(_ROUGHER * jumps[0], _JUMP) or any(
        is_worse(found[at], before.found[at]) for at in span
    )
    n_colliding = sum(bool(found[at]["colliding"]) for at in span)
    return worse, n_colliding, sum(found[at]["pairs"] for at in span)


def _jump(transforms: np.ndarray, lengths: np.ndarray) -> float:
    """Return the largest change of velocity of a bone's ends, in sizes of the skeleton.

    Parameters
    ----------
    transforms : (T, J, 4, 4) of the bones
    lengths : (J,) of the bones
    """
    points = _ends(transforms, lengths)
    if len(points) < 3:
        return 0.0
    size = np.linalg.norm(np.ptp(points[0], axis=0))
    return float(np.linalg.norm(np.diff(points, 2, axis=0), axis=-1).max() / max(size, 1e-30))


def _ends(transforms: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return (T, 3 J, 3) points of bones with (T, J, 4, 4) transforms and (J,) lengths."""
    heads = transforms[..., :3, 3]
    ends = [heads + lengths[:, None] * transforms[..., :3, axis] for axis in range(2)]
    return np.concatenate([heads, *ends], axis=1)


@dataclass
class Plan:
    """The content of a copy of an action.

    Attributes
    ----------
    values : for each property that changes, its (T, C) float32 values
    spans : disjoint spans of frame indices that change, with the tolerance of keys in each
    jumps : properties that jump into and out of a span, as when a limb is posed by FK there
    """

    values: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    spans: dict[range, float] = field(default_factory=dict)
    jumps: set[tuple[str, str]] = field(default_factory=set)

    def with_rows(
        self,
        rows: dict[range, "Rows"],
        tolerance: float,
        before: Callable[[tuple[str, str]], np.ndarray],
    ) -> "Plan":
        """Return the plan with other values in some spans.

        Parameters
        ----------
        before : returns the original values of a property
        """
        values, spans, jumps = dict(self.values), dict(self.spans), set(self.jumps)
        for span, own in rows.items():
            for key, numbers in own.values.items():
                old = values.get(key)
                values[key] = new = np.array(before(key) if old is None else old)
                new[span.start : span.stop] = numbers
            jumps |= own.jumps
            touching = [one for one in spans if one.start <= span.stop and span.start <= one.stop]
            whole = range(
                min(one.start for one in (span, *touching)),
                max(one.stop for one in (span, *touching)),
            )
            least = min([tolerance, *(spans.pop(one) for one in touching)])
            spans[whole] = least
        return Plan(values, spans, jumps)


@dataclass(frozen=True)
class Rows:
    """The values of written properties in a span.

    Attributes
    ----------
    values : (n, C) for its n frames
    jumps : see `Plan`
    """

    values: dict[tuple[str, str], np.ndarray]
    jumps: set[tuple[str, str]]


class ActionCopy:
    """A copy of an action, with other keys where bones are turned.

    Parameters
    ----------
    rigged : the character with the action; if it needs a copy, that is baked once something turns
    frames : the present frames

    Attributes
    ----------
    rigged : the character with the new action
    action : the new action
    old : the user's action, which stays
    now : the frames as Blender shows them with the new action
    kept : spans that the engine has not freed, with reasons; frames by index
    """

    def __init__(self, rigged: Rigged, frames: Frames) -> None:
        self.old = action_of(rigged)
        self.rigged, self._frames, self.now = rigged, frames, frames
        self._original, self._pose, self._states = rigged, rigged.state(), frames.states
        self.is_of_driven, self.kept = rigged.is_driven, []
        self._plan = Plan()
        self._name = _free_name((self.old or rigged.armature).name)
        self._source = self.action = self._slot = None

    def _begin(self) -> None:
        """Bake a copy if one is written, and remember the source action and its slot."""
        if self.rigged.is_copied:
            self._bake()
        data = self.rigged.armature.animation_data
        slot = getattr(data, "action_slot", None)
        self._slot = None if slot is None else slot.identifier
        self._source = data.action

    @property
    def by_fk(self) -> set[str]:
        """The limbs that are switched to FK in any span."""
        return {name for name, path in self._plan.jumps if path.startswith("[")}

    @property
    def acceleration(self) -> float:
        """The mean squared acceleration of the bones' ends in the spans, relative to before.

        The square of one that nobody sees is added to both, as `MotionReport` does.
        """
        near = {at for span in self._plan.spans for at in range(span.start - 1, span.stop + 1)}
        middles = np.array(sorted(near & set(range(1, len(self._frames.numbers) - 1))), int)
        lengths = self.rigged.lengths()
        both = [_ends(np.array(one.transforms), lengths) for one in (self._frames, self.now)]
        render = bpy.context.scene.render
        unseen = _UNSEEN_BEND * (_NOMINAL_RATE * render.fps_base / render.fps) ** 2
        unseen *= np.ptp(both[0][0], axis=0).max()
        bends = [np.diff(ends, 2, axis=0)[middles - 1] for ends in both]
        before, now = ((bend**2).sum(axis=2) + unseen**2 for bend in bends)
        return float(now.sum() / before.sum()) if len(middles) else 1.0

    def resolve(
        self, context: bpy.types.Context, character: OpenCharacter, wanted: Wanted, asked: dict
    ) -> Iterator[str]:
        """Repeat from what Blender shows, until it is free or no longer improves.

        Returns
        -------
        is_done : whether the result is better
        """
        level, is_better, frames = 0, False, self._frames
        is_off = max(one["off_rig"] for one in frames.found) > OFF_RIG
        for _ in range(MOST_STEPS):
            beyond, margin = LEVELS[level]
            progress: list[int] = []
            deepest = max((self.now.found[at]["deepest"] for at in self.now.colliding), default=0.0)
            shown = {"transforms": np.array(self.now.transforms)}
            if is_off:
                shown["vertices"] = np.array(self.now.vertices)
            request = character.send(
                "resolve_motion",
                lambda *told, into=progress: into.extend(told),
                beyond=beyond,
                clearance=wanted.clearance + margin * deepest,
                **asked,
                **shown,
            )
            reply = yield from wait_for(character.engine, request, "Resolving frames", progress)
            self.kept = reply["kept"]
            colliding = set(self.now.colliding)
            spans = {one: rows for one, rows in _spans(reply).items() if colliding & set(one)}
            if spans:
                if self._source is None:
                    self._begin()
                n_before = len(colliding), sum(one["pairs"] for one in self.now.found)
                yield from self._try(context, character, wanted, reply, spans, is_off)
                n_after = len(self.now.colliding), sum(one["pairs"] for one in self.now.found)
                is_step = n_after < n_before
            else:
                is_step = False
            is_better |= is_step
            if not self.now.colliding:
                break
            # If the engine sees all remaining collisions, another step would not free them.
            seen = {*reply["colliding_frames"], *reply["in_between"], *reply["touching"]}
            is_known = seen.issuperset(self.now.colliding)
            if is_known and not is_off:
                break
            level = 0 if is_step else level + 1
            if level == len(LEVELS):
                break
        # If the controls cannot reproduce the engine's result, a baked copy may.
        is_all = not self.now.colliding or is_known or self._original.controls is None
        pairs = zip(self.now.found, frames.found, strict=True)
        return is_better and is_all and not any(is_worse(now, before) for now, before in pairs)

    def _try(
        self,
        context: bpy.types.Context,
        character: OpenCharacter,
        wanted: Wanted,
        reply: dict,
        spans: dict[range, slice],
        is_off: bool,
    ) -> Iterator[str]:
        """Write the engine's turns in spans, and keep those that improve what Blender shows."""
        turned = {span: Turned(reply, rows) for span, rows in spans.items()}
        rows = yield from self._rows(turned)
        lengths = self.rigged.lengths()
        for tolerance in (TOLERANCE, 0.1 * TOLERANCE, 0.0):
            before, plan = self.now, self._plan
            self._plan = plan.with_rows(rows, tolerance, self._before)
            yield from self._show(context, character, wanted, rows, is_off)
            better = {
                span
                for span in rows
                if _cost(span, self._frames, self.now, lengths)
                < _cost(span, self._frames, before, lengths)
            }
            if better != set(rows):
                kept = {span: rows[span] for span in better}
                self._plan = plan.with_rows(kept, tolerance, self._before)
                yield from self._show(context, character, wanted, rows, is_off)
            rows = {
                span: own
                for span, own in rows.items()
                if span not in better or any(self.now.found[at]["colliding"] for at in span)
            }
            if not rows:
                break

    def _rows(self, turned: dict[range, Turned]) -> Generator[str, None, dict[range, Rows]]:
        """Return the properties' values after turning the bones from their shown pose."""
        scene, found = bpy.context.scene, {}
        before = scene.frame_current
        try:
            for span, one in turned.items():
                # A limb is posed by FK in a whole span, or not at all.
                by_fk, is_settled = set(), False
                while not is_settled:
                    is_settled, states = True, []
                    for at, turns in zip(span, one.turns, strict=True):
                        yield f"Turning bones, frame {self._frames.numbers[at]}"
                        scene.frame_set(self._frames.numbers[at])
                        self.rigged.put(self._states_now()[at])
                        now = self.now.transforms[at]
                        switched = self.rigged.turn(now, one.joints, turns, by_fk)
                        is_settled &= switched <= by_fk
                        by_fk |= switched
                        states.append(self.rigged.state())
                values = {
                    key: np.array([one[key] for one in states], np.float32) for key in states[0]
                }
                found[span] = Rows(values, self.rigged.jumping(by_fk))
        finally:
            scene.frame_set(before)
            self.rigged.put(self._pose)
        return found

    def _states_now(self) -> list[State]:
        """Return the present properties of all frames; those of a new copy are as baked."""
        return self._states if self.now is self._frames else self.now.states

    def _show(
        self,
        context: bpy.types.Context,
        character: OpenCharacter,
        wanted: Wanted,
        spans: Iterable[range],
        is_off: bool,
    ) -> Iterator[str]:
        """Write the plan, and read the frames of some spans again as Blender shows them."""
        self._write()
        places = sorted({at for span in spans for at in span})
        numbers = [self._frames.numbers[at] for at in places]
        again = yield from read_frames(context, self.rigged, character, wanted, numbers, is_off)
        now = replace(
            self.now,
            found=list(self.now.found),
            transforms=list(self.now.transforms),
            states=list(self._states_now()),
            vertices=list(self.now.vertices),
        )
        for row, at in enumerate(places):
            now.found[at], now.transforms[at] = again.found[row], again.transforms[row]
            now.states[at] = again.states[row]
            if is_off:
                now.vertices[at] = again.vertices[row]
        self.now = now

    def _assign(self, action: bpy.types.Action) -> None:
        """Assign an action to the armature, with the same slot as the old one."""
        data = self.rigged.armature.animation_data
        data.action = action
        if self._slot is not None:
            data.action_slot = next(one for one in action.slots if one.identifier == self._slot)

    def take_back(self) -> None:
        """Restore everything as it was before."""
        if self.rigged is not self._original:
            self.rigged.remove_copy()
            for action in filter(None, (self._source, self.action)):
                bpy.data.actions.remove(action)
        elif self._source is not None:
            self._assign(self._source)
            if self.action is not None:
                bpy.data.actions.remove(self.action)
        if self.rigged is self._original:
            self.rigged.put(self._pose)
        scene = bpy.context.scene
        scene.frame_set(scene.frame_current)

    def finish(self) -> None:
        """Keep the new action, and keep the old one in the file by a fake user."""
        if self.rigged is not self._original:
            bpy.data.actions.remove(self._source)
        elif self._source.library is None:
            self._source.use_fake_user = True
        self.action.name = self._name

    def _bake(self) -> None:
        """Key all bones of a copy in all frames as shown."""
        self.rigged = copy = self.rigged.baked_copy()
        self._source = action = bpy.data.actions.new(self._name)
        copy.armature.animation_data_create().action = action
        self._states = []
        for number, matrices in zip(self._frames.numbers, self._frames.matrices, strict=True):
            copy.place(matrices)
            for bone in copy.armature.pose.bones:
                for path in ("location", rotation_path(bone), "scale"):
                    bone.keyframe_insert(path, frame=number, group=bone.name)
            self._states.append(copy.state())
        self._pose = copy.state()

    def _write(self) -> None:
        """Write a new copy of the action according to the plan."""
        past = self.action
        self.action = self._source.copy()
        self._assign(self.action)
        if past is not None:
            bpy.data.actions.remove(past)
        self.action.name = self._name
        longest = self.rigged.longest_bone
        for (name, path), new in self._plan.values.items():
            bone, old = self.rigged.armature.pose.bones[name], self._before((name, path))
            # The components of a quaternion change by half the angle.
            unit = {"location": longest, "rotation_quaternion": 0.5}.get(path, 1.0)
            spans = [
                (span, tolerance * unit)
                for span, tolerance in self._plan.spans.items()
                if np.abs(new - old)[span.start : span.stop].max() > max(_SAME, tolerance) * unit
            ]
            if spans:
                curves, is_new = self._curves(bone, path, old.shape[1])
                is_jump = (name, path) in self._plan.jumps
                rekey(
                    curves,
                    is_new,
                    self._frames.numbers,
                    old,
                    new,
                    sorted(spans, key=lambda one: one[0].start),
                    is_jump,
                )
        self.action.update_tag()

    def _before(self, key: tuple[str, str]) -> np.ndarray:
        """Return the original (T, C) float32 values of a bone's property."""
        return np.array([state[key] for state in self._states], np.float32)

    def _curves(
        self, bone: bpy.types.PoseBone, path: str, n: int
    ) -> tuple[list[bpy.types.FCurve], list[bool]]:
        """Return the curves of a bone's property, and which of them were newly made."""
        item, own = self.rigged.armature, whole_path(bone, path)

        def existing() -> dict[int, bpy.types.FCurve]:
            curves = curves_of(self.action, item)
            return {one.array_index: one for one in curves if one.data_path == own}

        missing = [at for at in range(n) if at not in existing()]
        for at in missing:
            index = {} if path.startswith("[") else {"index": at}
            bone.keyframe_insert(path, frame=self._frames.numbers[0], group=bone.name, **index)
        found = existing()
        if len(found) != n:
            raise SceneError(f"{bone.name}: Blender gives its {path} no keys in {self.action.name}")
        return [found[at] for at in range(n)], [at in missing for at in range(n)]


def check_action(rigged: Rigged) -> None:
    """Refuse an action whose keys are not what is shown, before anything is computed.

    Raises
    ------
    SceneError : the action is edited or blended in the NLA.
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
    """Return the name of a copy; a copy of a copy gets the same name."""
    return re.sub(rf"({re.escape(_FREE)}(\.\d+)?)*$", "", name) + _FREE


_CLASSES = (LCOLLISION_OT_check_action, LCOLLISION_OT_resolve_action)

register, unregister = bpy.utils.register_classes_factory(_CLASSES)
