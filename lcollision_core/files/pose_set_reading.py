"""Read pose sets: folders of meshes, .npz files, clips of scenes, and point caches."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, MeshFileError, PoseSetError, listed
from lcollision_core.files.formats import (
    ANIMATED_SUFFIXES,
    FILES,
    GLTF_SUFFIXES,
    POINT_CACHE_SUFFIXES,
    READABLE_SUFFIXES,
    SCENE_SUFFIXES,
)
from lcollision_core.files.mesh_file import (
    KEEP_PRECISION,
    Mesh,
    audit_mesh,
    coarseness_of,
    read_mesh,
)
from lcollision_core.files.motion.caches import cache_rate, read_point_cache
from lcollision_core.files.pose_set import (
    FORMAT_VERSION,
    RULE_ARRAYS,
    PoseSet,
    disagreement,
    groups_from_arrays,
    provenance_from_arrays,
    rules_from_arrays,
    texts_of,
)
from lcollision_core.files.safe import MAX_ITEMS, read_npz
from lcollision_core.files.scene.joined import JoinedMesh, join_parts, sample_clip
from lcollision_core.files.scene.scene import MAX_FRAME_NUMBERS, Scene, parents_first
from lcollision_core.files.scene_files import as_file_error, read_scene
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.contact_rules import CHARACTER_REST_EXCLUSION, ContactRules
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.joint_kinds import joint_labels, part_labels
from lcollision_core.meshes.outliers import LARGEST_SIZE, is_torn, outlier_poses, scale_of
from lcollision_core.meshes.precision import LARGEST_COORDINATE, first_not_finite
from lcollision_core.meshes.topology import FloatArray, Topology, degenerate_faces

_FRAME_RULES = ContactRules(rest_exclusion=CHARACTER_REST_EXCLUSION)
"""The rules of poses that were read as frames of a motion."""

_MESH_ARRAYS = (("vertices", "V"), ("faces", "F"))
_EXTRA_ARRAYS = (
    *("format_version", "names", "notes", "near_exclusion", "up_axis", "vertex_labels"),
    *("metres", "provenance"),
    *RULE_ARRAYS,
)
_MAX_TEXT_LENGTH = 500


def natural_key(path: Path) -> tuple[list[str | int], str]:
    """Return a sort key that puts mesh2.obj before mesh10.obj, ignoring case."""
    parts = re.split(r"([0-9]+)", path.stem.casefold())
    # Every second part is digits, so numbers are only compared with numbers.
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], path.name


def mesh_files(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the mesh files of a folder in natural order, and the names of its other entries.

    Hidden files are ignored.

    Raises
    ------
    MeshFileError : the folder cannot be listed.
    """
    try:
        entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise MeshFileError.because(folder, "cannot be listed", error) from error
    files = [entry for entry in entries if entry.suffix.lower() in READABLE_SUFFIXES]
    others = sorted({entry.name for entry in entries} - {file.name for file in files})
    return sorted(files, key=natural_key), others


def read_pose_set(
    path: str | os.PathLike[str],
    job: Job = UNWATCHED,
    *,
    clip: str | None = None,
    fps: float | None = None,
    topology: Topology | None = None,
) -> PoseSet:
    """Read a pose set, and refuse it at the first defect.

    Parameters
    ----------
    path : a folder of mesh files of one format, read in natural order; an .npz file with
        `vertices` (N, V, 3) and `faces` (F, 3), also called `V` and `F`; a .glb, .gltf, .vrm or
        .fbx file with animations, whose rest pose becomes pose 0; or a .pc2 or .mdd file with its
        mesh beside it, which becomes pose 0
    job : reports (poses done, all poses); polled between poses
    clip : name of one animation of a file; None for all
    fps : frames per second of an animation; None for its keys, at most 30 per second
    topology : topology of another set of the same body, whose triangulation of polygons is used

    Returns
    -------
    the pose set; its vertices are float64, except that an .npz file's keep their precision

    Raises
    ------
    MeshFileError : the folder or a file cannot be read.
    PoseSetError : a pose has another vertex count or other faces than the first, another size or
        vertex order than most, or a triangle of the first has no area.
    CancelledError : the job was cancelled.
    """

    def refuse(defect: LCollisionError) -> None:
        raise defect

    pose_set = collect_poses(Path(path), refuse, job, clip, fps, topology).pose_set
    if pose_set is None:
        raise MeshFileError("contains no poses", "name another folder or file", where=path)
    require_usable_reference(pose_set)
    return pose_set


def require_usable_reference(poses: PoseSet) -> None:
    """Refuse a set whose reference has a face without area.

    Raises
    ------
    PoseSetError : the message names the set's source.
    """
    flat = degenerate_faces(poses.topology, poses.vertices[0])
    if len(flat):
        face = int(flat[0])
        raise PoseSetError(
            f"cannot be used: {len(flat)} faces of the reference, {_numbered(poses, 0)}, "
            f"have no area, the first is face {face} between vertices "
            f"{poses.faces[face].tolist()}",
            "remove them from all poses",
            where=poses.source,
        )


@dataclass(frozen=True, eq=False)
class PoseSetInspection:
    """Result of reading a path that should hold a pose set.

    Attributes
    ----------
    pose_set : the poses that match the first readable one; None if none can be used
    n_found : number of poses present, usable or not
    same_topology : whether all readable poses share their vertex count and faces
    defects : defects of the set and its poses, in the order found
    problems : a sentence for each defect, including those of the reference, pose 0
    """

    pose_set: PoseSet | None
    n_found: int = 0
    same_topology: bool = False
    defects: tuple[LCollisionError, ...] = ()
    problems: tuple[str, ...] = ()


def collect_poses(
    path: Path,
    report: Callable[[LCollisionError], None],
    job: Job = UNWATCHED,
    clip: str | None = None,
    fps: float | None = None,
    topology: Topology | None = None,
) -> PoseSetInspection:
    """Read all poses that match the first, and report each defect.

    Parameters
    ----------
    path : see `read_pose_set`
    report : called with each defect; raise in it to stop reading
    job, clip, fps, topology : see `read_pose_set`
    """
    try:
        is_folder, exists = path.is_dir(), path.exists()
    except OSError as error:
        report(MeshFileError.unreadable(path, error, "check the name"))
        return PoseSetInspection(None)
    if is_folder:
        return _without_outliers(_collect_folder(path, report, job, topology), report)
    suffix = path.suffix.lower()
    if exists and suffix in ANIMATED_SUFFIXES:
        return _collect_frames(path, report, job, clip, fps, topology)
    if exists and suffix == ".npz":
        return _without_outliers(_collect_npz(path, report, job), report)
    what = "is not a pose set" if exists else "does not exist"
    next_step = "name a folder of meshes, a character or an .npz file"
    if exists and suffix in READABLE_SUFFIXES:
        what, next_step = "is one mesh, not a pose set", "name its folder"
    report(MeshFileError(what, next_step, where=path))
    return PoseSetInspection(None)


def _too_far_to_compute(where: str, vertices: npt.NDArray[Any]) -> PoseSetError | None:
    """Return the error for a vertex of a pose that is not finite or too far out, if any."""
    vertex = first_not_finite(vertices, LARGEST_COORDINATE)
    if vertex is None:
        return None
    what = (
        f"has vertex {vertex} (from 0) at ({', '.join(f'{x:g}' for x in vertices[vertex])}), which "
        f"is not finite or beyond {LARGEST_COORDINATE:g}"
    )
    return PoseSetError(what, "remove or scale that pose", where=where)


def _without_outliers(
    collected: PoseSetInspection, report: Callable[[LCollisionError], None]
) -> PoseSetInspection:
    """Leave out poses of another body or in another unit."""
    poses = collected.pose_set
    outliers = {} if poses is None else outlier_poses(poses.topology, poses.vertices)
    if poses is None or not outliers:
        return collected
    for pose, defect in outliers.items():
        report(PoseSetError.from_error(defect, f"pose {poses.names[pose]} of {poses.source}"))
    inliers = [pose for pose in range(len(poses)) if pose not in outliers]
    return replace(collected, pose_set=_only(poses, inliers))


def _only(poses: PoseSet, kept: list[int]) -> PoseSet | None:
    """Return the kept poses of a set, or None if there are none."""
    if len(kept) in (0, len(poses)):
        return poses if kept else None
    names = tuple(poses.names[pose] for pose in kept)
    return replace(poses, vertices=poses.vertices[kept], names=names)


def _collect_folder(
    path: Path,
    report: Callable[[LCollisionError], None],
    job: Job,
    expected: Topology | None,
) -> PoseSetInspection:
    try:
        files, others = mesh_files(path)
    except MeshFileError as error:
        report(error)
        return PoseSetInspection(None)
    formats = Counter(file.suffix.lower() for file in files)
    if len(formats) != 1:
        counts = ", ".join(f"{count} {suffix}" for suffix, count in sorted(formats.items()))
        what, next_step = "contains no mesh", "name a folder of .obj, .ply, .off or .stl files"
        if formats:
            what = f"contains meshes of several formats ({counts})"
            next_step = "keep one format in a folder"
        report(MeshFileError(what, next_step, where=path))
        return PoseSetInspection(None, len(files))
    notes: Counter[str] = Counter()
    names: list[str] = []
    topology: Topology | None = None
    vertices = np.empty((0, 0, 3))
    same_topology = True
    for pose, file in enumerate(files):
        job.check()
        try:
            mesh = read_mesh(file, topology=topology or expected)
        except MeshFileError as error:
            report(error)
        else:
            if topology is None:
                topology = mesh.topology
                shape = len(files), topology.n_vertices, 3
                if np.prod(shape) > MAX_ITEMS:
                    what = f"holds {shape[0]} poses of {shape[1]} vertices, more than {MAX_ITEMS}"
                    advice = "keep fewer poses or decimate them"
                    report(MeshFileError(f"{what} coordinates", advice, where=path))
                    return PoseSetInspection(None, len(files))
                vertices = np.empty(shape, dtype=np.float64)
            where = f"pose {pose} ({file.name})"
            if (defect := disagreement(where, mesh.topology, topology)) is not None:
                same_topology = False
                report(defect)
            elif (too_far := _too_far_to_compute(where, mesh.vertices)) is not None:
                report(too_far)
            elif mesh.coarseness:
                report(PoseSetError(f"is damaged: {mesh.coarseness}", KEEP_PRECISION, where=where))
            else:
                vertices[len(names)] = mesh.vertices
                names.append(file.name)
                notes.update(mesh.notes)
        job.report(pose + 1, len(files))
    if topology is None:
        return PoseSetInspection(None, len(files))
    sentences = [
        note if times == len(names) else f"{note} (in {times} of {len(names)} files)"
        for note, times in notes.items()
    ]
    if others:
        sentences.append(f"entries that are no meshes were ignored: {listed(others, 5)}")
    # The glTF standard defines y as up.
    up_axis = 1 if formats.keys() <= set(GLTF_SUFFIXES) else None
    pose_set = PoseSet(
        vertices[: len(names)], topology, tuple(names), path, tuple(sentences), up_axis=up_axis
    )
    return PoseSetInspection(pose_set, len(files), same_topology)


def _collect_frames(
    path: Path,
    report: Callable[[LCollisionError], None],
    job: Job,
    clip: str | None,
    fps: float | None,
    topology: Topology | None,
) -> PoseSetInspection:
    try:
        poses = read_animated(path, clip, fps, job, topology)
    except MeshFileError as error:
        report(error)
        return PoseSetInspection(None)
    return PoseSetInspection(_usable(poses, report), len(poses), same_topology=True)


def _collect_npz(
    path: Path, report: Callable[[LCollisionError], None], job: Job
) -> PoseSetInspection:
    try:
        arrays, name_of = read_npz(path, (*_MESH_ARRAYS, *((name,) for name in _EXTRA_ARRAYS)))
        vertices, faces = _meshes_of(arrays, name_of)
        topology = Topology(faces, vertices.shape[1])
        names = tuple(f"pose {pose}" for pose in range(len(vertices)))
        extras = {"names": names} | _extras_of(arrays, vertices.shape)
        rules = rules_from_arrays(arrays, extras.pop("near_exclusion", 0.0))
        groups = groups_from_arrays(arrays, topology.n_faces)
        extras["provenance"] = provenance_from_arrays(arrays)
        pose_set = PoseSet(vertices, topology, source=path, rules=rules, groups=groups, **extras)
    except LCollisionError as error:
        report(MeshFileError.because(path, "cannot be read as a pose set", error))
        return PoseSetInspection(None)
    usable = _usable(pose_set, report, is_rounded=vertices.dtype == np.float32)
    job.report(len(vertices), len(vertices))
    return PoseSetInspection(usable, len(vertices), same_topology=True)


def _numbered(poses: PoseSet, pose: int) -> str:
    """Return a pose's number from 0, and its name if that says more."""
    number, name = f"pose {pose}", poses.names[pose]
    return number if name == number else f"{number} ({name})"


def _usable(
    poses: PoseSet, report: Callable[[LCollisionError], None], *, is_rounded: bool = False
) -> PoseSet | None:
    """Return the poses that can be computed with; check how coarse they are if rounded."""
    kept = []
    for pose, vertices in enumerate(poses.vertices):
        where = f"{_numbered(poses, pose)} of {poses.source}"
        if (too_far := _too_far_to_compute(where, vertices)) is not None:
            report(too_far)
        elif is_rounded and (coarseness := coarseness_of(vertices, poses.topology)):
            report(PoseSetError(f"is damaged: {coarseness}", KEEP_PRECISION, where=where))
        else:
            kept.append(pose)
    return _only(poses, kept)


def _meshes_of(
    arrays: dict[str, npt.NDArray[Any]], names: Sequence[str]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    meshes = []
    for name, short_name in _MESH_ARRAYS:
        if name not in arrays:
            others = listed(sorted(names))[:_MAX_TEXT_LENGTH]
            only = f", only {others}" if others else ""
            raise MeshFileError(f"it has no array {name!r} or {short_name!r}{only}")
        meshes.append(arrays[name])
    vertices, faces = meshes
    if vertices.ndim != 3 or vertices.shape[2] != 3 or 0 in vertices.shape:
        raise MeshFileError.must_be("vertices", "(N, V, 3) with N, V > 0", vertices.shape)
    if vertices.dtype.kind != "f" or vertices.dtype.itemsize not in (4, 8):
        raise MeshFileError.must_be("vertices", "float32 or float64", vertices.dtype)
    native = np.float32 if vertices.dtype.itemsize == 4 else np.float64
    return np.ascontiguousarray(vertices, dtype=native), faces


def _extras_of(arrays: dict[str, npt.NDArray[Any]], shape: tuple[int, ...]) -> dict[str, Any]:
    """Return the optional arguments of `PoseSet` from the arrays beside (N, V, 3) vertices."""
    extras: dict[str, Any] = {}
    for name, kinds, needed in (
        ("format_version", "iu", ()),
        ("near_exclusion", "fiu", ()),
        ("metres", "f", ()),
        ("up_axis", "iu", ()),
        ("names", "U", shape[:1]),
        ("notes", "U", (np.size(arrays.get("notes", ())),)),
        ("vertex_labels", "U", shape[1:2]),
    ):
        value = arrays.get(name)
        if value is None:
            continue
        if value.shape != needed or value.dtype.kind not in kinds:
            expected = f"{needed} strings" if kinds == "U" else "one number"
            raise MeshFileError.must_be(name, expected, f"{value.dtype} {value.shape}")
        convert = float if "f" in kinds else int
        extras[name] = texts_of(value, name, _MAX_TEXT_LENGTH) if kinds == "U" else convert(value)
    if (version := extras.pop("format_version", FORMAT_VERSION)) > FORMAT_VERSION:
        raise MeshFileError.too_new("it", version, FORMAT_VERSION)
    if "vertex_labels" in extras:
        extras["vertex_labels"] = np.array(extras["vertex_labels"])
    return extras


def inspect_pose_set(
    path: str | os.PathLike[str],
    job: Job = UNWATCHED,
) -> PoseSetInspection:
    """Read the usable poses of a pose set and list every defect instead of raising the first.

    Parameters
    ----------
    path : see `read_pose_set`
    job : reports (poses done, all poses)

    Returns
    -------
    the usable poses and the defects
    """
    defects: list[LCollisionError] = []
    poses = collect_poses(Path(path), defects.append, job)
    problems = [str(defect) for defect in defects]
    if poses.pose_set is not None:
        where = _numbered(poses.pose_set, 0)
        reference = audit_mesh(poses.pose_set.topology, poses.pose_set.vertices[0])
        problems += [f"{where}: {problem}" for problem in reference]
    return replace(poses, defects=tuple(defects), problems=tuple(problems))


def read_animated(
    path: Path,
    clip: str | None = None,
    fps: float | None = None,
    job: Job = UNWATCHED,
    topology: Topology | None = None,
) -> PoseSet:
    """Read a scene with animations, or a point cache and the mesh beside it; pose 0 is at rest.

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
) -> PoseSet:
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
    return PoseSet(
        np.concatenate(frames),
        mesh.topology,
        tuple(names),
        path,
        mesh.notes,
        _FRAME_RULES,
        mesh.groups,
        _up_axis(scene),
        labels_of(scene, mesh),
        metres=scene.metres,
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


def _read_cache(path: Path, topology: Topology | None) -> PoseSet:
    """Read a point cache, with the mesh beside it, or its own first frame, as pose 0."""
    beside = [path.with_suffix(suffix) for suffix in READABLE_SUFFIXES]
    files = [file for file in beside if file.is_file()]
    frames = read_point_cache(path)
    names = ("rest", *(f"frame {frame}" for frame in range(len(frames))))
    if not files and topology is not None and topology.n_vertices == frames.shape[1]:
        vertices = np.concatenate([frames[:1], frames])
        return PoseSet(vertices, topology, names, path, rules=_FRAME_RULES)
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
    up_axis = _up_axis(scene)
    return PoseSet(vertices, mesh.topology, names, path, notes, _FRAME_RULES, up_axis=up_axis)


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
