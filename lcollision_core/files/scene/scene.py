"""What a file of a scene holds, whatever its format: nodes, parts that they move, and clips."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.scene.appearance import Appearance
from lcollision_core.files.scene.transforms import are_regular, is_regular
from lcollision_core.meshes.topology import FloatArray

MAX_FRAME_NUMBERS = 1 << 28
"""The most coordinates, and the most numbers of node transforms, that the frames of a clip have."""

MOST_KEYS_PER_SECOND = 30.0
"""Keys that follow faster are no frames of their own."""

LEAST_RATE = 20.0
"""Keys a second, below which a clip is taken to move between its keys."""

_LEAST_STEP = 1e-3
"""Seconds between keys, below which they are one step."""

_SAME_FRAME = 1e-2
"""Of the step from frame to frame, by which a key may be off and still be the frame's."""

_MOST_FRAMES = 1_000_000
_NAMED = 3
"""Meshes that a note names."""

NO_MESH = (
    "it contains an animation, but no mesh",
    "name or open the character that it is to move, or export it with its mesh (on some sites: "
    "with skin)",
)
"""What is wrong with a file of an animation alone where a mesh is needed, and what helps."""


class NoMeshError(MeshFileError):
    """A file holds an animation alone."""


@dataclass(frozen=True, eq=False)
class ScenePoses:
    """N poses of a scene.

    Attributes
    ----------
    transforms : (N, n, 4, 4) float64 array, the nodes' global transforms
    weights : for each part, the (N, M) float64 weights of its morph targets
    """

    transforms: FloatArray
    weights: tuple[FloatArray, ...]

    def part(self, pose: int) -> ScenePoses:
        """Return one of the poses alone."""
        chosen = slice(pose, pose + 1)
        return ScenePoses(
            self.transforms[chosen], tuple(of_part[chosen] for of_part in self.weights)
        )


@dataclass(frozen=True)
class Primitive:
    """What a part is in a glTF file: numbers of its description, and how many there are."""

    node: int
    mesh: int
    primitive: int
    n_vertices: int
    n_instances: int = 1


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one mesh, moved by nodes.

    In a pose whose nodes have the global transforms G, vertex v, its morph deltas added, is
    sum_i weights[v, i] G_b bind[j] points[v] with j = bone_of[v, i] and b = bones[j].

    Attributes
    ----------
    mesh : its name: of the node that shows it, as artists see it, else of the mesh
    materials : names
    material_of : (F,) int64 array, each face's material; what is no index is none
    node : the node that shows it
    points : (W, 3) float64 array
    faces : (F, 3) int64 array, indices from 0 into the part's vertices, checked
    bones : (B,) int64 array, nodes; the node itself where nothing is skinned
    bind : (B, 4, 4) float64 array, from the part's coordinates to each bone's
    bone_of : (W, I) int32 array, indices into `bones`
    weights : (W, I) float64 array >= 0, each row sums to 1
    is_skinned : whether the bones are joints of a skin
    morphs : (M, W, 3) float32 array, what each morph target adds
    sliders : by the names that artists know, the (M,) weights that each adds to those at rest: that
        of one morph target, or of an expression all that it binds
    is_single : whether the file holds the points as float32
    dual : (W,) float64 array, the share in [0, 1] that dual quaternions have of the blend; None
        where it is linear, as above
    look : reads how it looks, which takes long; None where its file does not say that
    shaded_look : the same with the normals, which split points too; None where `look` is, or the
        file can be written itself
    cut_of : (F,) int64 array, ascending, the polygon that each face was cut from; None where each
        is one
    primitive : that it is in a glTF file; None in another
    """

    mesh: str
    materials: tuple[str, ...]
    material_of: npt.NDArray[np.int64]
    node: int
    points: FloatArray
    faces: npt.NDArray[np.int64]
    bones: npt.NDArray[np.int64]
    bind: FloatArray
    bone_of: npt.NDArray[np.int32]
    weights: FloatArray
    is_skinned: bool
    morphs: npt.NDArray[np.float32]
    sliders: Mapping[str, FloatArray] = field(default_factory=dict)
    is_single: bool = False
    dual: FloatArray | None = None
    look: Callable[[], Appearance] | None = None
    shaded_look: Callable[[], Appearance] | None = None
    cut_of: npt.NDArray[np.int64] | None = None
    primitive: Primitive | None = None


@dataclass(frozen=True, eq=False)
class Clip:
    """One animation.

    Attributes
    ----------
    name : unique in the scene
    moved : the nodes that it moves, without those that follow them
    read_key_times : makes `key_times`, which may read the file's arrays
    sample : from (N,) times to the N poses then
    """

    name: str
    moved: frozenset[int]
    read_key_times: Callable[[], FloatArray]
    sample: Callable[[FloatArray], ScenePoses]

    @cached_property
    def key_times(self) -> FloatArray:
        """(T,) float64 array, ascending, in seconds, T > 0.

        Raises
        ------
        MeshFileError : the animation is damaged; `sample` raises it too.
        """
        return self.read_key_times()

    @property
    def rate(self) -> float:
        """Keys a second, by the usual step between them, where there are enough.

        A clip of fewer than `LEAST_RATE` keys a second moves between them: its rate is
        `MOST_KEYS_PER_SECOND`.
        """
        steps = np.diff(self.key_times)
        steps = steps[steps > _LEAST_STEP]
        usual = np.median(steps) if len(steps) else np.inf
        # Keys are stored in single precision: the mean of many steps is right even late in a long
        # clip, and 1 / 24 s is 24 a second only nearly.
        alike = steps[np.abs(steps - usual) < 0.05 * usual]
        rate = 1.0 / float(alike.mean()) if len(alike) else 0.0
        nearest = float(round(rate))
        rate = nearest if abs(rate - nearest) < 1e-4 * rate else rate
        return rate if rate >= LEAST_RATE else MOST_KEYS_PER_SECOND

    def times(self, fps: float | None) -> FloatArray:
        """Return the times of its frames.

        Parameters
        ----------
        fps : frames a second from the first key to the last; None for the keys themselves, without
            those that follow another faster than `MOST_KEYS_PER_SECOND`

        Raises
        ------
        MeshFileError : fps is no number above 0, or there would be too many frames.
        """
        start, end = float(self.key_times[0]), float(self.key_times[-1])
        if fps is None:
            # Keys are stored in single precision: a thousandth of a step is no difference.
            least_step = (1.0 - 1e-3) / MOST_KEYS_PER_SECOND
            kept = [start]
            for time in self.key_times[1:].tolist():
                if time - kept[-1] >= least_step:
                    kept.append(time)
            return np.array(kept)
        if not 0.0 < fps < np.inf:
            raise MeshFileError.must_be("fps", "a number above 0", f"{fps:g}")
        # Keys are stored in single precision: a hundredth of a frame is no difference.
        n_steps = (end - start) * fps + _SAME_FRAME
        if not n_steps < _MOST_FRAMES:
            raise MeshFileError(
                f"its clip {self.name!r} of {end - start:g} s has more than {_MOST_FRAMES} frames "
                f"at {fps:g} a second",
                "choose fewer frames a second",
            )
        times = start + np.arange(int(n_steps) + 1) / fps
        # Just before a key, a value that steps would be the one of the key before.
        middles = 0.5 * (self.key_times[1:] + self.key_times[:-1])
        nearest = self.key_times[np.searchsorted(middles, times)]
        return np.where(np.abs(nearest - times) < _SAME_FRAME / fps, nearest, times)


@dataclass(frozen=True, eq=False)
class Scene:
    """The content of a file.

    Attributes
    ----------
    node_names : as in the file, "" where it has none; of a VRM avatar's bones what they are
    parents : (n,) int64 array, each node's parent, -1 for a root; no circles
    rest : the one pose in which the file stores the nodes
    parts : in the order of the file's meshes, then of the nodes that show each, then of its
        primitives
    clips : its animations
    up : (3,) float64 array, a signed unit axis; None where the file does not say it
    metres : length of the file's unit
    notes : sentences on what was left out
    unscaled : nodes that their parents' scale does not reach, as by Maya's segment scale compensate
    revealed : nodes that the rest pose has elsewhere than the file's, parents first
    showing : nodes that show something; said where the nodes alone were read
    bound : of nodes that carry the largest skin their (4, 4) transforms in its bind pose, in axes
        that they have in common; said where the nodes alone were read
    document : the `GltfDocument`; None for a file of another format
    """

    node_names: tuple[str, ...]
    parents: npt.NDArray[np.int64]
    rest: ScenePoses
    parts: tuple[Part, ...]
    clips: tuple[Clip, ...]
    up: FloatArray | None
    metres: float
    notes: tuple[str, ...] = ()
    unscaled: frozenset[int] = frozenset()
    revealed: tuple[int, ...] = ()
    showing: frozenset[int] = frozenset()
    bound: Mapping[int, FloatArray] = field(default_factory=dict)
    document: Any = None


def by_node(parts: Sequence[Part], values: Sequence[FloatArray]) -> dict[int, FloatArray]:
    """Return (N, M) values by morph target of the node that shows each part: the longest."""
    found: dict[int, FloatArray] = {}
    for part, own in zip(parts, values, strict=True):
        if own.shape[1] > found.get(part.node, own[:, :0]).shape[1]:
            found[part.node] = own
    return found


def character_parts(scene: Scene) -> list[int]:
    """Return which parts are of the characters of a scene; of one without skins all are.

    Floors, backdrops and other scenery are not: no joint carries them, and no clip moves them, not
    even by what carries the whole skeleton.
    """
    joints = {bone for part in scene.parts if part.is_skinned for bone in part.bones.tolist()}

    def with_carriers(node: int) -> list[int]:
        nodes = [node]
        while scene.parents[nodes[-1]] >= 0:
            nodes.append(int(scene.parents[nodes[-1]]))
        return nodes

    moved = frozenset[int]().union(*(clip.moved for clip in scene.clips))
    movers = joints | moved.difference(*map(with_carriers, joints))

    return [
        number
        for number, part in enumerate(scene.parts)
        if not joints or part.is_skinned or not movers.isdisjoint(with_carriers(part.node))
    ]


def with_parts(scene: Scene, kept: Sequence[int], why: str) -> Scene:
    """Return a scene with some of its parts, and a note on why the others are left out."""
    if len(kept) == len(scene.parts):
        return scene

    def of_kept(poses: ScenePoses) -> ScenePoses:
        return ScenePoses(poses.transforms, tuple(poses.weights[number] for number in kept))

    def clip_of_kept(clip: Clip) -> Clip:
        return replace(clip, sample=lambda times: of_kept(clip.sample(times)))

    others = [part.mesh for number, part in enumerate(scene.parts) if number not in kept]
    note = left_out_note(f"left out, {why}", others)
    return replace(
        scene,
        parts=tuple(scene.parts[number] for number in kept),
        rest=of_kept(scene.rest),
        clips=tuple(map(clip_of_kept, scene.clips)),
        notes=(*scene.notes, note),
    )


def left_out_note(what: str, names: Iterable[str]) -> str:
    """Return a sentence that names what something is true of, some of them where they are many."""
    different = list(dict.fromkeys(names))
    more = f" and {len(different) - _NAMED} more" if len(different) > _NAMED else ""
    return f"{what}: {', '.join(different[:_NAMED])}{more}"


def parents_first(parents: npt.NDArray[np.int64]) -> list[int]:
    """Return all nodes, each after its parent.

    Raises
    ------
    MeshFileError : a node is its own ancestor.
    """
    children: list[list[int]] = [[] for _ in parents]
    order: list[int] = []
    for node, parent in enumerate(parents.tolist()):
        (order if parent < 0 else children[parent]).append(node)
    for node in order:
        order += children[node]
    if len(order) < len(parents):
        lost = min(set(range(len(parents))) - set(order))
        raise MeshFileError(f"is damaged: node {lost} (from 0) is its own ancestor", where="it")
    return order


def bind_pose(
    skins: Iterable[tuple[npt.NDArray[np.integer], FloatArray]],
) -> dict[int, FloatArray]:
    """Return `Scene.bound`, of the skin with the most bones.

    Parameters
    ----------
    skins : the nodes (B,) that carry each, and the (B, 4, 4) inverses of where these are in it
    """
    most = max(skins, key=lambda skin: len(skin[0]), default=None)
    pairs = () if most is None else zip(*most, strict=True)
    return {int(bone): np.linalg.inv(matrix) for bone, matrix in pairs if is_regular(matrix)}


def is_mirrored(turns: FloatArray, bone_of: npt.NDArray[np.int32], weights: FloatArray) -> bool:
    """Whether most weight is of bones that turn faces inside out.

    Parameters
    ----------
    turns : (B, 4, 4) array, from a part's coordinates to the scene's by each bone
    bone_of, weights : of the part
    """
    # Too large a number is refused where the vertices are.
    with np.errstate(all="ignore"):
        signs = np.sign(np.linalg.det(turns[:, :3, :3]))
    return bool((signs[bone_of] * weights).sum() < 0.0)


_HIDDEN = 1e-3
"""Of the scale that a clip gives a node: what is scaled to less along an axis is hidden."""

_INVISIBLE = 1e-5
"""Of the size of a scene's largest part: what is smaller is not seen."""

_MOST_FRAMES_SAMPLED = 1000


def shown_scene(scene: Scene) -> Scene:
    """Show at rest what a clip shows, and leave out scenery and what is never seen; notes say so.

    Faces of a part that is scaled to nothing have no area, so its rest pose could not be checked.
    """
    carriers = _carriers(scene)
    for node in parents_first(scene.parents):
        if node in carriers and node not in scene.revealed:
            scene = _revealed(scene, node)
    scene = with_parts(scene, character_parts(scene), "as no joint carries it")
    return with_parts(scene, _seen_parts(scene), "as its scale is zero")


def _carriers(scene: Scene) -> set[int]:
    """Return the nodes that move parts, and those above them."""
    carriers: set[int] = set()
    for part in scene.parts:
        for bone in part.bones.tolist():
            while bone >= 0 and bone not in carriers:
                carriers.add(bone)
                bone = int(scene.parents[bone])
    return carriers


def _revealed(scene: Scene, node: int) -> Scene:
    """Place a node as a clip does, with all below it, if the rest pose alone hides it by scale."""
    rest = scene.rest.transforms
    parent = int(scene.parents[node])
    above = np.eye(4) if parent < 0 else rest[0, parent]
    least = _least_scale(rest, node, parent)[0]
    if not least < _HIDDEN or not is_regular(above):
        return scene
    frames: list[tuple[float, str, FloatArray]] = []
    for clip in scene.clips:
        if node in clip.moved:
            try:
                every = len(clip.key_times) // _MOST_FRAMES_SAMPLED + 1
                transforms = clip.sample(clip.key_times[::every]).transforms
            except MeshFileError:
                continue  # A damaged clip is refused where it is asked for.
            scales = _least_scale(transforms, node, parent).tolist()
            frames += zip(scales, [clip.name] * len(scales), transforms, strict=True)
    greatest = max((scale for scale, _, _ in frames), default=0.0)
    if not least < _HIDDEN * greatest:
        return scene
    # Not one of those in which it just grows, or beyond its size.
    shown = sorted(
        (frame for frame in frames if frame[0] >= 0.5 * greatest), key=lambda one: one[0]
    )
    _, clip_name, frame = shown[len(shown) // 2]
    below = [node]
    for other in parents_first(scene.parents):
        if scene.parents[other] in below:
            below.append(other)
    placed = rest.copy()
    placed[0, below] = above @ np.linalg.solve(_above(frame[None], parent), frame[below])
    parts = tuple(_wound(part, rest[0], placed[0], below) for part in scene.parts)
    names = [part.mesh for part in parts if not set(part.bones.tolist()).isdisjoint(below)]
    note = f"hidden at rest by its scale, shown as in the clip {clip_name!r}"
    joints = {bone for part in parts if part.is_skinned for bone in part.bones.tolist()}
    if not joints.isdisjoint(_ancestors(scene, node)):
        # What is only shown and hidden is carried by the joint that it hangs on.
        clips = tuple(replace(clip, moved=clip.moved - {node}) for clip in scene.clips)
        scene = replace(scene, clips=clips)
    return replace(
        scene,
        rest=ScenePoses(placed, scene.rest.weights),
        parts=parts,
        notes=(*scene.notes, left_out_note(note, names)),
        revealed=(*scene.revealed, *below),
    )


def _ancestors(scene: Scene, node: int) -> list[int]:
    ancestors = []
    while (node := int(scene.parents[node])) >= 0:
        ancestors.append(node)
    return ancestors


def _above(transforms: FloatArray, parent: int) -> FloatArray:
    return transforms[:, parent] if parent >= 0 else np.eye(4)[None]


def _least_scale(transforms: FloatArray, node: int, parent: int) -> FloatArray:
    """Return the (N,) least scales of a node relative to its parent; 0 where that has none."""
    above = np.broadcast_to(_above(transforms, parent), (len(transforms), 4, 4))
    regular = are_regular(above)
    least = np.zeros(len(transforms))
    local = np.linalg.solve(above[regular], transforms[regular, node])
    least[regular] = np.linalg.norm(local[:, :3, :3], axis=1).min(axis=1)
    return least


def _wound(part: Part, before: FloatArray, after: FloatArray, moved: Sequence[int]) -> Part:
    """Return a part whose faces look outwards as some of its nodes are placed now."""
    if set(part.bones.tolist()).isdisjoint(moved):
        return part
    was, is_now = (
        is_mirrored(placed[part.bones] @ part.bind, part.bone_of, part.weights)
        for placed in (before, after)
    )
    return part if was == is_now else replace(part, faces=part.faces[:, [0, 2, 1]])


def _seen_parts(scene: Scene) -> list[int]:
    """Return which parts are not scaled to nothing at rest; all where none is seen.

    Beside a skinned body, what is flat and on nothing that is not could not be posed.
    """
    rest = scene.rest.transforms[0]
    sizes = np.array([_largest_size(part, rest) for part in scene.parts])
    seen = sizes >= _INVISIBLE * sizes.max()
    if any(part.is_skinned for part in scene.parts):
        for number, part in enumerate(scene.parts):
            carriers = [part.node, *_ancestors(scene, part.node)]
            seen[number] &= part.is_skinned or any(is_regular(rest[node]) for node in carriers)
    return [number for number, is_seen in enumerate(seen) if is_seen or not seen.any()]


def _largest_size(part: Part, transforms: FloatArray) -> float:
    """Return a bound of how large a part is."""
    used = np.unique(part.bone_of[part.weights > 0.0])
    turns = transforms[part.bones[used]] @ part.bind[used]
    # Too large a number is refused where the vertices are.
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.linalg.norm(np.ptp(turns @ np.append(part.points.mean(axis=0), 1.0), axis=0))
        sizes = np.linalg.norm(turns[:, :3, :3], axis=(1, 2)) * np.linalg.norm(
            np.ptp(part.points, axis=0)
        )
    return float(np.nan_to_num(spread + sizes.max(), nan=np.inf))
