"""Whether a mesh runs into itself, by code that shares nothing with the project's.

Two triangles in general position meet exactly where an edge of one pierces the other. Every edge
is tried on every triangle near it; there is no tree, no depth, and no file reader of ours.
"""

from __future__ import annotations

from pathlib import Path

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
