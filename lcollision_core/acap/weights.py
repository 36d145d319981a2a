"""Edge weights of the reference mesh."""

from __future__ import annotations

import numpy as np
from scipy import sparse

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
    apex, start, end = np.stack([np.roll(topology.faces, -shift, axis=1) for shift in range(3)])
    side_a = rest_vertices[start] - rest_vertices[apex]
    side_b = rest_vertices[end] - rest_vertices[apex]
    sine = np.linalg.norm(np.cross(side_a, side_b), axis=2)
    cosine = (side_a * side_b).sum(axis=2)
    product = np.linalg.norm(side_a, axis=2) * np.linalg.norm(side_b, axis=2)
    sound = sine > _DEGENERATE_SINE * product
    cotangent = np.where(sound, cosine / np.where(sound, sine, 1.0), 0.0)
    # Duplicates are summed, and the entries sorted as the edges are.
    sums = sparse.csr_matrix(
        (cotangent.ravel(), (np.minimum(start, end).ravel(), np.maximum(start, end).ravel())),
        shape=(topology.n_vertices, topology.n_vertices),
    )
    weights: FloatArray = np.maximum(0.5 * sums.data, floor)
    return weights
