"""From deformation gradients back to vertices: one factorisation, then substitutions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph, linalg

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray, IntArray

BLOCK_POSES = 8
"""Poses that share one pass over the factor; more gain little and fall out of the cache."""


@dataclass(frozen=True)
class Poisson:
    """L p' = b(T) of step 5, factored.

    L is the weighted Laplacian of the reference with one vertex pinned per connected component;
    afterwards each component's weighted mean vertex is put where the reference has it.

    Attributes
    ----------
    position : (V,) int32 array, each vertex's place in the order of elimination; pinned ones
        come after all n free ones
    column_start, row, lower : unit lower triangle of L = lower diag(D) lower^T in CSC form,
        without its diagonal
    inverse_pivot : (n,) float64 array, 1 / D
    map_start, map_vertex, map_spoke : the rows of b: b_i is the sum of T_j s_ij over the
        one-ring and i itself; (V + 1,) and (nnz,) int32, s (nnz, 3) float64
    component : (V,) int32 array
    anchor : (V,) float64 array, weights that sum to 1 over each component
    rest_mean : (n_components, 3) float64 array, where each component's weighted mean is put
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
    rest_mean: FloatArray

    def right_sides(self, n_poses: int) -> FloatArray:
        """Make room, (V, 3 n), for the right-hand sides of up to `BLOCK_POSES` poses."""
        return np.empty((len(self.position), 3 * n_poses))

    def load(self, gradients: FloatArray, right_sides: FloatArray, slot: int) -> None:
        """Write the right-hand side of (V, 3, 3) deformation gradients into a pose's slot."""
        _load(
            gradients,
            self.map_start,
            self.map_vertex,
            self.map_spoke,
            self.position,
            3 * slot,
            right_sides,
        )

    def solve(self, right_sides: FloatArray, vertices: FloatArray) -> None:
        """Write the poses of loaded right-hand sides, which are used up.

        Parameters
        ----------
        right_sides : (V, 3 n) float64 array
        vertices : (n, V, 3) float64 array, overwritten; each component's mean is 0, to
            which `rest_mean` is to be added for poses, and nothing for derivatives
        """
        self._substitute(right_sides)
        for slot, out in enumerate(vertices):
            _unload(right_sides, 3 * slot, self.position, self.component, self.anchor, out)

    def solve_transposed(self, by_vertices: FloatArray) -> FloatArray:
        """Solve for a loss's derivative by the right-hand sides; `load_transposed` unpacks it.

        Parameters
        ----------
        by_vertices : (n, V, 3) float64 array, the derivative by the vertices

        Returns
        -------
        solution : (V, 3 n) float64 array
        """
        solution = self.right_sides(len(by_vertices))
        for slot, given in enumerate(by_vertices):
            _load_centred(given, self.position, self.component, self.anchor, 3 * slot, solution)
        self._substitute(solution)
        return solution

    def load_transposed(self, solution: FloatArray, slot: int, by_gradients: FloatArray) -> None:
        """Write a loss's derivative by a pose's (V, 3, 3) deformation gradients."""
        _load_transposed(
            solution,
            3 * slot,
            self.map_start,
            self.map_vertex,
            self.map_spoke,
            self.position,
            by_gradients,
        )

    def _substitute(self, right_sides: FloatArray) -> None:
        kernel = _substitute_three if right_sides.shape[1] == 3 else _substitute_many
        kernel(self.column_start, self.row, self.lower, self.inverse_pivot, right_sides)


@compiled
def _load(
    gradients: FloatArray,
    map_start: IntArray,
    map_vertex: IntArray,
    map_spoke: FloatArray,
    position: IntArray,
    column: int,
    right_sides: FloatArray,
) -> None:
    for i in range(len(gradients)):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(map_start[i], map_start[i + 1]):
            j = map_vertex[k]
            s0, s1, s2 = map_spoke[k, 0], map_spoke[k, 1], map_spoke[k, 2]
            x += gradients[j, 0, 0] * s0 + gradients[j, 0, 1] * s1 + gradients[j, 0, 2] * s2
            y += gradients[j, 1, 0] * s0 + gradients[j, 1, 1] * s1 + gradients[j, 1, 2] * s2
            z += gradients[j, 2, 0] * s0 + gradients[j, 2, 1] * s1 + gradients[j, 2, 2] * s2
        p = position[i]
        right_sides[p, column] = x
        right_sides[p, column + 1] = y
        right_sides[p, column + 2] = z


@compiled
def _load_transposed(
    solution: FloatArray,
    column: int,
    map_start: IntArray,
    map_vertex: IntArray,
    map_spoke: FloatArray,
    position: IntArray,
    by_gradients: FloatArray,
) -> None:
    by_gradients[:] = 0.0
    for i in range(len(position)):
        p = position[i]
        x, y, z = solution[p, column], solution[p, column + 1], solution[p, column + 2]
        for k in range(map_start[i], map_start[i + 1]):
            out = by_gradients[map_vertex[k]]
            for b in range(3):
                spoke = map_spoke[k, b]
                out[0, b] += x * spoke
                out[1, b] += y * spoke
                out[2, b] += z * spoke


@compiled
def _load_centred(
    by_vertices: FloatArray,
    position: IntArray,
    component: IntArray,
    anchor: FloatArray,
    column: int,
    right_sides: FloatArray,
) -> None:
    """`_unload` transposed: what is pinned to the mean passes no force on to the rest."""
    total = np.zeros((component.max() + 1, 3))
    for i in range(len(position)):
        for a in range(3):
            total[component[i], a] += by_vertices[i, a]
    for i in range(len(position)):
        for a in range(3):
            right_sides[position[i], column + a] = (
                by_vertices[i, a] - anchor[i] * total[component[i], a]
            )


@compiled
def _unload(
    solution: FloatArray,
    column: int,
    position: IntArray,
    component: IntArray,
    anchor: FloatArray,
    vertices: FloatArray,
) -> None:
    mean = np.zeros((component.max() + 1, 3))
    for i in range(len(position)):
        for a in range(3):
            vertices[i, a] = solution[position[i], column + a]
            mean[component[i], a] += anchor[i] * vertices[i, a]
    for i in range(len(position)):
        for a in range(3):
            vertices[i, a] -= mean[component[i], a]


@compiled
def _substitute_three(
    column_start: IntArray,
    row: IntArray,
    lower: FloatArray,
    inverse_pivot: FloatArray,
    right_sides: FloatArray,
) -> None:
    """`_substitute_many` for one pose, its three columns held in registers: half the time."""
    n_free = len(inverse_pivot)
    for j in range(n_free):
        x, y, z = right_sides[j, 0], right_sides[j, 1], right_sides[j, 2]
        for p in range(column_start[j], column_start[j + 1]):
            i, factor = row[p], lower[p]
            right_sides[i, 0] -= factor * x
            right_sides[i, 1] -= factor * y
            right_sides[i, 2] -= factor * z
    for j in range(n_free - 1, -1, -1):
        pivot = inverse_pivot[j]
        x, y, z = right_sides[j, 0] * pivot, right_sides[j, 1] * pivot, right_sides[j, 2] * pivot
        for p in range(column_start[j], column_start[j + 1]):
            i, factor = row[p], lower[p]
            x -= factor * right_sides[i, 0]
            y -= factor * right_sides[i, 1]
            z -= factor * right_sides[i, 2]
        right_sides[j, 0], right_sides[j, 1], right_sides[j, 2] = x, y, z
    right_sides[n_free:] = 0.0


@compiled
def _substitute_many(
    column_start: IntArray,
    row: IntArray,
    lower: FloatArray,
    inverse_pivot: FloatArray,
    right_sides: FloatArray,
) -> None:
    """Solve for all columns in place; the rows of pinned vertices, which come last, get 0."""
    n_free, width = len(inverse_pivot), right_sides.shape[1]
    for j in range(n_free):
        for p in range(column_start[j], column_start[j + 1]):
            i, factor = row[p], lower[p]
            for c in range(width):
                right_sides[i, c] -= factor * right_sides[j, c]
    for j in range(n_free - 1, -1, -1):
        pivot = inverse_pivot[j]
        for c in range(width):
            right_sides[j, c] *= pivot
        for p in range(column_start[j], column_start[j + 1]):
            i, factor = row[p], lower[p]
            for c in range(width):
                right_sides[j, c] -= factor * right_sides[i, c]
    right_sides[n_free:] = 0.0


def factor_poisson(
    rest_vertices: FloatArray,
    edges: IntArray,
    edge_weights: FloatArray,
    anchor_weights: FloatArray,
) -> Poisson:
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
    """
    n_vertices = len(rest_vertices)
    start, end = edges.T
    owner, other = np.concatenate([start, end]), np.concatenate([end, start])
    weight = np.concatenate([edge_weights, edge_weights])
    spoke = 0.5 * weight[:, None] * (rest_vertices[owner] - rest_vertices[other])
    own_spoke = np.zeros((n_vertices, 3))
    np.add.at(own_spoke, owner, spoke)
    rows = np.concatenate([owner, np.arange(n_vertices)])
    order = np.argsort(rows, kind="stable")

    graph = sparse.coo_matrix((weight, (owner, other)), shape=(n_vertices, n_vertices)).tocsr()
    count, component = csgraph.connected_components(graph, directed=False)
    _, pinned = np.unique(component, return_index=True)
    free = np.setdiff1d(np.arange(n_vertices), pinned)
    position = np.empty(n_vertices, dtype=np.int32)
    position[pinned] = np.arange(len(free), n_vertices)
    laplacian = (sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsc()
    # Positive definite, so that no pivoting is needed and U = D lower^T.
    factors = linalg.splu(
        laplacian[free][:, free],
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
    return Poisson(
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
        rest_mean=rest_mean,
    )
