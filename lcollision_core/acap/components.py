"""Edges that join the connected components of a mesh."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lcollision_core.meshes.topology import FloatArray, IntArray, Topology


def component_bridges(topology: Topology, rest_vertices: FloatArray) -> IntArray:
    """Pair each connected component's vertex with the nearest one of the largest component.

    Features do not hold the position of a component. One extra edge to its neighbour lets eyes or
    buttons follow the body that they sit on, and constrains nothing else: no cycle runs through it.

    Parameters
    ----------
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    bridges : (n, 2) int32 array, one row for each component but the largest; vertices in no face
        have none and stay where the reference has them
    """
    _, component = topology.vertex_components
    size = np.bincount(component)
    largest = int(np.argmax(size))
    main = np.flatnonzero(component == largest)
    others = np.flatnonzero((component != largest) & (size[component] > 1))
    if len(others) == 0:
        return np.empty((0, 2), dtype=np.int32)
    distance, nearest = cKDTree(rest_vertices[main]).query(rest_vertices[others])
    order = np.lexsort((distance, component[others]))
    _, first = np.unique(component[others][order], return_index=True)
    chosen = order[first]
    return np.stack([others[chosen], main[nearest[chosen]]], axis=1).astype(np.int32)
