"""Named groups of faces: the meshes, materials, objects and body parts of a file."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, ShapeError, listed
from lcollision_core.meshes.contact_rules import MAX_GROUP_NAME_LENGTH, ContactRules
from lcollision_core.meshes.topology import Topology

MAX_GROUPS = 1000
"""Most groups of one mesh."""

GROUP_KINDS = ("meshes and materials", "body parts", "components")
"""Kinds of groups of faces, from those named in the file to those found by connectivity."""


_LISTED = 8
"""Most names that an error message lists."""


@dataclass(frozen=True, eq=False)
class FaceGroup:
    """A named group of faces: those of a mesh, a material, an object or a body part.

    Attributes
    ----------
    name : as in the file
    faces : (n,) int64 array of ascending indices
    about_joint : whether these are the faces about the joint of this name, of the parts that it
        links. Such groups are for exclusions at joints and thin limbs; users cannot name them.
    is_material : whether only materials of the file have this name, no mesh
    """

    name: str
    faces: npt.NDArray[np.int64]
    about_joint: bool = False
    is_material: bool = False


def without_joints(groups: Iterable[FaceGroup]) -> tuple[FaceGroup, ...]:
    """Return the groups that users can name: all but those about joints."""
    return tuple(group for group in groups if not group.about_joint)


def component_groups(topology: Topology) -> tuple[FaceGroup, ...]:
    """Return the connected components of a mesh; "component 1" has the most faces."""
    _, of_vertex = topology.vertex_components
    _, of_face, sizes = np.unique(
        of_vertex[topology.faces[:, 0]], return_inverse=True, return_counts=True
    )
    order = np.argsort(-sizes, kind="stable")
    return tuple(
        FaceGroup(f"component {n + 1}", np.flatnonzero(of_face == component))
        for n, component in enumerate(order)
    )


def component_labels(topology: Topology) -> npt.NDArray[np.str_]:
    """Return the (V,) names of the vertices' components, "" for unused vertices."""
    groups = component_groups(topology)
    labels = np.zeros(topology.n_vertices, dtype=f"<U{max(len(group.name) for group in groups)}")
    for group in groups:
        labels[topology.faces[group.faces]] = group.name
    return labels


def part_groups(topology: Topology, vertex_labels: npt.NDArray[np.str_]) -> tuple[FaceGroup, ...]:
    """Return the faces of each body part: that of two of a face's corners, or else of the first.

    Parameters
    ----------
    vertex_labels : (V,) names of the parts
    """
    first, second, third = vertex_labels[topology.faces].T
    of_face = np.where(second == third, second, first)
    return tuple(
        FaceGroup(str(name), np.flatnonzero(of_face == name)) for name in np.unique(of_face)
    )


def groups_by_kind(
    groups: Sequence[FaceGroup],
    topology: Topology,
    vertex_labels: npt.NDArray[np.str_] | None = None,
) -> dict[str, tuple[FaceGroup, ...]]:
    """Return the groups of a mesh by kind, with its body parts and components of other names.

    Parameters
    ----------
    groups : groups of the mesh; body parts and components among them are listed as such
    vertex_labels : (V,) names of body parts, if they are known

    Returns
    -------
    groups by kind, for each of `GROUP_KINDS`
    """
    parts = () if vertex_labels is None else part_groups(topology, vertex_labels)
    computed = (parts, component_groups(topology))
    known_groups = {(group.name, group.faces.tobytes()) for kind in computed for group in kind}
    file_groups = tuple(
        group
        for group in without_joints(groups)
        if (group.name, group.faces.tobytes()) not in known_groups
    )
    used_names = {group.name for group in file_groups}
    others = (tuple(group for group in kind if group.name not in used_names) for kind in computed)
    return dict(zip(GROUP_KINDS, (file_groups, *others), strict=True))


def with_named_groups(
    groups: Sequence[FaceGroup],
    kinds: Mapping[str, Sequence[FaceGroup]],
    names: Iterable[str],
) -> tuple[FaceGroup, ...]:
    """Return the groups of a mesh, and those of `kinds` that rules name.

    Parameters
    ----------
    groups : groups of the mesh
    kinds : all groups by kind: see `groups_by_kind`
    names : see `ContactRules.named_groups`
    """
    named = {group.name for group in without_joints(groups)}
    missing_names = {*names} - named
    return (
        *groups,
        *(group for kind in kinds.values() for group in kind if group.name in missing_names),
    )


def named_pair(
    entry: str, names: Collection[str], what_it_is: str = "the ignored pair"
) -> tuple[str, str]:
    """Split "A:B" into two of `names`, which may contain colons.

    `what_it_is` begins the error message.

    Raises
    ------
    LCollisionError : it is not two of the names.
    """
    splits = [
        (entry[:at].strip(), entry[at + 1 :].strip())
        for at, character in enumerate(entry)
        if character == ":"
    ]
    for first, second in splits:
        if first in names and second in names:
            return first, second
    where, next_step = f"{what_it_is} {entry!r}", f"name two of {listed(sorted(names))}"
    if not splits:
        what = "is not A:B with the names of two groups of faces"
        raise LCollisionError(what, next_step, where=where)
    unknown = next(name for name in splits[0] if name not in names)
    what = f"names {unknown!r}, which is not a group of faces of this mesh"
    raise LCollisionError(what, next_step, where=where)


def touching_groups(
    entries: Iterable[str], groups: Sequence[FaceGroup]
) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """Return the faces of the pairs of groups "A:B" that may touch.

    Parameters
    ----------
    groups : groups of the mesh; those of the same name are merged

    Raises
    ------
    LCollisionError : an entry is not two of the names.
    """
    groups = without_joints(groups)
    names = {group.name for group in groups}
    pairs = (named_pair(entry, names, "the pair that may touch") for entry in entries)

    def faces(name: str) -> npt.NDArray[np.int64]:
        return np.concatenate([group.faces for group in groups if group.name == name])

    return [(faces(first), faces(second)) for first, second in pairs]


def named_group(entry: str, names: Collection[str]) -> str:
    """Return `entry` if it is the name of a group.

    Raises
    ------
    LCollisionError : there is no such group; the message lists similar names.
    """
    if entry in names:
        return entry
    by_small = {name.lower(): name for name in sorted(names)}
    near = get_close_matches(entry.lower(), by_small, _LISTED, 0.5)
    near += [small for small in by_small if entry.lower() in small and small not in near]
    near_names = listed(by_small[small] for small in near or by_small)
    raise LCollisionError(
        "is not a group of faces of this mesh",
        f"name one of {near_names}" if near_names else "",
        where=repr(entry),
    )


def require_groups(rules: ContactRules, groups: Sequence[FaceGroup], n_faces: int) -> None:
    """Refuse invalid groups, and rules that name missing groups.

    Raises
    ------
    ShapeError : a group or a rule is refused.
    """
    named = without_joints(groups)
    for what, n in (("groups of faces", len(named)), ("joints", len(groups) - len(named))):
        if n > MAX_GROUPS:
            raise ShapeError.must_be(f"the {what}", f"at most {MAX_GROUPS}", n)
    for group in groups:
        where = f"the group {group.name[:80]!r}"
        if not 0 < len(group.name) <= MAX_GROUP_NAME_LENGTH or not group.name.isprintable():
            allowed = f"named in 1 to {MAX_GROUP_NAME_LENGTH} printable characters"
            raise ShapeError.must_be("a group of faces", allowed, repr(group.name[:80]))
        faces = group.faces
        if faces.ndim != 1 or faces.dtype.kind != "i" or (np.diff(faces) <= 0).any():
            raise ShapeError("must list its faces once each, ascending", where=where)
        if len(faces) and not 0 <= faces[0] <= faces[-1] < n_faces:
            outside = faces[0] if faces[0] < 0 else faces[-1]
            raise ShapeError.must_be(where, f"of faces from 0 to {n_faces - 1}", int(outside))
    group_names = dict.fromkeys(group.name for group in named)
    for name in rules.named_groups:
        if name not in group_names:
            expected = listed(map(repr, group_names)) or "none: the mesh has no groups"
            raise ShapeError("is unknown", where=f"the group {name!r}", expected=expected)


def ignored_faces_digest(rules: ContactRules, groups: Iterable[FaceGroup]) -> str:
    """Return a digest of the groups that the rules use; empty if there are none."""
    names = rules.named_groups
    used = [
        group
        for group in groups
        if (
            rules.joint_exclusion or rules.near_by_limb
            if group.about_joint
            else group.name in names
        )
    ]
    if not used:
        return ""
    digest = hashlib.sha256()
    for group in sorted(used, key=lambda group: (group.about_joint, group.name)):
        digest.update(f"{group.name}\n{len(group.faces)}\n".encode())
        digest.update(group.faces.astype("<i8").tobytes())
    return digest.hexdigest()


def faces_to_runs(faces: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Encode ascending faces as runs: first, last plus one, first, last plus one ..."""
    if not len(faces):
        return np.empty(0, dtype=np.int64)
    breaks = np.flatnonzero(np.diff(faces) != 1)
    firsts, lasts = faces[np.r_[0, breaks + 1]], faces[np.r_[breaks, len(faces) - 1]]
    return np.stack([firsts, lasts + 1], axis=1).ravel().astype(np.int64)


def runs_to_faces(runs: npt.NDArray[np.integer], n_faces: int) -> npt.NDArray[np.int64]:
    """Decode the runs of `faces_to_runs` for a mesh of `n_faces` faces.

    Raises
    ------
    ShapeError : they are not ascending runs within the mesh.
    """
    sound = runs.ndim == 1 and len(runs) % 2 == 0 and (np.diff(runs) > 0).all()
    if not sound or (len(runs) and not 0 <= runs[0] < runs[-1] <= n_faces):
        raise ShapeError("are not runs that ascend", where="the faces of a group")
    inside = np.zeros(n_faces + 1, dtype=np.int8)
    inside[runs[0::2]], inside[runs[1::2]] = 1, -1
    return np.flatnonzero(np.cumsum(inside, dtype=np.int8))
