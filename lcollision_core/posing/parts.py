"""Body parts as shapes: their long axes and their far ends."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.pose_space import PoseSpace

_END = 0.8
"""Share of a part's vertices that lie before its far end."""


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

    Parameters
    ----------
    space : of the poses; the end is that of the reference
    domain : index from 0
    """
    inside = np.flatnonzero(space.vertex_domain == domain)
    points = space.rest_vertices[inside]
    axis = long_axis(points)
    along = points @ (
        axis * np.sign(axis @ (points.mean(axis=0) - space.rest_vertices.mean(axis=0)))
    )
    end = along >= np.quantile(along, _END)
    away = np.linalg.norm(points - points[end].mean(axis=0), axis=1)
    return int(inside[end][away[end].argmin()])
