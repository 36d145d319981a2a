"""Meshes with self-collisions that are known by construction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes import Topology

FloatArray = npt.NDArray[np.float64]


class Mesh(NamedTuple):
    """One pose with its faces."""

    vertices: FloatArray
    faces: npt.NDArray[np.int32]

    @property
    def topology(self) -> Topology:
        return Topology(self.faces, len(self.vertices))

    def moved(self, shift: npt.ArrayLike) -> Mesh:
        return Mesh(self.vertices + np.asarray(shift, dtype=np.float64), self.faces)

    def turned(self, rotation: FloatArray) -> Mesh:
        return Mesh(self.vertices @ rotation.T, self.faces)


def join(*meshes: Mesh) -> Mesh:
    """Concatenate meshes into one, faces and vertices in the order given."""
    counts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [mesh.faces + count for mesh, count in zip(meshes, counts, strict=False)]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.int32)
    )


def soup(triangles: npt.ArrayLike) -> Mesh:
    """Make a mesh of triangles (F, 3, 3) that share no vertex."""
    vertices = np.asarray(triangles, dtype=np.float64).reshape(-1, 3)
    return Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))


def random_rotation(rng: np.random.Generator) -> FloatArray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diagonal(r))
    q[:, 0] *= np.linalg.det(q)
    return q


def _quad_faces(
    rows: int, columns: int, *, rows_close: bool, columns_close: bool
) -> npt.NDArray[np.int32]:
    """Triangulate a lattice of rows x columns vertices, numbered row by row."""
    i, j = np.meshgrid(
        np.arange(rows if rows_close else rows - 1),
        np.arange(columns if columns_close else columns - 1),
        indexing="ij",
    )
    i, j = i.ravel(), j.ravel()
    i_next, j_next = (i + 1) % rows, (j + 1) % columns
    a, b = i * columns + j, i_next * columns + j
    c, d = i_next * columns + j_next, i * columns + j_next
    lower, upper = np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)
    return np.stack([lower, upper], axis=1).reshape(-1, 3).astype(np.int32)


def grid(n: int) -> Mesh:
    """Make the unit square in z = 0 of n x n cells, 2 n^2 faces."""
    line = np.linspace(0.0, 1.0, n + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return Mesh(vertices, _quad_faces(n + 1, n + 1, rows_close=False, columns_close=False))


def strip(columns: npt.ArrayLike) -> Mesh:
    """Make a ribbon of width 1 along y through the points `columns` (C, 2) of the xz-plane.

    Column c has vertex 2c at y = 0 and 2c + 1 at y = 1. Segment c has face 2c with the corners
    (c, c + 1 at y = 0; c + 1 at y = 1) and face 2c + 1 with (c at y = 0; c + 1, c at y = 1).
    """
    points = np.asarray(columns, dtype=np.float64)
    vertices = np.zeros((2 * len(points), 3))
    vertices[:, [0, 2]] = np.repeat(points, 2, axis=0)
    vertices[1::2, 1] = 1.0
    return Mesh(vertices, _quad_faces(len(points), 2, rows_close=False, columns_close=False))


def tube(
    centres: FloatArray, radius: float, sides: int = 8, up: Sequence[float] = (0, 0, 1)
) -> Mesh:
    """Sweep a regular polygon inside a circle of `radius` along a closed curve (N, 3).

    Its surface stays within `radius` of the curve if the curve's points are dense.
    `up` must be nowhere parallel to the curve.
    """
    tangents = np.roll(centres, -1, axis=0) - np.roll(centres, 1, axis=0)
    across = np.cross(tangents, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.cross(across, tangents)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angles = 2 * np.pi * np.arange(sides) / sides
    rings = (
        centres[:, None]
        + radius * np.cos(angles)[None, :, None] * across[:, None]
        + radius * np.sin(angles)[None, :, None] * normals[:, None]
    )
    faces = _quad_faces(len(centres), sides, rows_close=True, columns_close=True)
    return Mesh(rings.reshape(-1, 3), faces)


def circle(n: int, radius: float) -> FloatArray:
    """Return n points of a circle about the origin in the xy-plane."""
    angles = 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)


def torus(major: float, minor: float, rings: int = 32, sides: int = 10) -> Mesh:
    """Make a torus about the z axis."""
    return tube(circle(rings, major), minor, sides)


def interlocked_tori(minor: float) -> Mesh:
    """Link two tori of major radius 1 whose centre circles are 1 apart."""
    other = torus(1.0, minor)
    upright = np.stack([other.vertices[:, 0], other.vertices[:, 2], -other.vertices[:, 1]], axis=1)
    return join(torus(1.0, minor), Mesh(upright, other.faces).moved([1.0, 0.0, 0.0]))


def figure_eight(radius: float, lift: float) -> Mesh:
    """Make a tube along an 8 whose two passes cross at a vertical distance of 2 `lift`."""
    t = 2 * np.pi * (np.arange(64) + 0.5) / 64
    return tube(np.stack([np.sin(2 * t), 2 * np.sin(t), lift * np.cos(t)], axis=1), radius)


def sphere(radius: float = 1.0, n: int = 12) -> Mesh:
    """Make a sphere of n meridians: a closed lattice with a fan at each pole."""
    heights = np.linspace(-np.pi / 2, np.pi / 2, n // 2 + 1)[1:-1]
    angles = 2 * np.pi * np.arange(n) / n
    rings = np.stack(
        [
            np.outer(np.cos(heights), np.cos(angles)),
            np.outer(np.cos(heights), np.sin(angles)),
            np.outer(np.sin(heights), np.ones(n)),
        ],
        axis=2,
    )
    body = _quad_faces(len(heights), n, rows_close=False, columns_close=True)
    south, north = len(heights) * n, len(heights) * n + 1
    first, following = np.arange(n), (np.arange(n) + 1) % n
    last = (len(heights) - 1) * n
    caps = [
        np.stack([np.full(n, south), first, following], axis=1),
        np.stack([np.full(n, north), last + following, last + first], axis=1),
    ]
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, -1], [0, 0, 1]]])
    return Mesh(radius * vertices, np.concatenate([body, *caps]).astype(np.int32))


def box(lower: npt.ArrayLike, upper: npt.ArrayLike) -> Mesh:
    """Make an axis-aligned box of 8 vertices and 12 faces."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5],
        [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
        [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    return Mesh(low + corners * (high - low), np.array(faces, dtype=np.int32))
