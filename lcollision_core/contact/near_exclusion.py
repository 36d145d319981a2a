"""Which vertices lie within the near exclusion of each other, along the reference mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import csgraph

from lcollision_core.contact.arrays import NearVertices
from lcollision_core.contact.kernels import find_near
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import Topology

_SOURCES_AT_ONCE = 256
"""Rows of the dense distance block that SciPy returns; bounds the memory to 256 V numbers."""

MAX_NEAR = 250_000_000
"""The most entries that the table may have: 1 GB. All pairs of 10 000 vertices take 100 million."""


def near_vertices(
    topology: Topology, vertices: npt.NDArray[np.float64], distance: float
) -> NearVertices:
    """Collect for each vertex those reached by an edge path of at most `distance`.

    Parameters
    ----------
    topology : of the mesh
    vertices : (V, 3) float64 array, the reference
    distance : >= 0, in the unit of `vertices`; 0 excludes nothing

    Raises
    ------
    ShapeError : there would be more than `MAX_NEAR` entries.
    """
    if distance <= 0.0:
        return NearVertices(
            start=np.zeros(topology.n_vertices + 1, dtype=np.int64),
            vertex=np.empty(0, dtype=np.int32),
        )
    i, j = topology.edges.T
    lengths = topology.edge_lengths(vertices)
    # Duplicate vertices give edges of length 0, which a sparse graph stores like any other.
    graph = sparse.coo_matrix((lengths, (i, j)), shape=2 * (topology.n_vertices,)).tocsr()
    counts = np.zeros(topology.n_vertices + 1, dtype=np.int64)
    reached: list[npt.NDArray[np.int32]] = []
    for first in range(0, topology.n_vertices, _SOURCES_AT_ONCE):
        sources = np.arange(first, min(first + _SOURCES_AT_ONCE, topology.n_vertices))
        distances = csgraph.dijkstra(graph, directed=False, indices=sources, limit=distance)
        rows, columns = np.nonzero(distances <= distance)
        counts[sources + 1] = np.bincount(rows, minlength=len(sources))
        reached.append(columns.astype(np.int32))
        if counts.sum() > MAX_NEAR:
            raise ShapeError(
                f"the near exclusion relates more than {MAX_NEAR} pairs of the "
                f"{topology.n_vertices} vertices",
                "make it smaller",
            )
    return NearVertices(start=np.cumsum(counts), vertex=np.concatenate(reached))


def are_pairs_near(
    topology: Topology, pairs: npt.NDArray[np.integer], near: NearVertices
) -> npt.NDArray[np.bool_]:
    """Return (n,) whether some corners of the faces of (n, 2) pairs are near each other."""
    is_near = np.empty(len(pairs), dtype=np.bool_)
    find_near(topology.faces, pairs, near, is_near)
    return is_near
