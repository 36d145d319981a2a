"""The body size, which is the unit of normalised lengths, and guesses of the up axis and front."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import FloatArray, Topology


def _sides(vertices: npt.NDArray[Any], topology: Topology | None) -> npt.NDArray[np.float64]:
    """Return half of each side of the bounding box, as a whole side may overflow."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
        raise ShapeError.must_be("vertices", "a (V, 3) array with V > 0", vertices.shape)
    points = 0.5 * np.asarray(vertices, dtype=np.float64)
    if topology is not None and len(topology.unused_vertices):
        points = points[topology.used_vertices]
    sides: npt.NDArray[np.float64] = points.max(axis=0) - points.min(axis=0)
    return sides


def body_size(vertices: npt.NDArray[Any], topology: Topology | None = None) -> float:
    """Return the body size: the longest side of the bounding box of a mesh.

    Parameters
    ----------
    vertices : (V, 3) array, the reference mesh, in the file's unit
    topology : topology of the mesh; if given, vertices that no face uses are ignored

    Returns
    -------
    the size in the same unit; normalised lengths are divided by it

    Raises
    ------
    ShapeError : `vertices` is not (V, 3), or is empty.
    """
    return 2.0 * float(_sides(vertices, topology).max())


def box_corners(points: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the (4, 8) homogeneous corners of the bounding box of (N, 3) points."""
    low, high = points.min(axis=0), points.max(axis=0)
    corners = np.array([np.where(bits, high, low) for bits in np.ndindex(2, 2, 2)])
    return np.append(corners, np.ones((8, 1)), axis=1).T


def up_axis(vertices: npt.NDArray[Any], topology: Topology | None = None) -> int:
    """Return the axis along which a mesh is longest: 0, 1 or 2 for x, y or z.

    Parameters
    ----------
    vertices : (V, 3) array, the reference mesh
    topology : see `body_size`

    Raises
    ------
    ShapeError : `vertices` is not (V, 3), or is empty.
    """
    return int(_sides(vertices, topology).argmax())


def front_direction(vertices: npt.NDArray[Any], up_axis: int) -> npt.NDArray[np.float64]:
    """Guess the direction that a body faces: along its thinner level axis, where its toes point.

    Parameters
    ----------
    vertices : (V, 3) array, the reference mesh, upright
    up_axis : 0, 1 or 2

    Returns
    -------
    direction : (3,) float64 array, a unit vector along an axis
    """
    level_axes = [axis for axis in range(3) if axis != up_axis]
    depth = min(level_axes, key=lambda axis: float(np.ptp(vertices[:, axis])))
    level = vertices[:, up_axis]
    direction: npt.NDArray[np.float64] = np.eye(3)[depth]
    lowest = vertices[level < level.min() + 0.04 * np.ptp(level), depth]
    ankles = vertices[
        (level > level.min() + 0.06 * np.ptp(level)) & (level < level.min() + 0.12 * np.ptp(level)),
        depth,
    ]
    if len(lowest) and len(ankles) and lowest.mean() < ankles.mean():
        direction = -direction
    return direction


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
        hull = scipy.spatial.ConvexHull(flat[level <= _SUPPORT * extent])
    except (scipy.spatial.QhullError, ValueError):
        return 0.0  # too few points, or all on a line: no stable support
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
    tree = scipy.spatial.cKDTree(reference)
    distances = []
    for axis in range(3):
        image = reference.copy()
        image[:, axis] = image[:, axis].min() + image[:, axis].max() - image[:, axis]
        distances.append(float(tree.query(image)[0].mean()) / extent)
    nearest, other = np.sort(distances)[:2]
    return int(np.argmin(distances)) if nearest < _SYMMETRIC and other > 3.0 * nearest else None
