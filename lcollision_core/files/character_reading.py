"""Read a character from a file of any format, and convert it to glTF."""

from __future__ import annotations

import os
from collections.abc import Callable, Container
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.files.character import (
    NO_JOINTS,
    Character,
    CharacterFile,
    ClipFrames,
    Rig,
    Shapes,
)
from lcollision_core.files.formats import GLTF_SUFFIXES, SMPL_SUFFIX
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.files.gltf.write import gltf_of
from lcollision_core.files.mesh_file import turn_to_y
from lcollision_core.files.motion.smpl import SmplModel, read_smpl
from lcollision_core.files.safe import make_unique
from lcollision_core.files.scene.joined import JoinedMesh, join_parts, sample_clip
from lcollision_core.files.scene.scene import Scene, ScenePoses, nearest_above, parents_first
from lcollision_core.files.scene.transforms import is_regular
from lcollision_core.files.scene_files import (
    SceneDocument,
    as_file_error,
    open_scene,
    read_scene,
    scene_of,
)
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.extents import body_size, box_corners, guess_up
from lcollision_core.meshes.topology import FloatArray, Topology
from lcollision_core.meshes.trees import ancestry

_NEAR, _NEARLY = 0.05, 1.5
"""Separate pieces, as of a robot, adjoin vertices within the first distance, normalised, and within
the second one times that of the nearest vertex."""

_AT_END = 0.2
"""Largest distance of a loose joint from the skin of the limb that it ends, normalised."""

_SAME_PLACE = 0.02
"""Largest distance of two joints in the same place, normalised."""

_LEAST_CHAIN = 2
"""Fewest joints of a limb that lead vertices: a limb has at least a knee before its end."""


def with_ends_on_limbs(
    rig: Rig, topology: Topology, rest_vertices: FloatArray, body_size: float
) -> tuple[Rig, tuple[str, ...]]:
    """Attach each loose end of a limb to the limb, so that they move together.

    A paw or foot is loose if it hangs on the root beside its limb, and its surface continues in
    that of the last joint of a limb but in that of none of its ancestors. The joints' global
    transforms in poses are not affected.

    Parameters
    ----------
    rig, topology, rest_vertices : of the character, in its unit
    body_size : in the same unit

    Returns
    -------
    rig : its joints may be in another order; see `Rig.file_parents`
    notes : a sentence that names the ends, if there are any
    """
    parents, led_by = rig.parents.tolist(), rig.heaviest
    carries = ancestry(rig.parents).T
    n_led = np.bincount(led_by, minlength=len(parents))
    ends: dict[int, int] = {}
    for joint in _hanging_on_nothing(rig, n_led, carries):
        inside = carries[joint][led_by]
        near = _NEAR * body_size
        joined = _joined(inside, led_by, topology, rest_vertices, len(parents), near)
        if not joined.any() or joined[carries[:, joint]].any():
            continue
        end = _end(rig, joined, joint, n_led, carries, _SAME_PLACE * body_size)
        away = np.linalg.norm(rest_vertices[led_by == end] - rig.rest[joint, :3, 3], axis=1)
        way, common = carries[:, end], carries[:, end] & carries[:, joint]
        branch = int(np.flatnonzero(common)[-1]) if common.any() else -1
        if (
            parents[joint] == branch
            and int((n_led[way & ~common] > 0).sum()) >= _LEAST_CHAIN
            and n_led[carries[end]].sum() == n_led[end]
            and away.min() <= _AT_END * body_size
        ):
            ends[joint] = end
    if not ends:
        return rig, ()
    hung = rig.parents.copy()
    hung[list(ends)] = list(ends.values())
    names = ", ".join(
        f"{rig.joint_names[joint]} with {rig.joint_names[end]}" for joint, end in ends.items()
    )
    note = (
        "some joints (IK targets) are attached beside the limb they end; here they move with it: "
        f"{names}"
    )
    return _in_order(replace(rig, parents=hung, file_parents=rig.parents)), (note,)


def _hanging_on_nothing(
    rig: Rig, n_led: npt.NDArray[np.int64], carries: npt.NDArray[np.bool_]
) -> list[int]:
    """Return the joints that carry less than half the vertices, below joints that lead none."""
    carried = carries @ n_led
    return [
        joint
        for joint, parent in enumerate(rig.parents.tolist())
        if 0 < 2 * carried[joint] < n_led.sum()
        and (parent < 0 or not n_led[carries[:, parent]].any())
    ]


def _joined(
    inside: npt.NDArray[np.bool_],
    led_by: npt.NDArray[np.int32],
    topology: Topology,
    rest_vertices: FloatArray,
    n_joints: int,
    near: float,
) -> npt.NDArray[np.int64]:
    """Count, per joint, the vertices that adjoin the vertices `inside`, (J,).

    If none does, count nearby vertices.
    """
    edges = topology.edges
    across = edges[inside[edges[:, 0]] != inside[edges[:, 1]]]
    beyond = np.unique(across[~inside[across]])
    if not len(beyond):
        used = topology.used_vertices
        others, inside_rows = used[~inside[used]], used[inside[used]]
        if len(inside_rows) and len(others):
            away, _ = scipy.spatial.cKDTree(rest_vertices[inside_rows]).query(rest_vertices[others])
            beyond = others[away <= min(near, _NEARLY * away.min())]
    joined: npt.NDArray[np.int64] = np.bincount(led_by[beyond], minlength=n_joints)
    return joined


def _end(
    rig: Rig,
    joined: npt.NDArray[np.int64],
    loose: int,
    n_led: npt.NDArray[np.int64],
    carries: npt.NDArray[np.bool_],
    near: float,
) -> int:
    """Return the last joint of the limb that adjoins the surface or position of a loose one."""
    away = np.linalg.norm(rig.rest[:, :3, 3] - rig.rest[loose, :3, 3], axis=1)
    below = carries[joined.argmax()] & (n_led > 0) & ((joined > 0) | (away <= near))
    return int(np.flatnonzero(below)[-1])


def _in_order(rig: Rig) -> Rig:
    """Reorder the joints of a rig so that parents come before children."""
    order = np.array(parents_first(rig.parents))
    number = np.empty(len(order) + 1, dtype=np.int64)
    number[order], number[-1] = np.arange(len(order)), -1
    assert rig.file_parents is not None
    return replace(
        rig,
        joint_names=tuple(rig.joint_names[joint] for joint in order),
        parents=number[rig.parents[order]],
        file_parents=number[rig.file_parents[order]],
        rest=rig.rest[order],
        nodes=rig.nodes[order],
        joint_of=number[rig.joint_of].astype(np.int32),
        stretch=None if rig.stretch is None else rig.stretch[order],
    )


def character_of_smpl(
    model: SmplModel, betas: FloatArray | None = None, moving: Container[str] | None = None
) -> Character:
    """Make a character from a body model, whose joints turn about any axis.

    Parameters
    ----------
    betas : (n,) shape, of which numbers beyond the model's are ignored; None for the mean shape
    moving : names of the joints that turn; None for all
    """
    shape = np.zeros(0) if betas is None else betas[: model.shape_directions.shape[2]]
    vertices, joints = model.shaped(shape)
    rest = np.broadcast_to(np.eye(4), (len(joints), 4, 4)).copy()
    rest[:, :3, 3] = joints
    n_most = int((model.weights > 0.0).sum(axis=1).max())
    order = np.argsort(-model.weights, axis=1, kind="stable")[:, :n_most]
    rig = Rig(
        model.names,
        model.parents,
        rest,
        np.arange(len(joints)),
        order.astype(np.int32),
        np.take_along_axis(model.weights, order, axis=1),
        np.repeat(vertices[:, None], n_most, axis=1),
        moving=np.array([moving is None or name in moving for name in model.names]),
        pose_shapes=model.pose_directions,
    )
    up = np.array([0.0, 1.0, 0.0])
    return Character.without_clips(model.path, model.topology, vertices, up, rig, smpl=model)


_HIDDEN = 1e-3
"""Fraction of its scale at rest below which a part is hidden."""

_SAME = 1e-5
"""Largest deviation, in body sizes, that is ignored: of a part from its joint, or of a written rest
pose."""

_SAME_WEIGHT = 1e-6
"""Largest difference of morph target weights that is rounding error."""

_EVEN = 1e-6
"""Largest relative difference of scales along different axes that is rounding error."""


def read_character(
    source: str | os.PathLike[str] | SceneDocument,
    up: int | str | None = None,
    topology: Topology | None = None,
) -> Character:
    """Read the meshes, the rig and the clips of a file.

    Parameters
    ----------
    source : a .glb, .gltf, .vrm or .fbx file, or the result of `open_scene`; or the .npz file of a
        body model of the SMPL family
    up : up axis, 0, 1, 2, "x", "y" or "z", if the file's is wrong
    topology : topology of a model of the character, whose triangulation of polygons is used

    Raises
    ------
    MeshFileError : the file is missing, damaged, compressed or too large, or shows no triangles.
        The message names the file. A damaged clip is left out, or refused when it is sampled.
    MissingExtraError : the extra `fbx`, which reads FBX, is not installed.
    ShapeError : `up` is not an axis.
    """
    if not isinstance(source, SceneDocument) and Path(source).suffix.lower() == SMPL_SUFFIX:
        character = character_of_smpl(read_smpl(source))
    else:
        document = source if isinstance(source, SceneDocument) else open_scene(source)
        character = character_of(read_scene(document), document.path, topology)
    return character if up is None else with_up_axis(character, _axis(up))


def with_up_axis(character: Character, axis: int) -> Character:
    """Return a character with the up axis 0, 1 or 2, whatever its file says."""
    return replace(character, up=np.eye(3)[axis], up_is_sure=True)


def without_user_choices(character: Character) -> Character:
    """Return a character as in its file, without the user's choices of up axis and roles."""
    if character.smpl is not None and character.rig is not None:
        return with_up_axis(replace(character, rig=replace(character.rig, chosen={})), 1)
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
    """Make a character from the scene of a file.

    Parameters
    ----------
    scene : the scene without scenery
    path : path of the file
    topology : topology of a model of the character, whose triangulation of polygons is used

    Raises
    ------
    MeshFileError : the scene is damaged.
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
            return ClipFrames(names, times, None, skin)

        shapes, at_rest = rig.shapes, scene.rest.weights
        numbers = None if shapes is None else shapes.numbers(poses.weights, at_rest)
        points = _points_of_frames(scene, mesh, rig, size, poses, numbers)
        return ClipFrames(names, times, poses.transforms[:, rig.nodes], skin, points, numbers)

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


def character_of_gltf(data: bytes, path: Path) -> Character:
    """Make a character from the bytes of a glTF file, which errors call `path`.

    Raises
    ------
    MeshFileError : see `read_character`.
    """
    with as_file_error(path):
        scene = scene_of(GltfDocument(data, path))
    return character_of(scene, path)


def _clip_lengths(scene: Scene) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return `Character.clips`, and notes on clips whose key times are damaged."""
    lengths, notes = {}, []
    for clip in scene.clips:
        try:
            lengths[clip.name] = float(np.ptp(clip.key_times))
        except MeshFileError as error:
            notes.append(f"its clip {clip.name!r} is left out: {error.headline}")
    return lengths, tuple(notes)


def _points_of_frames(
    scene: Scene,
    mesh: JoinedMesh,
    rig: Rig,
    size: float,
    poses: ScenePoses,
    numbers: FloatArray | None,
) -> dict[int, Callable[[], FloatArray]]:
    """Return `ClipFrames.points` for frames in which parts are hidden or move on their joint.

    Include frames whose morph target weights differ from those of the (N, S) slider values.
    """
    is_own = np.zeros(len(poses.transforms), dtype=np.bool_)
    held_by = scene.rest.weights
    if rig.shapes is not None and numbers is not None:
        held_by = rig.shapes.weights(numbers, scene.rest.weights)
    for part, weights, others in zip(scene.parts, poses.weights, held_by, strict=True):
        moves = part.morphs.any(axis=(1, 2))
        is_own |= (np.abs(weights - others)[:, moves] > _SAME_WEIGHT).any(axis=1)
    used = np.unique(mesh.bone_of[mesh.weights > 0.0])
    carrier = np.zeros(len(mesh.bones), dtype=np.int64)
    carrier[mesh.bone_of] = rig.nodes[rig.joint_of]
    moved, rest = np.unique(mesh.bones[used]), scene.rest.transforms[0]
    least = _HIDDEN * np.linalg.norm(rest[moved, :3, :3], axis=(1, 2))
    sizes = np.linalg.norm(poses.transforms[:, moved, :3, :3], axis=(2, 3))
    is_own |= (sizes < least).any(axis=1)
    # A part fixed to a joint may still move on it, in clips that show and hide the part.
    carried = used[carrier[used] != mesh.bones[used]]
    transforms = np.broadcast_to(rest[mesh.bones], (len(is_own), len(mesh.bones), 4, 4)).copy()
    for bone in carried.tolist():
        node, joint = mesh.bones[bone], carrier[bone]
        # A joint's transform may be singular.
        back = rest[joint] @ np.linalg.pinv(poses.transforms[:, joint])
        now = back @ poses.transforms[:, node]
        at = mesh.bind[bone] @ box_corners(mesh.points[(mesh.bone_of == bone).any(axis=1)])
        is_off = np.abs((now - rest[node]) @ at).max(axis=(1, 2)) > _SAME * size
        transforms[is_off, bone] = now[is_off]
        is_own |= is_off
    frames = np.flatnonzero(is_own)
    if not len(frames):
        return {}
    part_weights = [of_part[frames] for of_part in poses.weights]
    values = np.concatenate(
        [*part_weights, transforms[frames][:, carried].reshape(len(frames), -1)], axis=1
    )
    _, first, kind = np.unique(values, axis=0, return_index=True, return_inverse=True)

    def made(at: int) -> FloatArray:
        points = _points(
            scene, mesh, transforms[frames[at]], tuple(one[at] for one in part_weights)
        )
        if rig.shapes is not None and numbers is not None:
            points[rig.weights > 0.0] -= rig.shapes.offsets(numbers[frames[at]])
        return points

    makers = [partial(made, at) for at in first.tolist()]
    return {frame: makers[at] for frame, at in zip(frames.tolist(), kind.ravel(), strict=True)}


def _shapes(scene: Scene, mesh: JoinedMesh, weights: FloatArray) -> Shapes | None:
    """Return the sliders of the parts, for a rig of (V, I) weights; None if none has an effect."""
    names = tuple(dict.fromkeys(name for part in scene.parts for name in part.sliders))
    if not names:
        return None
    turns, weighing = mesh.linear_parts(scene.rest.transforms[0]), weights > 0.0
    row_of = np.cumsum(weighing.reshape(-1)).reshape(weighing.shape) - 1
    columns = []
    for name in names:
        rows, values = [np.empty(0, dtype=np.int64)], [np.empty(0)]
        for morphs in mesh.morphs:
            mix = scene.parts[morphs.part].sliders.get(name)
            if mix is None:
                continue
            used = np.flatnonzero(mix)
            added = np.tensordot(mix[used], morphs.deltas[used], axes=1)
            moved = np.flatnonzero(added.any(axis=1))
            vertices = morphs.vertices[moved]
            shape_weights = weighing[vertices]
            by_bone = np.einsum("vijk,vk->vij", turns[vertices], added[moved])[shape_weights]
            rows.append((3 * row_of[vertices][shape_weights][:, None] + np.arange(3)).reshape(-1))
            values.append(by_bone.reshape(-1))
        columns.append((np.concatenate(rows), np.concatenate(values)))
    shape_numbers = [number for number, (rows, _) in enumerate(columns) if len(rows)]
    if not shape_numbers:
        return None
    ends = np.cumsum([0, *(len(columns[number][0]) for number in shape_numbers)])
    parts = (
        np.concatenate([columns[number][place] for number in shape_numbers]) for place in (1, 0)
    )
    deltas = scipy.sparse.csc_matrix(
        (*parts, ends), shape=(3 * int(weighing.sum()), len(shape_numbers))
    )
    names = tuple(names[number] for number in shape_numbers)
    mixes, sources = [], np.full((len(names), 2), -1)
    weights = np.zeros(len(names))
    for number, (part, at_rest) in enumerate(zip(scene.parts, scene.rest.weights, strict=True)):
        mix = np.array([part.sliders.get(name, np.zeros(len(part.morphs))) for name in names])
        mixes.append(mix)
        alone = ((mix != 0.0).sum(axis=1) == 1) & (mix.max(axis=1, initial=0.0) == 1.0)
        for slider in np.flatnonzero(alone & (sources[:, 0] < 0)).tolist():
            target = int(mix[slider].argmax())
            # If two sliders are the same target, clips set the second, as the first is an
            # expression.
            sources[(sources == [number, target]).all(axis=1)] = -1
            sources[slider] = number, target
            weights[slider] = at_rest[0, target]
    low, high = np.minimum(0.0 - weights, 0.0), np.maximum(1.0 - weights, 0.0)
    weights = np.where(sources[:, 0] >= 0, weights, 0.0)
    return Shapes(names, low, high, weights, tuple(mixes), sources, deltas)


def _points(
    scene: Scene, mesh: JoinedMesh, transforms: FloatArray, weights: tuple[FloatArray, ...]
) -> FloatArray:
    """Return `Rig.points`, (V, I, 3), with (B, 4, 4) transforms of the bones and morph weights."""
    turns = (transforms @ mesh.bind)[mesh.bone_of]
    points: FloatArray = np.einsum("vijk,vk->vij", turns[..., :3, :3], mesh.morphed(weights))
    points += turns[..., :3, 3]
    if mesh.dual.any():
        at_rest = ScenePoses(scene.rest.transforms, tuple(of_part[None] for of_part in weights))
        points[mesh.dual > 0.0] = mesh.posed(at_rest)[0][mesh.dual > 0.0, None]
    return points


def _axis(up: int | str) -> int:
    if up in ("x", "y", "z"):
        return "xyz".index(str(up))
    if up in (0, 1, 2):
        return int(up)
    raise ShapeError.must_be("up", "0, 1, 2, 'x', 'y' or 'z'", repr(up))


def _rig(
    scene: Scene, mesh: JoinedMesh, rest_vertices: FloatArray, size: float
) -> tuple[Rig | None, tuple[str, ...]]:
    """Return the rig of the skinned parts, None without a usable one, and notes."""
    in_skins = scene.joints
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
    # A bone without weight need not be a joint.
    joint_of_bone = np.array([joint.get(anchors[bone], 0) for bone in mesh.bones.tolist()])
    weights = tuple(of_part[0] for of_part in scene.rest.weights)
    at_rest = _points(scene, mesh, rest[mesh.bones], weights)
    notes: tuple[str, ...] = ()
    if mesh.dual.any():
        notes = (
            "its file blends the skin by dual quaternions, but its poses are blended linearly",
        )
    rig = Rig(
        tuple(make_unique(scene.node_names[node] or f"node {node}" for node in order)),
        np.array(
            [joint.get(nearest_above(scene.parents, node, joint), -1) for node in order], np.int64
        ),
        rest[order],
        np.array(order, dtype=np.int64),
        joint_of_bone[mesh.bone_of].astype(np.int32),
        mesh.weights,
        at_rest,
        stretch=_stretch(scene, order),
        shapes=_shapes(scene, mesh, mesh.weights),
    )
    rig, on_ends = with_ends_on_limbs(rig, mesh.topology, rest_vertices, size)
    return rig, notes + on_ends


def _stretch(scene: Scene, order: list[int]) -> FloatArray | None:
    """Return `Rig.stretch` for the joints' nodes."""
    above = np.broadcast_to(np.eye(3), (len(order), 3, 3)).copy()
    for number, node in enumerate(order):
        if scene.parents[node] >= 0 and node not in scene.unscaled:
            above[number] = scene.rest.transforms[0, scene.parents[node], :3, :3]
    axes, sizes, _ = np.linalg.svd(above)
    sizes /= sizes[:, :1]
    is_even = sizes[:, 2] > 1.0 - _EVEN
    sizes[is_even], axes[is_even] = 1.0, np.eye(3)
    return None if is_even.all() else (axes * sizes[:, None]) @ np.swapaxes(axes, 1, 2)


def _anchors(scene: Scene, in_skins: set[int]) -> dict[int, int]:
    """Return the node that serves as the joint of each node that moves vertices, -1 if none can.

    A node below a joint of a skin that no clip moves is part of that joint, and so is a node of
    zero scale, which is how accessories are hidden.
    """
    rest, movers = scene.rest.transforms[0], in_skins | scene.moved
    anchors = {}
    for bone in {bone for part in scene.parts for bone in part.bones.tolist()}:
        node, carriers = bone, in_skins if bone in in_skins else movers
        while node >= 0 and not (node in carriers and is_regular(rest[node])):
            node = int(scene.parents[node])
        anchors[bone] = node if node in in_skins or not is_regular(rest[bone]) else bone
    return anchors


@dataclass(frozen=True, eq=False)
class GltfCharacter:
    """A character converted to glTF, and how it maps to the original.

    Attributes
    ----------
    character : the converted character; the original if that is from a glTF file
    frame : transform from the original's coordinates to those of the glTF file
    from_read : (V',) int64 array, the original vertex of each of its vertices
    to_read : (V,) int64 array, the inverse map
    joints : (J,) int64 array, the original joint of each joint of its rig
    delays : seconds by which its clips begin later, by name
    notes : sentences on what the written file lacks
    """

    character: Character
    frame: RigidTransform
    from_read: npt.NDArray[np.int64]
    to_read: npt.NDArray[np.int64]
    joints: npt.NDArray[np.int64]
    delays: dict[str, float]
    notes: tuple[str, ...] = ()


def as_gltf(character: Character) -> GltfCharacter:
    """Convert a character from a file of another format to glTF; keep one from a glTF file.

    Raises
    ------
    MeshFileError : its file is damaged, too large for GLB, or would lose parts or joints.
    """
    joints = np.arange(0 if character.rig is None else len(character.rig.nodes))
    rows = np.arange(len(character.rest_vertices))
    file = character.file
    if is_gltf(character) or file is None:
        still = RigidTransform(np.eye(3), np.zeros(3))
        return GltfCharacter(character, still, rows, rows, joints, {})
    frame = written_frame(character)
    source = Path(character.source)
    with as_file_error(source, "cannot be written as GLB"):
        document = gltf_of(file.scene, frame.matrix, character.name, source)
        written = character_of(scene_of(GltfDocument(document.data, source)), source)
        if len(written.joined) != len(document.vertices):
            raise MeshFileError("some of its parts would be lost")
        from_read, to_read = np.empty(len(written.rest_vertices), np.int64), np.empty_like(rows)
        from_read[written.joined] = character.joined[document.vertices]
        to_read[character.joined[document.vertices]] = written.joined
        if character.rig is not None and written.rig is not None:
            number = {node: joint for joint, node in enumerate(character.rig.nodes.tolist())}
            if number.keys() != set(written.rig.nodes.tolist()):
                raise MeshFileError("some of its joints would be lost")
            joints = np.array([number[node] for node in written.rig.nodes.tolist()])
            rig = replace(written.rig, chosen=character.rig.chosen)
            written = replace(written, rig=rig, name=character.name)
    kind = source.suffix.removeprefix(".").upper()
    notes = [
        f"{kind} can't be written, so {source.name} comes back as GLB, in metres and y up, without "
        "lights and cameras, and its materials keep only base colours and textures",
        *document.notes,
    ]
    if file.mesh.dual.any():
        notes.append("GLB blends skins linearly, so clips look as if dual quaternions were off")
    off = np.abs(written.rest_vertices[to_read] - frame.apply(character.rest_vertices)).max()
    off /= body_size(written.rest_vertices, written.topology)
    if off > _SAME:
        notes.append(f"its rest pose is off by {100.0 * off:.2g} % of the body size in it")
    return GltfCharacter(written, frame, from_read, to_read, joints, document.delays, tuple(notes))


def is_gltf(character: Character) -> bool:
    """Whether a character was read from a glTF file, which exports keep as it is."""
    return Path(character.source).suffix.lower() in GLTF_SUFFIXES


def written_frame(character: Character) -> RigidTransform:
    """Return the transform from a character's coordinates to those of its written glTF file."""
    if is_gltf(character):
        return RigidTransform(np.eye(3), np.zeros(3))
    return RigidTransform(turn_to_y(character.up), np.zeros(3), character.metres)
