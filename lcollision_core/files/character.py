"""A character read from a file: joined meshes, a rig, clips, and the file itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.schema import GltfDocument, as_float, local_transform, set_parts
from lcollision_core.files.motion.smpl import SmplModel
from lcollision_core.files.scene.appearance import Appearance
from lcollision_core.files.scene.joined import JoinedMesh, look_of
from lcollision_core.files.scene.scene import MOST_KEYS_PER_SECOND, Part, Primitive, Scene
from lcollision_core.files.scene.transforms import decompose, is_regular
from lcollision_core.files.scene_files import as_file_error
from lcollision_core.meshes.face_groups import FaceGroup
from lcollision_core.meshes.normals import moved_normals, unit
from lcollision_core.meshes.topology import FloatArray, Topology

IDENTITY = np.eye(4)


@dataclass(frozen=True, eq=False)
class CharacterFile:
    """The content of a character's file, read once.

    The properties needed for writing are computed on demand, for .glb, .gltf and .vrm files only;
    they raise `MeshFileError` if the file is damaged.

    Attributes
    ----------
    scene : the scene without scenery
    mesh : the joined mesh of its parts
    """

    scene: Scene
    mesh: JoinedMesh

    @cached_property
    def appearance(self) -> Appearance | None:
        """Appearance of the mesh; None if the file does not define it."""
        return look_of(self.scene, self.mesh)

    @cached_property
    def rest(self) -> FloatArray:
        """(V, 3) float64 array, the rest pose."""
        vertices: FloatArray = self.mesh.posed(self.scene.rest)[0]
        return vertices

    @property
    def document(self) -> GltfDocument:
        """The glTF file itself."""
        document: GltfDocument | None = self.scene.document
        if document is None:
            raise MeshFileError("is no glTF file", where="it")
        return document

    @cached_property
    def editable(self) -> GltfDocument:
        """The file to write, in the rest pose of the scene; copy it before changing it."""
        document = self.document.editable()
        rest = self.scene.rest.transforms[0]
        for number in self.scene.revealed:
            parent = int(self.scene.parents[number])
            above = rest[parent] if parent >= 0 else IDENTITY
            if is_regular(above):
                node = document.description["nodes"][number]
                set_parts(node, decompose(np.linalg.solve(above, rest[number])))
        return document

    @cached_property
    def locals(self) -> list[FloatArray]:
        """The (4, 4) local transform of each node."""
        return [local_transform(node) for node in self.editable.objects("nodes")]

    @cached_property
    def parts(self) -> list[tuple[Part, Primitive, slice]]:
        """Each part with its primitive in the file and its rows of the file's vertices."""
        pairs = zip(self.scene.parts, self.scene.rows, strict=True)
        return [(part, part.primitive, rows) for part, rows in pairs if part.primitive is not None]

    @cached_property
    def stored_normals(self) -> list[FloatArray | None]:
        """The (n, 3) normals that the file stores for each part's vertices, None if it has none."""
        return [self._normals_of(part) for _, part, _ in self.parts]

    def _normals_of(self, part: Primitive) -> FloatArray | None:
        mesh = self.document.objects("meshes")[part.mesh]
        number = mesh["primitives"][part.primitive]["attributes"].get("NORMAL")
        if number is None:
            return None
        what = f"the normals of mesh {part.mesh}"
        stored = self.document.array(number, what, ("VEC3",), part.n_vertices)
        return np.tile(as_float(stored), (part.n_instances, 1))

    def normals(self, vertices: FloatArray) -> FloatArray:
        """Return the unit normals of the file's W vertices in a pose; 0 where none are stored."""
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
        # Use all triangles of the joined vertex, so that copies at a seam get equal normals.
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
"""The problem with a file without a skin when a rig is needed."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Sliders of a character, which add to the weights of its file's morph targets linearly.

    Attributes
    ----------
    names : S unique names of the sliders
    low, high : (S,) float64 arrays, the ends of their ranges; 0 is the rest pose
    at_rest : (S,) float64 array, the weights at rest of those that are morph targets, 0 of others
    mixes : for each part of the scene, the (S, M) weights that each slider adds
    sources : (S, 2) int64 array, the part and morph target whose weight a slider is; -1 for sliders
        that mix several targets, as expressions do
    deltas : (3 n, S), offsets that each slider adds to the n `Rig.points` of weight above 0
    """

    names: tuple[str, ...]
    low: FloatArray
    high: FloatArray
    at_rest: FloatArray
    mixes: tuple[FloatArray, ...]
    sources: npt.NDArray[np.int64]
    deltas: scipy.sparse.csc_matrix

    @cached_property
    def by_row(self) -> scipy.sparse.csr_matrix:
        """`deltas` in CSR form."""
        return self.deltas.tocsr()

    def offsets(self, numbers: FloatArray) -> FloatArray:
        """Return the (n, 3) offsets of the points for (S,) slider values, in the file's unit."""
        used = np.flatnonzero(numbers)
        added: FloatArray = (self.deltas[:, used] @ numbers[used]).reshape(-1, 3)
        return added

    def weights(self, numbers: FloatArray, at_rest: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Return the (N, M) weights of each part's morph targets for (N, S) slider values.

        Parameters
        ----------
        numbers : (N, S) slider values
        at_rest : for each part, the (1, M) weights in the rest pose
        """
        both = zip(at_rest, self.mixes, strict=True)
        return tuple(rest + numbers @ mix for rest, mix in both)

    def numbers(self, weights: Sequence[FloatArray], at_rest: Sequence[FloatArray]) -> FloatArray:
        """Return the (N, S) slider values for the weights of N poses; 0 for mixing sliders."""
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
        character's coordinates and unit
    nodes : (J,) int64 array, the number of each joint's node in the file
    joint_of : (V, I) int32 array, the joints that move each vertex
    weights : (V, I) float64 array >= 0, each row sums to 1
    points : (V, I, 3) float64 array, the rest position of the vertex by each of these joints alone;
        all equal if the rest pose is the bind pose
    chosen : roles of joints set by the user, by joint name: see `anatomy.ROLE_NAMES`
    followed : joints of another skeleton whose motion joints follow, None to follow none, by joint
        name, as set by the user
    stretch : (J, 3, 3) float64 array, positive definite: scale of each joint's parent at rest, P of
        the polar decomposition P Q of its linear part, the largest scale 1. Turning the joint in
        its file by R then turns the vertices by P Q R (P Q)^-1, which is a rotation only for P = 1.
        None if all are 1.
    moving : (J,) bool array, joints that turn about any axis; the others do not turn. None if the
        role of a joint determines how it turns.
    pose_shapes : (V, 3, 9 (J - 1)) float32 array, offsets of `points` by each entry of R - I, for
        the rotations R of all joints but the first relative to their parents, in the character's
        axes, row by row (the pose blend shapes of SMPL). None if there are none.
    file_parents : (J,) int64 array, each joint's parent in the file, which may come later; None if
        these are `parents`: see `with_ends_on_limbs`
    shapes : offsets of `points` by the file's morph targets; None if it has none
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

    @cached_property
    def heaviest(self) -> npt.NDArray[np.int32]:
        """(V,) int32 array, the joint with the largest weight in each vertex."""
        rows, largest = np.arange(len(self.joint_of)), self.weights.argmax(axis=1)
        joints: npt.NDArray[np.int32] = self.joint_of[rows, largest]
        return joints

    @property
    def own_parents(self) -> npt.NDArray[np.int64]:
        """(J,) int64 array, each joint's parent in the file."""
        return self.parents if self.file_parents is None else self.file_parents


@dataclass(frozen=True, eq=False)
class ClipFrames:
    """Frames of one animation.

    Attributes
    ----------
    names : N names such as "moves 12", numbered from 0 by frame
    times : (N,) float64 array, in seconds
    transforms : (N, J, 4, 4) float64 array, global transforms of the rig's joints; None without rig
    skin : computes `vertices`, which is slow
    points : by frame, functions that compute (V, I, 3) `Rig.points`, without the sliders' offsets,
        for frames that hide a part, move it relative to its joint or weight morph targets as no
        sliders do; frames with equal points share a function
    shapes : (N, S) float64 array, sliders of `Rig.shapes`; None if there are none
    """

    names: tuple[str, ...]
    times: FloatArray
    transforms: FloatArray | None
    skin: Callable[[], FloatArray]
    points: Mapping[int, Callable[[], FloatArray]] = field(default_factory=dict)
    shapes: FloatArray | None = None

    @cached_property
    def vertices(self) -> FloatArray:
        """(N, V, 3) float64 array, as the file has them, in the character's frame and unit."""
        return self.skin()


@dataclass(frozen=True, eq=False)
class Character:
    """A character, whose vertices are joined where position and weights are equal in all frames.

    Attributes
    ----------
    name : name of the file without extension
    source : its file
    topology : faces of the joined vertices, without those that joining makes degenerate
    rest_vertices : (V, 3) float64 array, the rest pose in the file's frame and unit
    joined : (W,) int64 array: the joined vertex of each of the file's W vertices, in the order of
        the file's meshes and primitives
    up : (3,) float64 array, a signed unit axis from the file, else a guess
    up_is_sure : whether the file defines it, or the guess leaves no doubt
    metres : length of the file's unit
    groups : named meshes and materials, as groups of the joined faces
    rig : None for a character without joints
    clips : lengths of its animations in seconds, by name
    sample : returns the frames for (clip, fps); fps is None for the clip's own keys at most 30 a
        second, or an array of (N,) times
    notes : sentences on changes made on reading
    no_rig : the reason why `rig` is None
    file : content of the file; None if it is not the file of a scene
    smpl : the body model that gives it its shape; None for other files
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

    @classmethod
    def without_clips(
        cls,
        path: Path,
        topology: Topology,
        vertices: FloatArray,
        up: FloatArray,
        rig: Rig | None,
        *,
        up_is_sure: bool = True,
        notes: tuple[str, ...] = (),
        smpl: SmplModel | None = None,
    ) -> Character:
        """Make a character that is not from a scene, whose vertices are those of its file."""

        def sample(clip: str, _: float | FloatArray | None) -> ClipFrames:
            raise MeshFileError(f"has no animation {clip!r}", "name a motion", where=path)

        return cls(
            name=path.stem,
            source=path,
            topology=topology,
            rest_vertices=vertices,
            joined=np.arange(len(vertices)),
            up=up,
            up_is_sure=up_is_sure,
            metres=1.0,
            groups=(),
            rig=rig,
            clips={},
            sample=sample,
            notes=notes,
            smpl=smpl,
        )

    def look(self) -> Appearance | None:
        """Read its appearance, which is slow the first time; None if no file defines it.

        Raises
        ------
        MeshFileError : the file is damaged.
        """
        if self.file is None:
            return None
        with as_file_error(self.source):
            return self.file.appearance

    def rate(self, clip: str) -> float:
        """Return the frames per second of a clip: see `Clip.rate`; raises as `sample` does."""
        clips = () if self.file is None else self.file.scene.clips
        with as_file_error(self.source):
            return next(
                (scene_clip.rate for scene_clip in clips if scene_clip.name == clip),
                MOST_KEYS_PER_SECOND,
            )
