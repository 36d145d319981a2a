"""Polygons as read from mesh files, limits common to all readers, and triangulation."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.topology import FloatArray, Int64Array, Topology, name_twice
from lcollision_core.sentences import say_number

MAX_FACES = 5_000_000
"""Most faces, and most vertices, in a mesh file.

It is far above any posed body, and low enough that a file at the limit fits into memory. Counts are
compared with it before memory is allocated.
"""

MAX_FILE_BYTES = 1 << 29
"""Largest mesh file that is read, in bytes; a text file takes about ten times that in memory."""

MAX_NUMBERS = 1 << 27
"""Most numbers that are read from all arrays of a file together: 1 GiB as float64."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """The content of a mesh file before triangulation.

    Attributes
    ----------
    vertices : (V, 3) float64 array, in the file's order
    sizes : (P,) int64 array, number of corners of each polygon
    corners : (sum of sizes,) int64 array of vertex indices, one polygon after the other
    notes : sentences on changes to the file's content
    is_single : whether the file stores the coordinates as float32
    cut_of : ascending indices of the original polygons, if they are triangulated already; None if
        not
    """

    vertices: npt.NDArray[np.float64]
    sizes: npt.NDArray[np.int64]
    corners: npt.NDArray[np.int64]
    notes: tuple[str, ...] = ()
    is_single: bool = False
    cut_of: npt.NDArray[np.int64] | None = None

    @classmethod
    def triangles(
        cls,
        vertices: npt.NDArray[np.float64],
        faces: npt.NDArray[np.int64],
        notes: tuple[str, ...] = (),
        is_single: bool = False,
        cut_of: npt.NDArray[np.int64] | None = None,
    ) -> Polygons:
        """Wrap (V, 3) vertices and (F, 3) faces."""
        sizes = np.full(len(faces), 3, dtype=np.int64)
        return cls(vertices, sizes, faces.reshape(-1), notes, is_single, cut_of)


def with_order_of(
    corners: npt.NDArray[np.float64], topology: Topology | None, note: str, is_single: bool
) -> Polygons | None:
    """Restore the vertex order of a mesh whose file stores the corners of triangles.

    Parameters
    ----------
    corners : (3 F, 3) array, three corners for each triangle
    topology : expected topology of the mesh
    note : note to add if the order is restored
    is_single : whether the file stores the corners as float32

    Returns
    -------
    the triangles; None if they do not match the topology
    """
    if topology is None or len(corners) != 3 * topology.n_faces or len(topology.unused_vertices):
        return None
    order = topology.faces.reshape(-1)
    vertices = np.empty((topology.n_vertices, 3), dtype=np.float64)
    vertices[order] = corners
    if not np.array_equal(vertices[order], corners):
        return None
    return Polygons.triangles(vertices, topology.faces.astype(np.int64), (note,), is_single)


def first_at_each_position(points: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return, for each of (n, 3) points, the index of the first point with equal coordinates."""
    # Adding 0.0 turns -0.0 into 0.0, so that equal coordinates have equal bits.
    bits = (np.ascontiguousarray(points, dtype=np.float64) + 0.0).view(np.int64)
    first, which = first_of_equal(bits)
    return first[which]


def first_of_equal(
    rows: npt.NDArray[np.integer],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the first of each set of equal rows, ascending, and the set of each row."""
    flat = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1])))
    _, first, which = np.unique(flat[:, 0], return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[which.reshape(-1)]


def require_plausible_count(count: int, what: str) -> None:
    """Raise `MeshFileError` if a file announces a negative count, or more than `MAX_FACES`."""
    if count < 0:
        raise MeshFileError(f"it is damaged: it announces {count} {what}")
    if count > MAX_FACES:
        raise MeshFileError(
            f"it holds {count} {what}, at most {MAX_FACES} can be read", "decimate the mesh"
        )


def read_rest(file: BinaryIO) -> bytes:
    """Read the rest of an open file, or raise `MeshFileError` above `MAX_FILE_BYTES`."""
    start = file.tell()
    size = file.seek(0, os.SEEK_END) - start
    if size > MAX_FILE_BYTES:
        raise MeshFileError(
            f"it is larger than {MAX_FILE_BYTES >> 20} MiB",
            "export it with smaller textures or none, decimate the mesh, or split the file",
        )
    file.seek(start)
    return file.read(size)


_ROUNDING = 1e-6
"""Largest area, relative to its polygon's, of an inverted fan triangle that is rounding error."""

_LEAST_AREA = 1e-12
"""Least area of a polygon relative to its squared length, as in `degenerate_faces`."""

_MOST_BEND = 0.5
"""Largest distance of a polygon from its plane, relative to the square root of its area."""


class Triangulation(NamedTuple):
    """The result of triangulating polygons.

    Attributes
    ----------
    faces : (F, 3) int64 array, in the order of the polygons
    cut_of : (F,) int64 array, ascending index of each face's polygon
    notes : a sentence for each kind of polygon
    """

    faces: Int64Array
    cut_of: Int64Array
    notes: tuple[str, ...]


def triangulate(polygons: Polygons, topology: Topology | None = None) -> Triangulation:
    """Cut each polygon of n corners into n - 2 triangles.

    They are the fan around its first corner if that covers exactly the polygon, as for every convex
    one; else its ears are clipped in the plane of its normal (Newell's). If neither covers the
    polygon, because it crosses itself or has no area, the fan is used, with a note.

    Parameters
    ----------
    polygons : the content of a file
    topology : topology of the file's set. If it comes from the same polygons, they are cut in the
        same way, so that all poses of a set have the same triangles.

    Raises
    ------
    MeshFileError : a polygon has fewer than three corners.

    Notes
    -----
    Triangles that use a vertex twice, as in files of CAD and decimated scans, are left out.
    """
    sizes, corners, notes = _without_repeats(polygons.sizes, polygons.corners)
    too_small = np.flatnonzero(sizes < 3)
    if len(too_small):
        face = int(too_small[0])
        raise MeshFileError(
            f"has {sizes[face]} corners, three are needed", where=f"face {face} (from 0)"
        )
    if n_quads := int((sizes == 4).sum()):
        notes.append(
            say_number(n_quads, "{n} quad was triangulated", "{n} quads were triangulated")
        )
    if n_larger := int((sizes > 4).sum()):
        notes.append(
            say_number(
                n_larger,
                "{n} polygon of more than four corners was triangulated",
                "{n} polygons of more than four corners were triangulated",
            )
        )
    polygon_of = np.repeat(np.arange(len(sizes)), sizes - 2)
    first = (np.cumsum(sizes) - sizes)[polygon_of]
    # Each earlier polygon has two more corners than triangles.
    second = np.arange(len(first)) + 2 * polygon_of + 1
    fans = np.stack([first, second, second + 1], axis=1)
    cut_of = polygon_of if polygons.cut_of is None else polygons.cut_of
    is_flat = name_twice(corners[fans]) & (sizes[polygon_of] == 3)
    if is_flat.any():
        notes.append(_left_out(cut_of[is_flat]))
        fans, cut_of, polygon_of = fans[~is_flat], cut_of[~is_flat], polygon_of[~is_flat]
    if (
        topology is not None
        and topology.n_vertices == len(polygons.vertices)
        and are_of_same_polygons(corners[fans], topology.faces, cut_of)
    ):
        return Triangulation(topology.faces.astype(np.int64), cut_of, tuple(notes))
    rows = np.flatnonzero(sizes[polygon_of] > 3)
    if len(rows) and len(polygons.vertices):
        # Indices out of range and coordinates that are not finite are refused later.
        points = polygons.vertices.take(corners, axis=0, mode="clip")
        with np.errstate(all="ignore"):
            fans[rows], doubtful = _cut_by_shape(points, corners, fans[rows], polygon_of[rows])
        notes += _doubts(doubtful)
    faces = corners[fans]
    is_flat = name_twice(faces)
    if is_flat.any():
        notes.append(_left_out(cut_of[is_flat]))
    return Triangulation(faces[~is_flat], cut_of[~is_flat], tuple(notes))


def _left_out(polygon: Int64Array) -> str:
    """Describe the triangles with two equal corners that are left out, by their polygons."""
    if len(polygon) == 1:
        return f"face {polygon[0]} (from 0), which has two equal corners, was left out"
    return (
        f"{len(polygon)} triangles with two equal corners were left out, the first of face "
        f"{polygon[0]} (from 0)"
    )


def are_of_same_polygons(
    faces: npt.NDArray[np.integer], others: npt.NDArray[np.integer], cut_of: Int64Array
) -> bool:
    """Whether two triangulations are of the same polygons.

    They are if the triangles of each polygon have the same boundary, that is, if the directed edges
    of both cancel. Polygons that are triangles must be equal.

    Parameters
    ----------
    faces, others : (F, 3) arrays, in the order of the polygons
    cut_of : (F,) array, the polygon of each face
    """
    if faces.shape != others.shape:
        return False
    rows = np.flatnonzero((faces != others).any(axis=1))
    if not len(rows):
        return True
    if np.bincount(cut_of)[cut_of[rows]].min() == 1:
        return False
    start = np.concatenate([faces[rows], others[rows]])
    end = np.roll(start, -1, axis=1)
    sign = np.where(start < end, 1, -1)
    sign[len(rows) :] *= -1
    low, high = np.minimum(start, end).ravel(), np.maximum(start, end).ravel()
    polygon = np.repeat(np.tile(cut_of[rows], 2), 3)
    order = np.lexsort((high, low, polygon))
    edges = np.stack([polygon, low, high])[:, order]
    is_first = np.append(True, (edges[:, 1:] != edges[:, :-1]).any(axis=0))
    return not np.add.reduceat(sign.ravel()[order], np.flatnonzero(is_first)).any()


def _without_repeats(
    sizes: Int64Array, corners: Int64Array
) -> tuple[Int64Array, Int64Array, list[str]]:
    """Leave out corners with the same vertex as the next one, if three corners remain."""
    ends = np.cumsum(sizes)
    filled = np.flatnonzero(sizes > 0)
    after = np.arange(1, len(corners) + 1)
    after[ends[filled] - 1] = (ends - sizes)[filled]
    polygon_of = np.repeat(np.arange(len(sizes)), sizes)
    is_repeated = corners == corners[after]
    kept_sizes = sizes - np.bincount(polygon_of[is_repeated], minlength=len(sizes))
    is_repeated &= (kept_sizes >= 3)[polygon_of]
    if not (count := int(is_repeated.sum())):
        return sizes, corners, []
    were = "corner that the next one repeats was" if count == 1 else "repeated corners were"
    kept_sizes = np.where(kept_sizes >= 3, kept_sizes, sizes)
    return kept_sizes, corners[~is_repeated], [f"{count} {were} left out"]


def _cut_by_shape(
    points: FloatArray, corners: Int64Array, fans: Int64Array, polygon_of: Int64Array
) -> tuple[Int64Array, Int64Array]:
    """Clip the ears of polygons that their fans do not cover.

    Parameters
    ----------
    points : (C, 3) array, positions of the corners of all polygons
    corners : (C,) array, their vertices
    fans : (F, 3) array of corner indices, the fans of P polygons
    polygon_of : (F,) array, ascending

    Returns
    -------
    triangles : (F, 3) array of corner indices
    doubtful : indices of polygons that have no area, are far from flat or cross themselves
    """
    # Scale to about 1, so that squares neither overflow nor vanish; a power of two is exact.
    points = np.ldexp(points, -int(np.frexp(np.abs(points).max())[1]))
    origin, *ends = points[fans.T]
    sides = np.stack(ends) - origin
    areas = np.cross(*sides)
    starts = np.flatnonzero(np.diff(polygon_of, prepend=-1))
    which = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(fans)))
    normals = np.add.reduceat(areas, starts)
    area = np.linalg.norm(normals, axis=1)
    normals /= area[:, None]
    squares = np.einsum("sfi,sfi->sf", sides, sides).max(axis=0)
    size = np.sqrt(np.maximum.reduceat(squares, starts))
    heights = np.abs(np.einsum("sfi,fi->sf", sides, normals[which])).max(axis=0)
    is_covering = np.einsum("fi,fi->f", areas, normals[which]) >= -_ROUNDING * area[which]
    is_covering &= ~name_twice(corners[fans])
    has_area = area > _LEAST_AREA * size**2
    is_doubtful = ~has_area
    is_doubtful |= np.maximum.reduceat(heights, starts) > _MOST_BEND * np.sqrt(area / 2.0)
    clipped = np.flatnonzero(has_area & ~np.logical_and.reduceat(is_covering, starts))
    is_clipped = np.isin(which, clipped)
    if len(clipped):
        n_corners = np.bincount(which)[clipped] + 2
        polygon_of_corner = np.repeat(np.arange(len(clipped)), n_corners)
        begin = np.cumsum(n_corners) - n_corners
        corner = (
            np.arange(len(polygon_of_corner))
            + (fans[starts[clipped], 0] - begin)[polygon_of_corner]
        )
        from_first = (points[corner] - points[corner[begin[polygon_of_corner]]]) / size[clipped][
            polygon_of_corner, None
        ]
        across = np.cross(normals[clipped], np.eye(3)[np.abs(normals[clipped]).argmin(axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        axes = np.stack([across, np.cross(normals[clipped], across)], axis=1)
        flat = np.einsum("cij,cj->ci", axes[polygon_of_corner], from_first)
        ears, is_cut = _clip_ears(flat, begin, n_corners)
        is_doubtful[clipped] |= ~is_cut
        is_clipped[is_clipped] = np.repeat(is_cut, n_corners - 2)
        fans = fans.copy()
        fans[is_clipped] = corner[ears[np.repeat(is_cut, n_corners - 2)]]
    return fans, polygon_of[starts[is_doubtful]]


def _doubts(polygons: Int64Array) -> list[str]:
    """Describe the polygons that programs triangulate differently."""
    if not len(polygons):
        return []
    first = f"face {polygons[0]} (from 0)"
    if len(polygons) == 1:
        what = f"1 polygon, {first}, crosses itself, has no area or is far from flat"
    else:
        what = (
            f"{len(polygons)} polygons, the first of which is {first}, cross themselves, have no "
            "area or are far from flat"
        )
    return [f"{what}: triangulate the mesh as you want it before you export it"]


@compiled_part
def _twice_area(points: FloatArray, a: int, b: int, c: int) -> float:
    x, y = points[a, 0], points[a, 1]
    return float((points[b, 0] - x) * (points[c, 1] - y) - (points[b, 1] - y) * (points[c, 0] - x))


@compiled_part
def _is_same(points: FloatArray, a: int, b: int) -> bool:
    return bool(points[a, 0] == points[b, 0] and points[a, 1] == points[b, 1])


@compiled_part
def _is_ear(
    points: FloatArray, before: Int64Array, after: Int64Array, corner: int, slack: float
) -> bool:
    """Whether a corner is convex and its triangle, enlarged by `slack`, contains no other corners.

    Only reflex corners are tested, as any triangle that is not empty contains one. Corners at the
    same position as one of the triangle's, as at the bridge to a hole, are ignored.
    """
    a, c = before[corner], after[corner]
    if _twice_area(points, a, corner, c) <= _LEAST_AREA:
        return False
    other = after[c]
    while other != a:
        if (
            _twice_area(points, a, corner, other) >= -slack
            and _twice_area(points, corner, c, other) >= -slack
            and _twice_area(points, c, a, other) >= -slack
            and _twice_area(points, before[other], other, after[other]) <= _LEAST_AREA
            and not _is_same(points, other, a)
            and not _is_same(points, other, corner)
            and not _is_same(points, other, c)
        ):
            return False
        other = after[other]
    return True


@compiled
def _clip_ears(
    points: FloatArray, starts: Int64Array, sizes: Int64Array
) -> tuple[Int64Array, npt.NDArray[np.bool_]]:
    """Clip the ears of counterclockwise polygons of size about 1.

    All triangles are counterclockwise too, or have no area, and their inner edges cancel. So the
    number of triangles that cover a point is the polygon's winding number, 0 outside.

    Parameters
    ----------
    points : (C, 2) array, the corners of one polygon after the other
    starts, sizes : (P,) arrays, first corner and number of corners of each polygon

    Returns
    -------
    triangles : (C - 2 P, 3) array of corner indices
    is_cut : (P,) array, False if a polygon crosses itself so that there are no such triangles
    """
    triangles = np.zeros((len(points) - 2 * len(starts), 3), np.int64)
    is_cut = np.ones(len(starts), np.bool_)
    before, after = np.arange(-1, len(points) - 1), np.arange(1, len(points) + 1)
    # Clipping an ear can only turn its neighbours into ears.
    is_known = np.zeros(len(points), np.bool_)
    for polygon in range(len(starts)):
        corner, n_left = starts[polygon], sizes[polygon]
        before[corner], after[corner + n_left - 1] = corner + n_left - 1, corner
        row = corner - 2 * polygon
        # First strict ears, then ears that other corners touch, then collinear or coincident ones.
        leniency, n_tried = 0, 0
        while n_left > 3 and leniency < 3:
            a, c = before[corner], after[corner]
            if leniency == 0 and is_known[corner]:
                is_ear = False
            elif leniency < 2:
                is_ear = _is_ear(points, before, after, corner, (1 - 2 * leniency) * _LEAST_AREA)
            else:
                is_ear = abs(_twice_area(points, a, corner, c)) <= _LEAST_AREA
            if is_ear:
                triangles[row] = (a, corner, c)
                after[a], before[c] = c, a
                is_known[a], is_known[c] = False, False
                row, n_left = row + 1, n_left - 1
                leniency, n_tried = 0, 0
                # Skip the neighbour, to avoid a fan of slivers.
                corner = after[c]
                continue
            is_known[corner] = True
            corner, n_tried = c, n_tried + 1
            if n_tried == n_left:
                leniency, n_tried = leniency + 1, 0
        a, c = before[corner], after[corner]
        triangles[row] = (a, corner, c)
        is_cut[polygon] = n_left == 3 and _twice_area(points, a, corner, c) >= -_LEAST_AREA
    return triangles, is_cut
