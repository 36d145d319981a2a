"""Faces that lie on each other: in one plane, and overlapping there in more than a line."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.kernels import PARALLEL_SINE_SQUARED, SMALL_SINE_SQUARED
from lcollision_core.meshes.topology import FloatArray


def coincide(triangles: FloatArray, tolerance: float) -> npt.NDArray[np.bool_]:
    """Tell which pairs of triangles lie on each other.

    Parameters
    ----------
    triangles : (P, 2, 3, 3) float64 array of corners
    tolerance : distance up to which points count as in the plane, or as touching, same unit

    Returns
    -------
    coincide : (P,) bool; False where the first triangle has no area
    """
    first, second = triangles[:, 0], triangles[:, 1]
    origin = first[:, :1]
    normal, length = _across(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0])
    off_plane = np.abs(np.einsum("pc,pkc->pk", normal, second - origin)).max(axis=1)
    found: npt.NDArray[np.bool_] = (length > 0.0) & (off_plane <= tolerance * length)
    flat = triangles[found]
    # Directions in the plane, across each edge: disjoint convex shapes are separated by one.
    edges = np.roll(flat, -1, axis=2) - flat
    across = np.cross(edges, normal[found, None, None]).reshape(len(flat), 6, 3)
    along = np.einsum("pdc,ptkc->pdtk", across, flat - origin[found, None])
    least, most = along.min(axis=3), along.max(axis=3)
    overlap = np.minimum(most[:, :, 0] - least[:, :, 1], most[:, :, 1] - least[:, :, 0])
    found[found] = (overlap > tolerance * np.linalg.norm(across, axis=2)).all(axis=1)
    return found


def _across(u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the (P, 3) directions across two edges and their lengths, 0 where they are parallel.

    As in the compiled search, rounding that leans a short direction towards an edge is taken out.
    """
    direction = np.cross(u, v)
    u_squared, v_squared = (u**2).sum(axis=1), (v**2).sum(axis=1)
    spanned = u_squared * v_squared
    sine_squared = (direction**2).sum(axis=1)
    longer = np.where((u_squared >= v_squared)[:, None], u, v)
    lean = (direction * longer).sum(axis=1) / np.maximum(np.maximum(u_squared, v_squared), 1e-300)
    is_small = sine_squared <= SMALL_SINE_SQUARED * spanned
    direction = np.where(is_small[:, None], direction - lean[:, None] * longer, direction)
    length = np.linalg.norm(direction, axis=1)
    return direction, np.where(sine_squared <= PARALLEL_SINE_SQUARED * spanned, 0.0, length)
