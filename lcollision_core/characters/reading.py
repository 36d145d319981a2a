"""Read a character from its file."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.characters.character import NO_JOINTS, Character, ClipFrames, Rig
from lcollision_core.characters.character_file import CharacterFile
from lcollision_core.characters.loose_ends import with_ends_on_limbs
from lcollision_core.characters.smpl import character_of_smpl
from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.meshes.formats.scene import Scene, ScenePoses, parents_first
from lcollision_core.meshes.formats.smpl import SMPL_SUFFIX, read_smpl
from lcollision_core.meshes.formats.transforms import is_regular
from lcollision_core.meshes.joined import JoinedMesh, join_parts, sample_clip
from lcollision_core.meshes.numbered_names import numbered_where_equal
from lcollision_core.meshes.scene_files import (
    SceneDocument,
    as_file_error,
    open_scene,
    read_scene,
)
from lcollision_core.meshes.topology import FloatArray, Topology
from lcollision_core.meshes.units import body_size, box_corners
from lcollision_core.meshes.upright import guess_up

_HIDDEN = 1e-3
"""Of its scale at rest, below which a part is hidden."""

_SAME = 1e-5
"""Of the body size: what a joint holds of a part to so much, it holds."""

_KEPT = 8
"""Frames whose vertices are kept, of those that the joints do not say."""

_EVEN = 1e-6
"""By which scales along different axes may differ and are rounding."""


def read_character(
    source: str | os.PathLike[str] | SceneDocument,
    up: int | str | None = None,
    topology: Topology | None = None,
) -> Character:
    """Read the meshes, the rig and the clips of a file.

    Parameters
    ----------
    source : a .glb, .gltf, .vrm or .fbx file, or what `open_scene` read of it; or the .npz file of
        a body model of the SMPL family
    up : the up axis where the file is wrong about it: 0, 1, 2, "x", "y" or "z"
    topology : of a model of the character, as which polygons are cut

    Raises
    ------
    MeshFileError : the file is missing, damaged, compressed or too large, or shows no triangles.
        The sentence names the file. A damaged clip is left out, or refused when it is sampled.
    MissingExtraError : the extra `fbx`, which reads FBX, is not installed.
    ShapeError : `up` is no axis.
    """
    if not isinstance(source, SceneDocument) and Path(source).suffix.lower() == SMPL_SUFFIX:
        character = character_of_smpl(read_smpl(source))
    else:
        document = source if isinstance(source, SceneDocument) else open_scene(source)
        character = character_of(read_scene(document), document.path, topology)
    return character if up is None else turned(character, _axis(up))


def turned(character: Character, axis: int) -> Character:
    """Return a character whose axis 0, 1 or 2 is up, whatever its file says."""
    return replace(character, up=np.eye(3)[axis], up_is_sure=True)


def as_read(character: Character) -> Character:
    """Return a character as its file has it, without what was chosen for it."""
    if character.smpl is not None and character.rig is not None:
        return turned(replace(character, rig=replace(character.rig, chosen={})), 1)
    if character.file is None or character.rig is None:
        return character
    up, is_sure = _up(character.file.scene, character.file.mesh, character.rest_vertices)
    return replace(character, up=up, up_is_sure=is_sure, rig=replace(character.rig, chosen={}))


def _up(scene: Scene, mesh: JoinedMesh, rest_vertices: FloatArray) -> tuple[FloatArray, bool]:
    """Return `Character.up` and `Character.up_is_sure`."""
    if scene.up is not None:
        return scene.up, True
    guess = guess_up(mesh.topology, rest_vertices[None])
    return np.eye(3)[guess.axis], guess.is_sure


def character_of(scene: Scene, path: Path, topology: Topology | None = None) -> Character:
    """Make a character of what a file shows.

    Parameters
    ----------
    scene : without scenery
    path : of the file
    topology : of a model of the character, as which polygons are cut

    Raises
    ------
    MeshFileError : it is damaged.
    """
    with as_file_error(path):
        mesh = join_parts(scene).cut_as(topology)
        rest = mesh.posed(scene.rest)[0]
        size = body_size(rest, mesh.topology)
        rig, notes = _rig(scene, mesh, rest, size)
        lengths, damaged = _clip_lengths(scene)

    def sample(clip: str, fps: float | FloatArray | None) -> ClipFrames:
        with as_file_error(path):
            times, poses = sample_clip(scene, clip, fps)

        def skin() -> FloatArray:
            with as_file_error(path):
                return mesh.posed(poses)

        names = tuple(f"{clip} {frame}" for frame in range(len(times)))
        if rig is None:
            return ClipFrames(clip, names, times, None, skin)

        # A check asks for what a frame shows, and for what that hides.
        @lru_cache(maxsize=_KEPT)
        def show(frame: int) -> FloatArray:
            with as_file_error(path):
                vertices: FloatArray = mesh.posed(poses.part(frame))[0]
                return vertices

        beyond = _beyond_joints(scene, mesh, rig, size, poses)
        shown = {frame: partial(show, frame) for frame in beyond.tolist()}
        return ClipFrames(clip, names, times, poses.transforms[:, rig.nodes], skin, shown)

    return Character(
        path.stem,
        path,
        mesh.topology,
        rest,
        mesh.joined,
        *_up(scene, mesh, rest),
        scene.metres,
        mesh.groups,
        rig,
        lengths,
        sample,
        mesh.notes + notes + damaged,
        NO_JOINTS if rig is not None or not notes else f"cannot be posed by its rig: {notes[0]}",
        CharacterFile(scene, mesh),
    )


def _clip_lengths(scene: Scene) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return `Character.clips`, and sentences on clips whose key times are damaged."""
    lengths, notes = {}, []
    for clip in scene.clips:
        try:
            lengths[clip.name] = float(np.ptp(clip.key_times))
        except MeshFileError as error:
            notes.append(f"its clip {clip.name!r} is left out: {error.headline}")
    return lengths, tuple(notes)


def _beyond_joints(
    scene: Scene, mesh: JoinedMesh, rig: Rig, size: float, poses: ScenePoses
) -> npt.NDArray[np.intp]:
    """Return the poses that the joints do not say: morphs, and parts that are hidden or grow."""
    is_beyond = np.zeros(len(poses.transforms), dtype=np.bool_)
    for weights, at_rest in zip(poses.weights, scene.rest.weights, strict=True):
        is_beyond |= (weights != at_rest).any(axis=1)
    used = np.unique(mesh.bone_of[mesh.weights > 0.0])
    carrier = np.zeros(len(mesh.bones), dtype=np.int64)
    carrier[mesh.bone_of] = rig.nodes[rig.joint_of]
    moved, rest = np.unique(mesh.bones[used]), scene.rest.transforms[0]
    least = _HIDDEN * np.linalg.norm(rest[moved, :3, :3], axis=(1, 2))
    sizes = np.linalg.norm(poses.transforms[:, moved, :3, :3], axis=(2, 3))
    is_beyond |= (sizes < least).any(axis=1)
    # What hangs on a joint may yet have a motion of its own where a clip shows and hides it.
    used = used[carrier[used] != mesh.bones[used]]
    for bone in used.tolist():
        node, joint = mesh.bones[bone], carrier[bone]
        # A joint may have no size at rest.
        held = np.linalg.pinv(rest[joint]) @ rest[node]
        at = mesh.bind[bone] @ box_corners(mesh.points[(mesh.bone_of == bone).any(axis=1)])
        off = (poses.transforms[:, node] - poses.transforms[:, joint] @ held) @ at
        is_beyond |= np.abs(off).max(axis=(1, 2)) > _SAME * size
    return np.flatnonzero(is_beyond)


def _axis(up: int | str) -> int:
    if up in ("x", "y", "z"):
        return "xyz".index(str(up))
    if up in (0, 1, 2):
        return int(up)
    raise ShapeError.must_be("up", "0, 1, 2, 'x', 'y' or 'z'", repr(up))


def _rig(
    scene: Scene, mesh: JoinedMesh, rest_vertices: FloatArray, size: float
) -> tuple[Rig | None, tuple[str, ...]]:
    """Return the skeleton of what is skinned, and notes."""
    in_skins = {bone for part in scene.parts if part.is_skinned for bone in part.bones.tolist()}
    if not in_skins:
        return None, ()
    anchors = _anchors(scene, in_skins)
    rest = scene.rest.transforms[0]
    moving = np.unique(mesh.bone_of[mesh.weights > 0.0])
    used = {anchors[bone] for bone in mesh.bones[moving].tolist()}
    if -1 in used:
        flat = min(bone for bone in mesh.bones[moving].tolist() if anchors[bone] < 0)
        name = scene.node_names[flat] or f"node {flat}"
        return None, (f"joint {name} has zero scale in its rest pose",)
    order = [
        node
        for node in parents_first(scene.parents)
        if node in used or (node in in_skins and is_regular(rest[node]))
    ]
    joint = {node: number for number, node in enumerate(order)}
    # A bone of no weight may be no joint.
    joint_of_bone = np.array([joint.get(anchors[bone], 0) for bone in mesh.bones.tolist()])
    placed = rest[mesh.bones] @ mesh.bind
    points = mesh.morphed(tuple(weights[0] for weights in scene.rest.weights))
    turns = placed[mesh.bone_of]
    at_rest = np.einsum("vijk,vk->vij", turns[..., :3, :3], points) + turns[..., :3, 3]
    notes: tuple[str, ...] = ()
    if mesh.dual.any():
        at_rest[mesh.dual > 0.0] = rest_vertices[mesh.dual > 0.0, None]
        notes = (
            "its file blends the skin by dual quaternions, but its poses are blended linearly",
        )
    rig = Rig(
        tuple(numbered_where_equal(scene.node_names[node] or f"node {node}" for node in order)),
        np.array([_parent_joint(scene, node, joint) for node in order], dtype=np.int64),
        rest[order],
        np.array(order, dtype=np.int64),
        joint_of_bone[mesh.bone_of].astype(np.int32),
        mesh.weights,
        at_rest,
        stretch=_stretch(scene, order),
    )
    rig, on_ends = with_ends_on_limbs(rig, mesh.topology, rest_vertices, size)
    return rig, notes + on_ends


def _stretch(scene: Scene, order: list[int]) -> FloatArray | None:
    """Return `Rig.stretch` of the nodes that are joints."""
    above = np.broadcast_to(np.eye(3), (len(order), 3, 3)).copy()
    for number, node in enumerate(order):
        if scene.parents[node] >= 0 and node not in scene.unscaled:
            above[number] = scene.rest.transforms[0, scene.parents[node], :3, :3]
    axes, sizes, _ = np.linalg.svd(above)
    sizes /= sizes[:, :1]
    is_even = sizes[:, 2] > 1.0 - _EVEN
    sizes[is_even], axes[is_even] = 1.0, np.eye(3)
    return None if is_even.all() else (axes * sizes[:, None]) @ np.swapaxes(axes, 1, 2)


def _parent_joint(scene: Scene, node: int, joint: dict[int, int]) -> int:
    parent = int(scene.parents[node])
    while parent >= 0 and parent not in joint:
        parent = int(scene.parents[parent])
    return joint.get(parent, -1)


def _anchors(scene: Scene, in_skins: set[int]) -> dict[int, int]:
    """Return for each node that moves vertices the one that is to be the joint.

    What hangs on a joint of a skin without moving in any clip is part of that joint, and so is what
    a node scaled to nothing moves, as accessories are hidden.
    """
    moved = frozenset[int]().union(*(clip.moved for clip in scene.clips))
    rest = scene.rest.transforms[0]
    anchors = {}
    for bone in {bone for part in scene.parts for bone in part.bones.tolist()}:
        node, carriers = bone, in_skins if bone in in_skins else in_skins | moved
        while node >= 0 and not (node in carriers and is_regular(rest[node])):
            node = int(scene.parents[node])
        anchors[bone] = node if node in in_skins or not is_regular(rest[bone]) else bone
    return anchors
