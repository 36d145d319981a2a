"""The bounding-volume tree of one topology: built once, refitted per pose by the kernels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.arrays import FaceTree, PoseWork
from lcollision_core.contact.kernels import LEAF_SIZE
from lcollision_core.contact.tree_kernels import split_faces

IntArray = npt.NDArray[np.int32]

COMPILED_FROM = 100_000
"""Faces from which on building the tree is worth a compiled loop. Both ways find the same pairs,
in another order, so that sums of energies may differ in the last bit."""


def build_tree(vertices: npt.NDArray[np.float64], faces: IntArray) -> FaceTree:
    """Build the tree by median splits of the face centroids along their longest extent.

    Parameters
    ----------
    vertices : (V, 3) float64 array, a typical pose (the reference)
    faces : (F, 3) int32 array

    Returns
    -------
    FaceTree, balanced: all leaves but the last are full.
    """
    centroids = vertices[faces].mean(axis=1)
    split = _split if len(faces) < COMPILED_FROM else _split_compiled
    order, left, right, leaf, size = split(centroids)
    n_leaves = -(-len(faces) // LEAF_SIZE)
    slot_face = np.full(n_leaves * LEAF_SIZE, -1, dtype=np.int32)
    slot_face[: len(faces)] = order
    corners = np.full((n_leaves * LEAF_SIZE, 3), -1, dtype=np.int32)
    corners[: len(faces)] = faces[order]
    by_leaf = corners.reshape(n_leaves, LEAF_SIZE, 3).transpose(0, 2, 1)
    return FaceTree(
        slot_face=slot_face,
        corners=np.ascontiguousarray(by_leaf).reshape(-1),
        left=left,
        right=right,
        leaf=leaf,
        size=size,
    )


def _split(centroids: npt.NDArray[np.float64]) -> tuple[IntArray, ...]:
    """Return the faces leaf by leaf, and left, right, leaf and size of each node."""
    order = np.arange(len(centroids))
    left: list[int] = []
    right: list[int] = []
    leaf: list[int] = []
    size: list[int] = []

    def split(start: int, stop: int) -> int:
        node = len(left)
        left.append(-1)
        right.append(-1)
        leaf.append(-1)
        size.append(stop - start)
        if stop - start <= LEAF_SIZE:
            leaf[node] = start // LEAF_SIZE
            return node
        members = order[start:stop]
        points = centroids[members]
        axis = int(np.argmax(np.ptp(points, axis=0)))
        n_leaves = -(-(stop - start) // LEAF_SIZE)
        middle = start + n_leaves // 2 * LEAF_SIZE
        order[start:stop] = members[np.argpartition(points[:, axis], middle - start)]
        left[node] = split(start, middle)
        right[node] = split(middle, stop)
        return node

    split(0, len(centroids))
    nodes = (np.array(values, dtype=np.int32) for values in (left, right, leaf, size))
    return (order.astype(np.int32), *nodes)


def _split_compiled(centroids: npt.NDArray[np.float64]) -> tuple[IntArray, ...]:
    """Do as `_split`, in a tenth of the time, once compiled; equal centroids may fall otherwise."""
    n_nodes = 2 * -(-len(centroids) // LEAF_SIZE) - 1
    order = np.arange(len(centroids), dtype=np.int32)
    left, right, leaf, size = (np.empty(n_nodes, dtype=np.int32) for _ in range(4))
    split_faces(centroids, LEAF_SIZE, order, left, right, leaf, size)
    return order, left, right, leaf, size


def allocate_work(tree: FaceTree) -> PoseWork:
    """Make the arrays that one thread needs to search poses with a tree."""
    n_slots = len(tree.slot_face)
    n_nodes = len(tree.left)
    # A pair of nodes is replaced by at most three, one level further down on one side or both.
    levels = int(np.ceil(np.log2(n_slots // LEAF_SIZE))) + 1
    return PoseWork(
        middle=np.empty(3),
        triangles=np.zeros((n_slots, 3, 3)),
        boxes=np.empty(6 * n_slots, dtype=np.float32),
        node_boxes=np.empty((n_nodes, 6), dtype=np.float32),
        stack=np.empty((4 * levels + 4, 2), dtype=np.int32),
        share=np.empty(4 * levels + 4),
    )
