"""Kernels of the exact check on a GPU; they share the CPU's functions for depth and rules.

Three kernels run in turn. `place_poses`, one block of threads per pose, refits the CPU's tree.
`find_candidates`, one thread per face, walks it for later faces whose boxes overlap.
`measure_candidates`, one thread per candidate, measures and judges it; only this one needs many
doubles, which are slow on consumer cards. Boxes are float32 and hold the same numbers as on the
CPU.

Energies are summed in fixed point, in two integers each, so that the sums do not depend on the
order of the candidates.
"""
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lcollision_core.contact import kernels
from lcollision_core.contact.kernels import COINCIDENT, COUNTED, LEAF_SIZE, MAX_DISTANCE
from lcollision_core.on_gpu import THREADS, DeviceArray, cuda, device_function

_STACK = 64
"""Size of the stack of waiting nodes: at most one per level of a balanced tree."""

_HIGH, _LOW = 2.0**40, 2.0**84
"""Inverse units of the two integers of a sum: it holds up to 8e6, and 500 000 terms."""

_pair_depth_squared = device_function(kernels.pair_depth_squared)
_rule_of = device_function(kernels.rule_of)
_is_uncounted = device_function(kernels.is_uncounted)
_is_candidate = device_function(kernels.is_candidate)
_gather = device_function(kernels.gather)


class GpuWork(NamedTuple):
    """The workspace of the n poses that are searched at once; see `PoseWorkspace`.

    Attributes
    ----------
    vertices : (n, V, 3) float64
    rounded : (n, V, 3) float32
    boxes : (n, 6 S) float32
    node_boxes : (n, nodes, 6) float32
    """

    vertices: DeviceArray
    rounded: DeviceArray
    boxes: DeviceArray
    node_boxes: DeviceArray


@cuda.jit
def place_poses(poses, rows, source, scale, tree, level_start, level_node, work, n_candidates):
    """Fill in the vertices and boxes of n of (B, V, 3) poses, a block of threads each.

    Parameters
    ----------
    rows : (n,) int32, indices of the poses
    source : (V,) int32, the vertex that stands for each: itself if a face uses it
    scale : factor to normalised length
    tree : `FaceTree`
    level_start, level_node : its nodes level by level, the root first
    work : `GpuWork` for n poses, overwritten
    n_candidates : (n,) int32, set to -1 if a vertex is not finite or beyond `MAX_DISTANCE`
    """
    pose, thread = cuda.blockIdx.x, cuda.threadIdx.x
    row, boxes, node_boxes = rows[pose], work.boxes, work.node_boxes
    low = cuda.shared.array((3, THREADS), np.float64)
    high = cuda.shared.array((3, THREADS), np.float64)
    for c in range(3):
        low[c, thread], high[c, thread] = math.inf, -math.inf
        for v in range(thread, poses.shape[1], THREADS):
            place = np.float64(poses[row, source[v], c])
            # Written so that NaN fails it.
            if not abs(place) * scale <= MAX_DISTANCE:
                n_candidates[pose] = -1
            low[c, thread] = min(low[c, thread], place)
            high[c, thread] = max(high[c, thread], place)
    half = THREADS // 2
    while half > 0:
        cuda.syncthreads()
        if thread < half:
            for c in range(3):
                low[c, thread] = min(low[c, thread], low[c, thread + half])
                high[c, thread] = max(high[c, thread], high[c, thread + half])
        half //= 2
    cuda.syncthreads()
    if n_candidates[pose] < 0:
        return
    for v in range(thread, poses.shape[1], THREADS):
        for c in range(3):
            middle = 0.5 * (low[c, 0] + high[c, 0])
            place = (np.float64(poses[row, source[v], c]) - middle) * scale
            work.vertices[pose, v, c] = place
            work.rounded[pose, v, c] = np.float32(place)
    cuda.syncthreads()
    for slot in range(thread, tree.slot_face.shape[0], THREADS):
        corner = slot // LEAF_SIZE * 3 * LEAF_SIZE + slot % LEAF_SIZE
        base = slot // LEAF_SIZE * 6 * LEAF_SIZE + slot % LEAF_SIZE
        for c in range(3):
            lower, upper = np.float32(math.inf), np.float32(-math.inf)
            if tree.corners[corner] >= 0:
                for k in range(3):
                    at = work.rounded[pose, tree.corners[corner + k * LEAF_SIZE], c]
                    lower, upper = min(lower, at), max(upper, at)
            boxes[pose, base + c * LEAF_SIZE] = lower
            boxes[pose, base + (3 + c) * LEAF_SIZE] = upper
    for level in range(level_start.shape[0] - 2, -1, -1):
        cuda.syncthreads()
        for k in range(level_start[level] + thread, level_start[level + 1], THREADS):
            node = level_node[k]
            left, right = tree.left[node], tree.right[node]
            base = tree.leaf[node] * 6 * LEAF_SIZE
            for c in range(3):
                lower, upper = np.float32(math.inf), np.float32(-math.inf)
                if left >= 0:
                    lower = min(node_boxes[pose, left, c], node_boxes[pose, right, c])
                    upper = max(node_boxes[pose, left, 3 + c], node_boxes[pose, right, 3 + c])
                else:
                    for lane in range(LEAF_SIZE):
                        lower = min(lower, boxes[pose, base + c * LEAF_SIZE + lane])
                        upper = max(upper, boxes[pose, base + (3 + c) * LEAF_SIZE + lane])
                node_boxes[pose, node, c], node_boxes[pose, node, 3 + c] = lower, upper


@cuda.jit
def find_candidates(tree, last_leaf, node_of_leaf, uncounted, work, candidates, n_candidates):
    """List the pairs of faces that share no vertex and whose boxes overlap, in any order.

    Each slot of a pose has a thread; the block's second index is the pose, of n.

    Parameters
    ----------
    last_leaf : (nodes,) int32, the last leaf below each node
    node_of_leaf : (leaves,) int32
    uncounted : `SkippableNodes`, whose pairs are left out
    work : of `place_poses`
    candidates : (n, capacity, 2) int32, overwritten by slots, the smaller first
    n_candidates : (n,) int32, 0 at first; candidates beyond `capacity` are counted but not listed
    """
    pose = cuda.blockIdx.y
    if n_candidates[pose] < 0:
        return
    corners, boxes, nodes = tree.corners, work.boxes[pose], work.node_boxes[pose]
    stack = cuda.local.array(_STACK, np.int32)
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for slot in range(first, tree.slot_face.shape[0], cuda.gridDim.x * cuda.blockDim.x):
        leaf, lane = slot // LEAF_SIZE, slot % LEAF_SIZE
        corner, base = leaf * 3 * LEAF_SIZE + lane, leaf * 6 * LEAF_SIZE + lane
        f0 = corners[corner]
        if f0 < 0:
            continue
        f1, f2 = corners[corner + LEAF_SIZE], corners[corner + 2 * LEAF_SIZE]
        x0, x1 = boxes[base], boxes[base + 3 * LEAF_SIZE]
        y0, y1 = boxes[base + LEAF_SIZE], boxes[base + 4 * LEAF_SIZE]
        z0, z1 = boxes[base + 2 * LEAF_SIZE], boxes[base + 5 * LEAF_SIZE]
        stack[0] = 0
        n_waiting = 1
        while n_waiting > 0:
            n_waiting -= 1
            node = stack[n_waiting]
            if (
                last_leaf[node] < leaf
                or x0 > nodes[node, 3]
                or nodes[node, 0] > x1
                or y0 > nodes[node, 4]
                or nodes[node, 1] > y1
                or z0 > nodes[node, 5]
                or nodes[node, 2] > z1
            ):
                continue
            other = tree.leaf[node]
            if other < 0:
                stack[n_waiting], stack[n_waiting + 1] = tree.left[node], tree.right[node]
                n_waiting += 2
                continue
            if uncounted.bits.shape[0] > 0 and _is_uncounted(uncounted, node_of_leaf[leaf], node):
                continue
            for k in range(lane + 1 if other == leaf else 0, LEAF_SIZE):
                c, x = np.uint64(other * 3 * LEAF_SIZE + k), np.uint64(other * 6 * LEAF_SIZE + k)
                if _is_candidate(corners, boxes, c, x, f0, f1, f2, x0, y0, z0, x1, y1, z1) != 0:
                    at = cuda.atomic.add(n_candidates, pose, 1)
                    if at < candidates.shape[1]:
                        candidates[pose, at, 0] = slot
                        candidates[pose, at, 1] = other * LEAF_SIZE + k


@cuda.jit(device=True)
def _add(sums, row, at, value):
    """Add a number to a fixed-point sum."""
    high = np.int64(value * _HIGH)
    if high != 0:
        cuda.atomic.add(sums, (row, at, 0), high)
    cuda.atomic.add(sums, (row, at, 1), np.int64((value - high / _HIGH) * _LOW))


@cuda.jit
def measure_candidates(
    rows,
    work,
    tree,
    exclusions,
    folds,
    cells,
    tolerance,
    first_only,
    candidates,
    n_candidates,
    n_by_rule,
    vertex_sums,
    cell_sums,
    squared_depths,
    rules,
):
    """Measure and judge the candidates of n poses; the block's second index is the pose.

    A pose with more candidates than are listed is skipped.

    Parameters
    ----------
    rows, work, candidates, n_candidates : of the earlier kernels
    exclusions, folds, cells, tolerance : as for `kernels.search_poses`
    first_only : whether to stop once a pair counts
    n_by_rule : (B, `N_KINDS`) int32, added to
    vertex_sums : (B, V, 2) int64, energies in fixed point, added to; (0, 0, 2) for none
    cell_sums : (B, C, 2) int64, the same for cells
    squared_depths, rules : (n, capacity), overwritten by those of the candidates, `COINCIDENT` if
        they do not penetrate; (0, 0) for none
    """
    pose = cuda.blockIdx.y
    if n_candidates[pose] > candidates.shape[1]:
        return
    row = rows[pose]
    pair = cuda.local.array((2, 3, 3), np.float64)
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for n in range(first, n_candidates[pose], cuda.gridDim.x * cuda.blockDim.x):
        if first_only and n_by_rule[row, COUNTED] > 0:
            return
        for side in range(2):
            _gather(tree.corners, work.vertices[pose], candidates[pose, n, side], pair, side)
        squared_depth = _pair_depth_squared(pair, 0, 1, tolerance)
        face_a = tree.slot_face[candidates[pose, n, 0]]
        face_b = tree.slot_face[candidates[pose, n, 1]]
        rule = _rule_of(face_a, face_b, squared_depth, exclusions)
        if rules.shape[0] > 0:
            squared_depths[pose, n], rules[pose, n] = squared_depth, rule
        if rule == COINCIDENT:
            continue
        cuda.atomic.add(n_by_rule, (row, np.int64(rule)), 1)
        if rule != COUNTED:
            continue
        fold = 0
        if cell_sums.shape[0] > 0 and _rule_of(face_a, face_b, squared_depth, folds) != COUNTED:
            fold = 1
        for k in range(3):
            for face in (face_a, face_b):
                vertex = exclusions.corners[face, k]
                if vertex_sums.shape[0] > 0:
                    _add(vertex_sums, row, vertex, squared_depth / 6.0)
                if cell_sums.shape[0] > 0:
                    _add(cell_sums, row, cells[fold, vertex], squared_depth / 6.0)


@cuda.jit
def take_sums(sums, total):
    """Convert (B, N, 2) fixed-point sums to (B, N) floats, with at least one block per row."""
    row = cuda.blockIdx.y
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for at in range(first, total.shape[1], cuda.gridDim.x * cuda.blockDim.x):
        total[row, at] = sums[row, at, 0] / _HIGH + sums[row, at, 1] / _LOW
