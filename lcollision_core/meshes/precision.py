"""Whether vertices are finite, and whether a number format can hold them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import Topology

LARGEST_RATIO = 0.01
"""Largest rounding step of a coordinate, relative to a short edge. Above it, faces lose their
shape, and results for a mesh do not hold for its file."""

_SHORT_EDGES = 10.0
"""Percentile of the edge lengths that defines a short edge."""


def rounding_step(
    vertices: npt.NDArray[Any], topology: Topology, dtype: npt.DTypeLike
) -> tuple[float, float]:
    """Return the largest rounding step of a mesh's coordinates, and its ratio to a short edge.

    Parameters
    ----------
    vertices : (V, 3) finite array; vertices that no face uses are ignored
    topology : topology of the mesh
    dtype : float32 or float64, in which the coordinates are stored

    Returns
    -------
    step : in the mesh's unit
    ratio : the step divided by the 10th percentile of the edge lengths above 0; 0 if there are none
    """
    used = np.asarray(vertices, dtype=np.float64)[topology.used_index]
    farthest = float(np.abs(used).max())
    # The spacing of the largest number is infinite.
    nearer = min(farthest, float(np.finfo(dtype).max) / 2.0)
    step = float(np.spacing(np.asarray(nearer, dtype=dtype)))
    # Scale to at most 1, so that squares do not overflow.
    points = np.zeros((topology.n_vertices, 3))
    points[topology.used_index] = used / (farthest or 1.0)
    lengths = topology.edge_lengths(points)
    lengths = lengths[lengths > 0.0]
    if not len(lengths):
        return step, 0.0
    return step, step / farthest / float(np.percentile(lengths, _SHORT_EDGES))


def can_hold(vertices: npt.NDArray[Any], topology: Topology, dtype: npt.DTypeLike) -> bool:
    """Whether rounding to a number format preserves the shape of a mesh at its location.

    Parameters and terms are those of `rounding_step`.
    """
    return rounding_step(vertices, topology, dtype)[1] <= LARGEST_RATIO


def first_not_finite(vertices: npt.NDArray[Any], largest: float = np.inf) -> int | None:
    """Return the first of (V, 3) vertices with a NaN or infinite coordinate, None if there is none.

    Coordinates beyond `largest` count as infinite.
    """
    finite = np.isfinite(vertices) & (np.abs(vertices) <= np.float64(largest))
    if finite.all():
        return None
    return int(np.flatnonzero(~finite.all(axis=1))[0])


LARGEST_COORDINATE = 1e150
"""Largest coordinate, whose square is finite."""


def in_unit(vertices: npt.NDArray[Any], factor: float) -> npt.NDArray[np.float64]:
    """Return vertices in another unit, as float64.

    Raises
    ------
    ShapeError : the factor is not a number above 0, or makes the square of a coordinate overflow.
    """
    if not 0.0 < factor < np.inf:
        advice = "give the factor from the file's unit to the model's"
        raise ShapeError.must_be("the scale", "a number above 0", f"{factor:g}", advice)
    if factor > 1.0 and float(np.abs(vertices).max(initial=0.0)) > LARGEST_COORDINATE / factor:
        raise ShapeError("is too large for the coordinates", where=f"the scale {factor:g}")
    scaled: npt.NDArray[np.float64] = vertices.astype(np.float64) * factor
    return scaled
