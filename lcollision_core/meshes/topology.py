"""The connectivity that all poses of a set share."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import PoseSetError, ShapeError

IntArray = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]

_LEAST_LENGTH = 1e-12
"""Least length of an edge in a length graph."""


def latent_array(values: npt.ArrayLike) -> npt.NDArray[Any]:
    """Convert latent poses given by the caller to an array.

    Raises
    ------
    ShapeError : it cannot be converted, such as a torch tensor on a GPU or with a gradient.
    """
    try:
        return np.asarray(values)
    except (RuntimeError, TypeError, ValueError) as error:
        raise ShapeError(
            "is not an array of numbers",
            "pass a NumPy array, of a torch tensor `tensor.detach().cpu().numpy()`; gradients pass "
            "through `LearnedBody.torch_module()`",
            where="latent",
            got=type(values).__name__,
        ) from error


def consecutive(sizes: Iterable[int]) -> list[slice]:
    """Return slices of the given sizes, each from the end of the one before."""
    return [slice(start, end) for start, end in pairwise(accumulate(sizes, initial=0))]


def evenly_spaced(count: int, most: int) -> npt.NDArray[np.int64]:
    """Return at most `most` of the indices below `count`, ascending, including first and last.

    Parameters
    ----------
    count : > 0
    most : > 0; 1 returns the first
    """
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))


def edge_graph(edges: IntArray, n_vertices: int, weights: FloatArray) -> scipy.sparse.csr_matrix:
    """Return the symmetric (V, V) matrix of (E,) weights of (E, 2) edges, in sorted CSR form."""
    i, j = edges.T
    matrix = scipy.sparse.coo_matrix(
        (np.tile(weights, 2), (np.concatenate([i, j]), np.concatenate([j, i]))),
        shape=(n_vertices, n_vertices),
    ).tocsr()
    matrix.sort_indices()
    return matrix


def length_graph(edges: IntArray, vertices: FloatArray) -> scipy.sparse.csr_matrix:
    """Return the symmetric (V, V) matrix of the lengths of (E, 2) edges between (V, 3) vertices."""
    # csgraph treats a stored 0 as no edge.
    lengths = np.maximum(_lengths(edges, vertices), _LEAST_LENGTH)
    return edge_graph(edges, len(vertices), lengths)


def name_twice(faces: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Return the mask of (F, 3) faces that use a vertex twice, and so never have area."""
    named_twice: npt.NDArray[np.bool_] = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return named_twice


def sorted_faces(faces: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Rotate each face so that its smallest vertex index comes first, then sort the faces."""
    turned = (np.arange(3) + faces.argmin(axis=1)[:, None]) % 3
    rows = np.take_along_axis(faces, turned, axis=1)
    return rows[np.lexsort(rows.T)]


def meeting_corners(
    faces: npt.NDArray[np.integer],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the corners of two faces at the ends of each edge that they share.

    Returns
    -------
    first, second : (2, n) corners 3 f + c of (F, 3) faces, at the lower and the higher vertex
    """
    corners = np.arange(faces.size).reshape(faces.shape)
    begin, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    at = np.stack([corners.ravel(), np.roll(corners, -1, axis=1).ravel()])
    at = np.where(begin > end, at[::-1], at)
    order = np.lexsort((high, low))
    one, other = order[:-1], order[1:]
    meet = (low[one] == low[other]) & (high[one] == high[other])
    return at[:, one[meet]], at[:, other[meet]]


def _lengths(edges: IntArray, vertices: FloatArray) -> FloatArray:
    # Column by column: three times faster than the norm of each row.
    way = np.take(vertices, edges[:, 1], axis=0)
    way -= np.take(vertices, edges[:, 0], axis=0)
    way *= way
    lengths: FloatArray = way[:, 0] + way[:, 1]
    lengths += way[:, 2]
    return np.sqrt(lengths, out=lengths)


class Topology:
    """Immutable connectivity of a triangle mesh, with derived properties.

    Parameters
    ----------
    faces : (F, 3) integer array of vertex indices, three different ones per face
    n_vertices : V, at least the largest index plus one

    Raises
    ------
    ShapeError : `faces` is not an (F, 3) integer array or is empty.
    PoseSetError : an index is out of range, or a face names a vertex twice.
    """

    def __init__(self, faces: npt.ArrayLike, n_vertices: int) -> None:
        checked = np.asarray(faces)
        if checked.ndim != 2 or checked.shape[1] != 3 or checked.dtype.kind not in "iu":
            raise ShapeError.must_be(
                "faces", "an (F, 3) integer array", f"{checked.dtype} {checked.shape}"
            )
        if len(checked) == 0:
            raise ShapeError("the mesh has no faces")
        out_of_range = np.flatnonzero(((checked < 0) | (checked >= n_vertices)).any(axis=1))
        if len(out_of_range):
            face = int(out_of_range[0])
            raise PoseSetError(
                f"names vertices {checked[face].tolist()}",
                where=f"face {face}",
                expected=f"0 to {n_vertices - 1}",
            )
        repeated = np.flatnonzero(name_twice(checked))
        if len(repeated):
            face = int(repeated[0])
            raise PoseSetError(
                f"names a vertex twice: {checked[face].tolist()}", where=f"face {face}"
            )
        self.faces: IntArray = np.array(checked, dtype=np.int32, order="C")
        self.faces.flags.writeable = False
        self.n_vertices = int(n_vertices)

    @property
    def n_faces(self) -> int:
        """F, the number of triangles."""
        return len(self.faces)

    def __eq__(self, other: object) -> bool:
        """Whether both have the same vertex count and the same faces in the same order."""
        if not isinstance(other, Topology):
            return NotImplemented
        return self.n_vertices == other.n_vertices and np.array_equal(self.faces, other.faces)

    def __hash__(self) -> int:
        return hash((self.n_vertices, self.faces.tobytes()))

    @cached_property
    def _edge_ends(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Lower and higher vertex of half-edge 3 f + c, from corner c of face f to the next."""
        after = np.roll(self.faces, -1, axis=1)
        low, high = np.minimum(self.faces, after), np.maximum(self.faces, after)
        return low.ravel().astype(np.int64), high.ravel().astype(np.int64)

    @cached_property
    def _edges_and_counts(self) -> tuple[IntArray, IntArray, bool]:
        low, high = self._edge_ends
        keys, which, counts = np.unique(
            low * self.n_vertices + high, return_inverse=True, return_counts=True
        )
        edges = np.stack(np.divmod(keys, self.n_vertices), axis=1).astype(np.int32)
        edges.flags.writeable = False
        n_forward = np.bincount(which, self.faces.ravel() == low)
        return edges, counts, bool((counts == 2).all() and (n_forward == 1).all())

    @property
    def edges(self) -> IntArray:
        """(E, 2) undirected edges, each row ascending, rows in lexicographic order."""
        return self._edges_and_counts[0]

    @property
    def boundary_edges(self) -> IntArray:
        """(B, 2) edges with one face: the rims of holes."""
        rims: IntArray = self.edges[self._edges_and_counts[1] == 1]
        return rims

    @property
    def non_manifold_edges(self) -> IntArray:
        """(M, 2) edges with more than two faces."""
        return self.edges[self._edges_and_counts[1] > 2]

    @cached_property
    def pinched_vertices(self) -> IntArray:
        """Indices of the vertices whose faces form several fans that share only the vertex."""
        # Corners of neighbouring faces at the same end of their common edge are in one fan.
        first, second = meeting_corners(self.faces)
        links = np.ones(first.size), (first.ravel(), second.ravel())
        graph = scipy.sparse.coo_matrix(links, 2 * (self.faces.size,))
        n_fans, fan = scipy.sparse.csgraph.connected_components(graph, directed=False)
        vertex = np.empty(n_fans, dtype=np.int64)
        vertex[fan] = self.faces.ravel()
        return np.flatnonzero(np.bincount(vertex) > 1).astype(np.int32)

    @property
    def is_watertight(self) -> bool:
        """Whether every edge has two faces that traverse it in opposite directions."""
        return self._edges_and_counts[2]

    @cached_property
    def adjacency(self) -> scipy.sparse.csr_matrix:
        """(V, V) symmetric 0/1 matrix, CSR with sorted indices: the one-rings."""
        return edge_graph(self.edges, self.n_vertices, np.ones(len(self.edges)))

    @cached_property
    def vertex_components(self) -> tuple[int, IntArray]:
        """Number of connected components, and the (V,) component of each vertex.

        A vertex in no face is a component of its own.
        """
        count, labels = scipy.sparse.csgraph.connected_components(self.adjacency, directed=False)
        return int(count), np.asarray(labels, dtype=np.int32)

    @cached_property
    def used_vertices(self) -> IntArray:
        """Indices of the vertices that some face uses."""
        is_used = np.zeros(self.n_vertices, dtype=np.bool_)
        is_used[self.faces] = True
        return np.flatnonzero(is_used).astype(np.int32)

    @cached_property
    def unused_vertices(self) -> IntArray:
        """Indices of the vertices that no face uses."""
        everyone = np.arange(self.n_vertices, dtype=np.int32)
        return np.setdiff1d(everyone, self.used_vertices, assume_unique=True)

    @cached_property
    def used_index(self) -> slice | IntArray:
        """Index of the used vertices in an array of all: a slice if all are used."""
        return self.used_vertices if len(self.unused_vertices) else slice(None)

    def gathered(self, vertices: FloatArray) -> FloatArray:
        """Move the unused vertices, which may lie anywhere, to the mean of the others.

        Parameters
        ----------
        vertices : (..., V, 3) float64 array

        Returns
        -------
        gathered : the same array if all vertices are used, else a copy
        """
        if not len(self.unused_vertices):
            return vertices
        gathered = vertices.copy()
        middle = vertices[..., self.used_vertices, :].mean(axis=-2, keepdims=True)
        gathered[..., self.unused_vertices, :] = middle
        return gathered

    def edge_lengths(self, vertices: npt.NDArray[Any]) -> FloatArray:
        """Return the (E,) lengths of `edges` in one pose, `vertices` (V, 3), in its unit."""
        return _lengths(self.edges, np.asarray(vertices, dtype=np.float64))

    def longest_sides(self, vertices: npt.NDArray[np.floating]) -> FloatArray:
        """Return the (F,) length of each face's longest side in one pose, `vertices` (V, 3)."""
        corners = vertices[self.faces]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        longest: FloatArray = sides.max(axis=1)
        return longest


def degenerate_faces(topology: Topology, vertices: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Return the faces without area.

    Parameters
    ----------
    topology : F faces
    vertices : (V, 3) array, one pose

    Returns
    -------
    (D,) indices of the faces whose height over their longest side is at most 1e-12 of that side,
    about the rounding error of float64, whatever the unit
    """
    corners = np.asarray(vertices, dtype=np.float64)[topology.faces.T]
    # Scale to about 1, so that squares neither overflow nor vanish; a power of two is exact.
    a, b, c = np.ldexp(corners, -int(np.frexp(np.abs(corners).max())[1]))
    sides = np.stack([b - a, c - a, c - b])
    twice_area = np.linalg.norm(np.cross(sides[0], sides[1]), axis=1)
    longest_squared = np.einsum("sfi,sfi->sf", sides, sides).max(axis=0)
    return np.flatnonzero(twice_area <= 1e-12 * longest_squared).astype(np.int32)
