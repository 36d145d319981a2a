"""Points all over the body, and the patch of skin round each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph

from lcollision_core.embedding import Embedding
from lcollision_core.embedding.seeding import edge_graph
from lcollision_core.meshes.topology import FloatArray

N_POINTS = 200
"""Of a mesh that has as many vertices; see the table in `geometric`."""

_LEAST_LENGTH = 1e-9


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """P points on the skin, a function of the embedding alone.

    Attributes
    ----------
    vertex : (P,) int64 array, ascending vertex indices
    distance : (P, V) float64 array, to every vertex along edges of the reference, in heights;
        infinite between components
    frame : (P, 3, 3) float64 array, columns: outer normal and two tangents on the reference
    """

    vertex: npt.NDArray[np.int64]
    distance: FloatArray
    frame: FloatArray

    @classmethod
    def of(cls, embedding: Embedding, n_points: int = N_POINTS) -> BodyPoints:
        """Choose points, each farthest from those before it.

        Parameters
        ----------
        embedding : of the body
        n_points : at most V are chosen
        """
        rest, topology = embedding.rest_vertices, embedding.topology
        used = np.setdiff1d(np.arange(len(rest)), topology.unused_vertices)
        places = rest[used]
        chosen: list[int] = []
        # The first is the one farthest from the middle.
        nearest = np.linalg.norm(places - places.mean(axis=0), axis=1)
        while len(chosen) < min(n_points, len(used)):
            best = int(nearest.argmax())
            to_best = np.linalg.norm(places - places[best], axis=1)
            nearest = np.minimum(nearest, to_best) if chosen else to_best
            chosen.append(int(used[best]))
        vertex = np.sort(np.array(chosen))
        distance = skin_distances(embedding, vertex)
        return cls(vertex, distance, tangent_frames(embedding, vertex))

    @property
    def patch(self) -> npt.NDArray[np.int64]:
        """(V,) int64 array: the point that each vertex is nearest to along the surface."""
        nearest: npt.NDArray[np.int64] = self.distance.argmin(axis=0)
        return nearest


def skin_distances(embedding: Embedding, vertex: npt.NDArray[np.integer]) -> FloatArray:
    """Return (n, V) lengths of the shortest edge paths from some vertices, in heights.

    They are infinite between components.
    """
    rest, topology = embedding.rest_vertices, embedding.topology
    # SciPy would drop edges of length 0.
    lengths = np.maximum(topology.edge_lengths(rest), _LEAST_LENGTH)
    graph = edge_graph(topology.edges, len(rest), lengths)
    distance: FloatArray = csgraph.dijkstra(graph, directed=False, indices=vertex)
    return distance


def tangent_frames(embedding: Embedding, vertex: npt.NDArray[np.integer]) -> FloatArray:
    """Return (P, 3, 3): columns normal and two tangents of the reference at some vertices."""
    rest, faces = embedding.rest_vertices, embedding.topology.faces
    corner = rest[faces]
    face_normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = np.zeros_like(rest)
    np.add.at(normal, faces.ravel(), np.repeat(face_normal, 3, axis=0))
    normal = normal[vertex]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), [1.0, 0.0, 0.0])
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    tangent = np.cross(normal, axis)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([normal, tangent, np.cross(normal, tangent)], axis=2)
