"""Pose sets: poses of one body as meshes that share their faces; thin, join and write them."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, PoseSetError, ShapeError
from lcollision_core.files.safe import MAX_ITEMS, atomic_write, write_npz
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.json_values import parse_json
from lcollision_core.meshes.contact_rules import (
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
from lcollision_core.meshes.precision import in_unit
from lcollision_core.meshes.topology import FloatArray, Topology

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


def disagreement(where: str, given: Topology, expected: Topology) -> PoseSetError | None:
    """Return the error for a mesh whose topology differs from its set's, None if it is equal."""
    if given.n_vertices != expected.n_vertices:
        what, needed, got = "number of vertices", expected.n_vertices, given.n_vertices
    elif given.n_faces != expected.n_faces:
        what, needed, got = "number of faces", expected.n_faces, given.n_faces
    elif different := np.flatnonzero((given.faces != expected.faces).any(axis=1)).tolist():
        face = different[0]
        needed, got = (topology.faces[face].tolist() for topology in (expected, given))
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
