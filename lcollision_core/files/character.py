"""A character as its file has it: joined meshes, a rig, clips, and the file itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix, csr_matrix

from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.schema import PARTS, GltfDocument, as_float, local_transform
from lcollision_core.files.scene.appearance import Appearance
from lcollision_core.files.scene.joined import JoinedMesh, look_of
from lcollision_core.files.scene.scene import MOST_KEYS_PER_SECOND, Part, Primitive, Scene
from lcollision_core.files.scene.smpl import SmplModel
from lcollision_core.files.scene.transforms import decompose, is_regular
from lcollision_core.files.scene_files import as_file_error
from lcollision_core.meshes.face_groups import FaceGroup
from lcollision_core.meshes.normals import moved_normals, unit
from lcollision_core.meshes.topology import FloatArray, Topology

IDENTITY = np.eye(4)


@dataclass(frozen=True, eq=False)
class CharacterFile:
    """The content of a character's file, read once.

    What writing needs beyond it is made when it is asked for, of a .glb, .gltf or .vrm file alone;
    it raises `MeshFileError` where the file is damaged.

    Attributes
    ----------
    scene : without scenery
    mesh : of its parts
    """

    scene: Scene
    mesh: JoinedMesh

    @cached_property
    def appearance(self) -> Appearance | None:
        """How it looks; None where the file does not say that."""
        return look_of(self.scene, self.mesh)

    @cached_property
    def rest(self) -> FloatArray:
        """(V, 3) float64 array, the rest pose."""
        vertices: FloatArray = self.mesh.posed(self.scene.rest)[0]
        return vertices

    @property
    def document(self) -> GltfDocument:
        """The file itself."""
        document: GltfDocument | None = self.scene.document
        if document is None:
            raise MeshFileError("is no glTF file", where="it")
        return document

    @cached_property
    def editable(self) -> GltfDocument:
        """The file to be written, in the rest pose of the scene; copies of it are changed."""
        document = self.document.editable()
        rest = self.scene.rest.transforms[0]
        for number in self.scene.revealed:
            parent = int(self.scene.parents[number])
            above = rest[parent] if parent >= 0 else IDENTITY
            if is_regular(above):
                node = document.description["nodes"][number]
                node.pop("matrix", None)
                local = decompose(np.linalg.solve(above, rest[number]))
                node |= {name: part.tolist() for name, part in zip(PARTS, local, strict=True)}
        return document

    @cached_property
    def locals(self) -> list[FloatArray]:
        """The (4, 4) local transform of each node."""
        return [local_transform(node) for node in self.editable.objects("nodes")]

    @cached_property
    def parts(self) -> list[tuple[Part, Primitive, slice]]:
        """Each part, what it is in the file, and its rows of the file's vertices."""
        parts, start = [], 0
        for part in self.scene.parts:
            if part.primitive is not None:
                parts.append((part, part.primitive, slice(start, start + len(part.points))))
            start += len(part.points)
        return parts

    @cached_property
    def stored_normals(self) -> list[FloatArray | None]:
        """The normals that the file stores for the vertices of each part, (n, 3)."""
        return list(self._stored_normals())

    def _stored_normals(self) -> Iterator[FloatArray | None]:
        for _, shown, _ in self.parts:
            mesh = self.document.objects("meshes")[shown.mesh]
            number = mesh["primitives"][shown.primitive]["attributes"].get("NORMAL")
            if number is None:
                yield None
                continue
            what = f"the normals of mesh {shown.mesh}"
            stored = self.document.array(number, what, ("VEC3",), shown.n_vertices)
            yield np.tile(as_float(stored), (shown.n_instances, 1))

    def normals(self, vertices: FloatArray) -> FloatArray:
        """Return the unit normals of the file's W vertices in a pose; 0 where it has none."""
        return moved_normals(*self._normals_at_rest, self.rest, vertices)

    @cached_property
    def _normals_at_rest(
        self,
    ) -> tuple[FloatArray, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        joined = self.mesh.joined
        rest = np.zeros((len(joined), 3))
        transforms = self.scene.rest.transforms[0]
        for (part, _, rows), stored in zip(self.parts, self.stored_normals, strict=True):
            if stored is not None:
                turns = np.linalg.pinv(blended(part, transforms)[:, :, :3])
                rest[rows] = unit(np.einsum("vij,vi->vj", turns, stored))
        # All triangles of the joined vertex, so that the copies at a seam move alike.
        faces = self.mesh.topology.faces.astype(np.int64)
        corners = np.concatenate([np.roll(faces, -side, axis=1) for side in range(3)])
        corners = corners[np.argsort(corners[:, 0], kind="stable")]
        first = np.searchsorted(corners[:, 0], np.arange(len(self.rest) + 1))
        counts = np.diff(first)[joined]
        owners = np.repeat(np.arange(len(counts)), counts)
        within = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
        return rest, owners, corners[np.repeat(first[joined], counts) + within]


def blended(part: Part, transforms: FloatArray) -> FloatArray:
    """Return the (n, 3, 4) affine map of each vertex of a part, for (nodes, 4, 4) transforms."""
    turns = (transforms[part.bones] @ part.bind)[:, :3]
    maps = np.zeros((len(part.points), 3, 4))
    for bone, weight in zip(part.bone_of.T, part.weights.T, strict=True):
        maps += weight[:, None, None] * turns[bone]
    return maps


NO_JOINTS = "has no joints to pose it by"
"""What is wrong with a file without a skin where a rig is needed."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """What a character's sliders add to the weights of its file's morph targets, linearly.

    Attributes
    ----------
    names : of S sliders, unique
    low, high : (S,) float64 arrays, the ends of their ranges; 0 is the rest pose
    mixes : of each part of the scene the (S, M) weights that each slider adds
    sources : (S, 2) int64 array, the part and the morph target whose weight alone a slider is; -1
        of those that mix several, as expressions do
    deltas : (3 n, S), what each adds to the n `Rig.points` whose weight is above 0
    """

    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray
    mixes: tuple[FloatArray, ...]
    sources: npt.NDArray[np.int64]
    deltas: csc_matrix

    @cached_property
    def by_row(self) -> csr_matrix:
        """The same as `deltas`, row by row."""
        return self.deltas.tocsr()

    def offsets(self, numbers: FloatArray) -> FloatArray:
        """Return what (S,) numbers of the sliders add to the points, (n, 3), in the file's unit."""
        used = np.flatnonzero(numbers)
        added: FloatArray = (self.deltas[:, used] @ numbers[used]).reshape(-1, 3)
        return added

    def weights(self, numbers: FloatArray, at_rest: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Return the (N, M) weights of each part's morph targets, of (N, S) sliders.

        Parameters
        ----------
        at_rest : of each part the (1, M) weights in the rest pose
        """
        both = zip(at_rest, self.mixes, strict=True)
        return tuple(rest + numbers @ mix for rest, mix in both)

    def numbers(self, weights: Sequence[FloatArray], at_rest: Sequence[FloatArray]) -> FloatArray:
        """Return the (N, S) sliders of the weights of N poses: those of single targets."""
        numbers = np.zeros((len(weights[0]), len(self.names)))
        for slider, (part, target) in enumerate(self.sources.tolist()):
            if part >= 0:
                numbers[:, slider] = weights[part][:, target] - at_rest[part][:, target]
        return numbers


@dataclass(frozen=True, eq=False)
class Rig:
    """A skeleton with linear blend skinning.

    Vertex v of a pose whose joints have the global transforms G is
    sum_i weights[v, i] T_j points[v, i] with j = joint_of[v, i] and T_j = G_j rest[j]^-1.

    Attributes
    ----------
    joint_names : J names as in the file, unique
    parents : (J,) int64 array, each joint's parent, -1 for a root; parents come before children
    rest : (J, 4, 4) float64 array, the joints' global transforms in the rest pose, in the
        character's frame and unit
    nodes : (J,) int64 array, the number of each joint's node in the file
    joint_of : (V, I) int32 array, the joints that move each vertex
    weights : (V, I) float64 array >= 0, each row sums to 1
    points : (V, I, 3) float64 array: where each of these joints alone has the vertex in the rest
        pose; all the same where the rest pose is the bind pose
    chosen : what the user says that joints are, by their names: of `anatomy.ROLE_NAMES`
    followed : by the names of joints, those of another skeleton's that they are to follow in its
        motions, None for none; where the user says so
    stretch : (J, 3, 3) float64 array, positive definite: how what is above each joint is scaled at
        rest, P of the polar decomposition P Q of its linear part, the largest scale 1. Turning the
        joint in its file by R then turns the vertices by P Q R (P Q)^-1, which is a rotation only
        for P = 1. None where all are 1.
    moving : (J,) bool array, joints that turn about any axis; the others do not turn. None where
        what a joint is says how it turns.
    pose_shapes : (V, 3, 9 (J - 1)) float32 array, what each entry of R - I adds to `points`, of the
        rotations R of all joints but the first against their parents, in the character's axes, row
        by row (the pose blend shapes of SMPL). None where poses shape nothing.
    file_parents : (J,) int64 array, each joint's parent in the file, which may come later; None
        where all are `parents`: see `loose_ends`
    shapes : what the morph targets of the file add to `points`; None where it has none
    """

    joint_names: tuple[str, ...]
    parents: npt.NDArray[np.int64]
    rest: FloatArray
    nodes: npt.NDArray[np.int64]
    joint_of: npt.NDArray[np.int32]
    weights: FloatArray
    points: FloatArray
    chosen: Mapping[str, str] = field(default_factory=dict)
    followed: Mapping[str, str | None] = field(default_factory=dict)
    stretch: FloatArray | None = None
    moving: npt.NDArray[np.bool_] | None = None
    pose_shapes: npt.NDArray[np.float32] | None = None
    file_parents: npt.NDArray[np.int64] | None = None
    shapes: Shapes | None = None

    @property
    def own_parents(self) -> npt.NDArray[np.int64]:
        """(J,) int64 array, each joint's parent in the file."""
        return self.parents if self.file_parents is None else self.file_parents


@dataclass(frozen=True, eq=False)
class ClipFrames:
    """Frames of one animation.

    Attributes
    ----------
    clip : its name
    names : N names, as "moves 12", numbered from 0 by frame
    times : (N,) float64 array, in seconds
    transforms : (N, J, 4, 4) float64 array, global transforms of the rig's joints; None without rig
    skin : makes `vertices`, which takes long
    points : of frames in which the rig has other `points` than at rest, as they hide a part, move
        it on its joint or weigh morph targets as no sliders do, what makes these (V, I, 3), to
        which the sliders add; the same for frames that share them
    shapes : (N, S) float64 array, the sliders of `Rig.shapes`; None where there are none
    """

    clip: str
    names: tuple[str, ...]
    times: FloatArray
    transforms: FloatArray | None
    skin: Callable[[], FloatArray]
    points: Mapping[int, Callable[[], FloatArray]] = field(default_factory=dict)
    shapes: FloatArray | None = None

    @cached_property
    def vertices(self) -> FloatArray:
        """(N, V, 3) float64 array, as the file says, in the character's frame and unit."""
        return self.skin()


@dataclass(frozen=True, eq=False)
class Character:
    """A character, its vertices at equal places with equal weights in all frames joined.

    Attributes
    ----------
    name : the file's, without extension
    source : its file
    topology : of the joined vertices; faces that joining makes degenerate are left out
    rest_vertices : (V, 3) float64 array, the rest pose in the file's frame and unit
    joined : (W,) int64 array: the joined vertex of each of the file's W vertices, in the order of
        the file's meshes and primitives
    up : (3,) float64 array, a signed unit axis: what the file says, else a guess
    up_is_sure : whether the file says so, or the guess leaves no doubt
    metres : length of the file's unit
    groups : named meshes and materials, of the joined faces
    rig : None for one without joints
    clips : lengths in seconds of its animations, by their names
    sample : (clip, fps) to its frames; None for the clip's own key frames at at most 30 a second,
        an array for frames at (N,) times
    notes : sentences on what was changed on reading
    no_rig : what is wrong with the file where `rig` is None
    file : what was read of it; None for one that is not from a file of a scene
    smpl : the body model that it has its shape of; None of other files
    """

    name: str
    source: Path
    topology: Topology
    rest_vertices: FloatArray
    joined: npt.NDArray[np.int64]
    up: FloatArray
    up_is_sure: bool
    metres: float
    groups: tuple[FaceGroup, ...]
    rig: Rig | None
    clips: Mapping[str, float]
    sample: Callable[[str, float | FloatArray | None], ClipFrames]
    notes: tuple[str, ...] = ()
    no_rig: str = NO_JOINTS
    file: CharacterFile | None = None
    smpl: SmplModel | None = None

    def look(self) -> Appearance | None:
        """Read how it looks, which takes long the first time; None where no file says that.

        Raises
        ------
        MeshFileError : the file is damaged.
        """
        if self.file is None:
            return None
        with as_file_error(self.source):
            return self.file.appearance

    def rate(self, clip: str) -> float:
        """Return how many frames a second a clip has: see `Clip.rate`; it raises as `sample`."""
        clips = () if self.file is None else self.file.scene.clips
        with as_file_error(self.source):
            return next(
                (scene_clip.rate for scene_clip in clips if scene_clip.name == clip),
                MOST_KEYS_PER_SECOND,
            )
