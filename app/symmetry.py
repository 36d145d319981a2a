"""Left and right of a mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

_TOLERANCE = 1e-3
"""In heights: how far a vertex may lie from its partner's mirror image."""


def mirror_vertices(
    reference: npt.NDArray[Any], faces: npt.NDArray[np.int32], up_axis: int
) -> npt.NDArray[np.int32] | None:
    """Find each vertex's partner on the other side, where the mesh is its own mirror image.

    Parameters
    ----------
    reference : (V, 3) array, a symmetric pose
    faces : (F, 3) int32 array
    up_axis : 0, 1 or 2; left and right are along one of the other two

    Returns
    -------
    mirror : (V,) int32 array, read-only, its own inverse, that maps faces onto faces; None where
        there is no such
    """
    from scipy.spatial import cKDTree

    vertices = np.asarray(reference, dtype=np.float64)
    tolerance = _TOLERANCE * float(np.ptp(vertices, axis=0).max())
    tree = cKDTree(vertices)
    everyone = np.arange(len(vertices))
    for axis in range(3):
        if axis == up_axis:
            continue
        image = vertices.copy()
        image[:, axis] = vertices[:, axis].min() + vertices[:, axis].max() - vertices[:, axis]
        distance, partner = tree.query(image)
        mirror: npt.NDArray[np.int32] = partner.astype(np.int32)
        is_exchange = distance.max() < tolerance and (mirror[mirror] == everyone).all()
        if is_exchange and _turned(mirror[faces[:, ::-1]]) == _turned(faces):
            mirror.flags.writeable = False
            return mirror
    return None


def _turned(faces: npt.NDArray[np.int32]) -> set[tuple[int, int, int]]:
    """Return the faces as a set, each turned until its least vertex comes first."""
    turns = (np.arange(3) + faces.argmin(axis=1)[:, None]) % 3
    rows = np.take_along_axis(faces, turns, axis=1)
    return {(int(a), int(b), int(c)) for a, b, c in rows}
