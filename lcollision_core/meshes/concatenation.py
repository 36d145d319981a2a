"""Several pose sets of one body as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lcollision_core.errors import PoseSetError
from lcollision_core.meshes.npz import MAX_ITEMS
from lcollision_core.meshes.pose_set import PoseSet, disagreement


def concatenated(pose_sets: Sequence[PoseSet]) -> PoseSet:
    """Return the poses of several sets, of which the first has the reference.

    The reference of a later set is left out where it is the first one's. What else a set has is
    taken from the first; names get their file's before them.

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
    vertices, names, notes = [], [], []
    for poses in pose_sets:
        if (defect := disagreement(str(poses.source), poses.topology, first.topology)) is not None:
            raise defect
        is_repeated = poses is not first and np.array_equal(poses.vertices[0], first.vertices[0])
        kept = slice(1, None) if is_repeated else slice(None)
        stem = poses.source.stem if poses.source else ""
        vertices.append(poses.vertices[kept])
        names += [f"{stem} {name}".strip() for name in poses.names[kept]]
        notes += [f"{stem}: {note}" for note in poses.notes]
    n_items = sum(some.size for some in vertices)
    if n_items > MAX_ITEMS:
        raise PoseSetError(
            f"the sets have {n_items} coordinates, at most {MAX_ITEMS} can be read",
            "name fewer files, or fewer frames a second",
        )
    return replace(first, vertices=np.concatenate(vertices), names=tuple(names), notes=tuple(notes))
