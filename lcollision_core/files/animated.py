"""Read poses of one mesh over time: clips of scenes, and point caches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.mesh_file import Mesh, read_mesh
from lcollision_core.files.motion.caches import cache_rate, read_point_cache
from lcollision_core.files.scene.joined import JoinedMesh, join_parts, sample_clip
from lcollision_core.files.scene.scene import MAX_FRAME_NUMBERS, Scene, parents_first
from lcollision_core.files.scene_files import as_file_error, read_scene
from lcollision_core.files.table import (
    FILES,
    POINT_CACHE_SUFFIXES,
    READABLE_SUFFIXES,
    SCENE_SUFFIXES,
)
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.face_groups import FaceGroup
from lcollision_core.meshes.joint_kinds import joint_labels, part_labels
from lcollision_core.meshes.outliers import LARGEST_SIZE, is_torn, scale_of
from lcollision_core.meshes.topology import FloatArray, Topology


@dataclass(frozen=True, eq=False)
class AnimatedMesh:
    """The rest pose of a mesh and the frames of its animations.

    Attributes
    ----------
    vertices : (N, V, 3) float64 array; pose 0 is the rest pose
    topology : topology of all poses
    names : "rest", then "wave 0", "wave 1" ...
    notes : sentences on changes made on reading
    up_axis : 0, 1 or 2, None if the file does not define it
    vertex_labels : (V,) strings, the body part of each vertex by the joints; None without joints
    groups : named meshes and materials of a scene
    metres : length of the file's unit, None if the file does not define it
    """

    vertices: FloatArray
    topology: Topology
    names: tuple[str, ...]
    notes: tuple[str, ...]
    up_axis: int | None
    vertex_labels: npt.NDArray[np.str_] | None
    groups: tuple[FaceGroup, ...] = ()
    metres: float | None = None


def read_animated(
    path: Path,
    clip: str | None = None,
    fps: float | None = None,
    job: Job = UNWATCHED,
    topology: Topology | None = None,
) -> AnimatedMesh:
    """Read a scene with animations, or a point cache and the mesh beside it.

    Parameters
    ----------
    path : a file with an extension of `ANIMATED_SUFFIXES`; the mesh of a point cache has the same
        name with the extension of a mesh
    clip : name of one animation of a scene; None for all
    fps : frames per second; None for the clip's keys, at most 30 per second. Not for point caches,
        whose frames are fixed.
    job : reports (frames done, all frames); polled between frames
    topology : topology of another set of the same body, whose triangulation of polygons is used; a
        point cache of as many vertices needs no mesh then, and its first frame is the rest pose

    Raises
    ------
    MeshFileError : a file cannot be read, has no animation or none of that name, a point cache is
        given a clip or a frame rate, or its mesh is missing or has another number of vertices.
    CancelledError : the job was cancelled.
    """
    if path.suffix.lower() not in POINT_CACHE_SUFFIXES:
        return _read_clips(path, clip, fps, job, topology)
    for value, option in ((clip, "clips"), (fps, "frame rate")):
        if value is not None:
            raise MeshFileError(f"is a point cache, which has no {option}", where=path)
    return _read_cache(path, topology)


def frame_rate(path: Path, clip: str | None) -> float | None:
    """Return the frames per second of a point cache, or of a clip of a scene.

    None if the file does not define it.

    Raises
    ------
    MeshFileError : the file cannot be read.
    """
    if path.suffix.lower() in POINT_CACHE_SUFFIXES:
        return cache_rate(path)
    if clip is None or path.suffix.lower() not in SCENE_SUFFIXES:
        return None
    with as_file_error(path):
        return next(
            (scene_clip.rate for scene_clip in read_scene(path).clips if scene_clip.name == clip),
            None,
        )


def _read_clips(
    path: Path,
    clip: str | None,
    fps: float | None,
    job: Job,
    topology: Topology | None,
) -> AnimatedMesh:
    scene = read_scene(path, job)
    with as_file_error(path):
        if not scene.clips:
            cached = [f" ({note})" for note in scene.notes if "geometry cache" in note]
            raise MeshFileError(
                f"it contains no animation{''.join(cached)}, so it is one mesh, not a pose set",
                "name its folder, export it with its animation, or let its rig pose it",
            )
        mesh = join_parts(scene).cut_as(topology)
        frames, names = [mesh.posed(scene.rest)], ["rest"]
        clip_names = [clip] if clip is not None else [scene_clip.name for scene_clip in scene.clips]
        n_numbers = 0
        for number, name in enumerate(clip_names):

            def report(done: int, total: int, number: int = number) -> None:
                job.report(number * total + done, len(clip_names) * total)

            times, poses = sample_clip(scene, name, fps, mesh.topology.n_vertices)
            n_numbers += len(times) * 3 * mesh.topology.n_vertices
            if n_numbers > MAX_FRAME_NUMBERS:
                raise MeshFileError(
                    f"its {len(clip_names)} clips have more than {MAX_FRAME_NUMBERS} coordinates",
                    "choose one of them, or fewer frames a second",
                )
            frames.append(mesh.posed(poses, job.part(report)))
            names += [f"{name} {frame}" for frame in range(len(times))]
    return AnimatedMesh(
        np.concatenate(frames),
        mesh.topology,
        tuple(names),
        mesh.notes,
        _up_axis(scene),
        labels_of(scene, mesh),
        mesh.groups,
        scene.metres,
    )


def labels_of(scene: Scene, mesh: JoinedMesh) -> npt.NDArray[np.str_] | None:
    """Return the (V,) body parts of the vertices by the nodes that move them; None if unskinned."""
    if not mesh.is_skinned.any():
        return None
    order = parents_first(scene.parents)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    parents = scene.parents[order]
    names = [scene.node_names[node] for node in order]
    joint_of = rank[mesh.bones][mesh.bone_of].astype(np.int32)
    labels = joint_labels(names, np.where(parents < 0, -1, rank[parents]))
    return part_labels(labels, joint_of, mesh.weights)


def _read_cache(path: Path, topology: Topology | None) -> AnimatedMesh:
    """Read a point cache, with the mesh beside it, or its own first frame, as pose 0."""
    beside = [path.with_suffix(suffix) for suffix in READABLE_SUFFIXES]
    files = [file for file in beside if file.is_file()]
    frames = read_point_cache(path)
    names = ("rest", *(f"frame {frame}" for frame in range(len(frames))))
    if not files and topology is not None and topology.n_vertices == frames.shape[1]:
        vertices = np.concatenate([frames[:1], frames])
        return AnimatedMesh(vertices, topology, names, (), None, None)
    if not files:
        raise MeshFileError(
            "is a point cache, which has no faces, and its mesh is not beside it",
            f"put it there as {beside[0].name}, or with another extension of a mesh",
            where=path,
        )
    # Reordering to a topology, as for formats that split vertices, would not match the frames.
    is_plain = FILES[files[0].suffix.lower()].keeps_order
    mesh = read_mesh(files[0], topology=topology if is_plain else None)
    n_vertices = frames.shape[1]
    scene = read_scene(files[0]) if files[0].suffix.lower() in SCENE_SUFFIXES else None
    if scene is not None and n_vertices != mesh.topology.n_vertices:
        joined = join_parts(scene).joined
        if len(joined) == n_vertices:
            # The cache has the file's own vertices, before joining at seams: keep one of each.
            frames = frames[:, np.unique(joined, return_index=True)[1]]
    if mesh.topology.n_vertices != frames.shape[1]:
        raise MeshFileError(
            f"holds {n_vertices} vertices per frame, its mesh {files[0].name} has "
            f"{mesh.topology.n_vertices}",
            "export both from the same mesh, without modifiers that add vertices",
            where=path,
        )
    _require_same_body(path, files[0], mesh, frames[0].astype(np.float64))
    vertices = np.concatenate([mesh.vertices[None], frames])
    notes = (f"{files[0].name} is its mesh and rest pose", *mesh.notes)
    return AnimatedMesh(vertices, mesh.topology, names, notes, _up_axis(scene), None)


def _up_axis(scene: Scene | None) -> int | None:
    return None if scene is None or scene.up is None else int(np.abs(scene.up).argmax())


def _require_same_body(path: Path, file: Path, mesh: Mesh, frame: FloatArray) -> None:
    """Refuse a cache whose first frame has another unit or vertex order than the mesh."""
    mesh_lengths, lengths = (
        mesh.topology.edge_lengths(vertices) for vertices in (mesh.vertices, frame)
    )
    scale = scale_of(lengths, mesh_lengths)
    tiny = np.finfo(np.float64).tiny
    if scale is not None and not 1.0 / LARGEST_SIZE < scale < LARGEST_SIZE:
        raise MeshFileError(
            f"is in another unit: its edges are {scale:.3g} times as long as those of {file.name}",
            "export both in one unit",
            where=path,
        )
    mesh_lengths = mesh_lengths / max(body_size(mesh.vertices, mesh.topology), tiny)
    lengths = lengths / max(body_size(frame, mesh.topology), tiny)
    # Either of the two may be the one whose vertices do not match the faces.
    if is_torn(lengths, mesh_lengths) or is_torn(mesh_lengths, lengths):
        raise MeshFileError(
            f"has a different vertex order from {file.name}",
            "export both from the same mesh, the mesh with its vertex order kept",
            where=path,
        )
