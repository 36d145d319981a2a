"""A skeleton in motion, and how it is made of the nodes of a scene, with or without meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import MeshFileError
from lcollision_core.files.scene.joined import sample_clip
from lcollision_core.files.scene.scene import Clip, Scene, nearest_above, parents_first
from lcollision_core.files.scene.transforms import are_regular
from lcollision_core.meshes.topology import FloatArray, evenly_spaced

_SAME_AXIS = 0.5
"""Cosine that separates parallel axes from perpendicular ones."""


_SHORT = 1e-9
"""Length below which a vector counts as zero."""


@dataclass(frozen=True, eq=False)
class SkeletonMotion:
    """A skeleton in motion, in the file's unit, whatever the format.

    Attributes
    ----------
    name : name of the clip
    names : J names of the joints
    parents : (J,) int64 array, -1 for a root; parents come before children
    offsets : (J, 3) rest position of each joint relative to its parent
    ends : (J, 3) ends of the bones relative to their joints; NaN if unknown
    axes : (J, 3, 3) rotations from each joint's local axes to the world at rest; None for BVH,
        whose joints all have the same
    times : (T,) in seconds, from 0
    up : (3,) unit vector, an axis; None if the file does not define it
    turns : (T, J, 3, 3) rotations of the joints from rest, relative to their parents
    places : (T, J, 3) positions of the joints relative to their parents; a root's is global
    notes : sentences on what was left out
    """

    name: str
    names: tuple[str, ...]
    parents: npt.NDArray[np.int64]
    offsets: FloatArray
    ends: FloatArray
    axes: FloatArray | None
    times: FloatArray
    up: FloatArray | None
    turns: FloatArray
    places: FloatArray
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return T, the number of frames."""
        return len(self.times)


def motion_of_nodes(
    scene: Scene,
    clip: Clip,
    nodes: Sequence[int],
    names: Sequence[str],
    fps: float | FloatArray | None = None,
) -> SkeletonMotion:
    """Return the motion of some nodes of a scene; scales are ignored.

    Parameters
    ----------
    scene : scene of the clip
    clip : the clip to sample
    nodes : parents before children
    names : names of the nodes
    fps : frames per second; None for the rate of the clip's keys, or the (T,) times of the frames

    Raises
    ------
    MeshFileError : the clip is damaged or too long.
    """
    if fps is None and len(clip.key_times) > 1:
        fps = clip.rate
    times, poses = sample_clip(scene, clip.name, fps)
    number = {node: joint for joint, node in enumerate(nodes)}
    parents = np.array(
        [number.get(nearest_above(scene.parents, node, number), -1) for node in nodes], np.int64
    )
    order = list(nodes)
    rest, moved = scene.rest.transforms[0, order], poses.transforms[:, order]
    at_rest, in_motion = rotations_of(rest), rotations_of(moved)
    axes = _bound_axes(scene, order, at_rest)
    world = in_motion @ np.swapaxes(axes, -2, -1)
    turns, places = relative_to_parents(parents, world, moved[..., :3, 3])
    offsets = rest[:, :3, 3].copy()
    # A joint that the bind pose turns carries its children along.
    changed = axes @ np.swapaxes(at_rest, -2, -1)
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            offsets[joint] = changed[parent] @ (rest[joint, :3, 3] - rest[parent, :3, 3])
    ends = np.full(offsets.shape, np.nan)
    since, up = times - times[0], scene.up
    return SkeletonMotion(
        clip.name, tuple(names), parents, offsets, ends, axes, since, up, turns, places
    )


def relative_to_parents(
    parents: npt.NDArray[np.int64], turns: FloatArray, places: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (T, J, 3, 3) rotations and (T, J, 3) positions in the world relative to parents."""
    local_turns, local_places = turns.copy(), places.copy()
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            back = np.swapaxes(turns[:, parent], 1, 2)
            local_turns[:, joint] = back @ turns[:, joint]
            way = places[:, joint] - places[:, parent]
            local_places[:, joint] = np.einsum("txy,ty->tx", back, way)
    return local_turns, local_places


def motions_of_scene(
    scene: Scene, clip: str | None = None, fps: float | None = None, most: int | None = None
) -> list[SkeletonMotion]:
    """Return the motions of a scene's skeleton by its clips.

    Parameters
    ----------
    scene : scene of nodes only
    clip : name of one of the clips; None for all
    fps : frames per second; None for the rate of the clips' keys
    most : most frames of each clip, evenly spaced; None for all

    Raises
    ------
    MeshFileError : there is no such clip, or it is damaged or too long.
    """
    if not scene.clips:
        raise MeshFileError("it has no animation", "export it with its animation")
    nodes = skeleton_nodes(scene)
    names = [scene.node_names[node] for node in nodes]
    named_clips = [scene_clip for scene_clip in scene.clips if clip in (None, scene_clip.name)]
    if not named_clips:
        # This raises an error that lists the clips.
        sample_clip(scene, clip or "", None)
    motions = []
    for chosen_clip in named_clips:
        rate: float | FloatArray | None = fps
        if most is not None:
            times = chosen_clip.times(fps)
            rate = times[evenly_spaced(len(times), most)]
        motions.append(motion_of_nodes(scene, chosen_clip, nodes, names, rate))
    return motions


def skeleton_nodes(scene: Scene) -> list[int]:
    """Return the nodes of a scene's skeleton, parents first.

    These are the joints of skins and their descendants that show nothing; without skins, all nodes
    that show nothing. Of several trees, it is the one with most such nodes, from the first node
    that moves or branches.
    """
    order, parents = parents_first(scene.parents), scene.parents.tolist()
    below_root: set[int] = set()
    for node in order:
        is_below = not scene.bound or parents[node] in below_root
        if node in scene.bound or (is_below and node not in scene.showing):
            below_root.add(node)
    below = dict.fromkeys(order, 0)
    for node in reversed(order):
        below[node] += node in below_root
        if parents[node] >= 0:
            below[parents[node]] += below[node]
    roots = [node for node in order if parents[node] < 0]
    moved = scene.moved
    root = max(roots, key=lambda node: below[node])
    while root not in moved and root not in scene.bound:
        children = [node for node in order if parents[node] == root and below[node]]
        if len(children) != 1:
            break
        (root,) = children
    nodes = {root}
    for node in order:
        if parents[node] in nodes and below[node]:
            nodes.add(node)
    return [node for node in order if node in nodes]


def rotations_of(transforms: FloatArray) -> FloatArray:
    """Return the (..., 3, 3) rotations nearest to transforms; the identity for singular ones."""
    linear = np.where(are_regular(transforms)[..., None, None], transforms[..., :3, :3], np.eye(3))
    mirrored = np.linalg.det(linear) < 0.0
    left, _, right = np.linalg.svd(linear * np.where(mirrored, -1.0, 1.0)[..., None, None])
    turned: FloatArray = left @ right
    return turned


def _bound_axes(scene: Scene, nodes: Sequence[int], at_rest: FloatArray) -> FloatArray:
    """Return the axes of nodes in the bind pose of the skin, or the stored ones without a skin.

    Parameters
    ----------
    at_rest : (n, 3, 3) rotations as stored
    """
    rows = [row for row, node in enumerate(nodes) if node in scene.bound]
    if not rows:
        return at_rest
    bound = np.stack([scene.bound[nodes[row]] for row in rows])
    regular = are_regular(bound)
    rows = [row for row, is_regular in zip(rows, regular, strict=True) if is_regular]
    axes = at_rest.copy()
    if not rows:
        return axes
    rotations = rotations_of(bound[regular])
    # A mesh may have other axes than the scene.
    axes[rows] = nearest_axes(at_rest[rows] @ np.swapaxes(rotations, 1, 2)) @ rotations
    number = {node: row for row, node in enumerate(nodes)}
    for row, node in enumerate(nodes):
        above = number.get(int(scene.parents[node]), -1)
        if row not in rows and above >= 0:
            axes[row] = axes[above] @ at_rest[above].T @ at_rest[row]
    return axes


def nearest_axes(
    rotations: FloatArray, one: FloatArray | None = None, other: FloatArray | None = None
) -> FloatArray:
    """Return the (3, 3) rotation by quarter turns that is nearest to (n, 3, 3) rotations overall.

    Parameters
    ----------
    one, other : if given, the rotation must take the first axis to the second
    """
    quarters = scipy.spatial.transform.Rotation.create_group("O").as_matrix().round()
    if one is not None and other is not None:
        quarters = quarters[(quarters @ one) @ other > _SAME_AXIS]
    nearest: FloatArray = quarters[np.einsum("qij,nij->q", quarters, rotations).argmax()]
    return nearest


def least_turns(ways: FloatArray, others: FloatArray) -> FloatArray:
    """Return the (N, 3, 3) smallest rotations from (N, 3) directions to others.

    It is the identity for zero vectors and for opposite directions, whose rotation is ambiguous.
    """
    a = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), _SHORT)
    b = others / np.maximum(np.linalg.norm(others, axis=1, keepdims=True), _SHORT)
    axis, cosine = np.cross(a, b), np.einsum("nx,nx->n", a, b)
    cross = np.zeros((len(a), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = axis
    cross[:, [1, 2, 0], [2, 0, 1]] = -axis
    share = (1.0 - cosine) / np.maximum(np.einsum("nx,nx->n", axis, axis), _SHORT**2)
    turned: FloatArray = np.eye(3) + cross + cross @ cross * share[:, None, None]
    return turned
