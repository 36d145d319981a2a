"""Guess the up axis from the shape of the poses, and whether the guess is reliable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError, cKDTree

from lcollision_core.meshes.topology import FloatArray, Topology
from lcollision_core.meshes.units import up_axis

_MOST_POSES = 12
_SUPPORT, _LEGS = 0.04, 0.12
"""Fractions of the extent along the axis: heights of the support, and of the legs."""
_CELLS = 24
_SYMMETRIC = 0.01
"""Largest mean distance of a symmetric body from its mirror image, normalised."""
_LEAST_EXTENT = 0.35
"""Fraction of the longest side; along an axis of smaller extent, a body lies and does not stand."""
_LONGEST = 0.1
_SURE = 0.15


@dataclass(frozen=True)
class UpGuess:
    """A guess of the up axis.

    Attributes
    ----------
    axis : 0, 1 or 2 for x, y or z
    is_sure : whether the shape leaves no doubt
    reason : the reason, for a message such as "y is up (...)"
    """

    axis: int
    is_sure: bool
    reason: str


def guess_up(topology: Topology, vertices: npt.NDArray[Any]) -> UpGuess:
    """Guess the up axis from the support of a body.

    A body is assumed to stand on narrow legs, with its centre above its support, in most of its
    poses, and never on a side, as given by its plane of symmetry.

    Parameters
    ----------
    topology : topology of all poses
    vertices : (N, V, 3) array, the first the reference

    Returns
    -------
    guess : the longest axis if the support is inconclusive
    """
    some = np.linspace(0, len(vertices) - 1, min(len(vertices), _MOST_POSES)).astype(int)
    poses = [np.asarray(vertices[pose], np.float64)[topology.used_index] for pose in some]
    longest = up_axis(np.asarray(vertices[0]), topology)
    scores = np.array([_standing(poses, axis) for axis in range(3)])
    extents = np.median([np.ptp(pose, axis=0) for pose in poses], axis=0)
    scores[extents < _LEAST_EXTENT * extents.max()] = 0.0
    scores[longest] += _LONGEST
    side = _side(poses[0])
    if side is not None:
        scores[side] = 0.0
    first, second = np.argsort(-scores, kind="stable")[:2]
    is_sure = bool(scores[first] > 0.0 and scores[first] - scores[second] >= _SURE)
    if not is_sure:
        axis = longest if longest != side else int(first)
        return UpGuess(
            axis, False, "what it stands on doesn't show it, so the longest side decides"
        )
    return UpGuess(int(first), True, "it stands on that end in most poses")


def _standing(poses: list[FloatArray], axis: int) -> float:
    """Return the mean score over the poses of standing along an axis, the better way up."""
    return max(
        float(np.mean([_stands(sign * pose, axis) for pose in poses])) for sign in (1.0, -1.0)
    )


def _stands(pose: FloatArray, axis: int) -> float:
    """Return 0 if a body would fall, else the fraction of its shadow not covered by legs."""
    level = pose[:, axis] - pose[:, axis].min()
    extent = max(float(level.max()), np.finfo(np.float64).tiny)
    flat = np.delete(pose, axis, axis=1)
    try:
        hull = ConvexHull(flat[level <= _SUPPORT * extent])
    except (QhullError, ValueError):  # too few points, or all on a line: no stable support
        return 0.0
    middle = flat.mean(axis=0)
    if (hull.equations[:, :2] @ middle + hull.equations[:, 2]).max() > 0.0:
        return 0.0
    low, size = flat.min(axis=0), max(float(np.ptp(flat, axis=0).max()), np.finfo(float).tiny)
    cells = np.minimum((_CELLS * (flat - low) / size).astype(int), _CELLS - 1) @ [1, _CELLS]
    legs = len(np.unique(cells[level <= _LEGS * extent]))
    return 1.0 - legs / len(np.unique(cells))


def _side(reference: FloatArray) -> int | None:
    """Return the normal axis of the body's plane of symmetry, None if there is not exactly one."""
    extent = float(np.ptp(reference, axis=0).max())
    if extent == 0.0:
        return None
    tree = cKDTree(reference)
    distances = []
    for axis in range(3):
        image = reference.copy()
        image[:, axis] = image[:, axis].min() + image[:, axis].max() - image[:, axis]
        distances.append(float(tree.query(image)[0].mean()) / extent)
    nearest, other = np.sort(distances)[:2]
    return int(np.argmin(distances)) if nearest < _SYMMETRIC and other > 3.0 * nearest else None
