"""The compiled way to build the tree of a large mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]


@compiled
def _select(keys: FloatArray, items: IntArray, start: int, stop: int, wanted: int) -> None:
    """Order `items` by `keys`, both from `start` to `stop`, as far as place `wanted` parts them.

    Quickselect with pivots drawn at random, equal keys set apart, so that neither sorted nor equal
    keys take long.
    """
    low, high, state = start, stop, 12345
    while high - low > 1:
        state = (state * 1103515245 + 12345) % 2147483648
        pivot = keys[low + state % (high - low)]
        less, place, more = low, low, high
        while place < more:
            key = keys[place]
            if key < pivot:
                keys[place], keys[less] = keys[less], key
                items[place], items[less] = items[less], items[place]
                less += 1
                place += 1
            elif key > pivot:
                more -= 1
                keys[place], keys[more] = keys[more], key
                items[place], items[more] = items[more], items[place]
            else:
                place += 1
        if wanted < less:
            high = less
        elif wanted >= more:
            low = more
        else:
            return


@compiled
def split_faces(
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
    height = 1
    while height > 0:
        height -= 1
        start, stop, node = starts[height], stops[height], nodes[height]
        left[node] = right[node] = leaf[node] = -1
        size[node] = stop - start
        if stop - start <= leaf_size:
            leaf[node] = start // leaf_size
            continue
        longest, axis = -1.0, 0
        for c in range(3):
            least, most = np.inf, -np.inf
            for place in range(start, stop):
                least = min(least, centroids[order[place], c])
                most = max(most, centroids[order[place], c])
            if most - least > longest:
                longest, axis = most - least, c
        for place in range(start, stop):
            keys[place] = centroids[order[place], axis]
        n_left = -(-(stop - start) // leaf_size) // 2
        middle = start + n_left * leaf_size
        _select(keys, order, start, stop, middle)
        left[node] = node + 1
        # A subtree of n leaves has 2 n - 1 nodes.
        right[node] = node + 2 * n_left
        starts[height], stops[height], nodes[height] = middle, stop, right[node]
        starts[height + 1], stops[height + 1], nodes[height + 1] = start, middle, left[node]
        height += 2
