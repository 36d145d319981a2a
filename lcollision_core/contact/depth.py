"""Exact penetration depth of two triangles, in closed form.

The depth of Tan et al. (2021) is the shortest translation that separates two triangles. It is
the distance from the origin to the boundary of their Minkowski difference, a convex polytope
whose faces are normal to one of eleven directions: the two triangle normals and the nine cross
products of an edge of one with an edge of the other. Along a direction ``d`` the triangles are
separated by moving one of them by the smaller overlap of their projections, so the depth is the
minimum of these overlaps over ``|d|``, and a direction without overlap makes it zero.
"""
# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.contact.kernels import fill_depths
from lcollision_core.errors import ShapeError

FloatArray = npt.NDArray[np.float64]


def penetration_depth(
    triangles_a: npt.ArrayLike, triangles_b: npt.ArrayLike, tolerance: float = 0.0
) -> FloatArray:
    """Measure how far each triangle of a is inside the triangle of b with the same index.

    Parameters
    ----------
    triangles_a, triangles_b : (P, 3, 3) arrays of corners, any length unit
    tolerance : depths up to this are contacts and count as 0, in the same unit

    Returns
    -------
    penetration_depth : (P,) float64 array >= 0, in the same unit; 0 where the triangles are
        disjoint or only touch. Coplanar triangles touch at most.

    Raises
    ------
    ShapeError : the arrays are not both (P, 3, 3), or hold NaN or infinity, or `tolerance` is
        negative or NaN.

    Notes
    -----
    PD of Tan et al. 2021, section "Collision-Free Constraints". A triangle without area is
    treated as the segment or point that it is.

    Examples
    --------
    >>> a = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
    >>> b = [[[0.2, 0.2, -0.1], [0.2, 0.2, 0.3], [0.3, 0.2, 0.3]]]
    >>> penetration_depth(a, b).round(3).tolist()
    [0.1]
    """
    if not tolerance >= 0.0:
        raise ShapeError.must_be("the tolerance", "0 or more", tolerance)
    corners, scale = in_unit_scale(triangles_a, triangles_b)
    depths = np.empty(len(corners))
    fill_depths(corners.reshape(-1, 3, 3), tolerance / scale, depths)
    return depths * scale


def in_unit_scale(
    triangles_a: npt.ArrayLike, triangles_b: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Scale pairs of triangles to a size of about 1 near the origin, and return their scale.

    This keeps products of edges from underflow and overflow. The scale is a power of two, so that
    exact contact stays exact.

    Parameters
    ----------
    triangles_a, triangles_b : (P, 3, 3) arrays of corners

    Returns
    -------
    corners : (P, 2, 3, 3) float64 array
    scale : (P,) float64 array > 0

    Raises
    ------
    ShapeError : the arrays are not both (P, 3, 3), or hold NaN or infinity.
    """
    first = np.asarray(triangles_a, dtype=np.float64)
    second = np.asarray(triangles_b, dtype=np.float64)
    if first.ndim != 3 or first.shape[1:] != (3, 3) or first.shape != second.shape:
        raise ShapeError.must_be(
            "triangles", "two (P, 3, 3) arrays of one length", f"{first.shape} and {second.shape}"
        )
    corners = np.stack([first, second], axis=1)
    if not np.isfinite(corners).all():
        pair = int(np.flatnonzero(~np.isfinite(corners).all(axis=(1, 2, 3)))[0])
        raise ShapeError("has a corner that is not finite", where=f"triangle pair {pair}")
    origin = corners[:, :1, :1]
    _, exponent = np.frexp(np.abs(corners - origin).max(axis=(1, 2, 3), initial=0.0))
    scale: FloatArray = np.ldexp(1.0, exponent - 1)
    return (corners - origin) / scale[:, None, None, None], scale


_PARALLEL_SINE_SQUARED = 1e-12


def depth_slopes(
    triangles_a: npt.ArrayLike, triangles_b: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Differentiate the penetration depth of pairs of triangles by their corners.

    Parameters
    ----------
    triangles_a, triangles_b : (P, 3, 3) arrays of corners

    Returns
    -------
    penetration_depth : (P,) float64 array; 0 or less where a pair is apart
    slopes : (P, 6, 3) float64 array, its derivative by the corners of a, then of b

    Notes
    -----
    The derivative is that of the overlap along the direction of least overlap, which turns with
    the two edges that span it.
    """
    corners = np.stack([triangles_a, triangles_b], axis=1).astype(np.float64)
    corners -= corners.mean(axis=(1, 2), keepdims=True)
    depths, slopes = np.empty(len(corners)), np.zeros((len(corners), 2, 3, 3))
    _fill_depth_slopes(corners, depths, slopes)
    return depths, slopes.reshape(-1, 6, 3)


@compiled
def _fill_depth_slopes(corners: FloatArray, depths: FloatArray, slopes: FloatArray) -> None:
    """Fill (P,) depths and (P, 2, 3, 3) slopes, which start at 0, of (P, 2, 3, 3) triangles."""
    for pair in range(len(corners)):
        depths[pair] = _depth_slope(corners[pair], slopes[pair])


@compiled_part
def _depth_slope(corners, slope):
    """Return the least overlap of (2, 3, 3) triangles near the origin; fill its (2, 3, 3) slope."""
    # With a plain 0, what spans a direction would be compiled twice.
    best, direction, upper, high, low = np.inf, int(np.int64(0)), 0, 0, 0
    for n in range(11):
        first, second, across, length_squared = _spanned(corners, n)
        spanned = _dot(first, first) * _dot(second, second)
        if not length_squared > _PARALLEL_SINE_SQUARED * spanned:
            continue
        length = np.sqrt(length_squared)
        for side in range(2):
            # Height of the highest corner of one triangle above the lowest of the other.
            top, bottom, highest, lowest = -np.inf, np.inf, 0, 0
            for k in range(3):
                above = _dot(across, corners[side, k])
                below = _dot(across, corners[1 - side, k])
                if above > top:
                    top, highest = above, k
                if below < bottom:
                    bottom, lowest = below, k
            overlap = (top - bottom) / length
            if overlap < best:
                best, direction, upper, high, low = overlap, n, side, highest, lowest
    if best == np.inf:
        return best
    first, second, across, length_squared = _spanned(corners, direction)
    length = np.sqrt(length_squared)
    axis = (across[0] / length, across[1] / length, across[2] / length)
    one, other = corners[upper, high], corners[1 - upper, low]
    between = (one[0] - other[0], one[1] - other[1], one[2] - other[2])
    along = _dot(between, axis)
    turning = (
        (between[0] - along * axis[0]) / length,
        (between[1] - along * axis[1]) / length,
        (between[2] - along * axis[2]) / length,
    )
    by_first, by_second = _cross(second, turning), _cross(turning, first)
    side_a, edge_a, side_b, edge_b = _edges(direction)
    for c in range(3):
        slope[upper, high, c] += axis[c]
        slope[1 - upper, low, c] -= axis[c]
        slope[side_a, edge_a, c] -= by_first[c]
        slope[side_a, (edge_a + 1) % 3, c] += by_first[c]
        slope[side_b, edge_b, c] -= by_second[c]
        slope[side_b, (edge_b + 1) % 3, c] += by_second[c]
    return best


@compiled_part
def _edges(direction):
    """Return the triangle and the number of each of the two edges that span a direction.

    Directions 0 and 1 are the triangles' normals, spanned by their own edges 0 and 1; direction
    2 + 3 i + j is the cross product of edge i of a and edge j of b.
    """
    if direction < 2:
        return direction, 0, direction, 1
    return 0, (direction - 2) // 3, 1, (direction - 2) % 3


@compiled_part
def _spanned(corners, direction):
    """Return the two edges that span a direction, their cross product and its squared length."""
    side_a, edge_a, side_b, edge_b = _edges(direction)
    first, second = _edge(corners, side_a, edge_a), _edge(corners, side_b, edge_b)
    across = _cross(first, second)
    return first, second, across, _dot(across, across)


@compiled_part
def _edge(corners, side, edge):
    start, end = corners[side, edge], corners[side, (edge + 1) % 3]
    return end[0] - start[0], end[1] - start[1], end[2] - start[2]


@compiled_part
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled_part
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
