"""Whether a mesh runs into itself, by code that shares nothing with the project's.

Two triangles in general position meet exactly where an edge of one pierces the other. Every edge
is tried on every triangle near it; there is no tree, no depth, and no file reader of ours. Contact
rules are applied pair by pair, by the text of their definition in the glossary.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from functools import cache
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
    near = cKDTree(middle).query_pairs(2.0 * radius.max(), output_type="ndarray")
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


def excluding_rules(
    pairs: Mapping[tuple[int, int], float],
    touching_at_rest: Iterable[tuple[int, int]],
    rest: Array,
    faces: npt.NDArray[np.int64],
    rules: Mapping[str, Any],
    groups: Mapping[str, set[int]],
) -> dict[tuple[int, int], str]:
    """Return the first rule that excludes each pair of a pose; those that count are left out.

    Parameters
    ----------
    pairs : colliding faces with their depths, in the unit of `rest`
    touching_at_rest : pairs of faces of the rest pose
    rules : as in JSON
    groups : faces by name
    """
    size = float(np.ptp(rest[np.unique(faces)], axis=0).max())
    neighbours: dict[int, set[int]] = {}
    for a, b, c in faces.tolist():
        for i, j in ((a, b), (b, c), (c, a)):
            neighbours.setdefault(i, set()).add(j)
            neighbours.setdefault(j, set()).add(i)
    faces_of: dict[int, set[int]] = {}
    for face, corners in enumerate(faces.tolist()):
        for corner in corners:
            faces_of.setdefault(corner, set()).add(face)

    @cache
    def around(face: int, radius: float) -> set[int]:
        """Faces with a corner at most so far from one of this face, along edges, by Dijkstra."""
        reached: set[int] = set()
        waiting = [(0.0, corner) for corner in faces[face].tolist()]
        while waiting:
            length, vertex = heapq.heappop(waiting)
            if vertex in reached:
                continue
            reached.add(vertex)
            for other in neighbours[vertex] - reached:
                further = length + float(np.linalg.norm(rest[vertex] - rest[other]))
                if further <= radius:
                    heapq.heappush(waiting, (further, other))
        return set().union(*(faces_of[vertex] for vertex in reached))

    near, of_rest = rules["near_exclusion"] * size, rules["rest_exclusion"]
    touched: dict[int, set[int]] = {}
    for a, b in touching_at_rest if of_rest is not None else ():
        touched.setdefault(a, set()).add(b)
        touched.setdefault(b, set()).add(a)

    def is_of_rest(a: int, b: int) -> bool:
        """Whether a face near a touches one near b at rest."""
        if not touched:
            return False
        by_a, by_b = ({f} if of_rest == 0.0 else around(f, of_rest * size) for f in (a, b))
        return any(touched.get(face, set()) & by_b for face in by_a)

    excluded = {}
    for (a, b), depth in pairs.items():
        if near > 0.0 and b in around(a, near):
            excluded[a, b] = "near"
        elif is_of_rest(a, b):
            excluded[a, b] = "rest"
        elif any(
            (a in groups[one] and b in groups[two]) or (b in groups[one] and a in groups[two])
            for one, two in rules["ignored"]
        ):
            excluded[a, b] = "ignored"
        elif depth <= rules["tolerated_depth"] * size:
            excluded[a, b] = "tolerated"
    return excluded


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
