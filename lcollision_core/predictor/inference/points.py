"""Points all over the body, and the skin round each."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import csgraph

from lcollision_core.embedding import Embedding
from lcollision_core.embedding.seeding import bridged_edges
from lcollision_core.meshes.normals import vertex_normals
from lcollision_core.meshes.topology import FloatArray, length_graph

N_POINTS = 240
"""Points of a mesh with enough vertices; see the table in docs/experiments.md."""


def body_points(embedding: Embedding, n_points: int = N_POINTS) -> npt.NDArray[np.int64]:
    """Return (P,) ascending vertices all over the body, a function of the embedding alone.

    Parameters
    ----------
    embedding : of the body
    n_points : fewer for a mesh with fewer used vertices
    """
    rest, topology = embedding.rest_vertices, embedding.topology
    used = np.setdiff1d(np.arange(len(rest)), topology.unused_vertices)
    positions = rest[used]
    outermost = int(np.linalg.norm(positions - positions.mean(axis=0), axis=1).argmax())
    return np.sort(used[farthest_points(positions, outermost, min(n_points, len(used)))])


def farthest_points(positions: FloatArray, first: int, n_points: int) -> npt.NDArray[np.int64]:
    """Choose some of (n, 3) positions, each farthest from those before it.

    When all are chosen, the first is repeated.
    """
    chosen = [first]
    nearest = np.linalg.norm(positions - positions[first], axis=1)
    while len(chosen) < n_points:
        best = int(nearest.argmax())
        chosen.append(best)
        nearest = np.minimum(nearest, np.linalg.norm(positions - positions[best], axis=1))
    return np.array(chosen)


def neighbour_order(positions: FloatArray, block: int) -> npt.NDArray[np.int32]:
    """Order (n, 3) positions so that each block of so many in turn lies close together.

    They are halved across their longest extent, and the halves likewise. The last one is
    repeated to fill its block.
    """

    def ordered(index: npt.NDArray[np.intp]) -> list[npt.NDArray[np.intp]]:
        n_blocks = -(-len(index) // block)
        if n_blocks < 2:
            return [index]
        own = positions[index]
        along = own[:, np.ptp(own, axis=0).argmax()].argsort(kind="stable")
        half = n_blocks // 2 * block
        return ordered(index[along[:half]]) + ordered(index[along[half:]])

    order = np.concatenate(ordered(np.arange(len(positions))))
    return np.append(order, np.repeat(order[-1], -len(order) % block)).astype(np.int32)


def skin_graph(embedding: Embedding) -> sparse.csr_matrix:
    """Return the (V, V) lengths of the reference's edges, in normalised length."""
    return length_graph(embedding.topology.edges, embedding.rest_vertices)


def skin_distances(
    graph: sparse.csr_matrix, vertex: npt.NDArray[np.integer], limit: float = np.inf
) -> FloatArray:
    """Return (n, V) lengths of the shortest edge paths from some vertices, in normalised length.

    They are infinite between components, and beyond the limit.
    """
    distance: FloatArray = csgraph.dijkstra(graph, directed=False, indices=vertex, limit=limit)
    return distance


def skin_cells(embedding: Embedding, centre: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Return (V,) which of some vertices each is nearest to along the surface, -1 if there is none.

    A component without any of them, such as an eye, is reached from its neighbour.
    """
    rest = embedding.rest_vertices
    if not len(centre):
        return np.full(len(rest), -1)
    graph = length_graph(bridged_edges(embedding.topology, rest), rest)
    nearest: npt.NDArray[np.int64] = skin_distances(graph, centre).argmin(axis=0)
    return nearest


def tangent_frames(embedding: Embedding, vertex: npt.NDArray[np.integer]) -> FloatArray:
    """Return (P, 3, 3): columns normal and two tangents of the reference at some vertices."""
    normal = vertex_normals(embedding.rest_vertices, embedding.topology.faces)[vertex]
    normal[~normal.any(axis=1)] = [1.0, 0.0, 0.0]
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    tangent = np.cross(normal, axis)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([normal, tangent, np.cross(normal, tangent)], axis=2)
