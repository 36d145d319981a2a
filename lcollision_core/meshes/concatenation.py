"""Several pose sets of one body as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lcollision_core.errors import PoseSetError
from lcollision_core.meshes.npz import MAX_ITEMS
from lcollision_core.meshes.pose_set import PoseSet, disagreement


def concatenated(pose_sets: Sequence[PoseSet]) -> PoseSet:
    """Return the poses of several sets, of which the first has the reference.

    The reference of a later set is left out where it is the first one's. What else a set has is
    taken from the first; names get their file's before them if there are several. Where a set has
    a provenance, that of the result lists all `sources`.

    Parameters
    ----------
    pose_sets : one or more of one topology

    Raises
    ------
    PoseSetError : the topology differs, or there are too many coordinates.
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
        kept = slice(1, None) if is_repeated else slice(None)
        stem = poses.source.stem if poses.source and not one_file else ""
        vertices.append(poses.vertices[kept])
        names += [f"{stem} {name}".strip() for name in poses.names[kept]]
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
    """Say which file each part of the poses is of, where one of them says how it was made."""
    if not any(poses.provenance for poses in pose_sets):
        return {}
    parts: list[dict[str, Any]] = []
    for poses, count in zip(pose_sets, counts, strict=True):
        known = poses.provenance.get("sources")
        if isinstance(known, list):
            parts += known
        else:
            file = {"file": poses.source.name} if poses.source else {}
            parts.append({**file, "poses": count, **poses.provenance})
    return {"sources": parts}
