"""The body size, which is the unit of normalised lengths, and the up axis."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import Topology


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
