"""How far edges are longer than in any plausible pose."""

from __future__ import annotations

import math

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray, IntArray


@compiled
def largest_stretch(vertices: FloatArray, edges: IntArray, longest: FloatArray) -> float:
    """Return the largest ratio of an edge to its longest length in plausible poses.

    Parameters
    ----------
    vertices : (V, 3) float64 array, in normalised length
    edges : (E, 2) int32 array
    longest : (E,) float64 array, likewise: see `PoseSpace.longest_edges`
    """
    largest = 0.0
    for edge in range(len(edges)):
        largest = max(largest, _length(vertices, edges[edge, 0], edges[edge, 1]) / longest[edge])
    return largest


@compiled
def excess_stretch(
    vertices: FloatArray, edges: IntArray, longest: FloatArray, slope: FloatArray
) -> float:
    """Measure what edges are stretched beyond 1: the root of the sum of squares.

    Parameters
    ----------
    vertices, edges, longest : see `largest_stretch`
    slope : (V, 3) float64 array, overwritten with its derivative by the vertices, 0 where no edge
        is stretched

    Returns
    -------
    excess : 0 or more
    """
    slope[:] = 0.0
    squared_excess = 0.0
    for edge in range(len(edges)):
        start, end = edges[edge, 0], edges[edge, 1]
        length = _length(vertices, start, end)
        if length > longest[edge]:
            beyond = length / longest[edge] - 1.0
            squared_excess += beyond * beyond
            for axis in range(3):
                along = vertices[end, axis] - vertices[start, axis]
                by_end = along * beyond / (length * longest[edge])
                slope[end, axis] += by_end
                slope[start, axis] -= by_end
    excess = math.sqrt(squared_excess)
    if excess > 0.0:
        slope /= excess
    return excess


@compiled
def _length(vertices: FloatArray, start: int, end: int) -> float:
    x = vertices[end, 0] - vertices[start, 0]
    y = vertices[end, 1] - vertices[start, 1]
    z = vertices[end, 2] - vertices[start, 2]
    return math.sqrt(x * x + y * y + z * z)
