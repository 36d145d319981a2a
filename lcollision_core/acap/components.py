"""Edges that join the connected components of a mesh."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csgraph
from scipy.spatial import Delaunay, QhullError, cKDTree

from lcollision_core.meshes.normals import vertex_normals
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

BRIDGE_WEIGHT, OLDER_BRIDGE_WEIGHT = 0.03, 0.01
"""Of an edge between components: beside those of the mesh it places them, and bends little. The
second is of models that were trained before layers were joined to what they cover."""

_EDGES_EACH = 128
"""Most edges between two components, of whose places the mean stays: that of a ball in its socket.

Of the X Bot's poses, encoded and decoded, the mean error is 5.9 % of the body size with one edge
from each component to the largest, 0.9 % with one to its neighbour, 0.5 % with 128, and 0.34 % with
its layers joined too."""

_COVERED_WITHIN = 0.03
"""Normalised distance within which a layer lies on what it covers."""

_SAME_WAY = 0.5
"""Least cosine between the normals of a layer and of what it covers: hands face a coat."""

_LEAST_LENGTH = 1e-12
"""Normalised, of an edge between components, as a graph has no edge of length 0."""


def component_bridges(
    topology: Topology, rest_vertices: FloatArray, *, layers: bool = True
) -> IntArray:
    """Join each connected component to a neighbour by the shortest edges from vertex to vertex.

    Features do not hold the position of a component. Edges to its neighbour let eyes or buttons
    follow the body that they sit on, and each shell of a robot the next. Joined components form a
    tree. Where one lies on another, as clothes on skin, each of its vertices is joined.

    Parameters
    ----------
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference, in normalised lengths
    layers : whether each vertex of a layer is joined to what it covers

    Returns
    -------
    bridges : (n, 2) int32 array; vertices in no face have none and stay where the reference has
        them

    Notes
    -----
    The Euclidean minimum spanning tree of points is a subgraph of their Delaunay triangulation.
    Where there is none, as of points in a plane, components are joined to the largest.
    """
    _, component = topology.vertex_components
    size = np.bincount(component)
    used = np.flatnonzero(size[component] > 1)
    _, of_point = np.unique(component[used], return_inverse=True)
    n_components = int(of_point.max()) + 1
    if n_components == 1:
        return np.empty((0, 2), dtype=np.int32)
    points = rest_vertices[used]
    edges = np.concatenate([_neighbours(points), _to_the_largest(points, of_point)])
    ends = of_point[edges]
    across = ends[:, 0] != ends[:, 1]
    edges, ends = edges[across], np.sort(ends[across], axis=1)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) + _LEAST_LENGTH
    order = np.lexsort((lengths, ends[:, 1], ends[:, 0]))
    edges, ends, lengths = edges[order], ends[order], lengths[order]
    pairs, first, pair_of = np.unique(ends, axis=0, return_index=True, return_inverse=True)
    shape = (n_components, n_components)
    graph = coo_matrix((lengths[first], tuple(pairs.T)), shape=shape).tocsr()
    tree = csgraph.minimum_spanning_tree(graph).tocoo()
    of_tree = np.zeros(shape, dtype=np.bool_)
    of_tree[tree.row, tree.col] = True
    rank = np.arange(len(edges)) - first[pair_of.ravel()]
    chosen = of_tree[tuple(ends.T)] & (rank < _EDGES_EACH)
    if layers:
        normals = vertex_normals(rest_vertices, topology.faces)[used]
        same_way = (normals[edges[:, 0]] * normals[edges[:, 1]]).sum(axis=1) > _SAME_WAY
        covers = same_way & (lengths < _COVERED_WITHIN)
        for own, other in ((0, 1), (1, 0)):
            # As the edges are by length, the first of a vertex to a component is its shortest.
            place = np.flatnonzero(covers)
            key = edges[place, own].astype(np.int64) * n_components + of_point[edges[place, other]]
            chosen[place[np.unique(key, return_index=True)[1]]] = True
    bridges: IntArray = used[edges[chosen]].astype(np.int32)
    return np.unique(np.sort(bridges, axis=1), axis=0) if layers else bridges


def _neighbours(points: FloatArray) -> npt.NDArray[np.intp]:
    """Return (n, 2) edges of the Delaunay triangulation of points; none where there is none."""
    try:
        delaunay = Delaunay(points)
    except QhullError:
        return np.empty((0, 2), dtype=np.intp)
    edges = [delaunay.simplices[:, pair] for pair in combinations(range(4), 2)]
    # Points that coincide with others are left out of it.
    return np.concatenate([*edges, delaunay.coplanar[:, [0, 2]]]).astype(np.intp)


def _to_the_largest(points: FloatArray, of_point: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return an edge from each component to the largest, so that all are joined for certain."""
    main = np.flatnonzero(of_point == np.bincount(of_point).argmax())
    others = np.setdiff1d(np.arange(len(points)), main)
    distance, nearest = cKDTree(points[main]).query(points[others])
    order = np.lexsort((distance, of_point[others]))
    _, first = np.unique(of_point[others][order], return_index=True)
    chosen = order[first]
    return np.stack([others[chosen], main[nearest[chosen]]], axis=1)
