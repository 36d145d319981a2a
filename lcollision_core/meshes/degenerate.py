"""Faces without area."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import Topology


def degenerate_faces(topology: Topology, vertices: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Return the faces without area.

    Parameters
    ----------
    topology : F faces
    vertices : (V, 3) array, one pose

    Returns
    -------
    (D,) indices of the faces whose height over their longest side is at most 1e-12 of that side,
    about the rounding error of float64, whatever the unit
    """
    corners = np.asarray(vertices, dtype=np.float64)[topology.faces.T]
    # Scale to about 1, so that squares neither overflow nor vanish; a power of two is exact.
    a, b, c = np.ldexp(corners, -int(np.frexp(np.abs(corners).max())[1]))
    sides = np.stack([b - a, c - a, c - b])
    twice_area = np.linalg.norm(np.cross(sides[0], sides[1]), axis=1)
    longest_squared = np.einsum("sfi,sfi->sf", sides, sides).max(axis=0)
    return np.flatnonzero(twice_area <= 1e-12 * longest_squared).astype(np.int32)
