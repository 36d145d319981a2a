"""The bounding-volume tree of one topology: built once, refitted per pose by the kernels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.arrays import FaceTree, PoseWork
from lcollision_core.contact.kernels import LEAF_SIZE

IntArray = npt.NDArray[np.int32]


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
    order = np.arange(len(faces))
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

    split(0, len(faces))
    n_leaves = -(-len(faces) // LEAF_SIZE)
    slot_face = np.full(n_leaves * LEAF_SIZE, -1, dtype=np.int32)
    slot_face[: len(faces)] = order
    corners = np.full((n_leaves * LEAF_SIZE, 3), -1, dtype=np.int32)
    corners[: len(faces)] = faces[order]
    by_leaf = corners.reshape(n_leaves, LEAF_SIZE, 3).transpose(0, 2, 1)
    return FaceTree(
        slot_face=slot_face,
        corners=np.ascontiguousarray(by_leaf).reshape(-1),
        left=np.array(left, dtype=np.int32),
        right=np.array(right, dtype=np.int32),
        leaf=np.array(leaf, dtype=np.int32),
        size=np.array(size, dtype=np.int32),
    )


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
