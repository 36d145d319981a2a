"""Contact rules and groups of faces as the arrays of a pose set's file."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import parse_json
from lcollision_core.meshes.contact_rules import MAX_NAME_LENGTH, ContactRules
from lcollision_core.meshes.face_groups import (
    MAX_GROUPS,
    FaceGroup,
    faces_to_runs,
    runs_to_faces,
)

Arrays = Mapping[str, npt.NDArray[Any]]

RULE_ARRAYS = ("rules", "group_names", "group_runs", "group_ends", "groups_about_joints")

_MAX_RULES_LENGTH = 2_000_000
_MAX_PROVENANCE_LENGTH = 2_000_000


def rules_to_arrays(rules: ContactRules) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of some rules: "near_exclusion", and "rules" where there are others."""
    arrays: dict[str, npt.NDArray[Any]] = {"near_exclusion": np.array(rules.near_exclusion)}
    if rules != ContactRules(rules.near_exclusion):
        arrays["rules"] = np.array(json.dumps(rules.to_json()))
    return arrays


def rules_from_arrays(arrays: Arrays, near_exclusion: float) -> ContactRules:
    """Return the rules of a file, of which older ones have the near exclusion only.

    Raises
    ------
    MeshFileError : they are damaged.
    ShapeError : the near exclusion is not a length.
    """
    stored = arrays.get("rules")
    if stored is None:
        return ContactRules(near_exclusion)
    if stored.shape != () or stored.dtype.kind != "U":
        raise MeshFileError.must_be("rules", "one string", f"{stored.dtype} {stored.shape}")
    (text,) = texts_of(stored.reshape(1), "rules", _MAX_RULES_LENGTH)
    try:
        rules = ContactRules.from_json(parse_json(text.encode()))
        return replace(rules, near_exclusion=near_exclusion)
    except ValueError as error:
        raise MeshFileError.because("rules", "are damaged", error) from error


def groups_to_arrays(groups: Sequence[FaceGroup]) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of groups: their names, and their runs of faces one after the other."""
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
    """Return the groups of a file whose mesh has so many faces.

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
            texts_of(names, "group_names", MAX_NAME_LENGTH),
            starts,
            ends,
            about_joint.tolist(),
            strict=True,
        )
    )


def texts_of(value: npt.NDArray[np.str_], name: str, most: int) -> tuple[str, ...]:
    """Return the texts of an array, cut to a length, that can be printed.

    Raises
    ------
    MeshFileError : a character does not exist.
    """
    native = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("="))
    if (native.view(np.uint32) > sys.maxunicode).any():
        raise MeshFileError("contains a character that does not exist", where=name)
    # A lone surrogate, from an undecodable file name, cannot be printed.
    return tuple(text[:most].encode(errors="replace").decode() for text in native.tolist())


def provenance_from_arrays(arrays: Arrays) -> dict[str, Any]:
    """Return how the poses of a file were made, JSON values by name; empty where it does not say.

    Raises
    ------
    MeshFileError : it is damaged.
    """
    stored = arrays.get("provenance")
    if stored is None:
        return {}
    if stored.shape != () or stored.dtype.kind != "U":
        raise MeshFileError.must_be("provenance", "one string", f"{stored.dtype} {stored.shape}")
    (text,) = texts_of(stored.reshape(1), "provenance", _MAX_PROVENANCE_LENGTH)
    try:
        values = parse_json(text.encode())
    except ValueError as error:
        raise MeshFileError.because("provenance", "is damaged", error) from error
    if not isinstance(values, dict):
        raise MeshFileError.must_be("provenance", "JSON values by name", type(values).__name__)
    return values
