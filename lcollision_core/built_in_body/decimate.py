"""Edge collapse that keeps a mirror half watertight against its other half."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.normals import vertex_normals

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
_Point = tuple[float, float, float]
Project = Callable[[FloatArray], FloatArray]

MIN_NORMAL_COSINE = 0.3
"""A collapse may turn a face that it keeps by no more than this cosine allows."""

SHAPE_WEIGHT = 60.0
"""What a squared distance from the surface costs beside a squared relative edge length."""


class HalfMesh:
    """The half x >= 0 of a mirror-symmetric closed mesh, open along the plane x = 0.

    Greedy collapse of the edge that is shortest relative to the length wanted there. Besides the
    link condition, which keeps a manifold a manifold, no inner edge may join two vertices of the
    rim: its mirror image would be the same edge again, with four faces.

    Parameters
    ----------
    vertices : (V, 3) float array; exactly the vertices of the open rim have x == 0
    faces : (F, 3) integer array
    edge_size : (V,) relative edge length wanted at each vertex, > 0
    """

    def __init__(
        self, vertices: FloatArray, faces: npt.NDArray[np.integer], edge_size: FloatArray
    ) -> None:
        self._position: list[_Point] = [(x, y, z) for x, y, z in vertices.tolist()]
        self._size = [float(s) for s in edge_size]
        self._on_rim = [p[0] == 0.0 for p in self._position]
        self._alive = [True] * len(self._position)
        self._rings: list[set[int]] = [set() for _ in self._position]
        self._faces_of: list[set[tuple[int, int, int]]] = [set() for _ in self._position]
        for a, b, c in faces.tolist():
            for u, v, w in ((a, b, c), (b, c, a), (c, a, b)):
                self._rings[u].update((v, w))
                self._faces_of[u].add((a, b, c))
        self._n_whole = 2 * len(self._position) - sum(self._on_rim)
        self._quadrics = _plane_quadrics(vertices, faces)
        self._version = [0] * len(self._position)

    def collapse_to(self, n_vertices: int) -> None:
        """Collapse until the half and its mirror image together have `n_vertices` vertices.

        Raises
        ------
        ValueError : no further edge can go without harm.
        """
        queue: list[tuple[float, int, int, int, int]] = []
        for u, ring in enumerate(self._rings):
            for v in ring:
                if u < v:
                    self._push(queue, u, v)
        heapq.heapify(queue)
        while self._n_whole > n_vertices:
            if not queue:
                raise ValueError(f"{self._n_whole} vertices cannot be reduced to {n_vertices}")
            _, u, v, version_u, version_v = heapq.heappop(queue)
            if self._version[u] != version_u or self._version[v] != version_v:
                continue
            removes = 1 if self._on_rim[u] and self._on_rim[v] else 2
            if removes > self._n_whole - n_vertices:
                # Only a rim edge can remove the last odd vertex.
                continue
            if self._may_collapse(u, v):
                self._collapse(u, v)
                self._n_whole -= removes
                for w in self._rings[u]:
                    self._push(queue, u, w)

    def arrays(self) -> tuple[FloatArray, IntArray, npt.NDArray[np.bool_]]:
        """Vertices (V, 3), faces (F, 3) and rim mask (V,) of what is left."""
        kept = np.flatnonzero(self._alive)
        index = np.full(len(self._alive), -1, dtype=np.int32)
        index[kept] = np.arange(len(kept), dtype=np.int32)
        faces = sorted({face for u in kept for face in self._faces_of[u]})
        return (
            np.array([self._position[u] for u in kept]),
            index[np.array(faces)],
            np.array([self._on_rim[u] for u in kept]),
        )

    def _push(self, queue: list[tuple[float, int, int, int, int]], u: int, v: int) -> None:
        cost = _squared(self._position[u], self._position[v]) / (self._size[u] * self._size[v])
        cost += SHAPE_WEIGHT * self._merged_position(u, v)[1]
        heapq.heappush(queue, (cost, u, v, self._version[u], self._version[v]))

    def _merged_position(self, u: int, v: int) -> tuple[_Point, float]:
        """Where the merged vertex goes, and its mean squared distance to the planes it replaces."""
        p, q = self._position[u], self._position[v]
        quadric = [a + b for a, b in zip(self._quadrics[u], self._quadrics[v], strict=True)]
        if self._on_rim[u] != self._on_rim[v]:
            candidates = [p if self._on_rim[u] else q]
        else:
            candidates = [((p[0] + q[0]) / 2, (p[1] + q[1]) / 2, (p[2] + q[2]) / 2), p, q]
        errors = [_quadric_error(quadric, c) for c in candidates]
        best = errors.index(min(errors))
        return candidates[best], errors[best]

    def _may_collapse(self, u: int, v: int) -> bool:
        common = self._rings[u] & self._rings[v]
        shared_faces = self._faces_of[u] & self._faces_of[v]
        if len(common) != len(shared_faces) or not shared_faces:
            return False
        both_rim = self._on_rim[u] and self._on_rim[v]
        if both_rim and len(shared_faces) != 1:
            return False
        union = self._rings[u] | self._rings[v]
        if len(union) - 2 < 4 or any(len(self._rings[w]) <= 4 - self._on_rim[w] for w in common):
            return False
        if self._on_rim[u] != self._on_rim[v]:
            inner = v if self._on_rim[u] else u
            rim = u if self._on_rim[u] else v
            beyond = self._rings[inner] - self._rings[rim] - {rim}
            if any(self._on_rim[w] for w in beyond):
                return False
        return self._keeps_normals(u, v, shared_faces)

    def _keeps_normals(self, u: int, v: int, gone: set[tuple[int, int, int]]) -> bool:
        target = self._merged_position(u, v)[0]
        for moved in (u, v):
            for face in self._faces_of[moved]:
                if face in gone:
                    continue
                p, q, r = (self._position[w] for w in face)
                old = _normal(p, q, r)
                p, q, r = (target if w == moved else self._position[w] for w in face)
                new = _normal(p, q, r)
                dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
                if dot <= MIN_NORMAL_COSINE * _length(old) * _length(new):
                    return False
        return True

    def _collapse(self, u: int, v: int) -> None:
        self._position[u] = self._merged_position(u, v)[0]
        self._quadrics[u] = [
            a + b for a, b in zip(self._quadrics[u], self._quadrics[v], strict=True)
        ]
        self._size[u] = min(self._size[u], self._size[v])
        self._on_rim[u] = self._on_rim[u] or self._on_rim[v]
        for face in list(self._faces_of[v]):
            for w in face:
                self._faces_of[w].discard(face)
            if u not in face:
                a, b, c = (u if w == v else w for w in face)
                for w in (a, b, c):
                    self._faces_of[w].add((a, b, c))
        for w in self._rings[v]:
            self._rings[w].discard(v)
            if w != u:
                self._rings[w].add(u)
                self._rings[u].add(w)
        self._rings[u].discard(v)
        self._rings[v].clear()
        self._faces_of[v].clear()
        self._alive[v] = False
        self._version[u] += 1
        self._version[v] += 1


def relax(
    vertices: FloatArray, faces: IntArray, on_rim: npt.NDArray[np.bool_], project: Project, n: int
) -> FloatArray:
    """Even out the triangles: move each vertex towards its ring's centre, along the surface.

    Parameters
    ----------
    vertices, faces, on_rim : a half mesh as `HalfMesh.arrays` returns it
    project : maps (V, 3) points to their closest points on the true surface
    n : number of sweeps

    Returns
    -------
    vertices : (V, 3) float64 array, on the surface; rim vertices stay in the plane x = 0
    """
    start = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.unique(np.concatenate([start, start[:, ::-1]]), axis=0)
    # A rim vertex slides along the rim only, or the two halves would pull it off its ridge.
    pairs = pairs[~on_rim[pairs[:, 0]] | on_rim[pairs[:, 1]]]
    degree = np.bincount(pairs[:, 0], minlength=len(vertices))
    for _ in range(n):
        normals = vertex_normals(vertices, faces)
        normals[on_rim, 0] = 0.0
        centre = np.zeros_like(vertices)
        np.add.at(centre, pairs[:, 0], vertices[pairs[:, 1]])
        centre /= degree[:, None]
        step = centre - vertices
        # Along the normal the centre lies inside the body: fingertips and toes would shrink.
        step -= np.einsum("ij,ij->i", step, normals)[:, None] * normals
        vertices = project(vertices + 0.4 * step)
        vertices[on_rim, 0] = 0.0
    return vertices


def flip_edges(vertices: FloatArray, faces: IntArray, on_rim: npt.NDArray[np.bool_]) -> IntArray:
    """Flip inner edges that are longer than the other diagonal, where no normal turns much."""
    triangles = faces.tolist()
    by_edge: dict[tuple[int, int], int] = {}
    for index, (a, b, c) in enumerate(triangles):
        by_edge[a, b] = by_edge[b, c] = by_edge[c, a] = index
    edges = {tuple(sorted(edge)) for edge in by_edge}
    points = vertices.tolist()
    for u, v in sorted(edges):
        left, right = by_edge.get((u, v)), by_edge.get((v, u))
        if left is None or right is None:
            continue
        a = next(w for w in triangles[left] if w not in (u, v))
        b = next(w for w in triangles[right] if w not in (u, v))
        if (a, b) in by_edge or (b, a) in by_edge or (on_rim[a] and on_rim[b]):
            continue
        if _squared(points[a], points[b]) > 0.8 * _squared(points[u], points[v]):
            continue
        old = _normal(points[u], points[v], points[a]), _normal(points[v], points[u], points[b])
        new = _normal(points[a], points[u], points[b]), _normal(points[b], points[v], points[a])
        if any(_dot(p, q) < 0.8 * _length(p) * _length(q) for p in old for q in new):
            continue
        triangles[left], triangles[right] = [a, u, b], [b, v, a]
        del by_edge[u, v], by_edge[v, u]
        for index in (left, right):
            p, q, r = triangles[index]
            by_edge[p, q] = by_edge[q, r] = by_edge[r, p] = index
    return np.array(triangles, dtype=np.int32)


def mirror_whole(
    vertices: FloatArray, faces: IntArray, on_rim: npt.NDArray[np.bool_]
) -> tuple[FloatArray, IntArray, IntArray]:
    """Join a half with its mirror image.

    Returns
    -------
    vertices : (V, 3) float64 array, the half first
    faces : (F, 3) int32 array, outward where the half's are
    mirror : (V,) int32 array, the index of each vertex's mirror image
    """
    n_half = len(vertices)
    image = np.arange(n_half, dtype=np.int32)
    image[~on_rim] = n_half + np.arange(int((~on_rim).sum()), dtype=np.int32)
    whole = np.concatenate([vertices, vertices[~on_rim] * [-1.0, 1.0, 1.0]])
    mirror = np.concatenate([image, np.flatnonzero(~on_rim).astype(np.int32)])
    return whole, np.concatenate([faces, image[faces[:, ::-1]]]), mirror


def _plane_quadrics(vertices: FloatArray, faces: npt.NDArray[np.integer]) -> list[list[float]]:
    """Area-weighted sums over each vertex's faces of n nT, n d, d d and one (Garland, Heckbert)."""
    a, b, c = vertices[faces.T]
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    x, y, z = (normal / np.maximum(area, 1e-30)[:, None]).T
    d = -(x * a[:, 0] + y * a[:, 1] + z * a[:, 2])
    one = np.ones_like(d)
    terms = np.stack([x * x, y * y, z * z, x * y, y * z, z * x, x * d, y * d, z * d, d * d, one])
    quadrics = np.zeros((len(vertices), len(terms)))
    for corner in range(3):
        np.add.at(quadrics, faces[:, corner], (terms * area).T)
    result: list[list[float]] = quadrics.tolist()
    return result


def _quadric_error(quadric: list[float], p: _Point) -> float:
    xx, yy, zz, xy, yz, zx, xd, yd, zd, dd, area = quadric
    x, y, z = p
    total = xx * x * x + yy * y * y + zz * z * z + dd
    total += 2 * (xy * x * y + yz * y * z + zx * z * x + xd * x + yd * y + zd * z)
    return max(total, 0.0) / area


def _normal(p: _Point, q: _Point, r: _Point) -> _Point:
    a, b, c = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    d, e, f = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    return (b * f - c * e, c * d - a * f, a * e - b * d)


def _dot(p: _Point, q: _Point) -> float:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def _length(p: _Point) -> float:
    return math.sqrt(_dot(p, p))


def _squared(p: _Point, q: _Point) -> float:
    return (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2
