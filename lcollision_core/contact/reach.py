"""Find vertices and faces near each other along the surface, and faces near touching pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.contact.arrays import IntArray, Lists
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes.topology import FloatArray, Topology

LongArray = npt.NDArray[np.int64]

_LISTS_AT_ONCE = 512
"""Lists that a thread makes at a time: few enough that each may hold all entries."""


class Surface(NamedTuple):
    """A mesh as its faces' corners, the faces at its vertices and the lengths of its edges.

    Attributes
    ----------
    corners : (F, 3) int32
    face_start : (V + 1,) int64, the faces of vertex v are ``face[face_start[v]:face_start[v + 1]]``
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


class Creases(NamedTuple):
    """Distances at rest up to which the skin at two vertices may fold onto itself.

    The limit is the lesser of the two vertices' lengths, or the length of a joint between them if
    that is larger: at a wrist, a thumb's base meets the forearm. A joint lies between two vertices
    if its distance from their midpoint is at most √½ of their distance.

    Attributes
    ----------
    places : (V, 3) float64, the vertices at rest
    length : (V,) float64
    joints : (J, 3) float64, positions of the joints
    joint_length : (J,) float64, the length at each
    """

    places: FloatArray
    length: FloatArray
    joints: FloatArray
    joint_length: FloatArray


def no_lists() -> Lists:
    """Return lists of no item, which exclude nothing."""
    return Lists(np.zeros(1, dtype=np.int64), np.empty(0, dtype=np.int32))


def lists_of(members: Sequence[npt.NDArray[np.integer]], n: int) -> Lists:
    """List for each of n items the numbers of the sets that contain it."""
    which = np.repeat(np.arange(len(members)), [len(some) for some in members])
    return _table(np.concatenate([np.empty(0, np.int64), *members]), which, n, len(members))


def surface_of(topology: Topology, reference: FloatArray) -> Surface:
    """Return a mesh in the form that the loops take, with edge lengths from (V, 3) vertices."""
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
) -> Lists:
    """List for each of n faces those that an edge path of at most `distance` leads to.

    Parameters
    ----------
    faces : (n,) int32; the list of a face includes the face itself
    require : called with the number of entries so far; may raise
    """
    vertices, corners = np.unique(surface.corners[faces], return_inverse=True)
    near = _reached(surface, vertices.astype(np.int32), distance, require)
    n_faces, n_vertices = len(surface.corners), len(surface.face_start) - 1
    of_corners = Lists(3 * np.arange(len(faces) + 1), corners.ravel().astype(np.int32))
    at_corners = matrix_of(of_corners, len(vertices))
    at_vertices = matrix_of(Lists(surface.face_start, surface.face), n_faces)
    near_corners = matrix_of(near, n_vertices)

    def search(first: int, last: int) -> tuple[LongArray, IntArray]:
        product = at_corners[first:last] @ near_corners @ at_vertices
        return np.diff(product.indptr), product.indices

    return _listed(search, len(faces), require)


def vertices_after(
    surface: Surface,
    distance: float,
    require: Callable[[int], None],
    creases: Creases | None = None,
) -> Lists:
    """List for each vertex the later ones that an edge path of at most `distance` leads to.

    Two faces are near each other if a corner of one and a corner of the other are, so lists of
    vertices hold the same information as lists of faces in a quarter of the entries.

    Parameters
    ----------
    require : see `faces_within`
    creases : limits of their distance in space; None for no limit
    """
    every = np.arange(len(surface.edge_start) - 1, dtype=np.int32)
    return _reached(surface, every, distance, require, later=True, creases=creases)


def with_pairs(lists: Lists, pairs: npt.NDArray[np.integer]) -> Lists:
    """Return lists with the second of each of (n, 2) pairs in the list of the first."""
    n = len(lists.start) - 1
    owner = np.repeat(np.arange(n), np.diff(lists.start))
    rows, entries = np.concatenate([owner, pairs[:, 0]]), np.concatenate([lists.entry, pairs[:, 1]])
    return _table(rows, entries, n, n)


def faces_near_touching(
    surface: Surface,
    pairs: npt.NDArray[np.integer],
    distance: float,
    require: Callable[[int], None],
) -> Lists:
    """List for each of F faces the later ones near a face that touches a face near it.

    Parameters
    ----------
    pairs : (n, 2) indices of faces that touch
    distance : 0 for the faces alone
    require : see `faces_within`
    """
    n_faces = len(surface.corners)
    faces, places = np.unique(pairs, return_inverse=True)
    a, b = places.reshape(-1, 2).T
    partners = _table(np.concatenate([a, b]), np.concatenate([b, a]), len(faces), len(faces))
    if distance > 0.0:
        around = faces_within(surface, faces.astype(np.int32), distance, require)
    else:
        around = Lists(np.arange(len(faces) + 1), faces.astype(np.int32))
    owner = np.repeat(np.arange(len(faces)), np.diff(around.start))
    near_to = _table(around.entry, owner, n_faces, len(faces))

    def search(first: int, last: int) -> tuple[LongArray, IntArray]:
        counts = np.empty(last - first, dtype=np.int64)
        seen_for, listed_for = (np.full(n, -1, dtype=np.int32) for n in (len(faces), n_faces))
        entries = _search_touching(near_to, partners, around, first, seen_for, listed_for, counts)
        return counts, entries.copy()

    return _listed(search, n_faces, require)


def _reached(
    surface: Surface,
    vertices: IntArray,
    distance: float,
    require: Callable[[int], None],
    *,
    later: bool = False,
    creases: Creases | None = None,
) -> Lists:
    """List for each of n vertices those within a distance, or the later ones among them."""
    nowhere = np.zeros((0, 3))
    # As a body's reference is, or the search would be compiled once more.
    nowhere.flags.writeable = False
    bounds = creases or Creases(nowhere, np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    n_vertices = len(surface.edge_start) - 1

    def search(first: int, last: int) -> tuple[LongArray, IntArray]:
        work = _Workspace(
            np.full(n_vertices, np.inf),
            np.empty(n_vertices, dtype=np.int32),
            np.empty(n_vertices, dtype=np.int32),
            np.zeros(n_vertices, dtype=np.bool_),
        )
        counts = np.empty(last - first, dtype=np.int64)
        entries = _search(surface, vertices[first:last], distance, later, bounds, work, counts)
        return counts, entries.copy()

    return _listed(search, len(vertices), require)


def _listed(
    search: Callable[[int, int], tuple[LongArray, IntArray]],
    n_lists: int,
    require: Callable[[int], None],
) -> Lists:
    """Join the lengths and unsorted entries of the lists that a search makes block by block."""
    parts: dict[int, tuple[LongArray, IntArray]] = {}

    def work(first: int, last: int) -> None:
        parts[first] = search(first, last)
        require(sum(len(entries) for _, entries in list(parts.values())))

    for_blocks(work, n_lists, _LISTS_AT_ONCE)
    if not parts:
        return no_lists()
    counts, entries = zip(*(parts[first] for first in sorted(parts)), strict=True)
    start, entry = _starts(np.concatenate(counts)), np.concatenate(entries)
    # Numba takes two seconds to compile a sort; transposing twice takes half the time of SciPy's.
    table = matrix_of(Lists(start, entry), int(entry.max(initial=0)) + 1).tocsc().tocsr()
    return Lists(start, table.indices.astype(np.int32, copy=False))


def matrix_of(lists: Lists, n_columns: int) -> scipy.sparse.csr_matrix:
    """Return the bool matrix whose row i is true in the columns of list i."""
    ones = np.ones(len(lists.entry), dtype=np.bool_)
    return scipy.sparse.csr_matrix(
        (ones, lists.entry, lists.start), (len(lists.start) - 1, n_columns)
    )


def _starts(counts: npt.NDArray[np.integer]) -> LongArray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _table(
    rows: npt.NDArray[np.integer], columns: npt.NDArray[np.integer], n_rows: int, n_columns: int
) -> Lists:
    """Return the columns of each row, ascending, each once."""
    ones = np.ones(len(rows), dtype=np.bool_)
    table = scipy.sparse.csr_matrix((ones, (rows, columns)), shape=(n_rows, n_columns))
    table.sum_duplicates()
    return Lists(table.indptr.astype(np.int64), table.indices.astype(np.int32))


class _Workspace(NamedTuple):
    """Arrays of one thread, (V,) each, the first infinite and the last false between searches.

    NumPy allocates them, as Numba takes long to compile that.
    """

    away: FloatArray
    reached: IntArray
    waiting: IntArray
    is_waiting: npt.NDArray[np.bool_]


@compiled
def _search(
    surface: Surface,
    vertices: IntArray,
    distance: float,
    later: bool,
    creases: Creases,
    work: _Workspace,
    counts: LongArray,
) -> IntArray:
    """Fill in the lengths of the lists of some vertices and return their unsorted entries."""
    away, reached = work.away, work.reached
    # With a plain 0, the search would be compiled twice.
    n_entries = int(np.int64(0))
    entries = np.empty(1024, dtype=np.int32)
    for i in range(len(vertices)):
        vertex, n_before = vertices[i], n_entries
        n_reached = _reach(surface, vertex, distance, work)
        entries = _with_space(entries, n_entries, n_reached)
        for k in range(n_reached):
            other = reached[k]
            away[other] = np.inf
            if later and other <= vertex:
                continue
            if len(creases.length) == 0 or _may_fold(creases, vertex, other):
                entries[n_entries] = other
                n_entries += 1
        counts[i] = n_entries - n_before
    return entries[:n_entries]


@compiled
def _search_touching(
    near_to: Lists,
    partners: Lists,
    around: Lists,
    first: int,
    seen_for: IntArray,
    listed_for: IntArray,
    counts: LongArray,
) -> IntArray:
    """Fill in the lengths of the lists of faces from `first` on; return their unsorted entries.

    Parameters
    ----------
    near_to : F lists of the T faces that touch others near each face, as indices into the T
    partners : T lists of the faces that each one touches, as indices into the T
    around : T lists of the faces near each one
    seen_for, listed_for : (T,) and (F,), -1 before
    """
    # As in `_search`.
    n_entries = int(np.int64(0))
    entries = np.empty(1024, dtype=np.int32)
    for face in range(first, first + len(counts)):
        n_before = n_entries
        for i in range(near_to.start[face], near_to.start[face + 1]):
            near = near_to.entry[i]
            for j in range(partners.start[near], partners.start[near + 1]):
                partner = partners.entry[j]
                if seen_for[partner] == face:
                    continue
                seen_for[partner] = face
                begin, end = around.start[partner], around.start[partner + 1]
                entries = _with_space(entries, n_entries, end - begin)
                for k in range(begin, end):
                    other = around.entry[k]
                    if listed_for[other] != face and other > face:
                        listed_for[other] = face
                        entries[n_entries] = other
                        n_entries += 1
        counts[face - first] = n_entries - n_before
    return entries[:n_entries]


@compiled_part
def _with_space(entries: IntArray, n_entries: int, n_more: int) -> IntArray:
    """Return the array, or a larger copy if it has no space for so many more entries."""
    if n_entries + n_more <= len(entries):
        return entries
    larger = np.empty(2 * (n_entries + n_more), dtype=np.int32)
    # By element: for slices Numba compiles the message of a shape mismatch.
    for k in range(n_entries):
        larger[k] = entries[k]
    return larger


@compiled_part
def _may_fold(creases: Creases, a: int, b: int) -> bool:
    """Whether two vertices are near enough at rest for skin to fold there."""
    places, joints = creases.places, creases.joints
    apart = 0.0
    for c in range(3):
        apart += (places[a, c] - places[b, c]) ** 2
    if apart <= min(creases.length[a], creases.length[b]) ** 2:
        return True
    for joint in range(len(joints)):
        if apart <= creases.joint_length[joint] ** 2:
            away = 0.0
            for c in range(3):
                away += (0.5 * (places[a, c] + places[b, c]) - joints[joint, c]) ** 2
            if away <= 0.5 * apart:
                return True
    return False


@compiled_part
def _reach(surface: Surface, start: int, distance: float, work: _Workspace) -> int:
    """List the vertices within a distance of one in `work.reached`; return their number.

    Find shortest paths with a first-in, first-out queue: on a surface few vertices are improved
    more than once, so a heap does not pay. Afterwards `work.away` holds their distances.
    """
    away, reached, waiting, is_waiting = work
    last, head, tail, n_waiting, n_reached = len(waiting) - 1, 0, 0, 1, 1
    away[start] = 0.0
    reached[0] = waiting[0] = start
    while n_waiting > 0:
        vertex = waiting[head]
        head = head + 1 if head < last else 0
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
                tail = tail + 1 if tail < last else 0
                waiting[tail] = other
                is_waiting[other] = True
                n_waiting += 1
    return n_reached
