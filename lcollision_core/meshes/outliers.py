"""Find poses of a set that show another body: another size or vertex order."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import PoseSetError
from lcollision_core.meshes.topology import FloatArray, Topology

LARGEST_SIZE = 1.25
"""Largest ratio of two sizes of one body; poses stretch its edges by a few percent."""

_UNIFORM = 1.5
"""Largest ratio of the 90th to the 10th percentile of edge scales if only the unit differs."""

_TORN = 3.0
"""Median edge scale above which the edges must join the wrong vertices."""

_COMPARED_POSES = 25


def scale_of(lengths: FloatArray, known: FloatArray) -> float | None:
    """Return the common scale of edges relative to known lengths, None if it varies.

    Parameters
    ----------
    lengths, known : (E,) lengths of the same edges
    """
    low, middle, high = _spread(lengths, known)
    return None if high > _UNIFORM * low else middle


def is_torn(lengths: FloatArray, known: FloatArray) -> bool:
    """Whether edges are so much longer than known that they must join the wrong vertices.

    Parameters
    ----------
    lengths, known : (E,) lengths of the same edges, of meshes of similar size
    """
    low, middle, high = _spread(lengths, known)
    return high > _UNIFORM * low and middle > _TORN


def outlier_poses(topology: Topology, vertices: npt.NDArray[Any]) -> dict[int, PoseSetError]:
    """Find the poses that do not show the same body as most poses.

    Parameters
    ----------
    topology : topology of all poses
    vertices : (N, V, 3) finite array

    Returns
    -------
    defects : the error of each such pose, by its index
    """
    if len(vertices) < 2:
        return {}
    some = np.linspace(0, len(vertices) - 1, min(len(vertices), _COMPARED_POSES)).astype(int)
    lengths = np.array([topology.edge_lengths(vertices[pose]) for pose in some])
    # Not the mean of the middle two, which could mix a right length with a wrong one.
    middle = (len(some) - 1) // 2
    reference_lengths = (
        lengths[0] if len(some) == 2 else np.partition(lengths, middle, axis=0)[middle]
    )
    defects = {}
    for pose, mesh in enumerate(vertices):
        mesh_lengths = topology.edge_lengths(mesh)
        scale = scale_of(mesh_lengths, reference_lengths)
        if scale is None:
            if is_torn(mesh_lengths, reference_lengths):
                defects[pose] = PoseSetError(
                    "connects other vertices than the other poses, as if in another vertex order",
                    "export it with the set's vertex order",
                )
        elif not 1.0 / LARGEST_SIZE < scale < LARGEST_SIZE:
            defects[pose] = PoseSetError("has no size", "remove it")
            if 0.0 < scale < np.inf:
                what = f"is {scale:.3g} times as large as the other poses"
                defects[pose] = PoseSetError(what, f"scale it by {1.0 / scale:.3g}")
    return defects


def _spread(lengths: FloatArray, known: FloatArray) -> tuple[float, float, float]:
    """Return the 10th, 50th and 90th percentiles of the ratios of edge lengths to known ones."""
    used = known > 0.0
    if not used.any():
        return 1.0, 1.0, 1.0
    low, middle, high = np.percentile(lengths[used] / known[used], (10, 50, 90))
    return float(low), float(middle), float(high)
