"""Pose sets, poses of one body as meshes that share their faces: read, thin and write them."""

from __future__ import annotations

import json
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, MeshFileError, PoseSetError, ShapeError, listed
from lcollision_core.files.animated import read_animated
from lcollision_core.files.mesh_file import (
    KEEP_PRECISION,
    LARGEST_COORDINATE,
    audit_mesh,
    coarseness_of,
    first_not_finite,
    in_unit,
    read_mesh,
)
from lcollision_core.files.safe import MAX_ITEMS, atomic_write, read_npz, write_npz
from lcollision_core.files.table import ANIMATED_SUFFIXES, GLTF_SUFFIXES, READABLE_SUFFIXES
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.json_values import parse_json
from lcollision_core.meshes.contact_rules import (
    CHARACTER_REST_EXCLUSION,
    MAX_GROUP_NAME_LENGTH,
    STRICT,
    ContactRules,
)
from lcollision_core.meshes.extents import UpGuess, body_size, guess_up
from lcollision_core.meshes.face_groups import (
    MAX_GROUPS,
    FaceGroup,
    faces_to_runs,
    require_groups,
    runs_to_faces,
)
from lcollision_core.meshes.outliers import outlier_poses
from lcollision_core.meshes.topology import FloatArray, Topology, degenerate_faces

Arrays = Mapping[str, npt.NDArray[Any]]

RULE_ARRAYS = ("rules", "group_names", "group_runs", "group_ends", "groups_about_joints")

_MAX_JSON_LENGTH = 2_000_000


def rules_to_arrays(rules: ContactRules) -> dict[str, npt.NDArray[Any]]:
    """Encode rules as arrays: "near_exclusion", and "rules" if there are others."""
    arrays: dict[str, npt.NDArray[Any]] = {"near_exclusion": np.array(rules.near_exclusion)}
    if rules != ContactRules(rules.near_exclusion):
        arrays["rules"] = np.array(json.dumps(rules.to_json()))
    return arrays


def rules_from_arrays(arrays: Arrays, near_exclusion: float) -> ContactRules:
    """Decode the rules of a file; older files have the near exclusion only.

    Raises
    ------
    MeshFileError : they are damaged.
    ShapeError : the near exclusion is invalid.
    """

    def rules_of(values: Any) -> ContactRules:
        return replace(ContactRules.from_json(values), near_exclusion=near_exclusion)

    rules: ContactRules | None = _json_in(arrays, "rules", "are damaged", rules_of)
    return ContactRules(near_exclusion) if rules is None else rules


def _json_in(arrays: Arrays, name: str, damage: str, convert: Callable[[Any], Any]) -> Any:
    """Convert the JSON values that an array of one string holds; return None without it."""
    stored = arrays.get(name)
    if stored is None:
        return None
    if stored.shape != () or stored.dtype.kind != "U":
        raise MeshFileError.must_be(name, "one string", f"{stored.dtype} {stored.shape}")
    (text,) = texts_of(stored.reshape(1), name, _MAX_JSON_LENGTH)
    try:
        return convert(parse_json(text.encode()))
    except ValueError as error:
        raise MeshFileError.because(name, damage, error) from error


def groups_to_arrays(groups: Sequence[FaceGroup]) -> dict[str, npt.NDArray[Any]]:
    """Encode groups as arrays: their names, and their concatenated runs of faces."""
    if not groups:
        return {}
    runs = [faces_to_runs(group.faces) for group in groups]
    about_joint = np.array([group.about_joint for group in groups])
    return ({"groups_about_joints": about_joint} if about_joint.any() else {}) | {
        "group_names": np.array([group.name for group in groups]),
        "group_runs": np.concatenate(runs),
        "group_ends": np.cumsum([len(some) for some in runs]),
    }


def groups_from_arrays(arrays: Arrays, n_faces: int) -> tuple[FaceGroup, ...]:
    """Decode the groups of a file whose mesh has `n_faces` faces.

    Raises
    ------
    MeshFileError, ShapeError : they are damaged.
    """
    if "group_names" not in arrays:
        return ()
    names, runs, ends = (arrays.get(name, np.empty(0)) for name in RULE_ARRAYS[1:4])
    if names.dtype.kind != "U" or names.ndim != 1 or len(names) > 2 * MAX_GROUPS:
        expected = f"at most {2 * MAX_GROUPS} strings"
        raise MeshFileError.must_be("group_names", expected, f"{names.dtype} {names.shape}")
    for name, array in (("group_runs", runs), ("group_ends", ends)):
        if array.dtype.kind != "i" or array.ndim != 1:
            expected = "a list of whole numbers"
            raise MeshFileError.must_be(name, expected, f"{array.dtype} {array.shape}")
    about_joint = arrays.get(RULE_ARRAYS[4], np.zeros(len(names), dtype=np.bool_))
    if about_joint.dtype != np.bool_ or about_joint.shape != names.shape:
        expected = "true or false for each group"
        got = f"{about_joint.dtype} {about_joint.shape}"
        raise MeshFileError.must_be(RULE_ARRAYS[4], expected, got)
    starts = np.concatenate([[0], ends[:-1]])
    if len(ends) != len(names) or (ends < starts).any() or ends[-1:].tolist() != [len(runs)]:
        raise MeshFileError("do not fit together", where="group_names, group_runs and group_ends")
    return tuple(
        FaceGroup(name, runs_to_faces(runs[start:end], n_faces), about)
        for name, start, end, about in zip(
            texts_of(names, "group_names", MAX_GROUP_NAME_LENGTH),
            starts,
            ends,
            about_joint.tolist(),
            strict=True,
        )
    )


def texts_of(value: npt.NDArray[np.str_], name: str, most: int) -> tuple[str, ...]:
    """Return the strings of an array, cut to `most` characters and made printable.

    Raises
    ------
    MeshFileError : a code point is beyond Unicode.
    """
    native = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("="))
    if (native.view(np.uint32) > sys.maxunicode).any():
        raise MeshFileError("contains a character that does not exist", where=name)
    # A lone surrogate, from an undecodable file name, cannot be printed.
    return tuple(text[:most].encode(errors="replace").decode() for text in native.tolist())


def provenance_from_arrays(arrays: Arrays) -> dict[str, Any]:
    """Return the provenance of a file's poses, JSON values by name; empty if there is none.

    Raises
    ------
    MeshFileError : it is damaged.
    """
    values = _json_in(arrays, "provenance", "is damaged", lambda values: values)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise MeshFileError.must_be("provenance", "JSON values by name", type(values).__name__)
    return values


FORMAT_VERSION = 2
"""The latest version that is read; sets without the rules it added are written as version 1."""

_MESH_ARRAYS = (("vertices", "V"), ("faces", "F"))
_EXTRA_ARRAYS = (
    *("format_version", "names", "notes", "near_exclusion", "up_axis", "vertex_labels"),
    *("metres", "provenance"),
    *RULE_ARRAYS,
)
_MAX_TEXT_LENGTH = 500


@dataclass(frozen=True, eq=False)
class PoseSet:
    """N poses of one mesh.

    Attributes
    ----------
    vertices : (N, V, 3) float32 or float64 array, read-only, in the files' unit; pose 0 is the
        reference
    topology : the faces that all poses share
    names : N names, of the mesh files or such as "pose 12"
    source : the folder or file that it was read from, if any
    notes : sentences on changes made on reading
    rules : contact rules
    groups : named groups of faces, which the rules may refer to
    up_axis : 0, 1 or 2 for x, y or z; None to guess it
    vertex_labels : (V,) array of printable strings, the body part of each vertex, if known
    provenance : how the poses were made, as JSON values by name
    metres : length of the vertices' unit, None if unknown

    Raises
    ------
    ShapeError : the arrays do not match, a value is out of range, or a vertex's label is blank or
        not printable.
    """

    vertices: npt.NDArray[Any]
    topology: Topology
    names: tuple[str, ...]
    source: Path | None = None
    notes: tuple[str, ...] = ()
    rules: ContactRules = STRICT
    groups: tuple[FaceGroup, ...] = ()
    up_axis: int | None = None
    vertex_labels: npt.NDArray[np.str_] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    metres: float | None = None

    def __post_init__(self) -> None:
        shape = self.vertices.shape
        if len(shape) != 3 or shape[1:] != (self.topology.n_vertices, 3) or shape[0] == 0:
            raise ShapeError.must_be(
                "vertices", f"(N, {self.topology.n_vertices}, 3) with N > 0", shape
            )
        if self.vertices.dtype not in (np.float32, np.float64):
            raise ShapeError.must_be("vertices", "float32 or float64", self.vertices.dtype)
        if len(self.names) != shape[0]:
            raise ShapeError.must_be("names", f"one for each of {shape[0]} poses", len(self.names))
        if self.up_axis not in (None, 0, 1, 2):
            raise ShapeError.must_be("up_axis", "0, 1 or 2", self.up_axis)
        if self.metres is not None and not 0.0 < self.metres < np.inf:
            raise ShapeError.must_be("metres", "a number above 0", self.metres)
        if not self.near_exclusion < 1.0:
            raise ShapeError.must_be("near_exclusion", "in [0, 1)", self.near_exclusion)
        require_groups(self.rules, self.groups, self.topology.n_faces)
        if self.vertex_labels is not None:
            if self.vertex_labels.shape != shape[1:2]:
                raise ShapeError.must_be(
                    "vertex_labels", f"({shape[1]},)", self.vertex_labels.shape
                )
            _require_labels(self.vertex_labels)
        # A view, so that the caller's array stays writable.
        view = self.vertices.view()
        view.flags.writeable = False
        object.__setattr__(self, "vertices", view)

    def __len__(self) -> int:
        """N, the number of poses."""
        return len(self.vertices)

    def scaled(self, factor: float) -> PoseSet:
        """Return the same poses in another unit, as float64.

        Raises
        ------
        ShapeError : the factor is not a number above 0, or a coordinate would overflow.
        """
        vertices = in_unit(self.vertices, factor)
        metres = None if self.metres is None else self.metres / factor
        return replace(self, vertices=vertices, metres=metres)

    @property
    def near_exclusion(self) -> float:
        """Normalised length along the surface within which pairs do not count."""
        return self.rules.near_exclusion

    @property
    def up(self) -> UpGuess:
        """The up axis stored in the set, else a guess from its poses."""
        if self.up_axis is not None:
            return UpGuess(self.up_axis, True, "the set says so")
        return guess_up(self.topology, self.vertices)

    @property
    def faces(self) -> npt.NDArray[np.int32]:
        """(F, 3) int32 array, vertex indices from 0, read-only."""
        return self.topology.faces


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


def disagreement(where: str, found: Topology, expected: Topology) -> PoseSetError | None:
    """Return the error for a mesh whose topology differs from its set's, None if it is equal."""
    if found.n_vertices != expected.n_vertices:
        what, needed, got = "number of vertices", expected.n_vertices, found.n_vertices
    elif found.n_faces != expected.n_faces:
        what, needed, got = "number of faces", expected.n_faces, found.n_faces
    elif different := np.flatnonzero((found.faces != expected.faces).any(axis=1)).tolist():
        face = different[0]
        needed, got = (topology.faces[face].tolist() for topology in (expected, found))
        what = f"face {face}"
    else:
        return None
    return PoseSetError(
        f"has another {what} than the set",
        "remove it or export it with the set's topology",
        where=where,
        expected=needed,
        got=got,
    )


def _collect_frames(
    path: Path,
    report: Callable[[LCollisionError], None],
    job: Job,
    clip: str | None,
    fps: float | None,
    topology: Topology | None,
) -> PoseSetInspection:
    try:
        frames = read_animated(path, clip, fps, job, topology)
    except MeshFileError as error:
        report(error)
        return PoseSetInspection(None)
    pose_set = PoseSet(
        frames.vertices,
        frames.topology,
        frames.names,
        path,
        frames.notes,
        up_axis=frames.up_axis,
        vertex_labels=frames.vertex_labels,
        rules=ContactRules(rest_exclusion=CHARACTER_REST_EXCLUSION),
        groups=frames.groups,
        metres=frames.metres,
    )
    usable = _usable(pose_set, report)
    return PoseSetInspection(usable, len(frames.vertices), same_topology=True)


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
    arrays: dict[str, npt.NDArray[Any]], held: Sequence[str]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    meshes = []
    for name, short_name in _MESH_ARRAYS:
        if name not in arrays:
            others = listed(sorted(held))[:_MAX_TEXT_LENGTH]
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


def _require_labels(vertex_labels: npt.NDArray[np.str_]) -> None:
    labels = vertex_labels.tolist()
    for label in dict.fromkeys(labels):
        if not label.strip() or not label.isprintable():
            raise ShapeError.must_be(
                "vertex_labels",
                "printable and not blank",
                f"{label[:80]!r} for vertex {labels.index(label)} (from 0)",
                "name the body part of every vertex",
            )


def write_pose_set(path: str | os.PathLike[str], pose_set: PoseSet) -> None:
    """Write a pose set as .npz atomically; equal sets give equal bytes.

    Parameters
    ----------
    path : an .npz file in an existing folder
    pose_set : the pose set; its `source` is not stored

    Raises
    ------
    MeshFileError : the extension is not .npz or the file cannot be written.
    """
    if Path(path).suffix.lower() != ".npz":
        raise MeshFileError.unwritable(path, "a pose set is an .npz file", "rename it")
    rules = pose_set.rules
    needs_latest = rules.joint_exclusion or rules.touching or rules.near_by_limb
    arrays: dict[str, npt.NDArray[Any]] = {
        "format_version": np.array(FORMAT_VERSION if needs_latest else 1),
        "vertices": pose_set.vertices,
        "faces": pose_set.faces,
        "names": np.array(pose_set.names, dtype=np.str_),
        **rules_to_arrays(pose_set.rules),
        **groups_to_arrays(pose_set.groups),
    }
    if pose_set.notes:
        arrays["notes"] = np.array(pose_set.notes, dtype=np.str_)
    if pose_set.up_axis is not None:
        arrays["up_axis"] = np.array(pose_set.up_axis)
    if pose_set.metres is not None:
        arrays["metres"] = np.array(pose_set.metres)
    if pose_set.vertex_labels is not None:
        arrays["vertex_labels"] = pose_set.vertex_labels
    if pose_set.provenance:
        arrays["provenance"] = np.array(json.dumps(dict(pose_set.provenance), allow_nan=False))
    with atomic_write(path) as file:
        write_npz(file, arrays)


def concatenated(pose_sets: Sequence[PoseSet]) -> PoseSet:
    """Concatenate the poses of several sets; the first one has the reference.

    The reference of a later set is left out if it equals the first one's. Everything but poses and
    notes is taken from the first set; names are prefixed by their file's if there are several. If
    a set has a provenance, that of the result lists all `sources`.

    Parameters
    ----------
    pose_sets : one or more sets of the same topology

    Raises
    ------
    PoseSetError : the topologies differ, or there are too many coordinates.
    """
    first = pose_sets[0]
    if len(pose_sets) == 1:
        return first
    one_file = len({poses.source for poses in pose_sets}) == 1
    vertices, names, notes = [], [], []
    for poses in pose_sets:
        if (defect := disagreement(str(poses.source), poses.topology, first.topology)) is not None:
            raise defect
        is_repeated = poses is not first and np.array_equal(poses.vertices[0], first.vertices[0])
        rows = slice(1, None) if is_repeated else slice(None)
        stem = poses.source.stem if poses.source and not one_file else ""
        vertices.append(poses.vertices[rows])
        names += [f"{stem} {name}".strip() for name in poses.names[rows]]
        notes += [f"{stem}: {note}" if stem else note for note in poses.notes]
    n_items = sum(some.size for some in vertices)
    if n_items > MAX_ITEMS:
        raise PoseSetError(
            f"the sets have {n_items} coordinates, at most {MAX_ITEMS} can be read",
            "name fewer files, or fewer frames a second",
        )
    return replace(
        first,
        vertices=np.concatenate(vertices),
        names=tuple(names),
        notes=tuple(dict.fromkeys(notes)),
        provenance=_provenance(pose_sets, list(map(len, vertices))),
    )


def _provenance(pose_sets: Sequence[PoseSet], counts: Sequence[int]) -> dict[str, Any]:
    """Return the sources of the poses in order, if any set has a provenance."""
    if not any(poses.provenance for poses in pose_sets):
        return {}
    parts: list[dict[str, Any]] = []
    for poses, count in zip(pose_sets, counts, strict=True):
        stored_sources = poses.provenance.get("sources")
        if isinstance(stored_sources, list):
            parts += stored_sources
        else:
            file = {"file": poses.source.name} if poses.source else {}
            parts.append({**file, "poses": count, **poses.provenance})
    return {"sources": parts}


TOLERANCE = 0.005
"""In body sizes, about the reconstruction error of a latent space. It keeps all 71 SCAPE poses, 145
of the 150 frames of the published jump, and 89 of the mannequin's clip and rest pose. With 0.01 it
would be 71, 137 and 47, but turning only the head by 35 degrees moves the mannequin by 0.0065, and
closing one hand by 0.011."""

_VERTICES = 500
"""Number of vertices by which poses are compared, evenly spaced among all."""


def thinned(poses: PoseSet, tolerance: float = TOLERANCE, job: Job = UNWATCHED) -> PoseSet:
    """Leave out near-duplicates of poses, up to rigid motion.

    Two poses are near-duplicates if the root mean square distance of their vertices, after rigid
    alignment, is below the tolerance. The first of them is kept, so pose 0 always is.

    Parameters
    ----------
    poses : the set
    tolerance : in body sizes
    job : polled between poses

    Returns
    -------
    poses : the remaining poses in order, with a note on how many were left out

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    pose_numbers = _kept(poses, tolerance, job)
    n_left_out = len(poses) - len(pose_numbers)
    if not n_left_out:
        return poses
    what = "1 pose is" if n_left_out == 1 else f"{n_left_out} poses are"
    note = f"{what} left out as nearly the same as others, within {100 * tolerance:g} % of the body"
    return replace(
        poses,
        vertices=poses.vertices[pose_numbers],
        names=tuple(poses.names[pose] for pose in pose_numbers),
        notes=(*poses.notes, f"{note} size"),
    )


def _kept(poses: PoseSet, tolerance: float, job: Job) -> list[int]:
    used = poses.topology.used_vertices
    sample = used[np.unique(np.linspace(0, len(used) - 1, _VERTICES).astype(np.int64))]
    size = body_size(poses.vertices[0], poses.topology)
    points = poses.vertices[:, sample].astype(np.float64) / size
    points -= points.mean(axis=1, keepdims=True)
    # A rigid motion keeps the distance of two vertices, and moving them by a and b changes it by at
    # most a + b, so half the sum of squared changes of disjoint pairs is a lower bound.
    half = len(sample) // 2
    spans = np.linalg.norm(points[:, :half] - points[:, half : 2 * half], axis=2)
    pose_numbers: list[int] = []
    for pose, vertices in enumerate(points):
        job.check()
        least = ((spans[pose_numbers] - spans[pose]) ** 2).sum(axis=1) / (2 * len(sample))
        near = np.array(pose_numbers, dtype=np.int64)[least < tolerance**2]
        if (_squared_distances(points[near], vertices) >= tolerance**2).all():
            pose_numbers.append(pose)
    return pose_numbers


def _squared_distances(poses: FloatArray, vertices: FloatArray) -> FloatArray:
    """Return mean squared distances of (K, n, 3) poses rotated onto (n, 3) vertices; all centred.

    With the best rotation, the trace of the covariance is the sum of its singular values, the last
    one negative if a reflection would fit better (Kabsch 1976).
    """
    covariance = np.einsum("ni,knj->kij", vertices, poses, optimize=True)
    values = np.linalg.svd(covariance, compute_uv=False)
    values[:, 2] *= np.sign(np.linalg.det(covariance))
    squares = (poses**2).sum(axis=(1, 2)) + (vertices**2).sum()
    distances: FloatArray = (squares - 2.0 * values.sum(axis=1)) / len(vertices)
    return distances


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
