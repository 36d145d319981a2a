"""Which faces lie near each other along the surface, and which lie near a pair that touches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from lcollision_core.compiled import compiled
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes.topology import FloatArray, Topology

IntArray = npt.NDArray[np.int32]
LongArray = npt.NDArray[np.int64]

_FACES_AT_ONCE = 512
"""Faces whose lists a thread makes at a time: few enough that each may list all others."""


class Surface(NamedTuple):
    """A mesh as its faces' corners, the faces at its vertices and the lengths of its edges.

    Attributes
    ----------
    corners : (F, 3) int32
    face_start : (V + 1,) int64, those of vertex v are ``face[face_start[v]:face_start[v + 1]]``
    face : (3 F,) int32
    edge_start : (V + 1,) int64, the edges of vertex v, likewise
    neighbour, length : (2 E,) int32 and float64, the other end of each edge, and its length
    """

    corners: IntArray
    face_start: LongArray
    face: IntArray
    edge_start: LongArray
    neighbour: IntArray
    length: FloatArray


class FaceLists(NamedTuple):
    """Lists of faces, each ascending; list i is ``face[start[i]:start[i + 1]]``.

    Attributes
    ----------
    start : (n + 1,) int64
    face : (m,) int32
    """

    start: LongArray
    face: IntArray


NO_LISTS = FaceLists(np.zeros(1, dtype=np.int64), np.empty(0, dtype=np.int32))


class TouchingFaces(NamedTuple):
    """Faces that touch others, T of them, and what lies near them.

    Attributes
    ----------
    partners : T lists of those that each one touches, by their place among the T
    around : T lists of the faces near each one
    near_to : F lists of those of the T that each face is near to, or none
    """

    partners: FaceLists
    around: FaceLists
    near_to: FaceLists


NOTHING_TOUCHES = TouchingFaces(NO_LISTS, NO_LISTS, NO_LISTS)


def surface_of(topology: Topology, reference: FloatArray) -> Surface:
    """Return a mesh as the loops take it, with the lengths of (V, 3) vertices."""
    n_vertices, corners = topology.n_vertices, topology.faces
    starts, ends = topology.edges.T
    tails = np.concatenate([starts, ends])
    order = np.argsort(tails, kind="stable")
    return Surface(
        corners,
        _starts(np.bincount(corners.ravel(), minlength=n_vertices)),
        (np.argsort(corners.ravel(), kind="stable") // 3).astype(np.int32),
        _starts(np.bincount(tails, minlength=n_vertices)),
        np.concatenate([ends, starts])[order].astype(np.int32),
        np.tile(topology.edge_lengths(reference), 2)[order],
    )


def faces_within(
    surface: Surface, faces: IntArray, distance: float, require: Callable[[int], None]
) -> FaceLists:
    """List the faces to which an edge path of at most `distance` leads from each of some faces.

    Parameters
    ----------
    faces : (n,) int32; a list has its own face too
    require : called with how many entries there are so far; may refuse more
    """
    found, _ = _listed(
        lambda first, last: _search(surface, faces, first, last, distance, NOTHING_TOUCHES, False),
        len(faces),
        require,
    )
    return found


def touching_faces(
    surface: Surface,
    pairs: npt.NDArray[np.integer],
    distance: float,
    require: Callable[[int], None],
) -> TouchingFaces:
    """Find what lies within a distance of pairs of faces that touch.

    Parameters
    ----------
    pairs : (n, 2) face indices
    distance : 0 for the faces alone
    require : see `faces_within`
    """
    faces, places = np.unique(pairs, return_inverse=True)
    a, b = places.reshape(-1, 2).T
    partners = _table(np.concatenate([a, b]), np.concatenate([b, a]), len(faces), len(faces))
    if distance > 0.0:
        around = faces_within(surface, faces.astype(np.int32), distance, require)
    else:
        around = FaceLists(np.arange(len(faces) + 1), faces.astype(np.int32))
    owner = np.repeat(np.arange(len(faces)), np.diff(around.start))
    near_to = _table(around.face, owner, len(surface.corners), len(faces))
    return TouchingFaces(partners, around, near_to)


def later_faces(
    surface: Surface, distance: float, touching: TouchingFaces, require: Callable[[int], None]
) -> tuple[FaceLists, npt.NDArray[np.bool_]]:
    """List for each face those after it that are near, or near what touches something near it.

    Parameters
    ----------
    distance : within which faces are near each other; below 0 for none
    touching : what touches, and what is near that
    require : see `faces_within`

    Returns
    -------
    lists : F lists
    by_touch : (m,) bool, which entries are there for touching alone
    """
    n_faces = len(surface.corners)
    if distance < 0.0 and len(touching.partners.face) == 0:
        return FaceLists(np.zeros(n_faces + 1, dtype=np.int64), NO_LISTS.face), np.empty(
            0, np.bool_
        )
    everyone = np.arange(n_faces, dtype=np.int32)
    return _listed(
        lambda first, last: _search(surface, everyone, first, last, distance, touching, True),
        n_faces,
        require,
    )


def _listed(
    search: Callable[[int, int], tuple[LongArray, IntArray, npt.NDArray[np.bool_]]],
    n_lists: int,
    require: Callable[[int], None],
) -> tuple[FaceLists, npt.NDArray[np.bool_]]:
    parts: dict[int, tuple[LongArray, IntArray, npt.NDArray[np.bool_]]] = {}

    def work(first: int, last: int) -> None:
        parts[first] = search(first, last)
        require(sum(len(face) for _, face, _ in list(parts.values())))

    for_blocks(work, n_lists, _FACES_AT_ONCE)
    if not parts:
        return NO_LISTS, np.empty(0, dtype=np.bool_)
    counts, faces, by_touch = zip(*(parts[first] for first in sorted(parts)), strict=True)
    start = _starts(np.concatenate(counts))
    return FaceLists(start, np.concatenate(faces)), np.concatenate(by_touch)


def _starts(counts: npt.NDArray[np.integer]) -> LongArray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _table(
    rows: npt.NDArray[np.integer], columns: npt.NDArray[np.integer], n_rows: int, n_columns: int
) -> FaceLists:
    """Return for each of the rows its columns, ascending, each once."""
    ones = np.ones(len(rows), dtype=np.bool_)
    table = sparse.csr_matrix((ones, (rows, columns)), shape=(n_rows, n_columns))
    table.sum_duplicates()
    return FaceLists(table.indptr.astype(np.int64), table.indices.astype(np.int32))


@compiled
def _search(
    surface: Surface,
    faces: IntArray,
    first: int,
    last: int,
    distance: float,
    touching: TouchingFaces,
    only_later: bool,
) -> tuple[LongArray, IntArray, npt.NDArray[np.bool_]]:
    """Make the lists of ``faces[first:last]``: their lengths, entries, and which are by touch."""
    n_faces, n_vertices = len(surface.corners), len(surface.face_start) - 1
    counts = np.zeros(last - first, dtype=np.int64)
    entries = np.empty(1024, dtype=np.int32)
    by_touch = np.empty(1024, dtype=np.bool_)
    n_entries = 0
    away = np.full(n_vertices, np.inf)
    reached = np.empty(n_vertices, dtype=np.int32)
    waiting = np.empty(n_vertices, dtype=np.int32)
    is_waiting = np.zeros(n_vertices, dtype=np.bool_)
    listed_for = np.full(n_faces, -1, dtype=np.int32)
    is_by_touch = np.empty(n_faces, dtype=np.bool_)
    seen_for = np.full(len(touching.partners.start), -1, dtype=np.int32)
    found = np.empty(n_faces, dtype=np.int32)
    for place in range(first, last):
        face = faces[place]
        n_found = 0
        if distance >= 0.0:
            n_reached = _reach(surface, face, distance, away, reached, waiting, is_waiting)
            for k in range(n_reached):
                vertex = reached[k]
                away[vertex] = np.inf
                for at in range(surface.face_start[vertex], surface.face_start[vertex + 1]):
                    other = surface.face[at]
                    if listed_for[other] != place and (other > face or not only_later):
                        listed_for[other] = place
                        is_by_touch[other] = False
                        found[n_found] = other
                        n_found += 1
        if face + 1 < len(touching.near_to.start):
            partners, around, near_to = touching.partners, touching.around, touching.near_to
            for i in range(near_to.start[face], near_to.start[face + 1]):
                near = near_to.face[i]
                for j in range(partners.start[near], partners.start[near + 1]):
                    partner = partners.face[j]
                    if seen_for[partner] == place:
                        continue
                    seen_for[partner] = place
                    for k in range(around.start[partner], around.start[partner + 1]):
                        other = around.face[k]
                        if listed_for[other] != place and other > face:
                            listed_for[other] = place
                            is_by_touch[other] = True
                            found[n_found] = other
                            n_found += 1
        if n_entries + n_found > len(entries):
            size = max(2 * len(entries), n_entries + n_found)
            larger, larger_by_touch = np.empty(size, np.int32), np.empty(size, np.bool_)
            larger[:n_entries] = entries[:n_entries]
            larger_by_touch[:n_entries] = by_touch[:n_entries]
            entries, by_touch = larger, larger_by_touch
        ascending = np.sort(found[:n_found])
        for k in range(n_found):
            entries[n_entries + k] = ascending[k]
            by_touch[n_entries + k] = is_by_touch[ascending[k]]
        n_entries += n_found
        counts[place - first] = n_found
    return counts, entries[:n_entries].copy(), by_touch[:n_entries].copy()


@compiled
def _reach(
    surface: Surface,
    face: int,
    distance: float,
    away: FloatArray,
    reached: IntArray,
    waiting: IntArray,
    is_waiting: npt.NDArray[np.bool_],
) -> int:
    """Fill `reached` with the vertices within a distance of a face's corners; return their number.

    The shortest paths of a first-in, first-out queue: on a surface few vertices are improved
    more than once, so that no heap pays. `away` is infinite before, and has distances after.
    """
    size, head, n_waiting, n_reached = len(waiting), 0, 0, 0
    for corner in range(3):
        vertex = surface.corners[face, corner]
        if away[vertex] > 0.0:
            away[vertex] = 0.0
            reached[n_reached] = vertex
            n_reached += 1
            waiting[(head + n_waiting) % size] = vertex
            is_waiting[vertex] = True
            n_waiting += 1
    while n_waiting > 0:
        vertex = waiting[head]
        head = (head + 1) % size
        n_waiting -= 1
        is_waiting[vertex] = False
        for edge in range(surface.edge_start[vertex], surface.edge_start[vertex + 1]):
            other, path = surface.neighbour[edge], away[vertex] + surface.length[edge]
            if path > distance or path >= away[other]:
                continue
            if away[other] == np.inf:
                reached[n_reached] = other
                n_reached += 1
            away[other] = path
            if not is_waiting[other]:
                waiting[(head + n_waiting) % size] = other
                is_waiting[other] = True
                n_waiting += 1
    return n_reached
