"""From deformation gradients back to vertices: one factorisation, then substitutions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph, linalg

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray, IntArray, edge_graph

BLOCK_POSES = 8
"""Poses that share one pass over the factor; more gain little and fall out of the cache."""


class Poisson(NamedTuple):
    """L p' = b(T) of step 5, factored.

    L is the weighted Laplacian of the reference with one vertex pinned per connected component;
    afterwards each component's weighted mean vertex is put at the origin.

    Attributes
    ----------
    position : (V,) int32 array, each vertex's position in the order of elimination; pinned ones
        come after all n free ones
    column_start, row, lower : unit lower triangle of L = lower diag(D) lower^T in CSC form,
        without its diagonal
    inverse_pivot : (n,) float64 array, 1 / D
    map_start, map_vertex, map_spoke : the rows of b: b_i is the sum of T_j s_ij over the
        one-ring and i itself; (V + 1,) and (nnz,) int32, s (nnz, 3) float64
    component : (V,) int32 array
    anchor : (V,) float64 array, weights that sum to 1 over each component
    """

    position: IntArray
    column_start: IntArray
    row: IntArray
    lower: FloatArray
    inverse_pivot: FloatArray
    map_start: IntArray
    map_vertex: IntArray
    map_spoke: FloatArray
    component: IntArray
    anchor: FloatArray


def factor_poisson(
    rest_vertices: FloatArray,
    edges: IntArray,
    edge_weights: FloatArray,
    anchor_weights: FloatArray,
) -> tuple[Poisson, FloatArray]:
    """Factor the reconstruction of step 5 of Gao et al. 2019 for one reference.

    Parameters
    ----------
    rest_vertices : (V, 3) float64 array, the reference p
    edges : (E, 2) integer array of different pairs i, j
    edge_weights : (E,) float64 array c_ij > 0
    anchor_weights : (V,) float64 array >= 0, the weights of the mean vertex; a component whose
        weights are all 0 counts every vertex alike

    Returns
    -------
    poisson : Poisson
    rest_mean : (V, 3) float64 array, the reference's weighted mean vertex of each one's component
    """
    n_vertices = len(rest_vertices)
    start, end = edges.T
    owner, other = np.concatenate([start, end]), np.concatenate([end, start])
    spoke = 0.5 * np.tile(edge_weights, 2)[:, None] * (rest_vertices[owner] - rest_vertices[other])
    own_spoke = np.zeros((n_vertices, 3))
    np.add.at(own_spoke, owner, spoke)
    rows = np.concatenate([owner, np.arange(n_vertices)])
    order = np.argsort(rows, kind="stable")

    graph = edge_graph(edges, n_vertices, edge_weights)
    count, component = csgraph.connected_components(graph, directed=False)
    _, pinned = np.unique(component, return_index=True)
    free = np.setdiff1d(np.arange(n_vertices), pinned)
    position = np.empty(n_vertices, dtype=np.int32)
    position[pinned] = np.arange(len(free), n_vertices)
    # Positive definite, so that no pivoting is needed and U = D lower^T.
    factors = linalg.splu(
        csgraph.laplacian(graph).tocsc()[free][:, free],
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    position[free] = factors.perm_c
    strict = sparse.tril(factors.L, -1).tocsc()

    totals = np.bincount(component, anchor_weights, minlength=count)
    anchor = np.where(totals[component] > 0.0, anchor_weights, 1.0)
    anchor /= np.bincount(component, anchor, minlength=count)[component]
    rest_mean = np.zeros((count, 3))
    np.add.at(rest_mean, component, anchor[:, None] * rest_vertices)
    poisson = Poisson(
        position=position,
        column_start=strict.indptr.astype(np.int32),
        row=strict.indices.astype(np.int32),
        lower=strict.data,
        inverse_pivot=1.0 / factors.U.diagonal(),
        map_start=np.searchsorted(rows[order], np.arange(n_vertices + 1)).astype(np.int32),
        map_vertex=np.concatenate([other, np.arange(n_vertices)])[order].astype(np.int32),
        map_spoke=np.concatenate([spoke, own_spoke])[order],
        component=component.astype(np.int32),
        anchor=anchor,
    )
    return poisson, rest_mean[component]


def substitute(poisson: Poisson, sides: FloatArray) -> None:
    """Solve for the right-hand sides of n poses, (V, 3 n), in place."""
    (_substitute_three if sides.shape[1] == 3 else _substitute_many)(poisson, sides)


@compiled
def load_gradients(poisson: Poisson, gradients: FloatArray, slot: int, sides: FloatArray) -> None:
    """Write b of a pose's (V, 3, 3) deformation gradients as right-hand side number `slot`."""
    column = 3 * slot
    for i in range(len(gradients)):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(poisson.map_start[i], poisson.map_start[i + 1]):
            j = poisson.map_vertex[k]
            s0, s1, s2 = poisson.map_spoke[k, 0], poisson.map_spoke[k, 1], poisson.map_spoke[k, 2]
            x += gradients[j, 0, 0] * s0 + gradients[j, 0, 1] * s1 + gradients[j, 0, 2] * s2
            y += gradients[j, 1, 0] * s0 + gradients[j, 1, 1] * s1 + gradients[j, 1, 2] * s2
            z += gradients[j, 2, 0] * s0 + gradients[j, 2, 1] * s1 + gradients[j, 2, 2] * s2
        p = poisson.position[i]
        sides[p, column], sides[p, column + 1], sides[p, column + 2] = x, y, z


@compiled
def load_gradients_transposed(
    poisson: Poisson, solution: FloatArray, slot: int, grad_gradients: FloatArray
) -> None:
    """Write a loss's derivative by a pose's (V, 3, 3) deformation gradients."""
    column = 3 * slot
    grad_gradients[:] = 0.0
    for i in range(len(poisson.position)):
        p = poisson.position[i]
        x, y, z = solution[p, column], solution[p, column + 1], solution[p, column + 2]
        for k in range(poisson.map_start[i], poisson.map_start[i + 1]):
            out = grad_gradients[poisson.map_vertex[k]]
            for b in range(3):
                spoke = poisson.map_spoke[k, b]
                out[0, b] += x * spoke
                out[1, b] += y * spoke
                out[2, b] += z * spoke


@compiled
def _n_components(component: IntArray) -> int:
    """Return one more than the largest number; Numba compiles ``max`` much longer."""
    count = 0
    for number in component:
        count = max(count, number + 1)
    return count


@compiled
def unload_vertices(poisson: Poisson, sides: FloatArray, slot: int, vertices: FloatArray) -> None:
    """Write a pose's (V, 3) vertices, each component's weighted mean at the origin."""
    position, component = poisson.position, poisson.component
    mean = np.zeros((_n_components(component), 3))
    for i in range(len(position)):
        for a in range(3):
            vertices[i, a] = sides[position[i], 3 * slot + a]
            mean[component[i], a] += poisson.anchor[i] * vertices[i, a]
    for i in range(len(position)):
        for a in range(3):
            vertices[i, a] -= mean[component[i], a]


@compiled
def unload_vertices_transposed(
    poisson: Poisson, grad_vertices: FloatArray, slot: int, sides: FloatArray
) -> None:
    """Write a loss's derivative by a pose's (V, 3) vertices as right-hand side number `slot`."""
    position, component = poisson.position, poisson.component
    total = np.zeros((_n_components(component), 3))
    for i in range(len(position)):
        for a in range(3):
            total[component[i], a] += grad_vertices[i, a]
    for i in range(len(position)):
        for a in range(3):
            sides[position[i], 3 * slot + a] = (
                grad_vertices[i, a] - poisson.anchor[i] * total[component[i], a]
            )


@compiled
def _substitute_three(poisson: Poisson, sides: FloatArray) -> None:
    """`_substitute_many` for one pose, its three columns held in registers: half the time."""
    start, row, lower = poisson.column_start, poisson.row, poisson.lower
    n_free = len(poisson.inverse_pivot)
    for j in range(n_free):
        x, y, z = sides[j, 0], sides[j, 1], sides[j, 2]
        for p in range(start[j], start[j + 1]):
            i, factor = row[p], lower[p]
            sides[i, 0] -= factor * x
            sides[i, 1] -= factor * y
            sides[i, 2] -= factor * z
    for j in range(n_free - 1, -1, -1):
        pivot = poisson.inverse_pivot[j]
        x, y, z = sides[j, 0] * pivot, sides[j, 1] * pivot, sides[j, 2] * pivot
        for p in range(start[j], start[j + 1]):
            i, factor = row[p], lower[p]
            x -= factor * sides[i, 0]
            y -= factor * sides[i, 1]
            z -= factor * sides[i, 2]
        sides[j, 0], sides[j, 1], sides[j, 2] = x, y, z
    sides[n_free:] = 0.0


@compiled
def _substitute_many(poisson: Poisson, sides: FloatArray) -> None:
    """Solve for all columns in place; the rows of pinned vertices, which come last, get 0."""
    start, row, lower = poisson.column_start, poisson.row, poisson.lower
    n_free, width = len(poisson.inverse_pivot), sides.shape[1]
    for j in range(n_free):
        for p in range(start[j], start[j + 1]):
            i, factor = row[p], lower[p]
            for c in range(width):
                sides[i, c] -= factor * sides[j, c]
    for j in range(n_free - 1, -1, -1):
        pivot = poisson.inverse_pivot[j]
        for c in range(width):
            sides[j, c] *= pivot
        for p in range(start[j], start[j + 1]):
            i, factor = row[p], lower[p]
            for c in range(width):
                sides[j, c] -= factor * sides[i, c]
    sides[n_free:] = 0.0
