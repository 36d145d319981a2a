"""Points all over the body, and which of them tell whether the skin round a point collides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph

from lcollision_core.embedding import Embedding
from lcollision_core.embedding.seeding import edge_graph
from lcollision_core.meshes.topology import FloatArray, IntArray

N_POINTS = 200
"""Of a mesh that has as many vertices; see the table in `geometric`."""

FAR_PARTNERS = 16
NEAR_PARTNERS = 8

_FAR_DISTANCE = 0.12
"""Heights along the surface beyond which two points collide like parts, not like folding skin."""

_NEAR_REACH = 0.16
_FAR_SCALE = 0.05
_FAR_SPREAD, _NEAR_SPREAD = 0.04, 0.03
"""Heights within which a chosen partner makes its neighbours redundant."""

_REDUNDANCE = 0.8
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
        edges = topology.edges
        # SciPy would drop edges of length 0.
        lengths = np.maximum(topology.edge_lengths(rest), _LEAST_LENGTH)
        graph = edge_graph(edges, len(rest), lengths)
        distance: FloatArray = csgraph.dijkstra(graph, directed=False, indices=vertex)
        return cls(vertex, distance, _tangent_frames(embedding, vertex))

    @property
    def patch(self) -> npt.NDArray[np.int64]:
        """(V,) int64 array: the point that each vertex is nearest to along the surface."""
        nearest: npt.NDArray[np.int64] = self.distance.argmin(axis=0)
        return nearest

    def partners(self, positions: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
        """Choose for each point those whose places tell most about collisions round it.

        First `FAR_PARTNERS` points of other parts, that come near often; then `NEAR_PARTNERS` of
        the skin about it, that tell how it folds. A choice makes its neighbours less wanted.

        Parameters
        ----------
        positions : (n, P, 3) array, the points in sampled poses, in heights

        Returns
        -------
        partners : (P, FAR_PARTNERS + NEAR_PARTNERS) int64 array; small bodies repeat points
        """
        between = self.distance[:, self.vertex]
        closeness = np.zeros_like(between)
        for pose in positions:
            offset = np.linalg.norm(pose[:, None] - pose[None], axis=2)
            closeness += np.exp(-offset / _FAR_SCALE)
        far = np.where(between < _FAR_DISTANCE, 0.0, closeness)
        near = np.where((between > 0.0) & (between < _NEAR_REACH), np.exp(-between / 0.1), 0.0)
        return np.concatenate(
            [
                _chosen(far, between, FAR_PARTNERS, _FAR_SPREAD),
                _chosen(near, between, NEAR_PARTNERS, _NEAR_SPREAD),
            ],
            axis=1,
        )


def _chosen(
    score: FloatArray, between: FloatArray, n_chosen: int, spread: float
) -> npt.NDArray[np.int64]:
    """Take the best of every row again and again, each time lowering its neighbours' scores."""
    left = score.copy()
    rows = np.arange(len(score))
    chosen = np.empty((len(score), n_chosen), dtype=np.int64)
    for number in range(n_chosen):
        chosen[:, number] = best = left.argmax(axis=1)
        left *= 1.0 - _REDUNDANCE * np.exp(-((between[best] / spread) ** 2))
        left[rows, best] = -1.0
    return chosen


def _tangent_frames(embedding: Embedding, vertex: IntArray) -> FloatArray:
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
