"""Edge weights of the reference mesh."""

from __future__ import annotations

import numpy as np

from lcollision_core.meshes.topology import FloatArray, Topology

_DEGENERATE_SINE = 1e-6


def cotangent_weights(topology: Topology, rest_vertices: FloatArray, floor: float) -> FloatArray:
    """Half the sum of the cotangents opposite each edge, clamped from below.

    Parameters
    ----------
    topology : the connectivity, with E edges
    rest_vertices : (V, 3) float64 array, the reference, in any unit
    floor : least weight, > 0; obtuse triangles have negative cotangents, with which the
        reconstruction's matrix is not positive definite and the round trip explodes

    Returns
    -------
    weights : (E,) float64 array, >= `floor` and finite, in the order of `topology.edges`

    Notes
    -----
    A triangle of no area would give infinite cotangents: the sine of an angle counts as at
    least 1e-6 of the product of the two sides, and the cotangent of such a sliver as 0.
    """
    faces = topology.faces
    keys = topology.edges[:, 0].astype(np.int64) * topology.n_vertices + topology.edges[:, 1]
    weights = np.zeros(len(keys))
    for corner in range(3):
        apex, start, end = faces[:, corner], faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3]
        side_a = rest_vertices[start] - rest_vertices[apex]
        side_b = rest_vertices[end] - rest_vertices[apex]
        sine = np.linalg.norm(np.cross(side_a, side_b), axis=1)
        cosine = np.einsum("fa,fa->f", side_a, side_b)
        product = np.linalg.norm(side_a, axis=1) * np.linalg.norm(side_b, axis=1)
        sound = sine > _DEGENERATE_SINE * product
        cotangent = np.where(sound, cosine / np.where(sound, sine, 1.0), 0.0)
        low, high = np.minimum(start, end), np.maximum(start, end)
        edge = np.searchsorted(keys, low.astype(np.int64) * topology.n_vertices + high)
        np.add.at(weights, edge, 0.5 * cotangent)
    clamped: FloatArray = np.maximum(weights, floor)
    return clamped
