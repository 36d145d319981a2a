"""The compiled loops over the edges, faces and vertices of a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled

IntArray = npt.NDArray[np.int32]
FloatArray = npt.NDArray[np.float64]


@compiled
def _sort_by(ends: IntArray, before: IntArray, n_vertices: int, after: IntArray) -> None:
    """Sort corners by the vertex of each, stably: one pass of a counting sort."""
    place = np.zeros(n_vertices + 1, dtype=np.int64)
    for vertex in ends:
        place[vertex + 1] += 1
    for vertex in range(n_vertices):
        place[vertex + 1] += place[vertex]
    for corner in before:
        vertex = ends[corner]
        after[place[vertex]] = corner
        place[vertex] += 1


@compiled
def sort_edges(faces: IntArray, n_vertices: int, order: IntArray) -> None:
    """Sort directed edges by their lower vertex, then by their higher one.

    Parameters
    ----------
    faces : (F, 3) int32 array; edge 3 f + c leads from corner c of face f to the next
    n_vertices : V
    order : (3 F,) int32 array, overwritten by the edges in order, equal ones as they come
    """
    n_edges = 3 * len(faces)
    low, high = np.empty(n_edges, dtype=np.int32), np.empty(n_edges, dtype=np.int32)
    for face in range(len(faces)):
        for c in range(3):
            v, w = faces[face, c], faces[face, (c + 1) % 3]
            low[3 * face + c], high[3 * face + c] = min(v, w), max(v, w)
    by_high = np.empty(n_edges, dtype=np.int32)
    _sort_by(high, np.arange(n_edges).astype(np.int32), n_vertices, by_high)
    _sort_by(low, by_high, n_vertices, order)


@compiled
def unique_edges(
    faces: IntArray, order: IntArray, edges: IntArray, counts: IntArray
) -> tuple[int, bool]:
    """Collect the different undirected edges of sorted directed ones.

    Parameters
    ----------
    faces : (F, 3) int32 array
    order : (3 F,) int32 array, of `sort_edges`
    edges : (3 F, 2) int32 array, its front overwritten, each row ascending
    counts : (3 F,) int32 array, its front overwritten by the faces at each

    Returns
    -------
    n_edges : how many there are
    is_watertight : whether each has two faces, which run along it in opposite directions
    """
    n_edges, n_forward, is_watertight = 0, 0, True
    for place in range(len(order) + 1):
        v, w = -1, -1
        if place < len(order):
            face, c = order[place] // 3, order[place] % 3
            v, w = faces[face, c], faces[face, (c + 1) % 3]
        low, high = min(v, w), max(v, w)
        same = n_edges > 0 and edges[n_edges - 1, 0] == low and edges[n_edges - 1, 1] == high
        if not same:
            if n_edges > 0:
                is_watertight &= counts[n_edges - 1] == 2 and n_forward == 1
            if place == len(order):
                break
            edges[n_edges, 0], edges[n_edges, 1] = low, high
            counts[n_edges] = 0
            n_forward = 0
            n_edges += 1
        counts[n_edges - 1] += 1
        n_forward += v < w
    return n_edges, is_watertight


@compiled
def _root(parent: IntArray, corner: int) -> int:
    while parent[corner] != corner:
        parent[corner] = parent[parent[corner]]
        corner = parent[corner]
    return corner


@compiled
def count_fans(faces: IntArray, order: IntArray, fans: IntArray) -> None:
    """Count for each vertex the fans of faces that are joined by edges at it.

    Parameters
    ----------
    faces : (F, 3) int32 array
    order : (3 F,) int32 array, of `sort_edges`
    fans : (V,) int32 array, overwritten
    """
    parent = np.arange(len(order)).astype(np.int32)
    for place in range(1, len(order)):
        f, c = order[place - 1] // 3, order[place - 1] % 3
        g, d = order[place] // 3, order[place] % 3
        f_next, g_next = 3 * f + (c + 1) % 3, 3 * g + (d + 1) % 3
        v, w = faces[f, c], faces[f, (c + 1) % 3]
        if v == faces[g, d] and w == faces[g, (d + 1) % 3]:
            parent[_root(parent, 3 * f + c)] = _root(parent, 3 * g + d)
            parent[_root(parent, f_next)] = _root(parent, g_next)
        elif v == faces[g, (d + 1) % 3] and w == faces[g, d]:
            parent[_root(parent, 3 * f + c)] = _root(parent, g_next)
            parent[_root(parent, f_next)] = _root(parent, 3 * g + d)
    fans[:] = 0
    for corner in range(len(parent)):
        if parent[corner] == corner:
            fans[faces[corner // 3, corner % 3]] += 1


@compiled
def mark_flat_faces(
    points: FloatArray, faces: IntArray, scale: float, is_flat: npt.NDArray[np.bool_]
) -> None:
    """Tell which faces have a height over their longest side below 1e-12 of that side.

    Parameters
    ----------
    points : (V, 3) float64 array
    faces : (F, 3) int32 array
    scale : what lengths are multiplied by before they are squared
    is_flat : (F,) bool array, overwritten
    """
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, vx = (points[b, 0] - points[a, 0]) * scale, (points[c, 0] - points[a, 0]) * scale
        uy, vy = (points[b, 1] - points[a, 1]) * scale, (points[c, 1] - points[a, 1]) * scale
        uz, vz = (points[b, 2] - points[a, 2]) * scale, (points[c, 2] - points[a, 2]) * scale
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        u, v = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
        w = (vx - ux) ** 2 + (vy - uy) ** 2 + (vz - uz) ** 2
        is_flat[face] = np.sqrt(nx * nx + ny * ny + nz * nz) <= 1e-12 * max(u, max(v, w))


@compiled
def find_equal_rows(rows: npt.NDArray[np.uint64], first: IntArray) -> None:
    """Find for each row the first that equals it, by a table of hashes.

    Parameters
    ----------
    rows : (n, 3) uint64 array
    first : (n,) int32 array, overwritten by indices, its own where there is none before
    """
    size = np.uint64(4)
    while size < 2 * len(rows):
        size *= np.uint64(2)
    mask = size - np.uint64(1)
    table = np.full(size, -1, dtype=np.int32)
    for place in range(len(rows)):
        key = np.uint64(0)
        for c in range(3):
            key = (key ^ rows[place, c]) * np.uint64(0x9E3779B97F4A7C15)
            key ^= key >> np.uint64(29)
        slot = key & mask
        while True:
            other = table[slot]
            if other < 0:
                table[slot] = place
                first[place] = place
                break
            if (
                rows[other, 0] == rows[place, 0]
                and rows[other, 1] == rows[place, 1]
                and rows[other, 2] == rows[place, 2]
            ):
                first[place] = other
                break
            slot = (slot + np.uint64(1)) & mask
