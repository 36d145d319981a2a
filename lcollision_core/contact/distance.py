"""Exact penetration depth and distance of two triangles, in closed form.

The depth of Tan et al. (2021) is the shortest translation that separates two triangles. It is
the distance from the origin to the boundary of their Minkowski difference, a convex polytope
whose faces are normal to one of eleven directions: the two triangle normals and the nine cross
products of an edge of one with an edge of the other. Along a direction ``d`` the triangles are
separated by moving one of them by the smaller overlap of their projections, so the depth is the
minimum of these overlaps over ``|d|``, and a direction without overlap makes it zero.

Two triangles that do not cross are nearest at a corner of one and a point on the other, or at inner
points of two edges, where the shortest path is perpendicular to both: six corners on the other
triangle and nine pairs of edges are tried. Where they cross, an edge of one pierces the other. The
points tried always lie on the triangles, so rounding can only make the distance too long. The
directions within a triangle are its longest edge and the height on it, which stay perpendicular
even on the thinnest sliver.

Clearance is measured by the *signed distance* of two faces: minus the penetration depth where they
penetrate, else the distance. Faces joined by skin are always near: two faces that are d apart at
rest are too near only below d / 2, whatever the clearance, so that skin may bend. Faces that touch
at rest, up to rounding, are too near only where they penetrate. So are faces of two groups that may
touch each other and, if no rest pose is known, faces joined by an edge or by a few clearances along
the surface.
"""
# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part, inlined
from lcollision_core.contact.arrays import ClearanceRule, FaceTree, PairBuffer
from lcollision_core.contact.kernels import fill_depths
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import FloatArray

REST_SHARE = 0.5
"""Share of their distance at rest to which two faces may always approach."""

_PARALLEL_SINE_SQUARED = 1e-28
"""Squared sine up to which edges count as parallel: they are nearest at an end as well."""

_NO_DIRECTION_SQUARED = 1e-12
"""Squared sine up to which the product of two edges is no direction to separate triangles along."""

_ROUNDING_SQUARED = 1e-30
"""Below this squared share of their extent, triangles touch or cross."""


_SURELY_FARTHER = 1.0 + 1e-6
"""Factor beyond which a squared distance is larger than another in spite of rounding."""


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
        if not length_squared > _NO_DIRECTION_SQUARED * spanned:
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


class TriangleDistances(NamedTuple):
    """The distances of P pairs of triangles, and their nearest points.

    Attributes
    ----------
    distance : (P,) float64 array >= 0, in the unit of the corners; 0 where they cross or touch
    weights : (P, 2, 3) float64 array, barycentric coordinates of the nearest point of each
        triangle; each row sums to 1
    """

    distance: FloatArray
    weights: npt.NDArray[np.float64]


def triangle_distance(triangles_a: npt.ArrayLike, triangles_b: npt.ArrayLike) -> TriangleDistances:
    """Measure how far each triangle of a is from the triangle of b with the same index.

    Parameters
    ----------
    triangles_a, triangles_b : (P, 3, 3) arrays of corners, any length unit

    Raises
    ------
    ShapeError : the arrays are not both (P, 3, 3), or hold NaN or infinity.

    Notes
    -----
    Exact within 1e-14 of the triangles' extent. A triangle without area is treated as the segment
    or point that it is. Of several nearest points one is returned.

    Examples
    --------
    >>> a = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
    >>> b = [[[0.2, 0.2, 0.5], [0.2, 0.2, 2], [0.3, 0.2, 2]]]
    >>> triangle_distance(a, b).distance.tolist()
    [0.5]
    """
    corners, scale = in_unit_scale(triangles_a, triangles_b)
    squared = np.empty(len(corners))
    weights = np.empty((len(corners), 2, 3))
    _fill_distances(corners, squared, weights)
    squared[squared < _ROUNDING_SQUARED] = 0.0
    return TriangleDistances(np.sqrt(squared) * scale, weights)


def distance_slopes(
    triangles_a: npt.ArrayLike, triangles_b: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Differentiate the distance of pairs of triangles by their corners.

    Parameters and errors are those of `triangle_distance`.

    Returns
    -------
    distance : (P,) float64 array
    slopes : (P, 6, 3) float64 array, its derivative by the corners of a, then of b: that of the
        distance of the two nearest points, which stay nearest to first order; 0 where the
        triangles touch or cross
    """
    distance, weights = triangle_distance(triangles_a, triangles_b)
    corners = np.stack([triangles_a, triangles_b], axis=1).astype(np.float64)
    signed = weights * np.array([1.0, -1.0])[:, None]
    way = np.einsum("pst,pstc->pc", signed, corners)
    direction = np.divide(
        way, distance[:, None], out=np.zeros_like(way), where=distance[:, None] > 0.0
    )
    return distance, (signed.reshape(-1, 6, 1) * direction[:, None]).reshape(-1, 6, 3)


@inlined
def _apart_squared(corners, a0, a1, a2, b0, b1, b2):
    """Return the squared distance of two points, given by weights of the corners."""
    total = 0.0
    for c in range(3):
        way = (
            a0 * corners[0, 0, c]
            + a1 * corners[0, 1, c]
            + a2 * corners[0, 2, c]
            - b0 * corners[1, 0, c]
            - b1 * corners[1, 1, c]
            - b2 * corners[1, 2, c]
        )
        total += way * way
    return total


@compiled_part
def _try(corners, tried, best, weights):
    """Keep the tried weights if they give nearer points; return the least squared distance."""
    squared = _apart_squared(
        corners, tried[0, 0], tried[0, 1], tried[0, 2], tried[1, 0], tried[1, 1], tried[1, 2]
    )
    if squared >= best:
        return best
    for side in range(2):
        for k in range(3):
            weights[side, k] = tried[side, k]
    return squared


@compiled_part
def _foot(corners, side, first, point, weights):
    """Fill (3,) weights of the foot of a point on a triangle; return whether it is inside.

    Parameters
    ----------
    first : the corner at which the triangle's longest edge begins
    """
    second, third = (first + 1) % 3, (first + 2) % 3
    uu = uw = up = 0.0
    for c in range(3):
        u = corners[side, second, c] - corners[side, first, c]
        uu += u * u
        uw += u * (corners[side, third, c] - corners[side, first, c])
        up += u * (point[c] - corners[side, first, c])
    if uu == 0.0:
        return False
    lean, along = uw / uu, up / uu
    hh = hu = hp = 0.0
    for c in range(3):
        u = corners[side, second, c] - corners[side, first, c]
        h = corners[side, third, c] - corners[side, first, c] - lean * u
        hh += h * h
        hu += h * u
        hp += h * (point[c] - corners[side, first, c] - along * u)
    if hh <= 1e-30 * uu:
        return False
    lean += hu / uu
    up_height = hp / hh
    weights[third] = up_height
    weights[second] = along - lean * up_height
    weights[first] = 1.0 - weights[second] - up_height
    return weights[0] >= 0.0 and weights[1] >= 0.0 and weights[2] >= 0.0


@compiled_part
def _longest_edge(corners, side):
    """Return the corner at which the longest edge of a triangle begins."""
    longest, first = -1.0, 0
    for i in range(3):
        squared = 0.0
        for c in range(3):
            squared += (corners[side, (i + 1) % 3, c] - corners[side, i, c]) ** 2
        if squared > longest:
            longest, first = squared, i
    return first


@compiled_part
def _height(corners, side, first, point):
    """Return the height of a point above a triangle's plane, in any unit; 0 if it has no plane."""
    second, third = (first + 1) % 3, (first + 2) % 3
    ux = corners[side, second, 0] - corners[side, first, 0]
    uy = corners[side, second, 1] - corners[side, first, 1]
    uz = corners[side, second, 2] - corners[side, first, 2]
    wx = corners[side, third, 0] - corners[side, first, 0]
    wy = corners[side, third, 1] - corners[side, first, 1]
    wz = corners[side, third, 2] - corners[side, first, 2]
    nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    uu = ux * ux + uy * uy + uz * uz
    if uu == 0.0:
        return 0.0
    # On a sliver, rounding leans the product towards the long edge, which matters far along it.
    lean = (nx * ux + ny * uy + nz * uz) / uu
    return (
        (nx - lean * ux) * (point[0] - corners[side, first, 0])
        + (ny - lean * uy) * (point[1] - corners[side, first, 1])
        + (nz - lean * uz) * (point[2] - corners[side, first, 2])
    )


@compiled_part
def _distance_squared(corners, weights):
    """Return the squared distance of (2, 3, 3) triangles; fill (2, 3) weights of the points."""
    best = np.inf
    tried = np.zeros((2, 3))
    foot, heights, crossing = np.zeros(3), np.zeros(3), np.zeros(3)
    for side in range(2):
        other = 1 - side
        first = _longest_edge(corners, other)
        for k in range(3):
            point = corners[side, k]
            heights[k] = _height(corners, other, first, point)
            tried[side, :] = 0.0
            tried[side, k] = 1.0
            if _foot(corners, other, first, point, foot):
                for c in range(3):
                    tried[other, c] = foot[c]
                best = _try(corners, tried, best, weights)
            for i in range(3):
                j = (i + 1) % 3
                ux = corners[other, j, 0] - corners[other, i, 0]
                uy = corners[other, j, 1] - corners[other, i, 1]
                uz = corners[other, j, 2] - corners[other, i, 2]
                px = point[0] - corners[other, i, 0]
                py = point[1] - corners[other, i, 1]
                pz = point[2] - corners[other, i, 2]
                uu, up = ux * ux + uy * uy + uz * uz, ux * px + uy * py + uz * pz
                share = min(max(up / uu, 0.0), 1.0) if uu > 0.0 else 0.0
                px, py, pz = px - share * ux, py - share * uy, pz - share * uz
                if px * px + py * py + pz * pz > _SURELY_FARTHER * best:
                    continue
                tried[other, :] = 0.0
                tried[other, i] = 1.0 - share
                tried[other, j] = share
                best = _try(corners, tried, best, weights)
        # An edge that crosses the other's plane may pierce it.
        for i in range(3):
            j = (i + 1) % 3
            if not heights[i] * heights[j] < 0.0:
                continue
            share = heights[i] / (heights[i] - heights[j])
            for c in range(3):
                crossing[c] = corners[side, i, c] + share * (
                    corners[side, j, c] - corners[side, i, c]
                )
            if _foot(corners, other, first, crossing, foot):
                for c in range(3):
                    tried[other, c] = foot[c]
                tried[side, :] = 0.0
                tried[side, i] = 1.0 - share
                tried[side, j] = share
                best = _try(corners, tried, best, weights)
    return _nearer_edges(corners, best, weights)


@compiled_part
def _nearer_edges(corners, best, weights):
    """Return the least squared distance, with inner points of pairs of edges tried as well."""
    for i in range(3):
        i_next = (i + 1) % 3
        ux = corners[0, i_next, 0] - corners[0, i, 0]
        uy = corners[0, i_next, 1] - corners[0, i, 1]
        uz = corners[0, i_next, 2] - corners[0, i, 2]
        uu = ux * ux + uy * uy + uz * uz
        for j in range(3):
            j_next = (j + 1) % 3
            vx = corners[1, j_next, 0] - corners[1, j, 0]
            vy = corners[1, j_next, 1] - corners[1, j, 1]
            vz = corners[1, j_next, 2] - corners[1, j, 2]
            wx = corners[1, j, 0] - corners[0, i, 0]
            wy = corners[1, j, 1] - corners[0, i, 1]
            wz = corners[1, j, 2] - corners[0, i, 2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            nn = nx * nx + ny * ny + nz * nz
            vv = vx * vx + vy * vy + vz * vz
            if nn <= _PARALLEL_SINE_SQUARED * uu * vv:
                continue
            s = (
                (wy * vz - wz * vy) * nx + (wz * vx - wx * vz) * ny + (wx * vy - wy * vx) * nz
            ) / nn
            if not 0.0 < s < 1.0:
                continue
            # Project that point on the other edge: on nearly parallel edges, rounding moves both
            # points along them, and by different lengths.
            t = (s * (ux * vx + uy * vy + uz * vz) - (wx * vx + wy * vy + wz * vz)) / vv
            t = min(max(t, 0.0), 1.0)
            a0, a1, a2 = _edge_weights(i, s)
            b0, b1, b2 = _edge_weights(j, t)
            squared = _apart_squared(corners, a0, a1, a2, b0, b1, b2)
            if squared < best:
                best = squared
                weights[0, 0], weights[0, 1], weights[0, 2] = a0, a1, a2
                weights[1, 0], weights[1, 1], weights[1, 2] = b0, b1, b2
    return best


@inlined
def _edge_weights(edge, share):
    """Return the weights of a triangle's corners at a fraction of an edge."""
    if edge == 0:
        return 1.0 - share, share, 0.0
    if edge == 1:
        return 0.0, 1.0 - share, share
    return share, 0.0, 1.0 - share


@compiled
def _fill_distances(triangles, squared, weights):
    """Fill (P,) squared distances and (P, 2, 3) weights of (P, 2, 3, 3) triangles."""
    for pair in range(len(triangles)):
        squared[pair] = _distance_squared(triangles[pair], weights[pair])


@compiled
def drop_far(
    tree: FaceTree, vertices: FloatArray, nearness: ClearanceRule, n_found: int, found: PairBuffer
) -> int:
    """Drop pairs that a quick test shows to keep the clearance, so that `keep_too_near` sees few.

    Parameters and the returned number are those of `keep_too_near`.
    """
    pair = np.empty((2, 3, 3))
    n_kept = 0
    for n in range(n_found):
        if found.squared_depth[n] == 0.0:
            face_a = tree.slot_face[found.slots[n, 0]]
            face_b = tree.slot_face[found.slots[n, 1]]
            _gather(nearness.corners, vertices, face_a, face_b, pair)
            if _is_beyond(pair, nearness.clearance):
                continue
        # By element, as in `kernels.drop_excluded`.
        found.slots[n_kept, 0] = found.slots[n, 0]
        found.slots[n_kept, 1] = found.slots[n, 1]
        found.squared_depth[n_kept] = found.squared_depth[n]
        n_kept += 1
    return n_kept


@compiled
def keep_too_near(
    tree: FaceTree,
    vertices: FloatArray,
    nearness: ClearanceRule,
    tolerance: float,
    n_found: int,
    found: PairBuffer,
    signed: FloatArray,
) -> int:
    """Keep only pairs that are too near, and store the distance that they lack as their depth.

    Parameters
    ----------
    vertices : (V, 3) of the pose, normalised
    tolerance : distance that a pair may lack, normalised
    n_found : number of pairs in `found`, with squared depth 0 if they do not penetrate
    found : overwritten, without the rules
    signed : (P,) overwritten by the signed distances of the pairs that are kept

    Returns
    -------
    n_kept : number of pairs kept, at the front of `found`
    """
    pair, resting, weights = np.empty((2, 3, 3)), np.empty((2, 3, 3)), np.empty((2, 3))
    has_rest, region = len(nearness.rest) > 0, nearness.region
    n_kept = 0
    for n in range(n_found):
        face_a = tree.slot_face[found.slots[n, 0]]
        face_b = tree.slot_face[found.slots[n, 1]]
        required = nearness.clearance
        may_touch = len(region) > 0 and nearness.may_touch[region[face_a], region[face_b]]
        if may_touch:
            required = 0.0
        elif has_rest:
            _gather(nearness.corners, nearness.rest, face_a, face_b, resting)
            # For most pairs, which skin joins, two corners at rest are enough.
            required = _required(required, np.sqrt(_corners_apart(resting)[0]), nearness.touching)
        if found.squared_depth[n] > 0.0:
            apart = -np.sqrt(found.squared_depth[n])
        else:
            _gather(nearness.corners, vertices, face_a, face_b, pair)
            if _is_beyond(pair, required) or _corners_apart(pair)[1] >= required:
                continue
            apart = np.sqrt(_distance_squared(pair, weights))
        if required - apart <= tolerance:
            continue
        if has_rest and not may_touch:
            if not _is_beyond(resting, required / REST_SHARE):
                at_rest = np.sqrt(_distance_squared(resting, weights))
                required = _required(required, at_rest, nearness.touching)
        elif not has_rest and _are_joined(nearness, face_a, face_b):
            required = 0.0
        lacks = required - apart
        if lacks <= tolerance:
            continue
        found.slots[n_kept, 0] = found.slots[n, 0]
        found.slots[n_kept, 1] = found.slots[n, 1]
        found.squared_depth[n_kept] = lacks * lacks
        signed[n_kept] = apart
        n_kept += 1
    return n_kept


@compiled_part
def _required(clearance, at_rest, touching):
    """Return the distance required of two faces that are `at_rest` apart in the rest pose."""
    return min(clearance, REST_SHARE * at_rest) if at_rest >= touching else 0.0


@compiled_part
def _gather(corners, vertices, face_a, face_b, pair):
    """Copy the corners of two faces."""
    for k in range(3):
        for c in range(3):
            pair[0, k, c] = vertices[corners[face_a, k], c]
            pair[1, k, c] = vertices[corners[face_b, k], c]


@compiled_part
def _corners_apart(pair):
    """Return the squared distance of the two nearest corners, and a lower bound of the distance.

    The bound is the gap between the triangles along the line through these corners; it is negative
    where they overlap along it.
    """
    least, i, j = np.inf, 0, 0
    for a in range(3):
        for b in range(3):
            squared = 0.0
            for c in range(3):
                squared += (pair[1, b, c] - pair[0, a, c]) ** 2
            if squared < least:
                least, i, j = squared, a, b
    if least == 0.0:
        return least, 0.0
    x = pair[1, j, 0] - pair[0, i, 0]
    y = pair[1, j, 1] - pair[0, i, 1]
    z = pair[1, j, 2] - pair[0, i, 2]
    low, high = np.inf, -np.inf
    for k in range(3):
        near = (
            x * (pair[0, k, 0] - pair[0, i, 0])
            + y * (pair[0, k, 1] - pair[0, i, 1])
            + z * (pair[0, k, 2] - pair[0, i, 2])
        )
        far = (
            x * (pair[1, k, 0] - pair[0, i, 0])
            + y * (pair[1, k, 1] - pair[0, i, 1])
            + z * (pair[1, k, 2] - pair[0, i, 2])
        )
        high, low = max(high, near), min(low, far)
    return least, (low - high) / np.sqrt(least)


@compiled_part
def _is_beyond(pair, distance):
    """Whether a plane of one triangle shows that the other is at least `distance` away.

    The planes are the triangle's own and those through its edges at right angles to it.
    """
    for side in range(2):
        ux = pair[side, 1, 0] - pair[side, 0, 0]
        uy = pair[side, 1, 1] - pair[side, 0, 1]
        uz = pair[side, 1, 2] - pair[side, 0, 2]
        wx = pair[side, 2, 0] - pair[side, 0, 0]
        wy = pair[side, 2, 1] - pair[side, 0, 1]
        wz = pair[side, 2, 2] - pair[side, 0, 2]
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        nn = nx * nx + ny * ny + nz * nz
        uu, ww = ux * ux + uy * uy + uz * uz, wx * wx + wy * wy + wz * wz
        # The plane of a sliver is not accurate enough.
        if nn <= 1e-10 * uu * ww:
            continue
        low, high = np.inf, -np.inf
        for k in range(3):
            height = (
                nx * (pair[1 - side, k, 0] - pair[side, 0, 0])
                + ny * (pair[1 - side, k, 1] - pair[side, 0, 1])
                + nz * (pair[1 - side, k, 2] - pair[side, 0, 2])
            )
            low, high = min(low, height), max(high, height)
        nearest = max(low, -high)
        if nearest > 0.0 and nearest * nearest >= distance * distance * nn:
            return True
        for i in range(3):
            j = (i + 1) % 3
            ex = pair[side, j, 0] - pair[side, i, 0]
            ey = pair[side, j, 1] - pair[side, i, 1]
            ez = pair[side, j, 2] - pair[side, i, 2]
            ox, oy, oz = ey * nz - ez * ny, ez * nx - ex * nz, ex * ny - ey * nx
            nearest = np.inf
            for k in range(3):
                nearest = min(
                    nearest,
                    ox * (pair[1 - side, k, 0] - pair[side, i, 0])
                    + oy * (pair[1 - side, k, 1] - pair[side, i, 1])
                    + oz * (pair[1 - side, k, 2] - pair[side, i, 2]),
                )
            oo = ox * ox + oy * oy + oz * oz
            if nearest > 0.0 and nearest * nearest >= distance * distance * oo:
                return True
    return False


@compiled_part
def _are_joined(nearness, face_a, face_b):
    """Whether skin joins a corner of one face to one of the other."""
    for i in range(3):
        for j in range(3):
            a, b = nearness.corners[face_a, i], nearness.corners[face_b, j]
            first, second = min(a, b), max(a, b)
            for k in range(nearness.joined_start[first], nearness.joined_start[first + 1]):
                if nearness.joined[k] == second:
                    return True
    return False
