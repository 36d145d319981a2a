# SPDX-License-Identifier: GPL-3.0-or-later
"""Keys of F-curves: new values in spans of frames, while all other frames stay bit-identical.

Blender rounds when it evaluates a curve, and a part of a Bezier curve is rounded differently from
the whole. So a curve that is cut between two keys is split exactly (de Casteljau) and evaluated
again. If a frame is off by a bit, the last bits of the handles are varied, then a key with the old
value is added.
"""

from functools import cache

import bpy
import numpy as np

from .controls import rotation_path
from .scene import Rigged, SceneError

_ENUMS = bpy.types.Keyframe.bl_rna.properties


def _number(name: str, item: str) -> int:
    """Return the number of an enumeration's item, as used in arrays of keys."""
    return _ENUMS[name].enum_items[item].value


_CONSTANT, _LINEAR, _BEZIER = (
    _number("interpolation", one) for one in ("CONSTANT", "LINEAR", "BEZIER")
)
_FREE, _VECTOR = (_number("handle_left_type", one) for one in ("FREE", "VECTOR"))
_KEY = np.dtype(
    [(name, np.float32, 2) for name in ("co", "handle_left", "handle_right")]
    + [(name, np.float32) for name in ("back", "amplitude", "period")]
    + [
        (name, np.int32)
        for name in ("interpolation", "easing", "type", "handle_left_type", "handle_right_type")
    ]
)
_NEW = np.zeros((), _KEY)
_NEW["back"], _NEW["amplitude"], _NEW["period"] = 1.70158, 0.8, 4.1
_NEW["interpolation"] = _LINEAR
_NEW["handle_left_type"] = _NEW["handle_right_type"] = _VECTOR

_N_TRIALS = 300
"""Number of trials of handles' last bits before a curve gets one more key."""

_AT = 1e-4
"""Tolerance, in frames, for a key to be at a frame."""


def curves_of(action: bpy.types.Action, item: bpy.types.Object) -> list[bpy.types.FCurve]:
    """Return the curves of an object's action, in any version of Blender."""
    slot = getattr(item.animation_data, "action_slot", None)
    if slot is None:
        return list(getattr(action, "fcurves", ()))
    # With slots, an action's own `fcurves`, if it has any, are only those of the first slot.
    strips = (strip for layer in action.layers for strip in layer.strips)
    bags = (strip.channelbag(slot) for strip in strips)
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]


def check_keyable(rigged: Rigged) -> None:
    """Refuse an armature whose action can't be keyed.

    Raises
    ------
    SceneError : the action is linked from another file.
    """
    data = rigged.armature.animation_data
    action = None if data is None else data.action
    if action is not None and action.library is not None:
        raise SceneError(
            f"{action.name} is linked from another file and can't be keyed; make it local first, "
            "or switch auto-keying off"
        )


def unkeyable_bones(rigged: Rigged, numbers: list[int] | None = None) -> dict[str, str]:
    """Return the deforming bones whose rotation cannot be keyed, and why.

    Parameters
    ----------
    numbers : frames that may be keyed, in order; the current one if None
    """
    data = rigged.armature.animation_data
    if data is None or data.action is None:
        return {}
    numbers = numbers or [bpy.context.scene.frame_current]
    curves: dict[str, list[bpy.types.FCurve]] = {}
    for curve in curves_of(data.action, rigged.armature):
        curves.setdefault(curve.data_path, []).append(curve)
    found = {}
    for joint, (name, parent) in enumerate(zip(rigged.bones, rigged.parents, strict=True)):
        own = []
        for writer in rigged.writers(joint):
            bone = rigged.armature.pose.bones[writer]
            # Only roots and controls also move.
            is_moved = parent < 0 or rigged.controls is not None
            for path in (rotation_path(bone), *(("location",) if is_moved else ())):
                own += curves.get(bone.path_from_id(path), ())
        why = next(filter(None, (_why_unkeyable(curve, numbers) for curve in own)), "")
        if why:
            found[name] = why
    return found


def _why_unkeyable(curve: bpy.types.FCurve, numbers: list[int]) -> str:
    """Return why keys of a curve would not be shown unchanged, or ""."""
    if curve.lock or (curve.group is not None and curve.group.lock):
        return "locked curves"
    if curve.mute or (curve.group is not None and curve.group.mute):
        return "muted curves"
    if len(curve.sampled_points):
        return "sampled curves"
    first, last = curve.range()
    for one in curve.modifiers:
        # Between its keys, a cycle equals the curve itself.
        is_itself = one.type == "CYCLES" and first <= numbers[0] and numbers[-1] <= last
        if not one.mute and not is_itself:
            return f"curves with the modifier {one.type.capitalize()}"
    return ""


def rekey(
    curves: list[bpy.types.FCurve],
    is_new: list[bool],
    numbers: list[int],
    before: np.ndarray,
    after: np.ndarray,
    spans: list[tuple[range, float]],
    is_jump: bool = False,
) -> None:
    """Give a property of a bone other values in spans of frames, with few keys.

    Parameters
    ----------
    curves : C, of its components
    is_new : (C,) whether a curve was newly made: its keys do not count
    numbers : T consecutive frames
    before, after : (T, C) float32 values before, and the wanted ones within the spans
    spans : disjoint spans of frame indices, each with the tolerance of the curves
    is_jump : whether the curve jumps into and out of the spans
    """
    old = [_NEW_KEYS if new else _read(one) for one, new in zip(curves, is_new, strict=True)]
    fits = [_fitted(after[span.start : span.stop], least) for span, least in spans]
    for column, (curve, keys) in enumerate(zip(curves, old, strict=True)):
        values = {
            number: curve.evaluate(number)
            for number in _frames(keys)
            if not numbers[0] <= number <= numbers[-1]
        }
        values |= dict(zip(numbers, before[:, column].tolist(), strict=True))
        regions = []
        for (span, _), (places, handles) in zip(spans, fits, strict=True):
            left, right = numbers[span.start] - 1, numbers[span.stop - 1] + 1
            # Beyond the keyed frames, the outermost key is shown.
            at = np.array(places) + span.start
            inner = _curved(np.array(numbers)[at], after[at, column], handles[..., column])
            if is_jump:
                inner["interpolation"][-1] = _CONSTANT
            regions.append(
                (left if left in values else -np.inf, right if right in values else np.inf, inner)
            )
        for span, _ in spans:
            for at in span:
                del values[numbers[at]]
        _rewrite(curve, keys, regions, values, _CONSTANT if is_jump else _LINEAR)


_NEW_KEYS = np.zeros(0, _KEY)


def _frames(keys: np.ndarray) -> range:
    """Return the frames from the first key to the last."""
    if not len(keys):
        return range(0)
    first, last = keys["co"][[0, -1], 0]
    return range(int(np.ceil(first - _AT)), int(np.floor(last + _AT)) + 1)


def _curved(numbers: np.ndarray, values: np.ndarray, handles: np.ndarray) -> np.ndarray:
    """Return k keys of a Bezier curve with (k - 1, 2) values of handles between them."""
    keys = np.full(len(numbers), _NEW)
    third = np.diff(numbers) / 3.0
    keys["co"] = np.stack([numbers, values], axis=1)
    keys["handle_left"] = keys["handle_right"] = keys["co"]
    keys["handle_right"][:-1] = np.stack([numbers[:-1] + third, handles[:, 0]], axis=1)
    keys["handle_left"][1:] = np.stack([numbers[1:] - third, handles[:, 1]], axis=1)
    keys["handle_left_type"] = keys["handle_right_type"] = _FREE
    keys["interpolation"][:-1] = _BEZIER
    return keys


def _fitted(values: np.ndarray, tolerance: float) -> tuple[list[int], np.ndarray]:
    """Fit Bezier curves with few keys, greedily, to (n, C) values.

    Parameters
    ----------
    tolerance : bound of the error, as a norm over the components

    Returns
    -------
    places : indices of k keys
    handles : (k - 1, 2, C) values of the handles between two keys, at thirds of the interval
    """
    values, last = values.astype(np.float64), len(values) - 1
    places, handles = [0], []
    while places[-1] < last:
        start = places[-1]
        end, (found, _) = start + 1, _cubic(values[start : start + 2])
        while end < last:
            further, off = _cubic(values[start : end + 2])
            if off >= tolerance:
                break
            end, found = end + 1, further
        places.append(end)
        handles.append(found)
    return places, np.array(handles).reshape(-1, 2, values.shape[1])


def _cubic(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the (2, C) handles of the curve nearest to (n, C) values, and its largest error.

    The curve passes through the first and the last value.
    """
    weights, inverse = _handle_weights(len(values))
    way = values[-1] - values[0]
    bent = values - values[0] - np.linspace(0.0, 1.0, len(values))[:, None] * way
    handles = inverse @ bent
    off = float(np.linalg.norm(bent - weights @ handles, axis=1).max())
    return values[0] + np.array([[1.0], [2.0]]) / 3.0 * way + handles, off


@cache
def _handle_weights(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n, 2) weights of two handles at n evenly spaced times, and their inverse."""
    time = np.linspace(0.0, 1.0, n)
    weights = 3.0 * np.stack([time * (1.0 - time) ** 2, time**2 * (1.0 - time)], axis=1)
    return weights, np.linalg.pinv(weights)


def _read(curve: bpy.types.FCurve) -> np.ndarray:
    points = curve.keyframe_points
    keys = np.zeros(len(points), _KEY)
    for name in _KEY.names:
        flat = np.zeros(keys[name].size, keys[name].dtype)
        points.foreach_get(name, flat)
        keys[name] = flat.reshape(keys[name].shape)
    return keys


def _write(curve: bpy.types.FCurve, keys: np.ndarray) -> None:
    points = curve.keyframe_points
    points.clear()
    points.add(len(keys))
    for name in _KEY.names:
        points.foreach_set(name, np.ascontiguousarray(keys[name]).ravel())
    curve.update()


def _rewrite(
    curve: bpy.types.FCurve,
    old: np.ndarray,
    regions: list[tuple],
    values: dict[int, float],
    way_in: int,
) -> None:
    """Put keys into regions of a curve without changing its other frames.

    Parameters
    ----------
    regions : for each, the frames on either side, which stay (infinite if none), and its keys
    values : of all frames outside the regions
    way_in : the interpolation of keys from which a region is entered
    """
    extra: set[int] = set()
    # The (2, 2) handles of parts of Bezier curves, by their times.
    handles: dict[tuple[float, float], np.ndarray] = {}
    while True:
        keys = _hold(curve, *_laid(old, regions, extra, values, handles, way_in))
        off = [number for number, value in values.items() if curve.evaluate(number) != value]
        off = [number for number in off if number not in extra]
        if not off:
            return
        times = keys["co"][:, 0].astype(np.float64)
        between = np.searchsorted(times, off) - 1
        for at in np.unique(between).tolist():
            missed = [one for one, place in zip(off, between, strict=True) if place == at]
            if 0 <= at < len(times) - 1 and keys["interpolation"][at] == _BEZIER:
                inside = range(int(np.floor(times[at])) + 1, int(np.ceil(times[at + 1])))
                wanted = {one: values[one] for one in inside}
                handles[times[at], times[at + 1]], is_met = _nudged(curve, at, wanted)
                missed = [] if is_met else [inside[len(inside) // 2]]
            extra.update(missed)


def _nudged(curve: bpy.types.FCurve, at: int, wanted: dict[int, float]) -> tuple[np.ndarray, bool]:
    """Vary the last bits of the handles between two keys, until the frames between are right.

    Returns
    -------
    handles : (2, 2) of the first key's right and the second key's left one
    is_met : whether all frames are right
    """
    one, other = curve.keyframe_points[at], curve.keyframe_points[at + 1]
    begin = np.array([one.handle_right, other.handle_left], np.float32)
    unit = np.spacing(np.abs([one.co, *begin, other.co]).max(axis=0).astype(np.float32))
    trials = np.random.default_rng(0).integers(-3, 4, (_N_TRIALS, 2, 2)).astype(np.float32)
    for trial in trials:
        handles = begin + trial * unit
        one.handle_right, other.handle_left = handles.tolist()
        if all(curve.evaluate(number) == value for number, value in wanted.items()):
            return handles, True
    return begin, False


def _hold(curve: bpy.types.FCurve, keys: np.ndarray, is_new: np.ndarray) -> np.ndarray:
    """Write keys, and set handles to free if Blender would move them for their new neighbours.

    Returns
    -------
    keys : as written
    """
    _write(curve, keys)
    is_bezier = keys["interpolation"] == _BEZIER
    is_linear = curve.extrapolation == "LINEAR"
    matters = {
        "handle_left": np.concatenate([[is_linear], is_bezier[:-1]]) & ~is_new,
        "handle_right": np.concatenate([is_bezier[:-1], [is_linear]]) & ~is_new,
    }
    for _ in keys:
        now, is_held = _read(curve), True
        for name, does in matters.items():
            moved = does & (now[name] != keys[name]).any(axis=1)
            moved &= keys[f"{name}_type"] != _FREE
            keys[f"{name}_type"][moved] = _FREE
            is_held &= not moved.any()
        if is_held:
            break
        _write(curve, keys)
    return keys


def _laid(
    old: np.ndarray,
    regions: list[tuple],
    extra: set[int],
    values: dict[int, float],
    handles: dict[tuple[float, float], np.ndarray],
    way_in: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the keys of a curve, and which of them are within the regions."""
    times = old["co"][:, 0].astype(np.float64)
    is_kept = np.ones(len(old), dtype=np.bool_)
    cuts = set(extra)
    for left, right, _ in regions:
        is_kept &= (times <= left + _AT) | (times >= right - _AT)
        cuts |= {one for one in (left, right) if np.isfinite(one)}
    kept = old[is_kept]
    missing = [one for one in sorted(cuts) if not (np.abs(times[is_kept] - one) < _AT).any()]
    cut = np.full(len(missing), _NEW)
    for row, number in enumerate(missing):
        above = int(np.searchsorted(times, number))
        if 0 < above < len(old):
            cut[row] = old[above - 1]
            cut["handle_left_type"][row] = cut["handle_right_type"][row] = _FREE
            cut["type"][row] = _NEW["type"]
        cut["co"][row] = number, values[number]
        cut["handle_left"][row] = cut["handle_right"][row] = cut["co"][row]
    keys = np.concatenate([kept, cut])
    keys = keys[np.argsort(keys["co"][:, 0], kind="stable")]
    _split(keys, old, regions, handles)
    for left, _, _ in regions:
        keys["interpolation"][np.abs(keys["co"][:, 0] - left) < _AT] = way_in
    keys = np.concatenate([keys, *(inner for _, _, inner in regions)])
    is_new = np.arange(len(keys)) >= len(kept) + len(cut)
    order = np.argsort(keys["co"][:, 0], kind="stable")
    return keys[order], is_new[order]


def _split(
    keys: np.ndarray,
    old: np.ndarray,
    regions: list[tuple],
    handles: dict[tuple[float, float], np.ndarray],
) -> None:
    """Give the parts of a cut curve the shape that the curve had there."""
    times = old["co"][:, 0].astype(np.float64)
    for at in range(len(keys) - 1):
        begin, end = keys["co"][at : at + 2, 0].astype(np.float64)
        if any(left - _AT < begin and end < right + _AT for left, right, _ in regions):
            continue
        below = int(np.searchsorted(times, begin, side="right")) - 1
        if not 0 <= below < len(old) - 1:
            keys["interpolation"][at] = _LINEAR
            continue
        if (times[below], times[below + 1]) == (begin, end):
            continue
        kind = keys["interpolation"][at]
        if kind == _BEZIER:
            part = handles.get((begin, end))
            if part is None:
                shape = _shape(old[below], old[below + 1])
                ends = (_parameter(shape[:, 0], one) for one in (begin, end))
                part = _part(shape, *ends)[1:3]
            keys["handle_right"][at], keys["handle_left"][at + 1] = part
            keys["handle_right_type"][at] = keys["handle_left_type"][at + 1] = _FREE
        elif kind not in (_LINEAR, _CONSTANT):
            # A part of an easing curve is not one itself: its frames get keys.
            keys["interpolation"][at] = _LINEAR


def _shape(one: np.void, other: np.void) -> np.ndarray:
    """Return the (4, 2) control points between two keys, with handles shortened as by Blender."""
    shape = np.array([one["co"], one["handle_right"], other["handle_left"], other["co"]], float)
    room = shape[3, 0] - shape[0, 0]
    for end, handle in ((0, 1), (3, 2)):
        reach = abs(shape[handle, 0] - shape[end, 0])
        if reach > room:
            shape[handle] = shape[end] + room / reach * (shape[handle] - shape[end])
    return shape


def _parameter(times: np.ndarray, time: float) -> float:
    """Return the parameter of a time on a curve with (4,) ascending times."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (
            (middle, high) if _point(times, middle, middle, middle) < time else (low, middle)
        )
    return 0.5 * (low + high)


def _part(shape: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Return the (4, 2) control points of a part of a curve."""
    turns = ((begin,) * 3, (begin, begin, end), (begin, end, end), (end,) * 3)
    return np.array([_point(shape, *one) for one in turns])


def _point(shape: np.ndarray, *parameters: float) -> np.ndarray:
    """Return the point of a cubic's polar form (its blossom) at three parameters."""
    for one in parameters:
        shape = shape[:-1] + one * (shape[1:] - shape[:-1])
    return shape[0]
