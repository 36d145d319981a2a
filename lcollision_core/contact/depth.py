"""Exact penetration depth of two triangles, in closed form.

The depth of Tan et al. (2021) is the shortest translation that separates two triangles. It is
the distance from the origin to the boundary of their Minkowski difference, a convex polytope
whose faces are normal to one of eleven directions: the two triangle normals and the nine cross
products of an edge of one with an edge of the other. Along a direction ``d`` the triangles are
parted by moving one of them by the smaller overlap of their projections, so the depth is the
minimum of these overlaps over ``|d|``, and a direction without overlap makes it zero.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

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
    tolerance : depths up to this are contacts and count as 0, same unit

    Returns
    -------
    penetration_depth : (P,) float64 array >= 0, same unit; 0 where the triangles are disjoint
        or only touch. Coplanar triangles touch at most.

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
    """Return pairs of triangles near the origin and about 1 in size, and how large they were.

    Neither products of tiny edges underflow then nor huge ones overflow. The scale is a power of
    two, so that exact contact stays exact.

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
