"""Which pairs of nodes of a tree hold no pair of faces that can count, in any pose.

On a character most leaves whose boxes overlap hold only pairs of faces that share a vertex or that
the contact rules exclude: of the 19 912 pairs of leaves that a pose of a mannequin visits, 84 hold
another. A search for pairs that count need not open them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import sparse

from lcollision_core.compiled import compiled
from lcollision_core.contact.arrays import Exclusions, FaceTree, IntArray, UncountedNodes
from lcollision_core.contact.kernels import LEAF_SIZE

MOST_BYTES = 1 << 27
"""Of the tables, which grow with the square of the faces: those of 200 000 faces have 110 MB."""

MOST_LISTED = 1 << 26
"""Of the pairs that the exclusions list, as they are listed a second time to make the tables."""

_LEAVES_AT_ONCE = 64

NOTHING_KNOWN = UncountedNodes(
    level=np.empty(0, dtype=np.int32),
    number=np.empty(0, dtype=np.int32),
    start=np.empty(0, dtype=np.int64),
    stride=np.empty(0, dtype=np.int64),
    bits=np.empty(0, dtype=np.uint8),
)


class UncountedTables:
    """The tables of one detector, made in a thread of their own once they are asked for.

    Parameters
    ----------
    tree, exclusions : of the detector
    """

    def __init__(self, tree: FaceTree, exclusions: Exclusions) -> None:
        self._tree, self._exclusions = tree, exclusions
        self._made = NOTHING_KNOWN
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def nodes(self, *, wait: bool = False) -> UncountedNodes:
        """Return the tables; `NOTHING_KNOWN` until they are made, and where they bring nothing.

        Parameters
        ----------
        wait : until they are made
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
        n_listed = len(exclusions.near) + len(exclusions.face) + len(exclusions.touching)
        return (
            (n_listed + len(exclusions.joint) > 0 or bool(exclusions.ignored.any()))
            and n_listed <= MOST_LISTED
            and n_leaves**2 // 6 <= MOST_BYTES
        )

    def _make(self) -> None:
        # The end of the program waits for this thread.
        made = make_uncounted(self._tree, self._exclusions, threading.main_thread().is_alive)
        if made is not None:
            self._made = made


def make_uncounted(
    tree: FaceTree, exclusions: Exclusions, goes_on: Callable[[], bool] = lambda: True
) -> UncountedNodes | None:
    """Make the tables of a tree.

    Parameters
    ----------
    tree, exclusions : of one topology
    goes_on : asked now and then; once it says no, None is returned
    """
    depth = np.zeros(len(tree.left), dtype=np.int32)
    _fill_depths(tree.left, tree.right, depth)
    leaves = int(depth[tree.leaf < 0].max(initial=-1)) + 1
    level = np.where(tree.leaf < 0, depth, np.int32(leaves))
    inner = [np.flatnonzero(level == one).astype(np.int32) for one in range(leaves)]
    number = tree.leaf.copy()
    for nodes in inner:
        number[nodes] = np.arange(len(nodes))
    size = np.bincount(level)
    stride = -(-size // 8)
    start = np.cumsum(size * stride) - size * stride
    bits = np.zeros(size @ stride, dtype=np.uint8)
    made = UncountedNodes(level, number, start, stride, bits)
    near = _both_ways(exclusions.near_start, exclusions.near)
    rest = _both_ways(exclusions.start, exclusions.face)
    touching = _both_ways(exclusions.touching_start, exclusions.touching)
    for first in range(0, int(size[leaves]), _LEAVES_AT_ONCE):
        if not goes_on():
            return None
        stop = min(first + _LEAVES_AT_ONCE, int(size[leaves]))
        _fill_leaves(tree, LEAF_SIZE, exclusions, near, rest, touching, first, stop, made)
    for nodes in reversed(inner):
        _fill_inner(tree, nodes, made)
    return made


class _BothWays(NamedTuple):
    """Lists of what comes after each thing and of what comes before it."""

    start: npt.NDArray[np.int64]
    entry: IntArray
    start_before: npt.NDArray[np.int64]
    entry_before: IntArray


def _both_ways(start: npt.NDArray[np.int64], entry: IntArray) -> _BothWays:
    n = len(start) - 1
    after = sparse.csr_matrix((np.ones(len(entry), dtype=np.bool_), entry, start), shape=(n, n))
    before = after.T.tocsr()
    return _BothWays(start, entry, before.indptr.astype(np.int64), before.indices.astype(np.int32))


@compiled
def _fill_depths(left: IntArray, right: IntArray, depth: IntArray) -> None:
    for node in range(len(left)):
        if left[node] >= 0:
            depth[left[node]] = depth[right[node]] = depth[node] + 1


@compiled
def _mark(
    start: npt.NDArray[np.int64],
    entry: IntArray,
    of: int,
    mask: npt.NDArray[np.uint8],
    bit: np.uint8,
) -> None:
    """Set a bit of everything in one list."""
    for k in range(start[of], start[of + 1]):
        mask[entry[k]] |= bit


@compiled
def _mark_both_ways(lists: _BothWays, of: int, mask: npt.NDArray[np.uint8], bit: np.uint8) -> None:
    if len(lists.start) > 1:
        _mark(lists.start, lists.entry, of, mask, bit)
        _mark(lists.start_before, lists.entry_before, of, mask, bit)


@compiled
def _fill_leaves(
    tree: FaceTree,
    leaf_size: int,
    exclusions: Exclusions,
    near: _BothWays,
    rest: _BothWays,
    touching: _BothWays,
    first: int,
    stop: int,
    made: UncountedNodes,
) -> None:
    """Fill in the table of the leaves for those from `first` to `stop` with themselves and later.

    Bit i of a vertex, face, region or joint says that no face that has it, is it, is of it or lies
    about it counts with face i of the leaf at hand.
    """
    corners, region = exclusions.corners, exclusions.region
    of_vertex = np.empty(corners.max() + 1, dtype=np.uint8)
    of_face = np.empty(len(corners), dtype=np.uint8)
    of_region = np.empty(len(exclusions.ignored), dtype=np.uint8)
    joint_start, joint = exclusions.joint_start, exclusions.joint
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
            if len(joint) > 0:
                _mark(joint_start, joint, face, of_joint, bit)
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


@compiled
def _has(made: UncountedNodes, a: int, b: int) -> bool:
    """Whether a table has the bit of two nodes."""
    level = made.level[a]
    if level != made.level[b]:
        return False
    column = made.number[b]
    row = made.start[level] + made.number[a] * made.stride[level]
    return bool((made.bits[row + (column >> 3)] >> (column & 7)) & 1)


@compiled
def _are_uncounted(tree: FaceTree, made: UncountedNodes, a: int, b: int) -> bool:
    """Whether no pair below two nodes of one depth counts; those below them have their tables.

    Depths of leaves differ by one at most: of an inner node beside a leaf both children are leaves.
    """
    if tree.leaf[a] < 0 and tree.leaf[b] >= 0:
        a, b = b, a
    if tree.leaf[a] < 0 or tree.leaf[b] >= 0:
        return _has(made, a, b)
    return _has(made, a, tree.left[b]) and _has(made, a, tree.right[b])


@compiled
def _fill_inner(tree: FaceTree, nodes: IntArray, made: UncountedNodes) -> None:
    """Fill in the table of the inner nodes of one depth from those of their children."""
    table, stride = made.start[made.level[nodes[0]]], made.stride[made.level[nodes[0]]]
    for i in range(len(nodes)):
        a = nodes[i]
        for j in range(i, len(nodes)):
            b = nodes[j]
            if (
                _are_uncounted(tree, made, tree.left[a], tree.left[b])
                and _are_uncounted(tree, made, tree.left[a], tree.right[b])
                and _are_uncounted(tree, made, tree.right[a], tree.left[b])
                and _are_uncounted(tree, made, tree.right[a], tree.right[b])
            ):
                made.bits[table + i * stride + (j >> 3)] |= np.uint8(1 << (j & 7))
                made.bits[table + j * stride + (i >> 3)] |= np.uint8(1 << (i & 7))
