"""Body parts as shapes: their long axes and their far ends."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.limbs import far_apart
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.pose_space import PoseSpace

_END = 0.8
"""Share of a part's vertices that lie before its far end."""

_FRAME = 0.15
"""Normalised: a foot is about so long."""


def long_axis(points: npt.NDArray[np.floating]) -> FloatArray:
    """Return the direction in which (n, 3) points spread most, of length 1.

    Its largest component is positive, so that it does not depend on rounding.
    """
    arms = points.astype(np.float64) - points.mean(axis=0, dtype=np.float64)
    axis: FloatArray = np.linalg.eigh(arms.T @ arms)[1][:, -1]
    axis *= np.sign(axis[np.abs(axis).argmax()])
    return axis


def far_end(space: PoseSpace, domain: int) -> int:
    """Return the vertex in the middle of a body part's end, away from the rest of the body.

    Fingers do not count.

    Parameters
    ----------
    space : of the poses; the end is that of the reference
    domain : index from 0
    """
    inside = _without_fingers(space, domain)
    points = space.rest_vertices[inside]
    axis = long_axis(points)
    along = points @ (
        axis * np.sign(axis @ (points.mean(axis=0) - space.rest_vertices.mean(axis=0)))
    )
    end = along >= np.quantile(along, _END)
    away = np.linalg.norm(points - points[end].mean(axis=0), axis=1)
    return int(inside[end][away[end].argmin()])


def frame_round(space: PoseSpace, vertex: int) -> list[int]:
    """Return vertices that, with a given one, fix the orientation of a hand, foot or head.

    They are as far as possible from it and from each other, within the body part's nearer end.

    Parameters
    ----------
    space : of the poses; distances are those of the reference
    vertex : index from 0
    """
    inside = _without_fingers(space, int(space.vertex_domain[vertex]))
    points = space.rest_vertices
    near = inside[np.linalg.norm(points[inside] - points[vertex], axis=1) < _FRAME]
    return far_apart(points, near, vertex)[1:]


def _without_fingers(space: PoseSpace, domain: int) -> npt.NDArray[np.intp]:
    """Return the vertices of a body part that do not belong to short limbs hanging on it."""
    inside = np.flatnonzero(space.vertex_domain == domain)
    counted = inside[~space.limbs.are_short[space.limbs.leads[inside]]]
    return counted if len(counted) else inside
