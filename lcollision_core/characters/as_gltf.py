"""A character of any format as the glTF file that gives it back, once for all that is written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.characters.character import Character
from lcollision_core.characters.posed_gltf import GLTF_SUFFIXES
from lcollision_core.characters.reading import character_of
from lcollision_core.errors import MeshFileError
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.files import turn_to_y
from lcollision_core.meshes.formats.gltf_document import GltfDocument
from lcollision_core.meshes.gltf_of_scene import gltf_of
from lcollision_core.meshes.scene_files import as_file_error, scene_of
from lcollision_core.meshes.units import body_size

_SAME = 1e-5
"""Of the body size: how far its rest pose may be off without a word."""


@dataclass(frozen=True, eq=False)
class GltfCharacter:
    """A character as a glTF file has it, beside the one that was read.

    Attributes
    ----------
    character : to be written; the one that was read where that is of a glTF file
    frame : from the coordinates that were read to those of the glTF file
    from_read : (V',) int64 array, for each of its vertices the one that was read
    to_read : (V,) int64 array, the other way
    joints : (J,) int64 array, for each joint of its rig the one that was read
    delays : seconds by which its clips begin later, by their names
    notes : sentences on what a file that is written lacks
    """

    character: Character
    frame: RigidTransform
    from_read: npt.NDArray[np.int64]
    to_read: npt.NDArray[np.int64]
    joints: npt.NDArray[np.int64]
    delays: dict[str, float]
    notes: tuple[str, ...] = ()


def as_gltf(character: Character) -> GltfCharacter:
    """Return a character as the glTF file that gives it back, made of what was read of another.

    Raises
    ------
    MeshFileError : its file is damaged, or too large for GLB.
    """
    joints = np.arange(0 if character.rig is None else len(character.rig.nodes))
    rows = np.arange(len(character.rest_vertices))
    file = character.file
    if is_gltf(character) or file is None:
        still = RigidTransform(np.eye(3), np.zeros(3))
        return GltfCharacter(character, still, rows, rows, joints, {})
    frame = written_frame(character)
    place = np.eye(4)
    place[:3, :3] = frame.scale * frame.rotation
    source = Path(character.source)
    with as_file_error(source, "cannot be written as GLB"):
        made = gltf_of(file.scene, place, character.name, source)
        written = character_of(scene_of(GltfDocument(made.data, source)), source)
        if len(written.joined) != len(made.vertices):
            raise MeshFileError("parts of it would be lost")
        from_read, to_read = np.empty(len(written.rest_vertices), np.int64), np.empty_like(rows)
        from_read[written.joined] = character.joined[made.vertices]
        to_read[character.joined[made.vertices]] = written.joined
        if character.rig is not None and written.rig is not None:
            number = {node: joint for joint, node in enumerate(character.rig.nodes.tolist())}
            if number.keys() != set(written.rig.nodes.tolist()):
                raise MeshFileError("joints of it would be lost")
            joints = np.array([number[node] for node in written.rig.nodes.tolist()])
            rig = replace(written.rig, chosen=character.rig.chosen)
            written = replace(written, rig=rig, name=character.name)
    kind = source.suffix.removeprefix(".").upper()
    notes = [
        f"{kind} can't be written, so {source.name} comes back as GLB, in metres and y up, without "
        "lights and cameras, and its materials keep only base colours and textures",
        *made.notes,
    ]
    if file.mesh.dual.any():
        notes.append("GLB blends skins linearly, so clips look as if dual quaternions were off")
    off = np.abs(written.rest_vertices[to_read] - frame.apply(character.rest_vertices)).max()
    off /= body_size(written.rest_vertices, written.topology)
    if off > _SAME:
        notes.append(f"its rest pose is off by {100.0 * off:.2g} % of the body size in it")
    return GltfCharacter(written, frame, from_read, to_read, joints, made.delays, tuple(notes))


def is_gltf(character: Character) -> bool:
    """Whether a character was read from a glTF file, which exports give back as it is."""
    return Path(character.source).suffix.lower() in GLTF_SUFFIXES


def written_frame(character: Character) -> RigidTransform:
    """Return what brings a character's coordinates to those of the glTF file that is written."""
    if is_gltf(character):
        return RigidTransform(np.eye(3), np.zeros(3))
    return RigidTransform(turn_to_y(character.up), np.zeros(3), character.metres)
