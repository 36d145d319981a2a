"""Change frames of the clips in a character's glTF file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from lcollision_core.errors import MeshFileError
from lcollision_core.files.character import Character, CharacterFile, Rig
from lcollision_core.files.gltf.clips import ClipTracks, Track, driven_property
from lcollision_core.files.gltf.schema import GltfDocument, set_parts, stored_parts
from lcollision_core.files.scene.scene import by_node
from lcollision_core.files.scene.transforms import are_regular, unit_quaternions
from lcollision_core.files.scene_files import as_file_error
from lcollision_core.meshes.topology import FloatArray

_UNCHANGED = 1e-9
"""Largest entry of a joint's turn, or shift in the character's unit, that is rounding error."""

_SpanTimes = tuple[float | None, FloatArray, float | None]


@dataclass(frozen=True, eq=False)
class ChangedClip:
    """A change to some frames of one clip.

    Attributes
    ----------
    clip : name of the clip
    times : (T,) float64 array, times of its frames in seconds
    spans : ranges of frames that change
    before, after : (n, J, 4, 4) float64 arrays, for the n frames of the spans in order: global
        transforms of the rig's joints by the pose space, before and after the change
    shapes : (n, S) changes of the sliders of morph targets; None if there are none
    """

    clip: str
    times: FloatArray
    spans: Sequence[range]
    before: FloatArray
    after: FloatArray
    shapes: FloatArray | None = None

    def spans_in_time(self) -> Iterator[tuple[slice, _SpanTimes]]:
        """Yield each span's rows, and the times before, in and after it: see `with_span`."""
        start = 0
        for span in self.spans:
            before = float(self.times[span.start - 1]) if span.start else None
            after = float(self.times[span.stop]) if span.stop < len(self.times) else None
            rows = slice(start, start + len(span))
            yield rows, (before, self.times[span.start : span.stop], after)
            start += len(span)


def changed_gltf(character: Character, changes: Sequence[ChangedClip]) -> bytes:
    """Turn the joints of a character in some frames of its clips.

    Only the rotations of joints that turn, and the translation of a root that is shifted, get new
    keys, and only within the spans. Everything else in the clip (scales, stretched bones) stays,
    and joints turn relative to their transforms in the clip. Outside the spans the values are
    unchanged: linear keys are kept, cubic ones keep their tangents, stepped ones become pairs of
    linear keys. Other clips and the rest of the file are unchanged.

    Parameters
    ----------
    character : with a rig, read from a .glb, .gltf or .vrm file
    changes : the changes of its clips

    Returns
    -------
    the file as GLB

    Raises
    ------
    MeshFileError : the file cannot be read, has no such clip, or would be too large.
    """
    rig, file = character.rig, character.file
    if rig is None or file is None:
        raise MeshFileError("has no joints whose clips could be changed", where=character.source)
    with as_file_error(character.source, "cannot be written with this motion"):
        written = file.editable.copy()
        for change in changes:
            _change(file, written, rig, change)
        return written.encoded()


def _change(file: CharacterFile, patch: GltfDocument, rig: Rig, change: ChangedClip) -> None:
    tracks = ClipTracks.of(file.document, change.clip, file.scene.parts)
    animations = patch.description["animations"]
    animation = animations[tracks.number] = deepcopy(animations[tracks.number])
    turns, turn_of = _local_turns(rig, change), scipy.spatial.transform.Rotation
    for joint, node in enumerate(rig.nodes.tolist()):
        rotation, translation, scale = (
            tracks.track(node, path, float(change.times[0]))
            for path in ("rotation", "translation", "scale")
        )
        new_rotation, new_translation = rotation, translation
        for rows, (before, at, after) in change.spans_in_time():
            joint_turns = turns[rows, joint]
            if np.abs(joint_turns - np.eye(4)).max() <= _UNCHANGED:
                continue
            old = turn_of.from_quat(unit_quaternions(rotation.at(at)[:, 0]))
            sizes = scale.at(at)[:, 0]
            turned = old * turn_of.from_matrix(_unscaled(joint_turns[:, :3, :3], sizes))
            new_rotation = new_rotation.with_span(before, at, after, turned.as_quat()[:, None])
            if np.abs(joint_turns[:, :3, 3]).max() > _UNCHANGED:
                moved = translation.at(at)[:, 0] + old.apply(sizes * joint_turns[:, :3, 3])
                new_translation = new_translation.with_span(before, at, after, moved[:, None])
        for track, new in ((rotation, new_rotation), (translation, new_translation)):
            if new is not track:
                _put(patch, animation, node, new)
    if rig.shapes is None or change.shapes is None:
        return
    parts = file.scene.parts
    at_rest = by_node(parts, file.scene.rest.weights)
    for node, mix in by_node(parts, rig.shapes.mixes).items():
        added = change.shapes @ mix
        if not added.any():
            continue
        track = tracks.track(node, "weights", float(change.times[0]), at_rest[node][0])
        for rows, (before, at, after) in change.spans_in_time():
            if added[rows].any():
                values = track.at(at) + added[rows][:, None]
                track = track.with_span(before, at, after, values)
        _put(patch, animation, node, track)


def _unscaled(turns: FloatArray, sizes: FloatArray) -> FloatArray:
    """Conjugate (n, 3, 3) turns, applied before (n, 3) scales, to apply after them."""
    divisors = np.where(np.abs(sizes) > _UNCHANGED, sizes, 1.0)
    return divisors[:, :, None] * turns / divisors[:, None, :]


def _local_turns(rig: Rig, change: ChangedClip) -> FloatArray:
    """Return the additional turn of each joint in its local frame: (n, J, 4, 4).

    None where a frame scales the joint to nothing.
    """
    flat = ~are_regular(change.before)
    before, after = change.before.copy(), change.after.copy()
    before[flat] = after[flat] = np.eye(4)

    def local(transforms: FloatArray) -> FloatArray:
        parents = rig.own_parents
        above = transforms[:, np.maximum(parents, 0)].copy()
        above[:, parents < 0] = np.eye(4)
        return np.linalg.solve(above, transforms).astype(np.float64)

    turns = np.linalg.solve(local(before), local(after)).astype(np.float64)
    turns[flat] = np.eye(4)
    return turns


def _put(patch: GltfDocument, animation: dict[str, Any], node: int, track: Track) -> None:
    """Set the keys of a node's property in an animation, with a single channel."""
    animation["samplers"].append(
        {
            "input": patch.add_array(track.times[:, None], has_bounds=True),
            "output": patch.add_array(
                track.values.reshape(-1, 1 if track.path == "weights" else track.values.shape[-1])
            ),
            "interpolation": track.interpolation,
        }
    )
    channel: dict[str, Any] = {"target": {"node": node, "path": track.path}}
    others = []
    for one in animation["channels"]:
        if driven_property(one) == (node, track.path):
            channel = one
        else:
            others.append(one)
    number = len(animation["samplers"]) - 1
    animation["channels"] = [*others, channel | {"sampler": number}]
    # Animated nodes must not have a matrix.
    moved = patch.description["nodes"][node]
    if "matrix" in moved:
        set_parts(moved, stored_parts(moved))
