"""Search a mesh for colliding pairs of faces: the tree, and tables of its nodes to skip.

On a character most leaves whose boxes overlap hold only pairs of faces that share a vertex or that
the contact rules exclude: of the 19 912 pairs of leaves visited in a pose of a mannequin, 84 hold
other pairs. A search for pairs that count can skip the rest.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.contact.arrays import (
    ClearanceRule,
    Exclusions,
    FaceTree,
    IntArray,
    Lists,
    PairBuffer,
    PoseWorkspace,
    SkippableNodes,
)
from lcollision_core.contact.distance import drop_far, keep_too_near
from lcollision_core.contact.kernels import (
    LEAF_SIZE,
    MAX_DISTANCE,
    N_KINDS,
    PARALLEL_SINE_SQUARED,
    SMALL_SINE_SQUARED,
    add_vertex_energy,
    drop_excluded,
    drop_out_of_reach,
    judge,
    load_vertices,
    remember,
    search_pose,
    search_poses,
    test_pairs,
)
from lcollision_core.contact.reach import matrix_of
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import FloatArray, Topology

_APART = 1e3
"""Factor by which the centroids of components are moved apart, relative to those within them."""


def build_tree(vertices: FloatArray, faces: IntArray, component: IntArray) -> FaceTree:
    """Build the tree by median splits of the face centroids along their longest extent.

    Components are split from each other first, by their own centroids, as overlapping shells move
    apart.

    Parameters
    ----------
    vertices : (V, 3) float64 array, a typical pose (the reference)
    faces : (F, 3) int32 array
    component : (V,) int32 array, the connected component of each vertex

    Returns
    -------
    FaceTree, balanced: all leaves but the last are full.
    """
    n_leaves = -(-len(faces) // LEAF_SIZE)
    order = np.arange(len(faces), dtype=np.int32)
    left, right, leaf = (np.full(2 * n_leaves - 1, -1, dtype=np.int32) for _ in range(3))
    centroids, of_face = vertices[faces].mean(axis=1), component[faces[:, 0]]
    if of_face.max() > of_face.min():
        of_component = [np.bincount(of_face, centroids[:, c]) for c in range(3)]
        n_faces = np.maximum(np.bincount(of_face), 1)
        centroids = centroids + _APART * (np.stack(of_component) / n_faces).T[of_face]
    size, starts = np.full(len(left), len(faces), dtype=np.int32), np.zeros_like(left)
    keys = np.empty(len(faces))
    _split_faces(centroids, LEAF_SIZE, order, left, right, leaf, size, starts, keys)
    slot_face = np.full(n_leaves * LEAF_SIZE, -1, dtype=np.int32)
    slot_face[: len(faces)] = order
    corners = np.full((n_leaves * LEAF_SIZE, 3), -1, dtype=np.int32)
    corners[: len(faces)] = faces[order]
    by_leaf = corners.reshape(n_leaves, LEAF_SIZE, 3).transpose(0, 2, 1)
    ordered = np.sort(corners.reshape(n_leaves, 3 * LEAF_SIZE), axis=1)
    is_new = (ordered >= 0) & (np.diff(ordered, axis=1, prepend=-1) != 0)
    first = np.concatenate([[0], np.cumsum(is_new.sum(axis=1))]).astype(np.int32)
    by_slot = np.ascontiguousarray(by_leaf).reshape(-1)
    return FaceTree(slot_face, by_slot, left, right, leaf, size, first, ordered[is_new])


@compiled_part
def _select(keys: FloatArray, items: IntArray, start: int, stop: int, wanted: int) -> None:
    """Partition `keys` and `items` from `start` to `stop` at index `wanted`, the smaller first.

    Quickselect with random pivots and equal keys grouped, so that neither sorted nor equal keys
    are slow.
    """
    low, high, state = start, stop, 12345
    while high - low > 1:
        state = (state * 1103515245 + 12345) % 2147483648
        pivot = keys[low + state % (high - low)]
        less, k, more = low, low, high
        while k < more:
            key = keys[k]
            if key < pivot:
                keys[k], keys[less] = keys[less], key
                items[k], items[less] = items[less], items[k]
                less += 1
                k += 1
            elif key > pivot:
                more -= 1
                keys[k], keys[more] = keys[more], key
                items[k], items[more] = items[more], items[k]
            else:
                k += 1
        if wanted < less:
            high = less
        elif wanted >= more:
            low = more
        else:
            return


@compiled
def _split_faces(
    centroids: FloatArray,
    leaf_size: int,
    order: IntArray,
    left: IntArray,
    right: IntArray,
    leaf: IntArray,
    size: IntArray,
    starts: IntArray,
    keys: FloatArray,
) -> None:
    """Split faces at the medians of their longest extents, parents before children.

    Parameters
    ----------
    centroids : (F, 3) float64 array
    leaf_size : faces in a leaf; all but the last are full
    order : (F,) int32 array, 0 to F - 1, overwritten by the faces leaf by leaf
    left, right, leaf : (n,) int32 arrays of a `FaceTree` of n nodes, filled with -1, overwritten
    size : likewise, F for the root, which comes first
    starts : (n,) int32 array, 0 for the root: where the faces of each node begin in `order`
    keys : (F,) workspace. Numba would compile its allocation for as long as half of this loop.
    """
    for node in range(len(size)):
        start, stop = starts[node], starts[node] + size[node]
        if size[node] <= leaf_size:
            leaf[node] = start // leaf_size
            continue
        longest, axis = -1.0, 0
        for c in range(3):
            least = most = centroids[order[start], c]
            for k in range(start, stop):
                place = centroids[order[k], c]
                if place < least:
                    least = place
                if place > most:
                    most = place
            if most - least > longest:
                longest, axis = most - least, c
        for k in range(start, stop):
            keys[k] = centroids[order[k], axis]
        n_left = -(-size[node] // leaf_size) // 2
        middle = start + n_left * leaf_size
        _select(keys, order, start, stop, middle)
        # A subtree of n leaves has 2 n - 1 nodes.
        a, b = node + 1, node + 2 * n_left
        left[node], starts[a], size[a] = a, start, middle - start
        right[node], starts[b], size[b] = b, middle, stop - middle


def allocate_work(tree: FaceTree, n_vertices: int) -> PoseWorkspace:
    """Allocate the arrays that one thread needs to search poses with a tree."""
    n_slots = len(tree.slot_face)
    n_nodes = len(tree.left)
    # A pair of nodes is replaced by at most three, one level further down on one side or both.
    levels = int(np.ceil(np.log2(n_slots // LEAF_SIZE))) + 1
    return PoseWorkspace(
        middle=np.empty(3),
        vertices=np.empty((n_vertices, 3)),
        pair=np.empty((2, 3, 3)),
        boxes=np.empty(6 * n_slots, dtype=np.float32),
        has_boxes=np.empty(n_slots // LEAF_SIZE, dtype=np.bool_),
        node_boxes=np.empty((n_nodes, 6), dtype=np.float32),
        stack=np.empty((4 * levels + 4, 2), dtype=np.int32),
        fraction=np.empty(4 * levels + 4),
    )


MOST_BYTES = 1 << 27
"""Bound on the tables, which grow with the square of the faces: 110 MB for 200 000 faces."""

MOST_LISTED = 1 << 26
"""Bound on the pairs that the exclusions list, as making the tables lists them again."""

_LEAVES_AT_ONCE = 64

NO_TABLES = SkippableNodes(
    level=np.empty(0, dtype=np.int32),
    number=np.empty(0, dtype=np.int32),
    start=np.empty(0, dtype=np.int64),
    stride=np.empty(0, dtype=np.int64),
    bits=np.empty(0, dtype=np.uint8),
)


class UncountedTables:
    """The tables of one detector, made in a thread of their own on the first request.

    Parameters
    ----------
    tree, exclusions : of the detector
    """

    def __init__(self, tree: FaceTree, exclusions: Exclusions) -> None:
        self._tree, self._exclusions = tree, exclusions
        self._made = NO_TABLES
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def nodes(self, *, wait: bool = False) -> SkippableNodes:
        """Return the tables; `NO_TABLES` until they are made, or if they are not worthwhile.

        Parameters
        ----------
        wait : whether to wait until they are made
        """
        with self._lock:
            if self._thread is None and self._are_worthwhile():
                self._thread = threading.Thread(target=self._make, name="uncounted nodes")
                self._thread.start()
        if wait and self._thread is not None:
            self._thread.join()
        return self._made

    def _are_worthwhile(self) -> bool:
        exclusions, n_leaves = self._exclusions, len(self._tree.slot_face) // LEAF_SIZE
        n_listed = sum(
            len(lists.entry) for lists in (exclusions.near, exclusions.rest, exclusions.touching)
        )
        return (
            (n_listed + len(exclusions.joint.entry) > 0 or bool(exclusions.ignored.any()))
            and n_listed <= MOST_LISTED
            and n_leaves**2 // 6 <= MOST_BYTES
        )

    def _make(self) -> None:
        # The interpreter waits for this thread on exit.
        tables = make_uncounted(self._tree, self._exclusions, threading.main_thread().is_alive)
        if tables is not None:
            self._made = tables


def make_uncounted(
    tree: FaceTree, exclusions: Exclusions, keep_going: Callable[[], bool]
) -> SkippableNodes | None:
    """Make the tables of a tree.

    Parameters
    ----------
    tree, exclusions : of one topology
    keep_going : polled now and then; if it returns False, None is returned
    """
    depth = node_depths(tree)
    leaves = int(depth[tree.leaf < 0].max(initial=-1)) + 1
    level = np.where(tree.leaf < 0, depth, np.int32(leaves))
    inner = [np.flatnonzero(level == leaf).astype(np.int32) for leaf in range(leaves)]
    number = tree.leaf.copy()
    for nodes in inner:
        number[nodes] = np.arange(len(nodes))
    size = np.bincount(level)
    stride = -(-size // 8)
    start = np.cumsum(size * stride) - size * stride
    bits = np.zeros(size @ stride, dtype=np.uint8)
    tables = SkippableNodes(level, number, start, stride, bits)
    near, rest, touching = map(_both_ways, (exclusions.near, exclusions.rest, exclusions.touching))
    for first in range(0, int(size[leaves]), _LEAVES_AT_ONCE):
        if not keep_going():
            return None
        stop = min(first + _LEAVES_AT_ONCE, int(size[leaves]))
        _fill_leaves(tree, LEAF_SIZE, exclusions, near, rest, touching, first, stop, tables)
    for nodes in reversed(inner):
        _fill_inner(tree, nodes, tables)
    return tables


class _SymmetricLists(NamedTuple):
    """Lists of the later partners of each item, and of the earlier ones."""

    later: Lists
    earlier: Lists


def _both_ways(later: Lists) -> _SymmetricLists:
    before = matrix_of(later, len(later.start) - 1).T.tocsr()
    return _SymmetricLists(
        later, Lists(before.indptr.astype(np.int64), before.indices.astype(np.int32))
    )


def node_depths(tree: FaceTree) -> IntArray:
    """Return the (n,) int32 depth of each node of a tree, 0 for the root."""
    depth = np.zeros(len(tree.left), dtype=np.int32)
    _fill_depths(tree.left, tree.right, depth)
    return depth


@compiled
def _fill_depths(left: IntArray, right: IntArray, depth: IntArray) -> None:
    for node in range(len(left)):
        if left[node] >= 0:
            depth[left[node]] = depth[right[node]] = depth[node] + 1


@compiled_part
def _mark(lists: Lists, of: int, mask: npt.NDArray[np.uint8], bit: np.uint8) -> None:
    """Set a bit in the mask of every entry of one list; there may be no lists."""
    if len(lists.start) > 1:
        for k in range(lists.start[of], lists.start[of + 1]):
            mask[lists.entry[k]] |= bit


@compiled_part
def _mark_both_ways(
    lists: _SymmetricLists, of: int, mask: npt.NDArray[np.uint8], bit: np.uint8
) -> None:
    _mark(lists.later, of, mask, bit)
    _mark(lists.earlier, of, mask, bit)


@compiled
def _fill_leaves(
    tree: FaceTree,
    leaf_size: int,
    exclusions: Exclusions,
    near: _SymmetricLists,
    rest: _SymmetricLists,
    touching: _SymmetricLists,
    first: int,
    stop: int,
    made: SkippableNodes,
) -> None:
    """Fill in the table of the leaves, for pairs of leaves `first` to `stop` with later leaves.

    Bit i of a vertex, face, region or joint says that a face with it cannot count against face i of
    the current leaf.
    """
    corners, region = exclusions.corners, exclusions.region
    of_vertex = np.empty(corners.max() + 1, dtype=np.uint8)
    of_face = np.empty(len(corners), dtype=np.uint8)
    of_region = np.empty(len(exclusions.ignored), dtype=np.uint8)
    joint_start, joint = exclusions.joint
    of_joint = np.empty(joint.max() + 1 if len(joint) else 0, dtype=np.uint8)
    n_leaves, all_bits = len(tree.slot_face) // leaf_size, np.uint8(2**leaf_size - 1)
    level = made.level[len(tree.left) - 1]
    table, stride = made.start[level], made.stride[level]
    for a in range(first, stop):
        of_vertex[:] = 0
        of_face[:] = 0
        of_region[:] = 0
        of_joint[:] = 0
        of_all = np.uint8(0)
        for i in range(leaf_size):
            bit = np.uint8(1 << i)
            face = tree.slot_face[a * leaf_size + i]
            if face < 0:
                of_all |= bit
                continue
            for c in range(3):
                v = corners[face, c]
                of_vertex[v] |= bit
                _mark_both_ways(near, v, of_vertex, bit)
            _mark_both_ways(rest, face, of_face, bit)
            _mark_both_ways(touching, face, of_face, bit)
            _mark(exclusions.joint, face, of_joint, bit)
            if len(region) > 0:
                for r in range(len(of_region)):
                    if exclusions.ignored[region[face], r]:
                        of_region[r] |= bit
        for b in range(a, n_leaves):
            counts = False
            for i in range(leaf_size):
                face = tree.slot_face[b * leaf_size + i]
                if face < 0:
                    continue
                mask = of_all | of_face[face]
                for c in range(3):
                    mask |= of_vertex[corners[face, c]]
                if len(region) > 0:
                    mask |= of_region[region[face]]
                if len(joint) > 0:
                    for k in range(joint_start[face], joint_start[face + 1]):
                        mask |= of_joint[joint[k]]
                if mask != all_bits:
                    counts = True
                    break
            if not counts:
                made.bits[table + a * stride + (b >> 3)] |= np.uint8(1 << (b & 7))
                made.bits[table + b * stride + (a >> 3)] |= np.uint8(1 << (a & 7))


@compiled_part
def _has(made: SkippableNodes, a: int, b: int) -> bool:
    """Whether two nodes share a table whose bit of them is set."""
    level = made.level[a]
    if level != made.level[b]:
        return False
    column = made.number[b]
    row = made.start[level] + made.number[a] * made.stride[level]
    return bool((made.bits[row + (column >> 3)] >> (column & 7)) & 1)


@compiled_part
def _are_uncounted(tree: FaceTree, made: SkippableNodes, a: int, b: int) -> bool:
    """Whether no pair below two nodes of one depth counts, by the tables of the levels below.

    Depths of leaves differ by at most one, so an inner node at a leaf's depth has two leaves.
    """
    if tree.leaf[a] < 0 and tree.leaf[b] >= 0:
        a, b = b, a
    if tree.leaf[a] < 0 or tree.leaf[b] >= 0:
        return _has(made, a, b)
    return _has(made, a, tree.left[b]) and _has(made, a, tree.right[b])


@compiled
def _fill_inner(tree: FaceTree, nodes: IntArray, made: SkippableNodes) -> None:
    """Fill in the table of the inner nodes of one depth from those of their children.

    Most pairs count, so only those whose first leaves are in the leaves' table are looked at.
    """
    table, stride = made.start[made.level[nodes[0]]], made.stride[made.level[nodes[0]]]
    leaves = made.level[len(tree.left) - 1]
    first_leaf = np.empty(len(nodes), dtype=np.int32)
    begins = np.full(8 * made.stride[leaves], -1, dtype=np.int32)  # the node with this first leaf
    for i in range(len(nodes)):
        node = nodes[i]
        while tree.leaf[node] < 0:
            node = tree.left[node]
        first_leaf[i] = tree.leaf[node]
        begins[first_leaf[i]] = i
    for i in range(len(nodes)):
        a = nodes[i]
        row = made.start[leaves] + first_leaf[i] * made.stride[leaves]
        for byte in range(made.stride[leaves]):
            bits = made.bits[row + byte]
            for bit in range(8 if bits else 0):
                j = begins[8 * byte + bit]
                if j < i or not (bits >> bit) & 1:
                    continue
                b = nodes[j]
                if (
                    _are_uncounted(tree, made, tree.left[a], tree.left[b])
                    and _are_uncounted(tree, made, tree.left[a], tree.right[b])
                    and _are_uncounted(tree, made, tree.right[a], tree.left[b])
                    and _are_uncounted(tree, made, tree.right[a], tree.right[b])
                ):
                    made.bits[table + i * stride + (j >> 3)] |= np.uint8(1 << (j & 7))
                    made.bits[table + j * stride + (i >> 3)] |= np.uint8(1 << (i & 7))


def coincide(triangles: FloatArray, tolerance: float) -> npt.NDArray[np.bool_]:
    """Return which pairs of triangles are coplanar and overlap.

    Parameters
    ----------
    triangles : (P, 2, 3, 3) float64 array of corners
    tolerance : distance up to which points count as in the plane, or touching, in the same unit

    Returns
    -------
    coincide : (P,) bool; False where the first triangle has no area
    """
    first, second = triangles[:, 0], triangles[:, 1]
    origin = first[:, :1]
    normal, length = _across(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0])
    off_plane = np.abs(np.einsum("pc,pkc->pk", normal, second - origin)).max(axis=1)
    is_coincident: npt.NDArray[np.bool_] = (length > 0.0) & (off_plane <= tolerance * length)
    flat = triangles[is_coincident]
    # Directions in the plane across each edge: one of them separates disjoint triangles.
    edges = np.roll(flat, -1, axis=2) - flat
    across = np.cross(edges, normal[is_coincident, None, None]).reshape(len(flat), 6, 3)
    along = np.einsum("pdc,ptkc->pdtk", across, flat - origin[is_coincident, None])
    least, most = along.min(axis=3), along.max(axis=3)
    overlap = np.minimum(most[:, :, 0] - least[:, :, 1], most[:, :, 1] - least[:, :, 0])
    is_coincident[is_coincident] = (overlap > tolerance * np.linalg.norm(across, axis=2)).all(
        axis=1
    )
    return is_coincident


def _across(u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the (P, 3) directions across two edges and their lengths, 0 where they are parallel.

    As in the compiled search, the lean of short directions towards an edge, a rounding error, is
    removed.
    """
    direction = np.cross(u, v)
    u_squared, v_squared = (u**2).sum(axis=1), (v**2).sum(axis=1)
    spanned = u_squared * v_squared
    sine_squared = (direction**2).sum(axis=1)
    longer = np.where((u_squared >= v_squared)[:, None], u, v)
    lean = (direction * longer).sum(axis=1) / np.maximum(np.maximum(u_squared, v_squared), 1e-300)
    is_small = sine_squared <= SMALL_SINE_SQUARED * spanned
    direction = np.where(is_small[:, None], direction - lean[:, None] * longer, direction)
    length = np.linalg.norm(direction, axis=1)
    return direction, np.where(sine_squared <= PARALLEL_SINE_SQUARED * spanned, 0.0, length)


DEPTH_TOLERANCE = 1e-9
"""Depth in normalised length up to which two faces touch; beyond it they collide."""

_PAIRS_AT_ONCE = 1 << 14
"""Pairs that a thread's buffer holds; they are passed on when it is full."""

_REMEMBERED = 256
"""Pairs of earlier poses, at most a quarter from each, that are tested first where one pair that
counts is enough: successive poses, as in Resolve, mostly collide at the same places."""


NO_ENERGY, NO_CELLS = np.empty((0, 0)), np.empty((2, 0), dtype=np.int32)


class Cells(NamedTuple):
    """Cells of vertices, by which the energy of pairs is summed.

    Attributes
    ----------
    folds : second rules
    of_vertices : (2, V) int32, the cells in pairs that count by these rules, and in other pairs
    """

    folds: Exclusions
    of_vertices: IntArray


class Searcher:
    """The search with the work arrays of one thread.

    Parameters
    ----------
    tree, exclusions, topology : of the detector
    body_size : in the reference's unit

    Attributes
    ----------
    found : pairs of the current pose
    signed : (P,) float64 array, their signed distances if there is a clearance
    """

    def __init__(
        self, tree: FaceTree, exclusions: Exclusions, topology: Topology, body_size: float
    ) -> None:
        self._tree = tree
        self._exclusions = exclusions
        self._body_size = body_size
        self._scale = 1.0 / body_size
        self._work: PoseWorkspace = allocate_work(tree, topology.n_vertices)
        self._poses = np.empty((1, topology.n_vertices, 3))
        self._unused = topology.unused_vertices
        self._faces, self._used = topology.faces, topology.faces[0, 0]
        self._waiting = 0
        self._remembered = np.empty((_REMEMBERED, 2), dtype=np.int32)
        self._n_remembered = np.zeros(1, dtype=np.int64)
        self.found = PairBuffer(
            slots=np.empty((_PAIRS_AT_ONCE, 2), dtype=np.int32),
            squared_depth=np.empty(_PAIRS_AT_ONCE),
            rule=np.empty(_PAIRS_AT_ONCE, dtype=np.uint8),
        )
        self.signed = np.empty(_PAIRS_AT_ONCE)

    def search(
        self,
        pose: npt.NDArray[np.floating],
        *,
        first_only: bool = False,
        number: int | None = None,
        unit: float = 1.0,
        with_coincident: bool = False,
        uncounted: SkippableNodes = NO_TABLES,
        nearness: ClearanceRule | None = None,
        exclusions: Exclusions | None = None,
        end: npt.NDArray[np.floating] | None = None,
    ) -> Iterator[int]:
        """Search a (V, 3) pose; yield the number of pairs in `found` at least once, until the end.

        Parameters
        ----------
        first_only : as for `search_pose`; pairs remembered from earlier poses may be all found
        number : the pose's index in its batch, for the error message
        unit : as for `CollisionDetector.detect`
        with_coincident : without `nearness`, also find coincident pairs, with depth 0
        uncounted : as for `search_pose`
        nearness : find pairs that are too near; `signed` then holds their signed distances
        exclusions : used instead of the detector's own
        end : (V, 3), finite; find pairs that may meet on the linear path to this pose, with the
            rules that hold where they penetrate
        """
        ruled = self._exclusions if exclusions is None else exclusions
        self._take(pose[None], unit)
        self._waiting = 0
        enlarged = 0.0 if nearness is None else nearness.clearance
        swept = np.asarray([] if end is None else end, dtype=np.float64).reshape(-1, 3)
        if end is not None or with_coincident:
            enlarged = max(enlarged, DEPTH_TOLERANCE)
        if not load_vertices(self._poses[0], self._scale, self._work):
            self._refuse(self._poses[0], number)
        if first_only:
            n_found = test_pairs(
                DEPTH_TOLERANCE,
                self._tree,
                self._work,
                self._remembered[: self._n_remembered[0]],
                enlarged > 0.0,
                self.found,
            )
            n_found, some_count = self._judged(n_found, ruled, nearness)
            if some_count:
                yield n_found
                return
        while True:
            n_found, self._waiting = search_pose(
                self._scale,
                DEPTH_TOLERANCE,
                self._tree,
                ruled,
                uncounted,
                self._work,
                first_only,
                self.found,
                enlarged,
                swept,
                self._waiting,
                LEAF_SIZE,
            )
            if end is not None:
                moves = (swept - self._poses[0]) * self._scale
                n_found = drop_out_of_reach(
                    self._tree, self._work.vertices, moves, n_found, self.found
                )
                # Apply the rules that hold for pairs that penetrate, whatever the depth.
                self.found.squared_depth[:n_found] = np.inf
                judge(self._tree, ruled, self.found, 0, n_found)
            elif nearness is not None or with_coincident:
                n_found, some_count = self._judged(n_found, ruled, nearness, with_coincident)
                if some_count and first_only:
                    self._waiting = 0
            if end is None and exclusions is None and not with_coincident:
                remember(self.found, n_found, self._remembered, self._n_remembered)
            yield n_found
            if self._waiting == 0:
                return

    def count(
        self,
        poses: npt.NDArray[np.floating],
        first: int,
        n_by_rule: npt.NDArray[np.int64],
        *,
        vertex_energy: FloatArray = NO_ENERGY,
        cells: Cells | None = None,
        cell_energy: FloatArray = NO_ENERGY,
        first_only: bool = False,
        unit: float = 1.0,
        uncounted: SkippableNodes = NO_TABLES,
        nearness: ClearanceRule | None = None,
    ) -> None:
        """Count the pairs of (B, V, 3) poses by rule, and sum their energy: see `search_poses`.

        `first` is the index of the first pose in its batch; others are as for `search`. With a
        clearance, there is no energy of cells.
        """
        if nearness is not None:
            for row, pose in enumerate(poses):
                for n_found in self.search(
                    pose,
                    first_only=first_only,
                    number=first + row,
                    unit=unit,
                    uncounted=uncounted,
                    nearness=nearness,
                ):
                    n_by_rule[row] += np.bincount(self.found.rule[:n_found], minlength=N_KINDS)
                    if len(vertex_energy):
                        add_vertex_energy(self._tree, self.found, n_found, vertex_energy[row])
            return
        self._take(poses, unit)
        n_done = search_poses(
            self._poses[: len(poses)],
            self._scale,
            DEPTH_TOLERANCE,
            self._tree,
            self._exclusions,
            uncounted,
            self._work,
            first_only,
            self.found,
            LEAF_SIZE,
            self._remembered,
            self._n_remembered,
            n_by_rule,
            vertex_energy,
            self._exclusions if cells is None else cells.folds,
            NO_CELLS if cells is None else cells.of_vertices,
            cell_energy,
        )
        if n_done < len(poses):
            self._refuse(self._poses[n_done], first + n_done)

    def _take(self, poses: npt.NDArray[np.floating], unit: float) -> None:
        """Copy (B, V, 3) poses, moving vertices that no face uses to one that a face uses."""
        if len(poses) > len(self._poses):
            self._poses = np.empty((len(poses), *self._poses.shape[1:]))
        workspace = self._poses[: len(poses)]
        np.copyto(workspace, poses)
        workspace[:, self._unused] = workspace[:, self._used, None]
        self._scale = unit / self._body_size

    def _judged(
        self,
        n_found: int,
        exclusions: Exclusions,
        nearness: ClearanceRule | None,
        with_coincident: bool = False,
    ) -> tuple[int, bool]:
        """Keep pairs that are too near, or coincide, and judge them.

        Return their number and whether any of them counts.
        """
        tree, vertices, candidates = self._tree, self._work.vertices, self.found
        if nearness is not None:
            n_found = drop_far(tree, vertices, nearness, n_found, candidates)
            n_found = drop_excluded(tree, exclusions, candidates, n_found)
            n_found = keep_too_near(
                tree, vertices, nearness, DEPTH_TOLERANCE, n_found, candidates, self.signed
            )
        elif with_coincident:
            n_found = self._keep_coincident(n_found)
        return n_found, judge(tree, exclusions, candidates, 0, n_found)

    def _keep_coincident(self, n_found: int) -> int:
        """Drop pairs that neither penetrate nor coincide; return the number left."""
        candidates = self.found
        is_deep = candidates.squared_depth[:n_found] > 0.0
        apart = np.flatnonzero(~is_deep)
        corners = self._faces[self._tree.slot_face[candidates.slots[apart]]]
        is_deep[apart] = coincide(self._work.vertices[corners], DEPTH_TOLERANCE)
        n_kept = int(is_deep.sum())
        for array in (candidates.slots, candidates.squared_depth):
            array[:n_kept] = array[:n_found][is_deep]
        return n_kept

    @property
    def share_done(self) -> float:
        """The estimated fraction of the search that is done."""
        return 1.0 - float(self._work.fraction[: self._waiting].sum())

    def _refuse(self, pose: FloatArray, number: int | None) -> NoReturn:
        within = np.abs(pose) * self._scale <= MAX_DISTANCE  # False for NaN
        vertex = int(np.flatnonzero(~within.all(axis=1))[0])
        where = "" if number is None else f" of pose {number}"
        position = pose[vertex].tolist()
        what = (
            f"is more than {MAX_DISTANCE:.0e} body sizes away from the origin"
            if np.isfinite(position).all()
            else "is not finite"
        )
        raise ShapeError(f"vertex {vertex}{where} {what}, at {position}", "move or repair the mesh")
