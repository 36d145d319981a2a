"""Whether a mesh runs into itself, by code that shares nothing with the project's.

Two triangles in general position meet exactly where an edge of one pierces the other. Every edge
is tried on every triangle near it; there is no tree, no depth, and no file reader of ours. Contact
rules are applied pair by pair, by the text of their definition in the glossary.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]


def read_obj(path: Path) -> tuple[Array, npt.NDArray[np.int64]]:
    """Read the vertices and triangles of a plain OBJ file."""
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        kind, *values = line.split() or [""]
        if kind == "v":
            vertices.append([float(value) for value in values[:3]])
        elif kind == "f":
            faces.append([int(value.split("/")[0]) - 1 for value in values])
    return np.array(vertices), np.array(faces)


def crossing_pairs(vertices: Array, faces: npt.NDArray[np.int64]) -> set[tuple[int, int]]:
    """Return the pairs of triangles without a common vertex of which one pierces the other."""
    corners = vertices[faces]
    middle = corners.mean(axis=1)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    # The larger of two faces that touch has the other's middle within twice its own radius.
    reached = cKDTree(middle).query_ball_point(middle, 2.0 * radius)
    larger = np.repeat(np.arange(len(faces)), [len(others) for others in reached])
    near = np.stack([larger, np.concatenate(reached).astype(np.int64)], axis=1)
    order = np.lexsort((np.arange(len(faces)), radius))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(faces))
    near = np.sort(near[rank[near[:, 1]] < rank[near[:, 0]]], axis=1)
    apart = np.linalg.norm(middle[near[:, 0]] - middle[near[:, 1]], axis=1)
    near = near[apart <= radius[near].sum(axis=1)]
    shared = (faces[near[:, 0], :, None] == faces[near[:, 1], None, :]).any(axis=(1, 2))
    near = near[~shared]
    found = np.zeros(len(near), dtype=bool)
    for own, other in ((0, 1), (1, 0)):
        triangle = corners[near[:, other]]
        for start in range(3):
            edge = corners[near[:, own]][:, [start, (start + 1) % 3]]
            found |= _pierces(edge[:, 0], edge[:, 1], triangle)
    return {(int(a), int(b)) for a, b in near[found]}


class IndependentRules:
    """Contact rules, applied pair by pair; what is found about a face is kept for later poses.

    Parameters
    ----------
    rest, faces : of the rest pose
    touching_at_rest : pairs of its faces
    rules : as in JSON
    groups : faces by name
    """

    def __init__(
        self,
        rest: Array,
        faces: npt.NDArray[np.int64],
        touching_at_rest: Iterable[tuple[int, int]],
        rules: Mapping[str, Any],
        groups: Mapping[str, set[int]],
    ) -> None:
        self._rest, self._corners, self._groups = rest, faces.tolist(), groups
        size = float(np.ptp(rest[np.unique(faces)], axis=0).max())
        self._near, self._tolerated = (
            rules["near_exclusion"] * size,
            rules["tolerated_depth"] * size,
        )
        self._ignored = rules["ignored"]
        self._of_rest = None if rules["rest_exclusion"] is None else rules["rest_exclusion"] * size
        self._neighbours: dict[int, set[int]] = {}
        self._faces_of: dict[int, set[int]] = {}
        for face, (a, b, c) in enumerate(self._corners):
            for i, j in ((a, b), (b, c), (c, a)):
                self._neighbours.setdefault(i, set()).add(j)
                self._neighbours.setdefault(j, set()).add(i)
                self._faces_of.setdefault(i, set()).add(face)
        self._touched: dict[int, set[int]] = {}
        for a, b in touching_at_rest:
            self._touched.setdefault(a, set()).add(b)
            self._touched.setdefault(b, set()).add(a)
        self._around: dict[tuple[int, float], set[int]] = {}

    def excluding(self, pairs: Mapping[tuple[int, int], float]) -> dict[tuple[int, int], str]:
        """Return the first rule that excludes each pair; those that count are left out.

        Parameters
        ----------
        pairs : colliding faces of a pose with their depths, in the unit of the rest pose
        """
        ruled = {pair: self._rule(*pair, depth) for pair, depth in pairs.items()}
        return {pair: rule for pair, rule in ruled.items() if rule is not None}

    def _rule(self, a: int, b: int, depth: float) -> str | None:
        if self._near > 0.0 and b in self._faces_around(a, self._near):
            return "near"
        if self._of_rest is not None and self._is_of_rest(a, b, self._of_rest):
            return "rest"
        for one, two in self._ignored:
            first, second = self._groups[one], self._groups[two]
            if (a in first and b in second) or (b in first and a in second):
                return "ignored"
        return "tolerated" if depth <= self._tolerated else None

    def _is_of_rest(self, a: int, b: int, radius: float) -> bool:
        """Whether a face near a touches one near b at rest."""
        by_b = self._faces_around(b, radius)
        return any(self._touched.get(face, set()) & by_b for face in self._faces_around(a, radius))

    def _faces_around(self, face: int, radius: float) -> set[int]:
        """Faces with a corner at most so far from one of this face, along edges, by Dijkstra."""
        if radius == 0.0:
            return {face}
        known = self._around.get((face, radius))
        if known is not None:
            return known
        reached: set[int] = set()
        waiting = [(0.0, corner) for corner in self._corners[face]]
        while waiting:
            length, vertex = heapq.heappop(waiting)
            if vertex in reached:
                continue
            reached.add(vertex)
            for other in self._neighbours[vertex] - reached:
                further = length + float(np.linalg.norm(self._rest[vertex] - self._rest[other]))
                if further <= radius:
                    heapq.heappush(waiting, (further, other))
        found = set().union(*(self._faces_of[vertex] for vertex in reached))
        self._around[face, radius] = found
        return found


def _pierces(start: Array, stop: Array, triangle: Array) -> npt.NDArray[np.bool_]:
    """Tell which segments cross their triangles: signs of volumes of tetrahedra."""
    a, b, c = triangle.transpose(1, 0, 2)

    def side(p: Array, q: Array, r: Array, s: Array) -> Array:
        volume: Array = (np.cross(q - p, r - p) * (s - p)).sum(axis=1)
        return volume

    across = side(a, b, c, start) * side(a, b, c, stop) < 0.0
    turns = [side(start, stop, *ends) for ends in ((a, b), (b, c), (c, a))]
    signs = np.sign(turns)
    inside: npt.NDArray[np.bool_] = (signs == signs[0]).all(axis=0) & (signs[0] != 0.0)
    return across & inside
