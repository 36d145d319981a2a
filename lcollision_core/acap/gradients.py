"""Deformation gradients: the linear map that takes each vertex's one-ring into the pose."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, edge_graph

NORMAL_LENGTH = 0.3
_LOST_DIRECTION = 1e-10


class RingFit(NamedTuple):
    """The least-squares fit of every one-ring, solved once for the reference.

    Attributes
    ----------
    faces : (F, 3) int32 array
    ring_start, ring : (V + 1,) and (2E,) int32 arrays, the one-rings in CSR form
    ring_solution : (2E, 3) float64 array g_ij: T_i is the sum of (p'_i - p'_j) g_ij^T and the
        two parts below
    normal_solution : (V, 3) float64 array, g of the row of the normal
    kept_identity : (V, 3, 3) float64 array, the identity in the directions that neither
        neighbours nor a normal see (all of them at a vertex in no face), 0 elsewhere
    """

    faces: IntArray
    ring_start: IntArray
    ring: IntArray
    ring_solution: FloatArray
    normal_solution: FloatArray
    kept_identity: FloatArray


@compiled
def scaled_normals(
    vertices: FloatArray, faces: IntArray, ring_start: IntArray, ring: IntArray, normals: FloatArray
) -> None:
    """Write every vertex's area-weighted unit normal times 0.3 of its mean one-ring edge length.

    Parameters
    ----------
    vertices : (V, 3) float64 array
    faces : (F, 3) int32 array
    ring_start, ring : the one-rings in CSR form
    normals : (V, 3) float64 array, overwritten; zero where there is no normal
    """
    normals[:] = 0.0
    for face in range(len(faces)):
        i, j, k = faces[face]
        a0 = vertices[j, 0] - vertices[i, 0]
        a1 = vertices[j, 1] - vertices[i, 1]
        a2 = vertices[j, 2] - vertices[i, 2]
        b0 = vertices[k, 0] - vertices[i, 0]
        b1 = vertices[k, 1] - vertices[i, 1]
        b2 = vertices[k, 2] - vertices[i, 2]
        n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        for corner in (i, j, k):
            normals[corner, 0] += n0
            normals[corner, 1] += n1
            normals[corner, 2] += n2
    for i in range(len(vertices)):
        length = math.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
        if length == 0.0:
            continue
        edge_sum = 0.0
        for k in range(ring_start[i], ring_start[i + 1]):
            j = ring[k]
            edge_sum += math.sqrt(
                (vertices[i, 0] - vertices[j, 0]) ** 2
                + (vertices[i, 1] - vertices[j, 1]) ** 2
                + (vertices[i, 2] - vertices[j, 2]) ** 2
            )
        scale = NORMAL_LENGTH * edge_sum / (ring_start[i + 1] - ring_start[i]) / length
        for a in range(3):
            normals[i, a] *= scale


def fit_rings(
    topology: Topology, rest_vertices: FloatArray, edge_weights: FloatArray, normal_weight: float
) -> RingFit:
    """Solve the normal equations of step 1 of Gao et al. 2019 for every one-ring.

    Parameters
    ----------
    topology : the connectivity, with E edges
    rest_vertices : (V, 3) float64 array, the reference p
    edge_weights : (E,) float64 array w_ij > 0
    normal_weight : weight of the normal's row, in units of the one-ring's mean edge weight

    Returns
    -------
    fit : RingFit; a flat, thin or empty one-ring gets the identity where it says nothing
    """
    graph = edge_graph(topology.edges, topology.n_vertices, edge_weights)
    start, ring, weight = graph.indptr, graph.indices, graph.data
    n_neighbours = np.diff(start)
    owner = np.repeat(np.arange(topology.n_vertices), n_neighbours)
    spoke = rest_vertices[owner] - rest_vertices[ring]
    normals = np.empty_like(rest_vertices)
    scaled_normals(rest_vertices, topology.faces, start, ring, normals)
    mean_weight = np.bincount(owner, weight, topology.n_vertices) / np.maximum(n_neighbours, 1)
    row_weight = normal_weight * mean_weight

    gram = np.einsum("v,va,vb->vab", row_weight, normals, normals)
    np.add.at(gram, owner, np.einsum("r,ra,rb->rab", weight, spoke, spoke))
    values, axes = np.linalg.eigh(gram)
    seen = values > _LOST_DIRECTION * values[:, -1:]
    inverse_values = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
    inverse = np.einsum("vab,vb,vcb->vac", axes, inverse_values, axes)
    kept = np.einsum("vab,vb,vcb->vac", axes, np.where(seen, 0.0, 1.0), axes)
    return RingFit(
        faces=topology.faces,
        ring_start=start,
        ring=ring,
        ring_solution=np.einsum("rab,rb,r->ra", inverse[owner], spoke, weight),
        normal_solution=np.einsum("vab,vb,v->va", inverse, normals, row_weight),
        kept_identity=kept,
    )


@compiled
def deformation_gradients(vertices: FloatArray, fit: RingFit, gradients: FloatArray) -> FloatArray:
    """Write T_i, (V, 3, 3), of every vertex of one pose (V, 3), and return them."""
    normals = np.empty((len(vertices), 3))
    scaled_normals(vertices, fit.faces, fit.ring_start, fit.ring, normals)
    for i in range(len(vertices)):
        for a in range(3):
            for b in range(3):
                gradients[i, a, b] = (
                    fit.kept_identity[i, a, b] + normals[i, a] * fit.normal_solution[i, b]
                )
        for k in range(fit.ring_start[i], fit.ring_start[i + 1]):
            j = fit.ring[k]
            for a in range(3):
                difference = vertices[i, a] - vertices[j, a]
                for b in range(3):
                    gradients[i, a, b] += difference * fit.ring_solution[k, b]
    return gradients
