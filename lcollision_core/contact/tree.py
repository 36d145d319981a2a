"""The bounding-volume tree of one topology: built once, refitted per pose by the kernels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled
from lcollision_core.contact.arrays import FaceTree, PoseWork
from lcollision_core.contact.kernels import LEAF_SIZE

_APART = 1e3
"""Factor by which the centroids of components are drawn apart, against those within them."""

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]


def build_tree(vertices: FloatArray, faces: IntArray, component: IntArray) -> FaceTree:
    """Build the tree by median splits of the face centroids along their longest extent.

    Components are split from each other first, by their own centroids, as shells that cover each
    other move apart.

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
    left, right, leaf, size = (np.empty(2 * n_leaves - 1, dtype=np.int32) for _ in range(4))
    centroids, of_face = vertices[faces].mean(axis=1), component[faces[:, 0]]
    if of_face.max() > of_face.min():
        of_component = [np.bincount(of_face, centroids[:, c]) for c in range(3)]
        n_faces = np.maximum(np.bincount(of_face), 1)
        centroids = centroids + _APART * (np.stack(of_component) / n_faces).T[of_face]
    _split_faces(centroids, LEAF_SIZE, order, left, right, leaf, size)
    slot_face = np.full(n_leaves * LEAF_SIZE, -1, dtype=np.int32)
    slot_face[: len(faces)] = order
    corners = np.full((n_leaves * LEAF_SIZE, 3), -1, dtype=np.int32)
    corners[: len(faces)] = faces[order]
    by_leaf = corners.reshape(n_leaves, LEAF_SIZE, 3).transpose(0, 2, 1)
    return FaceTree(slot_face, np.ascontiguousarray(by_leaf).reshape(-1), left, right, leaf, size)


@compiled
def _select(keys: FloatArray, items: IntArray, start: int, stop: int, wanted: int) -> None:
    """Reorder `keys` and `items` from `start` to `stop`: none after index `wanted` is smaller.

    Quickselect with random pivots and equal keys grouped, so that neither sorted nor equal keys
    take long.
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
) -> None:
    """Split faces at the medians of their longest extents, parents before children.

    Parameters
    ----------
    centroids : (F, 3) float64 array
    leaf_size : faces in a leaf; all but the last are full
    order : (F,) int32 array, 0 to F - 1, overwritten by the faces leaf by leaf
    left, right, leaf, size : (n,) int32 arrays of a `FaceTree` of n nodes, overwritten
    """
    keys = np.empty(len(order))
    starts, nodes = np.zeros(64, dtype=np.int64), np.zeros(64, dtype=np.int64)
    stops = np.full(64, len(order), dtype=np.int64)
    n_waiting = 1
    while n_waiting > 0:
        n_waiting -= 1
        start, stop, node = starts[n_waiting], stops[n_waiting], nodes[n_waiting]
        left[node] = right[node] = leaf[node] = -1
        size[node] = stop - start
        if stop - start <= leaf_size:
            leaf[node] = start // leaf_size
            continue
        longest, axis = -1.0, 0
        for c in range(3):
            least, most = np.inf, -np.inf
            for k in range(start, stop):
                least = min(least, centroids[order[k], c])
                most = max(most, centroids[order[k], c])
            if most - least > longest:
                longest, axis = most - least, c
        for k in range(start, stop):
            keys[k] = centroids[order[k], axis]
        n_left = -(-(stop - start) // leaf_size) // 2
        middle = start + n_left * leaf_size
        _select(keys, order, start, stop, middle)
        left[node] = node + 1
        # A subtree of n leaves has 2 n - 1 nodes.
        right[node] = node + 2 * n_left
        starts[n_waiting], stops[n_waiting], nodes[n_waiting] = middle, stop, right[node]
        starts[n_waiting + 1], stops[n_waiting + 1], nodes[n_waiting + 1] = (
            start,
            middle,
            left[node],
        )
        n_waiting += 2


def allocate_work(tree: FaceTree, n_vertices: int) -> PoseWork:
    """Make the arrays that one thread needs to search poses with a tree."""
    n_slots = len(tree.slot_face)
    n_nodes = len(tree.left)
    # A pair of nodes is replaced by at most three, one level further down on one side or both.
    levels = int(np.ceil(np.log2(n_slots // LEAF_SIZE))) + 1
    return PoseWork(
        middle=np.empty(3),
        vertices=np.empty((n_vertices, 3)),
        rounded=np.empty((n_vertices, 3), dtype=np.float32),
        pair=np.empty((2, 3, 3)),
        boxes=np.empty(6 * n_slots, dtype=np.float32),
        node_boxes=np.empty((n_nodes, 6), dtype=np.float32),
        stack=np.empty((4 * levels + 4, 2), dtype=np.int32),
        fraction=np.empty(4 * levels + 4),
    )
