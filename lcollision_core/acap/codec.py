"""Convert vertices to features and back: gradients, and reconstruction by a sparse linear system.

A vertex's deformation gradient averages over its one-ring, so a round trip blurs. Features are
therefore computed from the pose plus the error of its round trip; poses that are already exact
(rigid, uniformly scaled, flat) are not changed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.acap.features import (
    BRIDGE_WEIGHT,
    N_FEATURES,
    N_ROTATION,
    OLDER_BRIDGE_WEIGHT,
    component_bridges,
    gradients_from_features,
    pull_back,
    pull_back_means,
    push_forward,
)
from lcollision_core.acap.rotations import component_roots, consistent_logarithms, split_gradients
from lcollision_core.compiled import compiled, compiled_part, inlined
from lcollision_core.errors import ShapeError
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, edge_graph, length_graph

BLOCK_POSES = 8
"""Poses that share one pass over the factor; more gain little and fall out of the cache."""


class Poisson(NamedTuple):
    """The system L p' = b(T) of step 5 of Gao et al. 2019, factored.

    L is the weighted Laplacian of the reference with one vertex pinned per connected component;
    afterwards each component's weighted mean vertex is moved to the origin.

    Attributes
    ----------
    position : (V,) int32 array, each vertex's position in the order of elimination; pinned ones
        come after all n free ones
    column_start, row, lower : unit lower triangle of L = lower diag(D) lower^T in CSC form,
        without its diagonal
    inverse_pivot : (n,) float64 array, 1 / D
    map_start, map_vertex, map_spoke : (V + 1,) int32, (nnz,) int32 and s (nnz, 3) float64, the rows
        of b: b_i is the sum of T_j s_ij over the one-ring and i itself
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
    anchor_weights : (V,) float64 array >= 0, the weights of the mean vertex; in a component whose
        weights are all 0, every vertex has the same weight

    Returns
    -------
    poisson : Poisson
    rest_mean : (V, 3) float64 array, for each vertex the weighted mean of its component in the
        reference
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
    count, component = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, pinned = np.unique(component, return_index=True)
    free = np.setdiff1d(np.arange(n_vertices), pinned)
    position = np.empty(n_vertices, dtype=np.int32)
    position[pinned] = np.arange(len(free), n_vertices)
    # The matrix is positive definite, so no pivoting is needed and U = D lower^T.
    factors = scipy.sparse.linalg.splu(
        scipy.sparse.csgraph.laplacian(graph).tocsc()[free][:, free],
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    position[free] = factors.perm_c
    strict = scipy.sparse.tril(factors.L, -1).tocsc()

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


@compiled_part
def _n_components(component: IntArray) -> int:
    """Return one more than the largest number; Numba compiles ``max`` much more slowly."""
    count = 0
    for number in component:
        count = max(count, number + 1)
    return count


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
    """Do `_substitute_many` for one pose, its three columns in registers: half the time."""
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


@inlined
def load_gradient(poisson, gradients, i, column, sides):  # type: ignore[no-untyped-def]
    """Write b_i of a pose's (V, 3, 3) deformation gradients to three columns of `sides` (V, n)."""
    x, y, z = 0.0, 0.0, 0.0
    for k in range(poisson.map_start[i], poisson.map_start[i + 1]):
        j = poisson.map_vertex[k]
        s0, s1, s2 = poisson.map_spoke[k, 0], poisson.map_spoke[k, 1], poisson.map_spoke[k, 2]
        x += gradients[j, 0, 0] * s0 + gradients[j, 0, 1] * s1 + gradients[j, 0, 2] * s2
        y += gradients[j, 1, 0] * s0 + gradients[j, 1, 1] * s1 + gradients[j, 1, 2] * s2
        z += gradients[j, 2, 0] * s0 + gradients[j, 2, 1] * s1 + gradients[j, 2, 2] * s2
    p = poisson.position[i]
    sides[p, column], sides[p, column + 1], sides[p, column + 2] = x, y, z


@compiled_part
def _load_gradients(poisson: Poisson, gradients: FloatArray, slot: int, sides: FloatArray) -> None:
    """Write b of a pose's (V, 3, 3) deformation gradients as right-hand side number `slot`."""
    for i in range(len(gradients)):
        load_gradient(poisson, gradients, i, 3 * slot, sides)


@compiled_part
def _unload_vertices(poisson: Poisson, sides: FloatArray, slot: int, vertices: FloatArray) -> None:
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
def integrate(
    poisson: Poisson, gradients: FloatArray, offset: FloatArray, vertices: FloatArray
) -> None:
    """Write the (n, V, 3) vertices of n poses' (n, V, 3, 3) deformation gradients.

    `offset` (V, 3) is added to each pose.
    """
    n_poses, n_vertices = gradients.shape[0], gradients.shape[1]
    sides = np.empty((n_vertices, 3 * n_poses))
    for pose in range(n_poses):
        _load_gradients(poisson, gradients[pose], pose, sides)
    if n_poses == 1:
        _substitute_three(poisson, sides)
    else:
        _substitute_many(poisson, sides)
    for pose in range(n_poses):
        _unload_vertices(poisson, sides, pose, vertices[pose])
        for i in range(n_vertices):
            for a in range(3):
                vertices[pose, i, a] += offset[i, a]


NORMAL_LENGTH = 0.3
_LOST_DIRECTION = 1e-10


class RingFit(NamedTuple):
    """The least-squares fit of every one-ring, solved once for the reference.

    Attributes
    ----------
    faces : (F, 3) int32 array
    ring_start, ring : (V + 1,) and (2E,) int32 arrays, the one-rings in CSR form
    ring_solution : (2E, 3) float64 array g_ij: T_i is the sum of (p'_i - p'_j) g_ij^T and the
        next two terms
    normal_solution : (V, 3) float64 array, g of the normal's row
    kept_identity : (V, 3, 3) float64 array, the identity in the directions that neither
        neighbours nor a normal determine (all of them at a vertex in no face), 0 elsewhere
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
    fit : RingFit; a flat, thin or empty one-ring gets the identity in undetermined directions
    """
    graph = edge_graph(topology.edges, topology.n_vertices, edge_weights)
    start, ring, weight = graph.indptr, graph.indices, graph.data
    n_neighbours = np.diff(start)
    owner = np.repeat(np.arange(topology.n_vertices), n_neighbours)
    spoke = rest_vertices[owner] - rest_vertices[ring]
    normals = np.empty_like(rest_vertices)
    # A copy, as it would be compiled once more for an array that is read-only.
    scaled_normals(rest_vertices.copy(), topology.faces, start, ring, normals)
    mean_weight = np.bincount(owner, weight, topology.n_vertices) / np.maximum(n_neighbours, 1)
    row_weight = normal_weight * mean_weight

    gram = np.einsum("v,va,vb->vab", row_weight, normals, normals)
    np.add.at(gram, owner, np.einsum("r,ra,rb->rab", weight, spoke, spoke))
    values, axes = np.linalg.eigh(gram)
    is_spanned = values > _LOST_DIRECTION * values[:, -1:]
    inverse_values = np.where(is_spanned, 1.0 / np.where(is_spanned, values, 1.0), 0.0)
    inverse = np.einsum("vab,vb,vcb->vac", axes, inverse_values, axes)
    lost_directions = np.einsum("vab,vb,vcb->vac", axes, np.where(is_spanned, 0.0, 1.0), axes)
    return RingFit(
        faces=topology.faces,
        ring_start=start,
        ring=ring,
        ring_solution=np.einsum("rab,rb,r->ra", inverse[owner], spoke, weight),
        normal_solution=np.einsum("vab,vb,v->va", inverse, normals, row_weight),
        kept_identity=lost_directions,
    )


@compiled
def deformation_gradients(vertices: FloatArray, fit: RingFit, gradients: FloatArray) -> FloatArray:
    """Write T_i of every vertex of one pose (V, 3) as (V, 3, 3) `gradients`, and return them."""
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


_DEGENERATE_SINE = 1e-6


def cotangent_weights(topology: Topology, rest_vertices: FloatArray, floor: float) -> FloatArray:
    """Return half the sum of the cotangents opposite each edge, clamped from below.

    Parameters
    ----------
    topology : the connectivity, with E edges
    rest_vertices : (V, 3) float64 array, the reference, in any unit
    floor : least weight, > 0; obtuse triangles have negative cotangents, which would make the
        reconstruction's matrix indefinite and the round trip unstable

    Returns
    -------
    weights : (E,) float64 array, >= `floor` and finite, in the order of `topology.edges`

    Notes
    -----
    A triangle without area would give infinite cotangents, so the cotangent of an angle whose sine
    is at most 1e-6 counts as 0.
    """
    apex, start, end = np.stack([np.roll(topology.faces, -shift, axis=1) for shift in range(3)])
    side_a = rest_vertices[start] - rest_vertices[apex]
    side_b = rest_vertices[end] - rest_vertices[apex]
    sine = np.linalg.norm(np.cross(side_a, side_b), axis=2)
    cosine = (side_a * side_b).sum(axis=2)
    product = np.linalg.norm(side_a, axis=2) * np.linalg.norm(side_b, axis=2)
    sound = sine > _DEGENERATE_SINE * product
    cotangent = np.where(sound, cosine / np.where(sound, sine, 1.0), 0.0)
    # The matrix sums duplicates and sorts its entries like the edges.
    sums = scipy.sparse.csr_matrix(
        (cotangent.ravel(), (np.minimum(start, end).ravel(), np.maximum(start, end).ravel())),
        shape=(topology.n_vertices, topology.n_vertices),
    )
    weights: FloatArray = np.maximum(0.5 * sums.data, floor)
    return weights


WEIGHT_FLOOR = 0.05
NORMAL_WEIGHT = 1.0


class AcapCodec:
    """The map between poses and ACAP features for one reference mesh; immutable, thread-safe.

    Parameters
    ----------
    topology : the connectivity of all poses
    rest_vertices : (V, 3) finite array, the reference, in normalised lengths; vertices that no face
        uses are moved to the mean of the others
    anchor_weights : (V,) finite array >= 0; a decoded pose is placed so that its weighted mean
        vertex is the reference's. With the weights of the poses' rigid alignment, a decoded pose
        lies where the aligned pose was.
    bridges : (n, 2) edges between components, see `component_bridges`; None for those of models
        trained before layers were joined to the surface below
    """

    def __init__(
        self,
        topology: Topology,
        rest_vertices: npt.NDArray[Any],
        anchor_weights: npt.NDArray[Any],
        bridges: IntArray | None = None,
    ) -> None:
        rest = topology.gathered(np.array(rest_vertices, dtype=np.float64))
        rest.flags.writeable = False
        self.topology = topology
        self.rest_vertices: FloatArray = rest
        self.anchor_weights: FloatArray = np.asarray(anchor_weights, dtype=np.float64)
        weights = cotangent_weights(topology, rest, WEIGHT_FLOOR)
        tied, bridge_weight = topology.edges, OLDER_BRIDGE_WEIGHT
        if bridges is None:
            bridges = component_bridges(topology, rest, layers=False)
        else:
            tied, bridge_weight = np.concatenate([tied, bridges]), BRIDGE_WEIGHT
        self.bridges = bridges
        # Layers turn with the surface below, even by more than half a turn.
        graph = length_graph(tied, rest)
        self._around = graph.indptr, graph.indices
        self._roots = component_roots(graph)
        self._fit = fit_rings(topology, rest, weights, NORMAL_WEIGHT)
        self.poisson, self.rest_mean = factor_poisson(
            rest,
            np.concatenate([topology.edges, bridges]),
            np.concatenate([weights, np.full(len(bridges), bridge_weight)]),
            self.anchor_weights,
        )
        self._nowhere = np.zeros_like(self.rest_mean)

    def encode(
        self, vertices: npt.NDArray[Any], n_threads: int | None = None, job: Job = UNWATCHED
    ) -> FloatArray:
        """Compute the deformation features of poses that are aligned to the reference.

        Parameters
        ----------
        vertices : (B, V, 3) finite array, in normalised lengths; translation does not
            matter, rotation does
        n_threads : threads to spread the poses over, one for each core by default
        job : reports (poses done, all poses); polled every few poses

        Returns
        -------
        features : (B, V, 9) float64 array, unscaled

        Raises
        ------
        ShapeError : another shape.
        CancelledError : the job was cancelled.
        """
        poses = self._checked(vertices, 3, "vertices")
        features = np.empty((len(poses), self.topology.n_vertices, N_FEATURES))

        def encode_block(start: int, stop: int) -> None:
            gradients = np.empty((self.topology.n_vertices, 3, 3))
            quaternions = np.empty((self.topology.n_vertices, 4))
            for pose, sharpened in enumerate(self._sharpened(poses[start:stop]), start):
                deformation_gradients(sharpened, self._fit, gradients)
                split_gradients(gradients, quaternions, features[pose, :, N_ROTATION:])
                consistent_logarithms(
                    quaternions,
                    *self._around,
                    self._roots,
                    features[pose, :, :N_ROTATION],
                )

        for_blocks(encode_block, len(poses), BLOCK_POSES, n_threads, job)
        return features

    def decode(self, features: npt.NDArray[Any], n_threads: int | None = None) -> FloatArray:
        """Rebuild the poses of deformation features.

        Parameters
        ----------
        features : (B, V, 9) array, unscaled
        n_threads : threads to spread the poses over, one for each core by default

        Returns
        -------
        vertices : (B, V, 3) float64 array, in normalised lengths. Features do not hold the
            position, so a pose's mean vertex (weighted by the codec's `anchor_weights`) is that of
            the reference. The size of the batch does not change the bits of a pose.

        Raises
        ------
        ShapeError : another shape.
        """
        fields = self._checked(features, N_FEATURES, "features")
        vertices = np.empty((len(fields), self.topology.n_vertices, 3))

        def decode_block(start: int, stop: int) -> None:
            gradients = np.empty((stop - start, self.topology.n_vertices, 3, 3))
            gradients_from_features(fields[start:stop], gradients)
            integrate(self.poisson, gradients, self.rest_mean, vertices[start:stop])

        for_blocks(decode_block, len(fields), BLOCK_POSES, n_threads)
        return vertices

    def decode_jvp(
        self,
        features: npt.NDArray[Any],
        tangents: npt.NDArray[Any],
        n_threads: int | None = None,
    ) -> FloatArray:
        """Differentiate one decoded pose along several changes of its features.

        Parameters
        ----------
        features : (V, 9) array, the point of differentiation
        tangents : (m, V, 9) array, the changes
        n_threads : threads to spread the changes over, one for each core by default

        Returns
        -------
        moved : (m, V, 3) float64 array, the vertices' derivatives

        Raises
        ------
        ShapeError : another shape.
        """
        at = self._checked(np.asarray(features)[None], N_FEATURES, "features")[0]
        along = self._checked(tangents, N_FEATURES, "tangents")
        moved = np.empty((len(along), self.topology.n_vertices, 3))

        def push_block(start: int, stop: int) -> None:
            gradients = np.empty((stop - start, self.topology.n_vertices, 3, 3))
            push_forward(at, along[start:stop], gradients)
            integrate(self.poisson, gradients, self._nowhere, moved[start:stop])

        for_blocks(push_block, len(along), BLOCK_POSES, n_threads)
        return moved

    def decode_vjp(
        self,
        features: npt.NDArray[Any],
        grad_vertices: npt.NDArray[Any],
        n_threads: int | None = None,
    ) -> FloatArray:
        """Turn a loss's derivative by decoded vertices into that by the features.

        Parameters
        ----------
        features : (B, V, 9) array, the point of differentiation, or (1, V, 9) for B losses of one
            pose
        grad_vertices : (B, V, 3) array, derivative of each loss by the vertices
        n_threads : threads to spread the poses over, one for each core by default

        Returns
        -------
        grad_features : (B, V, 9) float64 array

        Raises
        ------
        ShapeError : another shape.
        """
        at = self._checked(features, N_FEATURES, "features")
        given = self._checked(grad_vertices, 3, "grad_vertices")
        if len(at) not in (1, len(given)):
            raise ShapeError.must_be("features", f"of 1 or {len(given)} poses", len(at))
        grad_features = np.empty((*given.shape[:2], N_FEATURES))

        def pull_block(start: int, stop: int) -> None:
            for row, grad_gradients in enumerate(self._by_gradients(given[start:stop]), start):
                pull_back(at[row if len(at) > 1 else 0], grad_gradients, grad_features[row])

        for_blocks(pull_block, len(given), BLOCK_POSES, n_threads)
        return grad_features

    def means_by_gradients(self, weights: scipy.sparse.csr_matrix) -> FloatArray:
        """Differentiate patches' means by the deformation gradients, for `means_vjp`.

        These are the same in every pose, as vertices are linear in deformation gradients.

        Parameters
        ----------
        weights : (m, V) sparse matrix; each patch's mean is its row times a pose's vertices

        Returns
        -------
        by_gradients : (m, V, 3) float64 array: by_gradients[k, i] is the derivative of coordinate a
            of patch k's mean by row a of vertex i's deformation gradient, for every a

        Raises
        ------
        ShapeError : another number of columns.
        """
        n_patches, n_vertices = weights.shape[0], self.topology.n_vertices
        if weights.shape[1] != n_vertices:
            raise ShapeError.must_be("weights", f"of shape (m, {n_vertices})", weights.shape)
        # All coordinates need the same solve, so one solve of x, y and z serves three patches.
        padded = np.zeros((n_patches + -n_patches % 3, n_vertices))
        padded[:n_patches] = weights.toarray()
        triples = np.ascontiguousarray(padded.reshape(-1, 3, n_vertices).transpose(0, 2, 1))
        by_gradients = np.empty((len(triples), 3, n_vertices, 3))
        for start in range(0, len(triples), BLOCK_POSES):
            solved = self._by_gradients(triples[start : start + BLOCK_POSES])
            for triple, grad_gradients in enumerate(solved, start):
                by_gradients[triple] = grad_gradients.transpose(1, 0, 2)
        return by_gradients.reshape(-1, n_vertices, 3)[:n_patches]

    def means_vjp(
        self,
        features: npt.NDArray[Any],
        by_gradients: FloatArray,
        grad_vertices: npt.NDArray[Any],
    ) -> FloatArray:
        """Differentiate patches' means, and losses by vertices, by one pose's features.

        The means need no solve; the losses need one, as in `decode_vjp`.

        Parameters
        ----------
        features : (V, 9) array, the point of differentiation
        by_gradients : (m, V, 3) float64 array of `means_by_gradients`
        grad_vertices : (n, V, 3) array, the losses' derivatives by the vertices

        Returns
        -------
        grad_features : (3 m + n, V, 9) float64 array: x, y and z of each mean, then the losses

        Raises
        ------
        ShapeError : another shape.
        """
        at = self._checked(np.asarray(features)[None], N_FEATURES, "features")[0]
        given = self._checked(grad_vertices, 3, "grad_vertices")
        n_means = 3 * len(by_gradients)
        grad_features = np.empty((n_means + len(given), *at.shape))
        pull_back_means(at, by_gradients, grad_features[:n_means].reshape(-1, 3, *at.shape))
        for row, grad_gradients in enumerate(self._by_gradients(given), n_means):
            pull_back(at, grad_gradients, grad_features[row])
        return grad_features

    def _sharpened(self, poses: FloatArray) -> FloatArray:
        """Add to at most `BLOCK_POSES` poses the detail that their round trips would lose."""
        gradients = np.empty((*poses.shape[:2], 3, 3))
        rebuilt = np.empty_like(poses)
        for pose, out in zip(poses, gradients, strict=True):
            deformation_gradients(pose, self._fit, out)
        integrate(self.poisson, gradients, self._nowhere, rebuilt)
        return 2.0 * poses - rebuilt

    def _by_gradients(self, grad_vertices: FloatArray) -> Iterator[FloatArray]:
        """Turn n derivatives by (V, 3) vertices into those by (V, 3, 3) deformation gradients.

        This is the transpose of `integrate`. All are yielded in the same memory.
        """
        n_vertices = self.topology.n_vertices
        sides = np.empty((n_vertices, 3 * len(grad_vertices)))
        for slot, gradient in enumerate(grad_vertices):
            unload_vertices_transposed(self.poisson, gradient, slot, sides)
        substitute(self.poisson, sides)
        grad_gradients = np.empty((n_vertices, 3, 3))
        for slot in range(len(grad_vertices)):
            load_gradients_transposed(self.poisson, sides, slot, grad_gradients)
            yield grad_gradients

    def _checked(self, array: npt.NDArray[Any], width: int, name: str) -> FloatArray:
        shape = np.shape(array)
        if len(shape) != 3 or shape[1:] != (self.topology.n_vertices, width):
            needed = f"of shape (B, {self.topology.n_vertices}, {width})"
            raise ShapeError.must_be(name, needed, shape)
        return np.ascontiguousarray(array, dtype=np.float64)
