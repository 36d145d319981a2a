"""A character's glTF file with some frames of its clips changed: all else stays as it was."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lcollision_core.characters.character import Character, Rig
from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.gltf_animation import ClipTracks, Track, driven_property
from lcollision_core.meshes.formats.gltf_document import GltfDocument
from lcollision_core.meshes.formats.gltf_nodes import PARTS, stored_parts
from lcollision_core.meshes.joined import join_parts
from lcollision_core.meshes.scene_files import as_file_error, scene_of
from lcollision_core.meshes.topology import FloatArray

_UNCHANGED = 1e-9
"""Of a joint's turn, or its shift in the character's unit: what is less is rounding."""

_AT_ONCE = 16
"""Frames that are evaluated together."""


@dataclass(frozen=True, eq=False)
class ChangedClip:
    """The frames of one clip that are to be changed.

    Attributes
    ----------
    clip : its name
    times : (T,) float64 array, of its frames, in seconds
    spans : of frames that change
    before, after : (S, J, 4, 4) float64 arrays of the S frames of the spans, in their order: global
        transforms of the rig's joints by the pose space, without and with the change
    """

    clip: str
    times: FloatArray
    spans: Sequence[range]
    before: FloatArray
    after: FloatArray


def changed_gltf(character: Character, changes: Sequence[ChangedClip]) -> bytes:
    """Turn the joints of a character in some frames of its clips.

    Only the rotations of joints that turn, and the translation of a root that is shifted, get new
    keys, and only within the spans; what else a clip holds there (scales, stretched bones) stays,
    and the joint turns as far from where the clip has it as the pose does. Outside of the spans
    each value stays what it was: linear keys as they are, cubic ones with their tangents, stepped
    ones as pairs of linear keys. Other clips and all else of the file stay as they were.

    Parameters
    ----------
    character : with a rig, read from a .glb, .gltf or .vrm file
    changes : of its clips

    Returns
    -------
    the file, as GLB

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
            _change(file.document, written, rig, change)
        return written.encoded()


def clip_vertices(data: bytes, path: Path, clip: str, times: FloatArray) -> Iterator[FloatArray]:
    """Evaluate a clip of a written file: (V, 3) vertices at each time, as readers get them.

    Raises
    ------
    MeshFileError : the file cannot be read.
    """
    with as_file_error(path):
        scene = scene_of(GltfDocument(data, path))
        mesh = join_parts(scene)
        found = next(one for one in scene.clips if one.name == clip)
        for start in range(0, len(times), _AT_ONCE):
            yield from mesh.posed(found.sample(times[start : start + _AT_ONCE]))


def _change(document: GltfDocument, patch: GltfDocument, rig: Rig, change: ChangedClip) -> None:
    tracks = ClipTracks.of(document, change.clip)
    animations = patch.description["animations"]
    animation = animations[tracks.number] = deepcopy(animations[tracks.number])
    turns = _local_turns(rig, change)
    for joint, node in enumerate(rig.nodes.tolist()):
        rotation, translation, scale = (
            tracks.track(node, path, float(change.times[0]))
            for path in ("rotation", "translation", "scale")
        )
        new_rotation, new_translation, start = rotation, translation, 0
        for span in change.spans:
            own = turns[start : start + len(span), joint]
            start += len(span)
            if np.abs(own - np.eye(4)).max() <= _UNCHANGED:
                continue
            at = change.times[span.start : span.stop]
            before = float(change.times[span.start - 1]) if span.start else None
            after = float(change.times[span.stop]) if span.stop < len(change.times) else None
            old = Rotation.from_quat(rotation.at(at)[:, 0])
            turned = (old * Rotation.from_matrix(own[:, :3, :3])).as_quat()
            new_rotation = new_rotation.with_span(before, at, after, turned[:, None])
            if np.abs(own[:, :3, 3]).max() > _UNCHANGED:
                moved = translation.at(at)[:, 0] + old.apply(scale.at(at)[:, 0] * own[:, :3, 3])
                new_translation = new_translation.with_span(before, at, after, moved[:, None])
        for track, new in ((rotation, new_rotation), (translation, new_translation)):
            if new is not track:
                _put(patch, animation, node, new)


def _local_turns(rig: Rig, change: ChangedClip) -> FloatArray:
    """Return by how much each joint turns further, in its own frame: (S, J, 4, 4)."""

    def local(transforms: FloatArray) -> FloatArray:
        parents = rig.own_parents
        above = transforms[:, np.maximum(parents, 0)].copy()
        above[:, parents < 0] = np.eye(4)
        return np.linalg.solve(above, transforms).astype(np.float64)

    return np.linalg.solve(local(change.before), local(change.after)).astype(np.float64)


def _put(patch: GltfDocument, animation: dict[str, Any], node: int, track: Track) -> None:
    """Give a property of a node its keys in an animation, by one channel."""
    animation["samplers"].append(
        {
            "input": patch.add_array(track.times[:, None], has_bounds=True),
            "output": patch.add_array(track.values.reshape(-1, track.values.shape[-1])),
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
    # What is animated has no matrix.
    moved = patch.description["nodes"][node]
    if "matrix" in moved:
        parts = dict(zip(PARTS, stored_parts(moved), strict=True))
        del moved["matrix"]
        moved |= {name: part.tolist() for name, part in parts.items()}
