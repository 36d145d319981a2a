"""How the exact penetration depths, and what pairs lack of a clearance, change as vertices move."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import DEPTH_TOLERANCE, distance_slopes
from lcollision_core.meshes.topology import FloatArray

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
    PD of Tan et al. 2021 is the least overlap of the projections on eleven directions (see
    `contact.penetration_depth`); its derivative is that of the overlap along the one where it is
    least, which turns with the two edges that span it.
    """
    corners = np.stack([triangles_a, triangles_b], axis=1).astype(np.float64)
    corners -= corners.mean(axis=(1, 2), keepdims=True)
    edges = np.roll(corners, -1, axis=2) - corners
    n_pairs = len(corners)
    first = np.concatenate([edges[:, :, 0], np.repeat(edges[:, 0], 3, axis=1)], axis=1)
    second = np.concatenate([edges[:, :, 1], np.tile(edges[:, 1], (1, 3, 1))], axis=1)
    across = np.cross(first, second)
    length = np.linalg.norm(across, axis=2)
    spanned = (first**2).sum(axis=2) * (second**2).sum(axis=2)
    usable = length**2 > _PARALLEL_SINE_SQUARED * spanned
    normal = across / np.where(usable, length, 1.0)[:, :, None]
    along = np.einsum("pdx,ptcx->pdtc", normal, corners)
    least, most = along.min(axis=3), along.max(axis=3)
    # Height of the highest corner of one triangle above the lowest of the other.
    overlap = np.stack([most[:, :, 0] - least[:, :, 1], most[:, :, 1] - least[:, :, 0]], axis=2)
    overlap[~usable] = np.inf
    best = overlap.reshape(n_pairs, -1).argmin(axis=1)
    direction, upper = best // 2, best % 2
    pair = np.arange(n_pairs)
    depth = overlap[pair, direction, upper]

    high = along[pair, direction, upper].argmax(axis=1)
    low = along[pair, direction, 1 - upper].argmin(axis=1)
    axis = normal[pair, direction]
    between = corners[pair, upper, high] - corners[pair, 1 - upper, low]
    turning = (between - (between * axis).sum(axis=1, keepdims=True) * axis) / length[
        pair, direction
    ][:, None]
    by_first = np.cross(second[pair, direction], turning)
    by_second = np.cross(turning, first[pair, direction])
    slopes = np.zeros((n_pairs, 2, 3, 3))
    slopes[pair, upper, high] += axis
    slopes[pair, 1 - upper, low] -= axis
    side, start = _edge_of(direction, 0)
    np.add.at(slopes, (pair, side, start), -by_first)
    np.add.at(slopes, (pair, side, (start + 1) % 3), by_first)
    side, start = _edge_of(direction, 1)
    np.add.at(slopes, (pair, side, start), -by_second)
    np.add.at(slopes, (pair, side, (start + 1) % 3), by_second)
    return depth, slopes.reshape(n_pairs, 6, 3)


def lack_slopes(triangles_a: FloatArray, triangles_b: FloatArray) -> FloatArray:
    """Differentiate by their corners what pairs of triangles lack of a clearance.

    Parameters
    ----------
    triangles_a, triangles_b : (P, 3, 3) float64 arrays of corners, normalised

    Returns
    -------
    slopes : (P, 6, 3) float64 array: minus that of the distance where a pair is apart, else that of
        the penetration depth
    """
    _, slopes = depth_slopes(triangles_a, triangles_b)
    distance, by_distance = distance_slopes(triangles_a, triangles_b)
    return np.where((distance > DEPTH_TOLERANCE)[:, None, None], -by_distance, slopes)


def add_slopes(
    by_vertices: FloatArray,
    row_of_pair: npt.NDArray[np.int64],
    faces: npt.NDArray[np.integer],
    decoded: FloatArray,
    weights: FloatArray,
    *,
    may_be_apart: bool,
) -> None:
    """Add to rows of derivatives by a pose's vertices the slopes of its colliding pairs.

    Parameters
    ----------
    by_vertices : (R, V, 3) float64 array, added to in place
    row_of_pair : (P,) where each pair goes
    faces : (P, 2, 3) vertices of each pair
    decoded : (V, 3) float64 array, normalised
    weights : (P,) factors of the slopes
    may_be_apart : whether pairs were found by a clearance, so that slopes are of what they lack
    """
    triangles = decoded[faces[:, 0]], decoded[faces[:, 1]]
    slopes = lack_slopes(*triangles) if may_be_apart else depth_slopes(*triangles)[1]
    places = row_of_pair[:, None], faces.reshape(len(faces), 6)
    np.add.at(by_vertices, places, slopes * weights[:, None, None])


def _edge_of(
    direction: npt.NDArray[np.int64], which: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the triangle and the number of the first or second edge that spans a direction.

    Directions 0 and 1 are the triangles' normals, spanned by their own edges 0 and 1; the others
    are edge i of a across edge j of b, at 2 + 3 i + j.
    """
    is_normal = direction < 2
    crossed = direction - 2
    side = np.where(is_normal, direction, which)
    edge = np.where(is_normal, which, crossed // 3 if which == 0 else crossed % 3)
    return side, edge
