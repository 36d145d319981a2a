"""Join the parts of a scene, and their vertices at seams, to one mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import MeshFileError, listed
from lcollision_core.files.mesh.polygons import are_of_same_polygons, first_of_equal
from lcollision_core.files.scene.appearance import Appearance, join_appearances
from lcollision_core.files.scene.scene import MAX_FRAME_NUMBERS, Part, Scene, ScenePoses
from lcollision_core.files.scene.transforms import blend_dual_quaternions
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.contact_rules import MAX_GROUP_NAME_LENGTH
from lcollision_core.meshes.face_groups import MAX_GROUPS, FaceGroup
from lcollision_core.meshes.topology import (
    FloatArray,
    Int64Array,
    Topology,
    consecutive,
    degenerate_faces,
    name_twice,
)


@dataclass(frozen=True, eq=False)
class _Morphs:
    """Morph targets of n `vertices`: (M, n, 3) `deltas` with the weights of `part`."""

    part: int
    vertices: Int64Array
    deltas: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class JoinedMesh:
    """One mesh of all parts of a scene; vertices that no pose can separate are joined.

    Those are vertices with the same coordinates, bones, weights and morph deltas.

    Attributes
    ----------
    topology : topology of the V joined vertices, numbered by first appearance; without faces that
        joining makes degenerate or that have no area at rest
    cut_of : (F,) int64 array, ascending, the polygon that each face was cut from
    joined : (W,) int64 array, the joined vertex of each of the parts' W vertices
    bones : (B,) int64 array, nodes that move vertices; a node may occur several times
    bind : (B, 4, 4) float64 array, from the vertices' coordinates to each bone's
    bone_of : (V, I) int32 array, indices into `bones`, ascending, then those without weight
    weights : (V, I) float64 array >= 0, each row sums to 1
    points : (V, 3) float64 array, in the coordinates of each vertex's part
    is_skinned : (V,) bool array
    dual : (V,) float64 array, share of dual quaternions in the blend
    morphs : morph targets, which are added to `points`
    groups : named meshes and materials, at most `MAX_GROUPS`
    notes : sentences on what was changed
    """

    topology: Topology
    cut_of: Int64Array
    joined: Int64Array
    bones: Int64Array
    bind: FloatArray
    bone_of: npt.NDArray[np.int32]
    weights: FloatArray
    points: FloatArray
    is_skinned: npt.NDArray[np.bool_]
    dual: FloatArray
    morphs: tuple[_Morphs, ...]
    groups: tuple[FaceGroup, ...]
    notes: tuple[str, ...]

    def cut_as(self, topology: Topology | None) -> JoinedMesh:
        """Return the mesh with the triangulation of `topology`, if that has the same polygons."""
        if (
            topology is None
            or topology.n_vertices != self.topology.n_vertices
            or not are_of_same_polygons(self.topology.faces, topology.faces, self.cut_of)
        ):
            return self
        return replace(self, topology=topology)

    def morphed(self, weights: tuple[FloatArray, ...]) -> FloatArray:
        """Return the (V, 3) points with morph targets applied, for (M,) weights of each part."""
        points = self.points.copy()
        for morphs in self.morphs:
            used = np.flatnonzero(weights[morphs.part])
            shares = weights[morphs.part][used]
            points[morphs.vertices] += np.tensordot(shares, morphs.deltas[used], axes=1)
        return points

    def posed(
        self,
        poses: ScenePoses,
        job: Job = UNWATCHED,
    ) -> FloatArray:
        """Return the vertices of N poses of the scene.

        Parameters
        ----------
        poses : poses of the scene
        job : reports (poses done, N); polled between poses

        Returns
        -------
        (N, V, 3) float64 array

        Raises
        ------
        MeshFileError : a coordinate is not finite.
        """
        n, n_vertices = len(poses.transforms), self.topology.n_vertices
        result = np.empty((n, n_vertices, 3))
        for pose in range(n):
            job.check()
            with np.errstate(over="ignore", invalid="ignore"):
                blended = self._blended(poses.transforms[pose])
                points = self.morphed(tuple(weights[pose] for weights in poses.weights))
                result[pose] = np.einsum("vij,vj->vi", blended[:, :, :3], points)
                result[pose] += blended[:, :, 3]
            job.report(pose + 1, n)
        if not np.isfinite(result).all():
            raise MeshFileError("a pose of its nodes has coordinates that are not finite")
        return result

    @cached_property
    def _blend(self) -> scipy.sparse.csr_matrix:
        """Return the weights as a (V, B) matrix."""
        n_vertices = self.topology.n_vertices
        rows = np.repeat(np.arange(n_vertices), self.bone_of.shape[1])
        entries = (self.weights.reshape(-1), (rows, self.bone_of.reshape(-1)))
        return scipy.sparse.csr_matrix(entries, (n_vertices, len(self.bones)))

    def _blended(self, transforms: FloatArray) -> FloatArray:
        """Return the (V, 3, 4) affine maps of the vertices, for (nodes, 4, 4) transforms."""
        turns = transforms[self.bones] @ self.bind
        blended: FloatArray = (self._blend @ turns[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        rows = np.flatnonzero(self.dual)
        if len(rows):
            other = blend_dual_quaternions(turns, self.bone_of[rows], self.weights[rows])[:, :3]
            share = self.dual[rows, None, None]
            blended[rows] = (1.0 - share) * blended[rows] + share * other
        return blended

    def linear_parts(self, transforms: FloatArray) -> FloatArray:
        """Return the (V, I, 3, 3) linear maps of each vertex by each of its bones alone.

        Parameters
        ----------
        transforms : (nodes, 4, 4) of a pose; dual quaternions give the blend of all bones instead
        """
        turns: FloatArray = (transforms[self.bones] @ self.bind)[self.bone_of, :3, :3]
        rows = np.flatnonzero(self.dual)
        if len(rows):
            turns[rows] = self._blended(transforms)[rows, None, :, :3]
        return turns


def sample_clip(
    scene: Scene, name: str, fps: float | FloatArray | None, n_vertices: int = 0
) -> tuple[FloatArray, ScenePoses]:
    """Sample the frames of a clip, at times chosen by `Clip.times`.

    Parameters
    ----------
    scene : scene of the clip
    name : name of the clip
    fps : frames per second; None for the clip's keys; or the (N,) times themselves
    n_vertices : number of vertices per frame, for the size limit; 0 for transforms only

    Returns
    -------
    times : (N,) float64 array, in seconds
    poses : N poses of the scene

    Raises
    ------
    MeshFileError : there is no such clip, or it has too many frames.
    """
    clips = [clip for clip in scene.clips if clip.name == name]
    if not clips:
        clip_names = listed(repr(clip.name) for clip in scene.clips) or "none"
        raise MeshFileError(
            f"it has no clip {name!r}, its clips are: {clip_names}", "name one of them"
        )
    times = fps if isinstance(fps, np.ndarray) else clips[0].times(fps)
    numbers_each = max(3 * n_vertices, 16 * len(scene.parents))
    if len(times) * numbers_each > MAX_FRAME_NUMBERS:
        raise MeshFileError(
            f"its clip {name!r} has {len(times)} frames of {numbers_each} numbers, more than "
            f"{MAX_FRAME_NUMBERS} in all",
            "choose fewer frames a second",
        )
    return times, clips[0].sample(times)


def look_of(scene: Scene, mesh: JoinedMesh) -> Appearance | None:
    """Read the appearance of a scene on its joined mesh; None if the file does not define it.

    Raises
    ------
    MeshFileError : the file is damaged.
    """
    looks = [part.look() for part in scene.parts if part.look is not None]
    if len(looks) < len(scene.parts):
        return None
    return join_appearances(looks, [len(part.points) for part in scene.parts], mesh.joined)


def join_parts(scene: Scene) -> JoinedMesh:
    """Join the parts of a scene.

    Raises
    ------
    MeshFileError : no face with area is left.
    """
    parts = scene.parts
    first_vertex = np.cumsum([0] + [len(part.points) for part in parts])
    bones, bind, bone_of, weights = _common_bones(parts)
    points = np.concatenate([part.points for part in parts])
    morph_of = _morph_numbers(parts)
    dual = np.concatenate(
        [np.zeros(len(part.points)) if part.dual is None else part.dual for part in parts]
    )
    # Adding 0.0 turns -0.0 into 0.0, so that equal numbers have equal bits.
    places = np.column_stack([points, dual]) + 0.0
    keys = np.concatenate(
        [places.view(np.int64), bone_of, weights.view(np.int64), morph_of], axis=1
    )
    first_vertices, joined = first_of_equal(keys)
    faces = np.concatenate([joined[part.faces + first_vertex[i]] for i, part in enumerate(parts)])
    # The numbers of polygons need only ascend.
    n_before = np.cumsum([0] + [len(part.faces) for part in parts])
    cut_of = np.concatenate(
        [
            n + (np.arange(len(part.faces)) if part.cut_of is None else part.cut_of)
            for n, part in zip(n_before.tolist(), parts, strict=False)
        ]
    )
    is_flat = name_twice(faces)
    morphs = []
    for i, part in enumerate(parts):
        local = first_vertices[
            (first_vertices >= first_vertex[i]) & (first_vertices < first_vertex[i + 1])
        ]
        moved = local[morph_of[local, 0] > 0]
        if len(moved):
            deltas = part.morphs[:, moved - first_vertex[i]]
            morphs.append(_Morphs(i, joined[moved], deltas))
    is_skinned = np.repeat([part.is_skinned for part in parts], np.diff(first_vertex))
    mesh = JoinedMesh(
        _topology(faces, is_flat, len(first_vertices)),
        cut_of[~is_flat],
        joined,
        bones,
        bind,
        bone_of[first_vertices].astype(np.int32),
        weights[first_vertices],
        points[first_vertices],
        is_skinned[first_vertices],
        dual[first_vertices],
        tuple(morphs),
        (),
        (),
    )
    # Faces with collinear or coincident corners.
    flat = degenerate_faces(mesh.topology, mesh.posed(scene.rest)[0])
    is_flat[np.flatnonzero(~is_flat)[flat]] = True
    notes = list(scene.notes)
    if n_joined := len(joined) - len(first_vertices):
        were = "vertex was" if n_joined == 1 else "vertices were"
        notes.append(f"{n_joined} {were} joined with others at seams")
    if n_flat := int(is_flat.sum()):
        were = "face without area was" if n_flat == 1 else "faces without area were"
        notes.append(f"{n_flat} {were} left out")
    return replace(
        mesh,
        topology=_topology(faces, is_flat, len(first_vertices)),
        cut_of=cut_of[~is_flat],
        groups=_groups(parts, is_flat),
        notes=tuple(notes),
    )


def _topology(faces: Int64Array, is_left_out: npt.NDArray[np.bool_], n_vertices: int) -> Topology:
    if len(faces) and is_left_out.all():
        raise MeshFileError(
            "none of its faces has an area in its rest pose",
            "check the scale of what it holds, and export it again",
        )
    if not len(faces):
        raise MeshFileError("it contains vertices but no faces", "export it as a triangle mesh")
    return Topology(faces[~is_left_out], n_vertices)


def _common_bones(parts: tuple[Part, ...]) -> tuple[Int64Array, FloatArray, Int64Array, FloatArray]:
    """Give the bones of all parts common numbers, and sort those of each vertex.

    Returns
    -------
    bones, bind : see `JoinedMesh`; no two pairs are equal
    bone_of : (W, I) int64 array, 0 where the weight is 0
    weights : (W, I) float64 array
    """
    number_of_bone: dict[tuple[int, bytes], int] = {}
    width = max(part.bone_of.shape[1] for part in parts)
    n = sum(len(part.points) for part in parts)
    bone_of, weights = np.zeros((n, width), dtype=np.int64), np.zeros((n, width))
    for part, rows in zip(parts, consecutive(len(part.points) for part in parts), strict=True):
        pairs = zip(part.bones.tolist(), part.bind + 0.0, strict=True)
        numbers = np.array(
            [
                number_of_bone.setdefault((bone, bind.tobytes()), len(number_of_bone))
                for bone, bind in pairs
            ]
        )
        columns = part.bone_of.shape[1]
        weights[rows, :columns] = part.weights
        bone_of[rows, :columns] = np.where(part.weights > 0.0, numbers[part.bone_of], 0)
    # Those without weight come last, with number 0.
    n_bones = len(number_of_bone)
    order = np.argsort(np.where(weights > 0.0, bone_of, n_bones), axis=1, kind="stable")
    bone_of = np.take_along_axis(bone_of, order, axis=1)
    weights = np.take_along_axis(weights, order, axis=1)
    bones, binds = zip(*number_of_bone, strict=True)
    bind = np.frombuffer(b"".join(binds)).reshape(-1, 4, 4).copy()
    return np.array(bones, dtype=np.int64), bind, bone_of, weights


def _morph_numbers(parts: tuple[Part, ...]) -> Int64Array:
    """Return (W, 2) numbers that are equal for vertices with equal morph deltas; 0, 0 for none."""
    result = [np.zeros((len(part.points), 2), dtype=np.int64) for part in parts]
    # The parts that one node shows share their weights.
    for node in {part.node for part in parts}:
        node_parts = [i for i, part in enumerate(parts) if part.node == node and part.morphs.any()]
        n_targets = max((len(parts[i].morphs) for i in node_parts), default=0)
        rows, deltas = [], []
        for i in node_parts:
            moved = np.flatnonzero(parts[i].morphs.any(axis=(0, 2)))
            given = np.zeros((len(moved), n_targets, 3), dtype=np.float32)
            given[:, : len(parts[i].morphs)] = parts[i].morphs[:, moved].transpose(1, 0, 2)
            rows.append(moved)
            deltas.append(given.reshape(len(moved), -1) + np.float32(0.0))
        if not node_parts:
            continue
        _, kind = first_of_equal(np.concatenate(deltas).view(np.int32))
        kinds = np.split(kind, np.cumsum([len(moved) for moved in rows])[:-1])
        for i, moved, which in zip(node_parts, rows, kinds, strict=True):
            result[i][moved, 0], result[i][moved, 1] = node + 1, which
    return np.concatenate(result)


def _groups(parts: tuple[Part, ...], is_left_out: npt.NDArray[np.bool_]) -> tuple[FaceGroup, ...]:
    """Return the faces of each mesh and material, merged by name."""
    number = np.cumsum(~is_left_out) - 1
    faces_of: dict[str, list[Int64Array]] = {}
    meshes: set[str] = set()
    for part, rows in zip(parts, consecutive(len(part.faces) for part in parts), strict=True):
        is_kept = ~is_left_out[rows]
        named = [(part.mesh, is_kept)]
        for index, name in enumerate(part.materials):
            named.append((name, is_kept & (part.material_of == index)))
        for name, group_name in named:
            printable = "".join(filter(str.isprintable, name))[:MAX_GROUP_NAME_LENGTH]
            if printable.strip():
                faces_of.setdefault(printable, []).append(number[rows][group_name])
                meshes |= {printable} if group_name is is_kept else set()
    first_groups = list(faces_of.items())[:MAX_GROUPS]
    # Sorting is several times as fast as np.unique, which hashes.
    group_faces = [(name, np.sort(np.concatenate(faces))) for name, faces in first_groups]
    return tuple(
        FaceGroup(name, faces[np.diff(faces, prepend=-1) > 0], is_material=name not in meshes)
        for name, faces in group_faces
    )
