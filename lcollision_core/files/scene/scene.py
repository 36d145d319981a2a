"""The content of a scene file in any format: nodes, parts that they move, and clips."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, listed
from lcollision_core.files.scene.appearance import Appearance
from lcollision_core.files.scene.transforms import are_regular, is_regular
from lcollision_core.meshes.topology import FloatArray, consecutive
from lcollision_core.meshes.trees import lineage

MAX_FRAME_NUMBERS = 1 << 28
"""Most coordinates, and most numbers of node transforms, in the frames of a clip."""

MOST_KEYS_PER_SECOND = 30.0
"""Keys that follow faster are not frames of their own."""

LEAST_RATE = 20.0
"""Keys per second below which a clip is assumed to move between its keys."""

KEYS_ARE_FRAMES = "keysAreFrames"
"""Name in a glTF animation's extras that marks the keys of a motion with fewer frames."""

_LEAST_STEP = 1e-3
"""Shortest time between keys, in seconds, that counts as a step."""

_SAME_FRAME = 1e-2
"""Largest deviation of a key from its frame, as a fraction of a frame."""

_MOST_FRAMES = 1_000_000
_NAMED = 3
"""Most names that a note lists."""

NO_MESH = (
    "it contains an animation, but no mesh",
    "name or open the character that it is to move (in commands also --motion or --clips), or "
    "export it with its mesh (on some sites: with skin)",
)
"""Problem and advice for a file with only an animation when a mesh is needed."""


class NoMeshError(MeshFileError):
    """A file has an animation but no mesh."""


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


@dataclass(frozen=True)
class Primitive:
    """A part's primitive in a glTF file: indices in its description, and counts."""

    node: int
    mesh: int
    primitive: int
    n_vertices: int
    n_instances: int = 1


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one mesh, moved by nodes.

    In a pose whose nodes have the global transforms G, vertex v is
    sum_i weights[v, i] G_b bind[j] points[v] with j = bone_of[v, i] and b = bones[j], where points
    include morph deltas.

    Attributes
    ----------
    mesh : name of the node that shows it, as artists see it, else of the mesh
    materials : names of materials
    material_of : (F,) int64 array, each face's material; none if out of range
    node : the node that shows it
    points : (W, 3) float64 array
    faces : (F, 3) int64 array, checked indices into the part's vertices
    bones : (B,) int64 array of nodes; the node itself if nothing is skinned
    bind : (B, 4, 4) float64 array, from the part's coordinates to each bone's
    bone_of : (W, I) int32 array, indices into `bones`
    weights : (W, I) float64 array >= 0, each row sums to 1
    is_skinned : whether the bones are joints of a skin
    morphs : (M, W, 3) float32 array, deltas of each morph target
    sliders : (M,) weights that each slider adds to those at rest, by name: of one morph target, or
        of all that an expression binds
    is_single : whether the file stores the points as float32
    dual : (W,) float64 array, share in [0, 1] of dual quaternions in the blend; None for linear
        blending as above
    look : reads the appearance, which is slow; None if the file does not define it
    shaded_look : the same with normals, which split points too; None without `look`, or if the file
        itself can be written
    cut_of : (F,) int64 array, ascending, the polygon that each face was cut from; None if the
        polygons are the faces
    primitive : its primitive in a glTF file; None for other formats
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
    name : unique name in the scene
    moved : the nodes that it moves, without those that follow them
    read_key_times : returns `key_times`, and may read the file's arrays
    sample : returns the N poses at (N,) times
    keys_are_frames : whether it is known not to move between its keys, however few they are
    """

    name: str
    moved: frozenset[int]
    read_key_times: Callable[[], FloatArray]
    sample: Callable[[FloatArray], ScenePoses]
    keys_are_frames: bool = False

    @cached_property
    def key_times(self) -> FloatArray:
        """(T,) float64 array of ascending times in seconds, T > 0.

        Raises
        ------
        MeshFileError : the animation is damaged; `sample` raises it too.
        """
        return self.read_key_times()

    @property
    def rate(self) -> float:
        """Keys per second, from the median step between them.

        A clip with fewer than `LEAST_RATE` keys per second is assumed to move between them, so its
        rate is `MOST_KEYS_PER_SECOND`.
        """
        steps = np.diff(self.key_times)
        steps = steps[steps > _LEAST_STEP]
        usual = np.median(steps) if len(steps) else np.inf
        # Keys are stored in single precision: the mean of many steps is accurate even late in a
        # long clip, but 1 / 24 s must be rounded to 24 per second.
        alike = steps[np.abs(steps - usual) < 0.05 * usual]
        rate = 1.0 / float(alike.mean()) if len(alike) else 0.0
        nearest = float(round(rate))
        rate = nearest if abs(rate - nearest) < 1e-4 * rate else rate
        are_frames = rate >= LEAST_RATE or (self.keys_are_frames and rate > 0.0)
        return rate if are_frames else MOST_KEYS_PER_SECOND

    def times(self, fps: float | None) -> FloatArray:
        """Return the times of the clip's frames.

        Parameters
        ----------
        fps : frames per second from the first key to the last; None for the keys themselves,
            without those that follow faster than `MOST_KEYS_PER_SECOND`

        Raises
        ------
        MeshFileError : fps is not a number above 0, or there would be too many frames.
        """
        start, end = float(self.key_times[0]), float(self.key_times[-1])
        if fps is None:
            # Keys are stored in single precision, so tolerate a thousandth of a step.
            least_step = (1.0 - 1e-3) / MOST_KEYS_PER_SECOND
            key_times = [start]
            for time in self.key_times[1:].tolist():
                if time - key_times[-1] >= least_step:
                    key_times.append(time)
            return np.array(key_times)
        if not 0.0 < fps < np.inf:
            raise MeshFileError.must_be("fps", "a number above 0", f"{fps:g}")
        # Keys are stored in single precision, so tolerate a hundredth of a frame.
        n_steps = (end - start) * fps + _SAME_FRAME
        if not n_steps < _MOST_FRAMES:
            raise MeshFileError(
                f"its clip {self.name!r} of {end - start:g} s has more than {_MOST_FRAMES} frames "
                f"at {fps:g} a second",
                "choose fewer frames a second",
            )
        times = start + np.arange(int(n_steps) + 1) / fps
        # Move times to nearby keys: just before a key, a stepped value is still the previous one.
        middles = 0.5 * (self.key_times[1:] + self.key_times[:-1])
        nearest = self.key_times[np.searchsorted(middles, times)]
        return np.where(np.abs(nearest - times) < _SAME_FRAME / fps, nearest, times)


@dataclass(frozen=True, eq=False)
class Scene:
    """The content of a file.

    Attributes
    ----------
    node_names : names in the file, empty if there is none; standard names for a VRM avatar's bones
    parents : (n,) int64 array, each node's parent, -1 for a root; no cycles
    rest : the single pose in which the file stores the nodes
    parts : ordered by the file's meshes, then the nodes that show each, then its primitives
    clips : its animations
    up : (3,) float64 array, a signed unit axis; None if the file does not define it
    metres : length of the file's unit
    notes : sentences on what was left out
    unscaled : nodes that do not inherit their parent's scale, as with Maya's segment scale
        compensate
    revealed : nodes whose rest transforms differ from the file's, parents first
    showing : nodes that show something; only set if just the nodes were read
    bound : (4, 4) transforms of the largest skin's nodes in its bind pose, in common axes; only set
        if just the nodes were read
    document : the `GltfDocument`; None for other formats
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

    @property
    def rows(self) -> list[slice]:
        """Rows of each part's points among those of all parts."""
        return consecutive(len(part.points) for part in self.parts)

    @property
    def joints(self) -> set[int]:
        """Nodes that are joints of skins."""
        return {bone for part in self.parts if part.is_skinned for bone in part.bones.tolist()}

    @property
    def moved(self) -> frozenset[int]:
        """Nodes that a clip moves, without those that follow them."""
        return frozenset[int]().union(*(clip.moved for clip in self.clips))


def by_node(parts: Sequence[Part], values: Sequence[FloatArray]) -> dict[int, FloatArray]:
    """Return the (N, M) morph target values of each node, the longest of its parts."""
    value_of_node: dict[int, FloatArray] = {}
    for part, value in zip(parts, values, strict=True):
        if value.shape[1] > value_of_node.get(part.node, value[:, :0]).shape[1]:
            value_of_node[part.node] = value
    return value_of_node


def character_parts(scene: Scene) -> list[int]:
    """Return the indices of the parts that belong to characters; all in a scene without skins.

    Floors, backdrops and other scenery do not: no joint carries them, and no clip moves them, other
    than by nodes above the skeleton.
    """
    joints, with_carriers = scene.joints, partial(lineage, scene.parents)
    movers = joints | scene.moved.difference(*map(with_carriers, joints))
    return [
        number
        for number, part in enumerate(scene.parts)
        if not joints or part.is_skinned or not movers.isdisjoint(with_carriers(part.node))
    ]


def with_parts(scene: Scene, kept: Sequence[int], why: str) -> Scene:
    """Return a scene with the `kept` parts, and a note on why the others are left out."""
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
    """Return a note followed by names, of which only the first few are listed."""
    return f"{what}: {listed(dict.fromkeys(names), _NAMED)}"


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


def nearest_above(parents: npt.NDArray[np.integer], node: int, among: Container[int]) -> int:
    """Return the nearest ancestor of a node among some nodes, -1 for none."""
    while (node := int(parents[node])) >= 0 and node not in among:
        pass
    return node


def bind_pose(
    skins: Iterable[tuple[npt.NDArray[np.integer], FloatArray]],
) -> dict[int, FloatArray]:
    """Return `Scene.bound` for the skin with the most bones.

    Parameters
    ----------
    skins : for each skin, its (B,) nodes and their (B, 4, 4) inverse bind matrices
    """
    most = max(skins, key=lambda skin: len(skin[0]), default=None)
    pairs = () if most is None else zip(*most, strict=True)
    return {int(bone): np.linalg.inv(matrix) for bone, matrix in pairs if is_regular(matrix)}


def is_mirrored(turns: FloatArray, bone_of: npt.NDArray[np.int32], weights: FloatArray) -> bool:
    """Whether bones that mirror the faces have most of the weight.

    Parameters
    ----------
    turns : (B, 4, 4) array, from a part's coordinates to the scene's by each bone
    bone_of, weights : bones and weights of the part's vertices
    """
    # Numbers that are too large are refused with the vertices.
    with np.errstate(all="ignore"):
        signs = np.sign(np.linalg.det(turns[:, :3, :3]))
    return bool((signs[bone_of] * weights).sum() < 0.0)


_HIDDEN = 1e-3
"""Least scale along an axis, relative to that in a clip, of a node that is not hidden."""

_INVISIBLE = 1e-5
"""Least size of a visible part, relative to the largest part of the scene."""

_MOST_FRAMES_SAMPLED = 1000


def shown_scene(scene: Scene) -> Scene:
    """Show at rest parts that a clip shows, and leave out scenery and invisible parts, with notes.

    The faces of a part of zero scale have no area, so its rest pose could not be checked.
    """
    movers = {bone for part in scene.parts for bone in part.bones.tolist()}
    carriers = {carrier for bone in movers for carrier in lineage(scene.parents, bone)}
    for node in parents_first(scene.parents):
        if node in carriers and node not in scene.revealed:
            scene = _revealed(scene, node)
    scene = with_parts(scene, character_parts(scene), "as no joint carries it")
    return with_parts(scene, _seen_parts(scene), "as its scale is zero")


def _revealed(scene: Scene, node: int) -> Scene:
    """Place a node and its descendants as in a clip if only the rest pose hides it by scale.

    Joints below a first one are placed as they were bound, as the clip may bend them.
    """
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
                continue  # A damaged clip is refused when it is used.
            scales = _least_scale(transforms, node, parent).tolist()
            frames += zip(scales, [clip.name] * len(scales), transforms, strict=True)
    greatest = max((scale for scale, _, _ in frames), default=0.0)
    if not least < _HIDDEN * greatest:
        return scene
    # Choose a median frame, not one in which the node just grows or overshoots.
    visible_frames = sorted(
        (frame for frame in frames if frame[0] >= 0.5 * greatest), key=lambda one: one[0]
    )
    _, clip_name, frame = visible_frames[len(visible_frames) // 2]
    below = [node]
    for other in parents_first(scene.parents):
        if scene.parents[other] in below:
            below.append(other)
    placed = rest.copy()
    shown = _as_bound(scene, frame, below)
    placed[0, below] = above @ np.linalg.solve(_above(frame[None], parent), shown[below])
    parts = tuple(_wound(part, rest[0], placed[0], below) for part in scene.parts)
    names = [
        part.mesh
        for part in parts
        if not set(part.bones[part.bone_of[part.weights > 0.0]].tolist()).isdisjoint(below)
    ]
    note = f"hidden at rest by its scale, shown as in the clip {clip_name!r}"
    if not scene.joints.isdisjoint(lineage(scene.parents, node)[1:]):
        # A node that a clip only shows and hides is carried by its joint.
        clips = tuple(replace(clip, moved=clip.moved - {node}) for clip in scene.clips)
        scene = replace(scene, clips=clips)
    return replace(
        scene,
        rest=ScenePoses(placed, scene.rest.weights),
        parts=parts,
        notes=(*scene.notes, left_out_note(note, names)),
        revealed=(*scene.revealed, *below),
    )


def _as_bound(scene: Scene, frame: FloatArray, nodes: Sequence[int]) -> FloatArray:
    """Return a frame in which joints among some nodes lie as bound, relative to the first of them.

    Parameters
    ----------
    frame : (n, 4, 4) transforms of all nodes; other nodes move with their parents
    nodes : a node and its descendants, parents first
    """
    placed, bound = frame.copy(), dict[int, FloatArray]()
    for part in scene.parts:
        skin = bind_pose([(part.bones, part.bind)] if part.is_skinned else ())
        first, *others = [node for node in nodes if node in skin] or [-1]
        for node in others:
            bound.setdefault(node, frame[first] @ np.linalg.solve(skin[first], skin[node]))
    for node in nodes[1:]:
        parent = scene.parents[node]
        if node in bound:
            placed[node] = bound[node]
        elif is_regular(frame[parent]):
            placed[node] = placed[parent] @ np.linalg.solve(frame[parent], frame[node])
    return placed


def _above(transforms: FloatArray, parent: int) -> FloatArray:
    return transforms[:, parent] if parent >= 0 else np.eye(4)[None]


def _least_scale(transforms: FloatArray, node: int, parent: int) -> FloatArray:
    """Return the (N,) least scales of a node relative to its parent; 0 if that is singular."""
    above = np.broadcast_to(_above(transforms, parent), (len(transforms), 4, 4))
    regular = are_regular(above)
    least = np.zeros(len(transforms))
    local = np.linalg.solve(above[regular], transforms[regular, node])
    least[regular] = np.linalg.norm(local[:, :3, :3], axis=1).min(axis=1)
    return least


def _wound(part: Part, before: FloatArray, after: FloatArray, moved: Sequence[int]) -> Part:
    """Return a part with its faces flipped if moving its nodes has mirrored it."""
    if set(part.bones.tolist()).isdisjoint(moved):
        return part
    was, is_now = (
        is_mirrored(placed[part.bones] @ part.bind, part.bone_of, part.weights)
        for placed in (before, after)
    )
    return part if was == is_now else replace(part, faces=part.faces[:, [0, 2, 1]])


def _seen_parts(scene: Scene) -> list[int]:
    """Return the indices of the parts that are visible at rest; all if none is.

    Beside a skinned body, leave out unskinned parts whose node and its ancestors are all singular,
    as they could not be posed.
    """
    rest = scene.rest.transforms[0]
    sizes = np.array([_largest_size(part, rest) for part in scene.parts])
    is_visible = sizes >= _INVISIBLE * sizes.max()
    if any(part.is_skinned for part in scene.parts):
        for number, part in enumerate(scene.parts):
            carriers = lineage(scene.parents, part.node)
            is_visible[number] &= part.is_skinned or any(
                is_regular(rest[node]) for node in carriers
            )
    return [number for number, is_seen in enumerate(is_visible) if is_seen or not is_visible.any()]


def _largest_size(part: Part, transforms: FloatArray) -> float:
    """Return an upper bound of the size of a part."""
    used = np.unique(part.bone_of[part.weights > 0.0])
    turns = transforms[part.bones[used]] @ part.bind[used]
    # Numbers that are too large are refused with the vertices.
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.linalg.norm(np.ptp(turns @ np.append(part.points.mean(axis=0), 1.0), axis=0))
        sizes = np.linalg.norm(turns[:, :3, :3], axis=(1, 2)) * np.linalg.norm(
            np.ptp(part.points, axis=0)
        )
    return float(np.nan_to_num(spread + sizes.max(), nan=np.inf))
