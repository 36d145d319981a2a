"""The compiled inner loops: refit the tree to a pose, find candidates, keep those that penetrate.

They release the GIL and write into arrays that the caller keeps, so threads work on poses side
by side and nothing is allocated per pose. Boxes are float32: twice as many fit into a vector
instruction, and no pair is lost, as rounding keeps the order of numbers: boxes that overlap still
do. Depths are float64.

All compiled code that the search calls is in this file, with the constants that it bakes in,
because Numba detects a stale cache of a function only by the date of the function's file. With a
clearance, the loops of `contact.distance` measure the pairs that the search finds.
"""
# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part, inlined
from lcollision_core.contact.arrays import (
    Exclusions,
    FaceTree,
    PairBuffer,
    PoseWorkspace,
    SkippableNodes,
)
from lcollision_core.meshes.topology import FloatArray

LEAF_SIZE = 8
"""Faces in a leaf of the tree: the number that one vector instruction compares."""

PARALLEL_SINE_SQUARED = 1e-20
"""Edges at an angle of a smaller squared sine span no direction of their own.

The squared sine is independent of scale. Any direction gives an upper bound of the depth, so the
tolerance only has to exclude cross products that are rounding noise.
"""

MAX_DISTANCE = 1e9
"""Largest distance of a vertex from the origin, in normalised length; poses beyond it are refused.
Within it, products of coordinates stay far from overflow."""

SMALL_SINE_SQUARED = 1e-6
"""Squared sine of their angle below which two edges' cross product is corrected for rounding."""

N_KINDS = 9
COUNTED, NEAR, REST, IGNORED, TOLERATED, JOINT, TOUCHING, SHAPE, COINCIDENT = range(N_KINDS)
"""Kind of a pair of faces: it counts; a rule, in the order of `RuleCounts`, excludes it; or its
faces coincide, which is no collision."""

_OUTWARD = np.float32(2.0**-21)

_LEAF = np.uint64(LEAF_SIZE)
_LEAF_CORNERS = np.uint64(3 * LEAF_SIZE)
_LEAF_BOXES = np.uint64(6 * LEAF_SIZE)


@inlined
def _across(ux, uy, uz, vx, vy, vz):
    """Return the direction across two edges and its squared length, 0 where they are parallel."""
    dx, dy, dz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length_squared = dx * dx + dy * dy + dz * dz
    u_squared = ux * ux + uy * uy + uz * uz
    v_squared = vx * vx + vy * vy + vz * vz
    if length_squared <= SMALL_SINE_SQUARED * u_squared * v_squared:
        if length_squared <= PARALLEL_SINE_SQUARED * u_squared * v_squared:
            return 0.0, 0.0, 0.0, 0.0
        # Rounding leans the product towards the edges by up to 2^-53 / sine. The edges then no
        # longer project to points, as the overlaps assume, and long edges seem separate.
        if u_squared >= v_squared:
            lean = (dx * ux + dy * uy + dz * uz) / u_squared
            dx, dy, dz = dx - lean * ux, dy - lean * uy, dz - lean * uz
        else:
            lean = (dx * vx + dy * vy + dz * vz) / v_squared
            dx, dy, dz = dx - lean * vx, dy - lean * vy, dz - lean * vz
        length_squared = dx * dx + dy * dy + dz * dz
    return dx, dy, dz, length_squared


@inlined
def _along(triangles, t, k, ox, oy, oz, dx, dy, dz):
    """Return the position of corner k of triangle t along d, relative to o."""
    return (
        dx * (triangles[t, k, 0] - ox)
        + dy * (triangles[t, k, 1] - oy)
        + dz * (triangles[t, k, 2] - oz)
    )


@compiled_part
def pair_depth_squared(triangles, a, b, tolerance):
    """Return the squared depth of triangles a and b, or 0 where it is at most `tolerance`.

    Parameters
    ----------
    triangles : (T, 3, 3) float64 array of corners
    a, b : indices into `triangles`
    tolerance : depth up to which triangles touch rather than penetrate, in the same unit
    """
    tolerance_squared = tolerance * tolerance
    best = np.inf

    # The normal of each triangle in turn. The triangle's own corners project to the origin.
    for side in range(2):
        p = a if side == 0 else b
        q = b if side == 0 else a
        ox, oy, oz = triangles[p, 0, 0], triangles[p, 0, 1], triangles[p, 0, 2]
        ux, uy, uz = triangles[p, 1, 0] - ox, triangles[p, 1, 1] - oy, triangles[p, 1, 2] - oz
        vx, vy, vz = triangles[p, 2, 0] - ox, triangles[p, 2, 1] - oy, triangles[p, 2, 2] - oz
        nx, ny, nz, length_squared = _across(ux, uy, uz, vx, vy, vz)
        if length_squared == 0.0:
            continue
        q0 = _along(triangles, q, 0, ox, oy, oz, nx, ny, nz)
        q1 = _along(triangles, q, 1, ox, oy, oz, nx, ny, nz)
        q2 = _along(triangles, q, 2, ox, oy, oz, nx, ny, nz)
        overlap = min(max(q0, max(q1, q2)), -min(q0, min(q1, q2)))
        if overlap <= 0.0 or overlap * overlap <= tolerance_squared * length_squared:
            return 0.0
        best = min(best, overlap * overlap / length_squared)

    # Edge of a by edge of b. Both ends of an edge project to one point, so that point and the
    # opposite corner span each triangle's interval.
    for i in range(3):
        i_next = i + 1 if i < 2 else 0
        i_opposite = i_next + 1 if i_next < 2 else 0
        ox, oy, oz = triangles[a, i, 0], triangles[a, i, 1], triangles[a, i, 2]
        ux = triangles[a, i_next, 0] - ox
        uy = triangles[a, i_next, 1] - oy
        uz = triangles[a, i_next, 2] - oz
        wx = triangles[a, i_opposite, 0] - ox
        wy = triangles[a, i_opposite, 1] - oy
        wz = triangles[a, i_opposite, 2] - oz
        for j in range(3):
            j_next = j + 1 if j < 2 else 0
            j_opposite = j_next + 1 if j_next < 2 else 0
            sx, sy, sz = triangles[b, j, 0], triangles[b, j, 1], triangles[b, j, 2]
            vx = triangles[b, j_next, 0] - sx
            vy = triangles[b, j_next, 1] - sy
            vz = triangles[b, j_next, 2] - sz
            dx, dy, dz, length_squared = _across(ux, uy, uz, vx, vy, vz)
            if length_squared == 0.0:
                continue
            a_opposite = dx * wx + dy * wy + dz * wz
            b_edge = dx * (sx - ox) + dy * (sy - oy) + dz * (sz - oz)
            b_opposite = _along(triangles, b, j_opposite, ox, oy, oz, dx, dy, dz)
            overlap = min(
                max(0.0, a_opposite) - min(b_edge, b_opposite),
                max(b_edge, b_opposite) - min(0.0, a_opposite),
            )
            if overlap <= 0.0 or overlap * overlap <= tolerance_squared * length_squared:
                return 0.0
            best = min(best, overlap * overlap / length_squared)

    return best if best < np.inf else 0.0


@compiled
def fill_depths(triangles: FloatArray, tolerances: FloatArray, depths: FloatArray) -> None:
    """Write the depth of triangles 2i and 2i + 1 to depths[i], or 0 if at most tolerances[i]."""
    for pair in range(len(depths)):
        depths[pair] = np.sqrt(
            pair_depth_squared(triangles, 2 * pair, 2 * pair + 1, tolerances[pair])
        )


@compiled
def load_vertices(pose: FloatArray, scale: float, work: PoseWorkspace) -> bool:
    """Fill in the vertices of one pose and return True, or False if beyond `MAX_DISTANCE`.

    Coordinates are relative to the middle of the pose's bounding box, so that a pose far from the
    origin keeps its precision.

    Parameters
    ----------
    pose : (V, 3) float64 array
    scale : factor from the pose's unit to normalised length
    work : overwritten
    """
    numbers = pose.reshape(-1)
    n_beyond = np.int64(0)
    for n in range(len(numbers)):
        # Written so that NaN fails it.
        n_beyond += np.int64(not abs(numbers[n]) * scale <= MAX_DISTANCE)
    if n_beyond > 0:
        return False
    x0 = y0 = z0 = np.inf
    x1 = y1 = z1 = -np.inf
    for v in range(len(pose)):
        x, y, z = pose[v, 0], pose[v, 1], pose[v, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    x, y, z = 0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1)
    middle, vertices = work.middle, work.vertices
    middle[0], middle[1], middle[2] = x, y, z
    for v in range(len(pose)):
        vertices[v, 0] = (pose[v, 0] - x) * scale
        vertices[v, 1] = (pose[v, 1] - y) * scale
        vertices[v, 2] = (pose[v, 2] - z) * scale
    return True


@inlined
def _are_one_point(vertices, a, b, c):
    return (
        vertices[a, 0] == vertices[b, 0]
        and vertices[a, 0] == vertices[c, 0]
        and vertices[a, 1] == vertices[b, 1]
        and vertices[a, 1] == vertices[c, 1]
        and vertices[a, 2] == vertices[b, 2]
        and vertices[a, 2] == vertices[c, 2]
    )


@inlined
def _wider(lower, upper, enlarged):
    """Return the ends of an interval in float32, moved outwards by half of `enlarged` if any."""
    lower, upper = np.float32(lower), np.float32(upper)
    if enlarged > 0.0 and lower <= upper:
        # Rounding a place, and moving it, errs by 2^-24 of the numbers each.
        half = np.float32(0.5 * enlarged)
        half += (half + max(abs(lower), abs(upper))) * _OUTWARD
        lower, upper = lower - half, upper + half
    return lower, upper


@compiled_part
def _refit(scale, tolerance, enlarged, end, tree, work):
    """Fill the boxes of the nodes for one pose whose vertices are loaded.

    Boxes of faces that are at most `enlarged` apart, in normalised length, overlap. If there is a
    pose `end`, boxes hold the linear path of their faces to it. With neither, faces that are one
    point have empty boxes: they penetrate nothing, and many at one place would make many pairs.
    """
    middle, vertices, node_boxes = work.middle, work.vertices, work.node_boxes
    moves = len(end) > 0
    work.has_boxes[:] = False
    for node in range(len(tree.left) - 1, -1, -1):
        if tree.leaf[node] >= 0:
            leaf = tree.leaf[node]
            x0 = y0 = z0 = np.inf
            x1 = y1 = z1 = -np.inf
            for k in range(np.uint64(tree.start[leaf]), np.uint64(tree.start[leaf + 1])):
                v = np.uint64(tree.vertex[k])
                x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
                x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
                x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
                if moves:
                    x = (end[v, 0] - middle[0]) * scale
                    y = (end[v, 1] - middle[1]) * scale
                    z = (end[v, 2] - middle[2]) * scale
                    x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
                    x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
            if not moves and enlarged <= tolerance and x0 == x1 and y0 == y1 and z0 == z1:
                x0 = y0 = z0 = np.inf
                x1 = y1 = z1 = -np.inf
            node_boxes[node, 0], node_boxes[node, 3] = _wider(x0, x1, enlarged)
            node_boxes[node, 1], node_boxes[node, 4] = _wider(y0, y1, enlarged)
            node_boxes[node, 2], node_boxes[node, 5] = _wider(z0, z1, enlarged)
        else:
            a = tree.left[node]
            b = tree.right[node]
            for c in range(3):
                node_boxes[node, c] = min(node_boxes[a, c], node_boxes[b, c])
                node_boxes[node, 3 + c] = max(node_boxes[a, 3 + c], node_boxes[b, 3 + c])


@compiled_part
def _box_faces(leaf, scale, tolerance, enlarged, end, corners, work):
    """Fill the boxes of the faces of one leaf, as `_refit` those of the nodes.

    Most leaves are not visited in a search, so that they need none.
    """
    middle, vertices, boxes = work.middle, work.vertices, work.boxes
    moves = len(end) > 0
    for lane in range(LEAF_SIZE):
        first = leaf * 3 * LEAF_SIZE + lane
        one, two = corners[first], corners[first + LEAF_SIZE]
        three = corners[first + 2 * LEAF_SIZE]
        is_left_out = one < 0
        if not is_left_out and not moves and enlarged <= tolerance:
            is_left_out = _are_one_point(vertices, one, two, three)
        at = leaf * 6 * LEAF_SIZE + lane
        for c in range(3):
            lower, upper = np.inf, -np.inf
            if not is_left_out:
                for v in (one, two, three):
                    lower, upper = min(lower, vertices[v, c]), max(upper, vertices[v, c])
                    if moves:
                        place = (end[v, c] - middle[c]) * scale
                        lower, upper = min(lower, place), max(upper, place)
            boxes[at + c * LEAF_SIZE], boxes[at + (3 + c) * LEAF_SIZE] = _wider(
                lower, upper, enlarged
            )
    work.has_boxes[leaf] = True


@inlined
def _push(stack, n_waiting, a, b):
    stack[n_waiting, 0] = a
    stack[n_waiting, 1] = b
    return n_waiting + 1


@inlined
def is_uncounted(uncounted, a, b):
    """Whether two nodes share a table that says that no pair of faces below them can count."""
    level = uncounted.level[a]
    if level != uncounted.level[b]:
        return False
    column = uncounted.number[b]
    row = uncounted.start[level] + uncounted.number[a] * uncounted.stride[level]
    return (uncounted.bits[row + (column >> 3)] >> (column & 7)) & 1 != 0


@inlined
def _overlap(boxes, a, b):
    return (
        (boxes[a, 0] <= boxes[b, 3])
        & (boxes[b, 0] <= boxes[a, 3])
        & (boxes[a, 1] <= boxes[b, 4])
        & (boxes[b, 1] <= boxes[a, 4])
        & (boxes[a, 2] <= boxes[b, 5])
        & (boxes[b, 2] <= boxes[a, 5])
    )


@inlined
def is_candidate(corners, boxes, c, x, f0, f1, f2, x0, y0, z0, x1, y1, z1):
    """Return 1 if the boxes overlap and the faces share no vertex, else 0, without a branch."""
    n = _LEAF
    g0 = corners[c]
    g1 = corners[c + n]
    g2 = corners[c + n + n]
    return (
        np.int32(x0 <= boxes[x + np.uint64(3) * n])
        & np.int32(boxes[x] <= x1)
        & np.int32(y0 <= boxes[x + np.uint64(4) * n])
        & np.int32(boxes[x + n] <= y1)
        & np.int32(z0 <= boxes[x + np.uint64(5) * n])
        & np.int32(boxes[x + n + n] <= z1)
        & np.int32(f0 != g0)
        & np.int32(f0 != g1)
        & np.int32(f0 != g2)
        & np.int32(f1 != g0)
        & np.int32(f1 != g1)
        & np.int32(f1 != g2)
        & np.int32(f2 != g0)
        & np.int32(f2 != g1)
        & np.int32(f2 != g2)
    )


@compiled_part
def _is_listed(lists, number, wanted):
    """Whether list `number` has an entry `wanted`; false if there are no lists."""
    start, entry = lists
    if len(start) == 1:
        return False
    low = start[number]
    end = start[number + 1]
    high = end
    while low < high:
        probe = (low + high) // 2
        if entry[probe] < wanted:
            low = probe + 1
        else:
            high = probe
    return low < end and entry[low] == wanted


@compiled_part
def _have_common(lists, a, b):
    """Whether lists a and b, both short, have an entry in common; false if there are no lists."""
    start, entry = lists
    if len(start) == 1:
        return False
    i, j = start[a], start[b]
    while i < start[a + 1] and j < start[b + 1]:
        if entry[i] == entry[j]:
            return True
        if entry[i] < entry[j]:
            i += 1
        else:
            j += 1
    return False


@compiled_part
def rule_of(face_a, face_b, squared_depth, exclusions):
    """Return the first rule that excludes two faces, or `COUNTED`; `COINCIDENT` for depth 0."""
    if squared_depth == 0.0:
        return np.uint8(COINCIDENT)
    if len(exclusions.near.start) > 1:
        for i in range(3):
            for j in range(3):
                a, b = exclusions.corners[face_a, i], exclusions.corners[face_b, j]
                if _is_listed(exclusions.near, min(a, b), max(a, b)):
                    return np.uint8(NEAR)
    first = min(face_a, face_b)
    second = max(face_a, face_b)
    if _is_listed(exclusions.rest, first, second):
        return np.uint8(REST)
    one = other = np.int32(0)
    if len(exclusions.region) > 0:
        one, other = exclusions.region[first], exclusions.region[second]
        if exclusions.ignored[one, other]:
            return np.uint8(IGNORED)
    if squared_depth <= exclusions.squared_tolerance[one, other]:
        return np.uint8(TOLERATED)
    if _have_common(exclusions.joint, first, second):
        return np.uint8(JOINT)
    if _is_listed(exclusions.touching, first, second):
        return np.uint8(TOUCHING)
    if _is_listed(exclusions.shape, first, second):
        return np.uint8(SHAPE)
    return np.uint8(COUNTED)


@compiled
def find_rules(
    pairs: npt.NDArray[np.integer],
    squared_depth: FloatArray,
    exclusions: Exclusions,
    rule: npt.NDArray[np.uint8],
) -> None:
    """Fill in the first rule that excludes each pair of faces, or `COUNTED`.

    Parameters
    ----------
    pairs : (n, 2) face indices
    squared_depth : (n,) in normalised length squared
    rule : (n,), overwritten
    """
    for n in range(len(pairs)):
        rule[n] = rule_of(pairs[n, 0], pairs[n, 1], squared_depth[n], exclusions)


@inlined
def gather(corners, vertices, slot, pair, side):
    """Copy the corners of the face in a slot to one side of a pair."""
    base = slot // LEAF_SIZE * 3 * LEAF_SIZE + slot % LEAF_SIZE
    for k in range(3):
        v = corners[base + k * LEAF_SIZE]
        for c in range(3):
            pair[side, k, c] = vertices[v, c]


@compiled_part
def _search_leaves(
    corners,
    boxes,
    vertices,
    pair,
    leaf_a,
    leaf_b,
    box_b,
    tolerance,
    slots,
    squared_depths,
    n_found,
    with_apart,
    leaf_size,
):
    """Append the pairs that penetrate between two leaves, or within one.

    With `with_apart`, also append the other pairs whose boxes overlap, with depth 0. Return the
    number found so far.

    `leaf_size` is `LEAF_SIZE`, passed in because a loop of constant length is unrolled rather than
    vectorised. Arrays are passed one by one because every array of a tuple costs its reference
    count at every call.
    """
    corner_base = np.uint64(leaf_b) * _LEAF_CORNERS
    box_base = np.uint64(leaf_b) * _LEAF_BOXES
    for i in range(LEAF_SIZE):
        place_a = np.uint64(leaf_a) * _LEAF_BOXES + np.uint64(i)
        x0 = boxes[place_a]
        y0 = boxes[place_a + _LEAF]
        z0 = boxes[place_a + np.uint64(2) * _LEAF]
        x1 = boxes[place_a + np.uint64(3) * _LEAF]
        y1 = boxes[place_a + np.uint64(4) * _LEAF]
        z1 = boxes[place_a + np.uint64(5) * _LEAF]
        if not (
            (x0 <= box_b[3])
            & (box_b[0] <= x1)
            & (y0 <= box_b[4])
            & (box_b[1] <= y1)
            & (z0 <= box_b[5])
            & (box_b[2] <= z1)
        ):
            continue
        place_a = np.uint64(leaf_a) * _LEAF_CORNERS + np.uint64(i)
        f0 = corners[place_a]
        f1 = corners[place_a + _LEAF]
        f2 = corners[place_a + np.uint64(2) * _LEAF]
        # Nearly all rows hold only neighbours: test a whole row first, then its faces if needed.
        some = np.int32(0)
        for k in range(np.uint64(leaf_size)):
            c = corner_base + k
            x = box_base + k
            some |= is_candidate(corners, boxes, c, x, f0, f1, f2, x0, y0, z0, x1, y1, z1)
        if some == 0:
            continue
        slot_a = leaf_a * LEAF_SIZE + i
        for j in range(i + 1 if leaf_a == leaf_b else 0, LEAF_SIZE):
            c = corner_base + np.uint64(j)
            x = box_base + np.uint64(j)
            if is_candidate(corners, boxes, c, x, f0, f1, f2, x0, y0, z0, x1, y1, z1) == 0:
                continue
            slot_b = leaf_b * LEAF_SIZE + j
            gather(corners, vertices, slot_a, pair, 0)
            gather(corners, vertices, slot_b, pair, 1)
            squared_depth = pair_depth_squared(pair, 0, 1, tolerance)
            if squared_depth == 0.0 and not with_apart:
                continue
            slots[n_found, 0] = slot_a
            slots[n_found, 1] = slot_b
            squared_depths[n_found] = squared_depth
            n_found += 1
    return n_found


@compiled
def judge(tree: FaceTree, exclusions: Exclusions, found: PairBuffer, start: int, stop: int) -> bool:
    """Fill in the rules of the pairs from `start` to `stop`; return whether any of them counts."""
    some_count = False
    for n in range(start, stop):
        face_a = tree.slot_face[found.slots[n, 0]]
        face_b = tree.slot_face[found.slots[n, 1]]
        found.rule[n] = rule_of(face_a, face_b, found.squared_depth[n], exclusions)
        some_count |= found.rule[n] == COUNTED
    return some_count


@compiled
def drop_excluded(tree: FaceTree, exclusions: Exclusions, found: PairBuffer, n_found: int) -> int:
    """Drop pairs that do not penetrate and that a rule excludes; return the number left."""
    n_kept = 0
    for n in range(n_found):
        if found.squared_depth[n] == 0.0:
            face_a = tree.slot_face[found.slots[n, 0]]
            face_b = tree.slot_face[found.slots[n, 1]]
            if rule_of(face_a, face_b, np.inf, exclusions) != COUNTED:
                continue
        # By element: for rows Numba spends seconds compiling the message of a shape mismatch.
        found.slots[n_kept, 0] = found.slots[n, 0]
        found.slots[n_kept, 1] = found.slots[n, 1]
        found.squared_depth[n_kept] = found.squared_depth[n]
        n_kept += 1
    return n_kept


SLACK = 1e-6
"""Relative and normalised margin within which moving faces may meet."""


@compiled
def drop_out_of_reach(
    tree: FaceTree, vertices: FloatArray, moves: FloatArray, n_found: int, found: PairBuffer
) -> int:
    """Drop pairs of moving faces whose boxes are at first farther apart than their motion.

    The approach of two faces is at most the largest relative motion of two of their corners.

    Parameters
    ----------
    vertices, moves : (V, 3) at first and on the linear path, normalised
    n_found : number of pairs in `found`, which is overwritten without rules

    Returns
    -------
    n_kept : number of pairs left
    """
    pair, moved = np.empty((2, 3, 3)), np.empty((2, 3, 3))
    n_kept = 0
    for n in range(n_found):
        for side in range(2):
            gather(tree.corners, vertices, found.slots[n, side], pair, side)
            gather(tree.corners, moves, found.slots[n, side], moved, side)
        squared_reach = 0.0
        for i in range(3):
            for j in range(3):
                squared = 0.0
                for c in range(3):
                    squared += (moved[0, i, c] - moved[1, j, c]) ** 2
                squared_reach = max(squared_reach, squared)
        squared_gap = 0.0
        for c in range(3):
            low = min(pair[0, 0, c], min(pair[0, 1, c], pair[0, 2, c]))
            high = max(pair[0, 0, c], max(pair[0, 1, c], pair[0, 2, c]))
            other_low = min(pair[1, 0, c], min(pair[1, 1, c], pair[1, 2, c]))
            other_high = max(pair[1, 0, c], max(pair[1, 1, c], pair[1, 2, c]))
            squared_gap += max(other_low - high, low - other_high, 0.0) ** 2
        if squared_gap > (np.sqrt(squared_reach) * (1.0 + SLACK) + SLACK) ** 2:
            continue
        # By element, as in `drop_excluded`.
        found.slots[n_kept, 0] = found.slots[n, 0]
        found.slots[n_kept, 1] = found.slots[n, 1]
        n_kept += 1
    return n_kept


@compiled
def test_pairs(
    tolerance: float,
    tree: FaceTree,
    work: PoseWorkspace,
    slots: npt.NDArray[np.int32],
    with_apart: bool,
    found: PairBuffer,
) -> int:
    """Test known pairs in one pose and put those that penetrate into `found`.

    Parameters
    ----------
    tolerance, tree, work, found : as for `search_pose`, which would find them too
    slots : (n, 2) of the pairs
    with_apart : whether to put in the other pairs as well, with depth 0

    Returns
    -------
    n_found : number of pairs in `found`, without rules
    """
    n_found = 0
    for n in range(len(slots)):
        for side in range(2):
            gather(tree.corners, work.vertices, slots[n, side], work.pair, side)
        squared_depth = pair_depth_squared(work.pair, 0, 1, tolerance)
        if squared_depth > 0.0 or with_apart:
            found.slots[n_found, 0] = slots[n, 0]
            found.slots[n_found, 1] = slots[n, 1]
            found.squared_depth[n_found] = squared_depth
            n_found += 1
    return n_found


@compiled
def search_pose(
    scale: float,
    tolerance: float,
    tree: FaceTree,
    exclusions: Exclusions,
    uncounted: SkippableNodes,
    work: PoseWorkspace,
    first_only: bool,
    found: PairBuffer,
    enlarged: float,
    end: FloatArray,
    n_waiting: int,
    leaf_size: int,
) -> tuple[int, int]:
    """Find the pairs of faces that share no vertex and penetrate each other in one pose.

    Ends when `found` is full; called again with the `n_waiting` it returned, it continues there.

    Parameters
    ----------
    scale : factor from the pose's unit to normalised length
    tolerance : depth in normalised length up to which two faces touch rather than penetrate
    tree, exclusions, uncounted, work : of one topology; `work` holds the vertices that
        `load_vertices` has filled in, all else in it is overwritten. Pairs of faces below nodes
        that are `uncounted` are not found.
    first_only : end the search at the first leaves that have a pair that counts
    found : `PairBuffer` for at least `LEAF_SIZE`² pairs, overwritten
    enlarged : if above 0, also find the pairs that are at most this far apart, and some that are
        farther, with depth 0; then no rules are filled in and `first_only` has no effect
    end : (V, 3) of the pose that this one moves to, in its unit, or (0, 3); with it, pairs are
        found that come so near anywhere on the linear path there
    n_waiting : 0 to begin, else the value that the previous call returned
    leaf_size : `LEAF_SIZE`

    Returns
    -------
    n_found : number of pairs that this call has put into `found`
    n_waiting : number of pairs of nodes still to be visited, 0 at the end; `work.fraction` holds
        the estimated fraction of the search of each
    """
    boxes = work.node_boxes
    stack = work.stack
    fraction = work.fraction
    skips = len(uncounted.bits) > 0
    # With a plain 0, the search of leaves would be compiled twice.
    n_found: int = int(np.int64(0))
    if n_waiting == 0:
        _refit(scale, tolerance, enlarged, end, tree, work)
        n_waiting = _push(stack, 0, 0, 0)
        fraction[0] = 1.0
    while n_waiting > 0:
        n_waiting -= 1
        a = stack[n_waiting, 0]
        b = stack[n_waiting, 1]
        if skips and is_uncounted(uncounted, a, b):
            continue
        if tree.leaf[a] >= 0 and tree.leaf[b] >= 0:
            if n_found + LEAF_SIZE * LEAF_SIZE > len(found.slots):
                return n_found, n_waiting + 1
            for leaf in (tree.leaf[a], tree.leaf[b]):
                if not work.has_boxes[leaf]:
                    _box_faces(leaf, scale, tolerance, enlarged, end, tree.corners, work)
            n_before = n_found
            n_found = _search_leaves(
                tree.corners,
                work.boxes,
                work.vertices,
                work.pair,
                tree.leaf[a],
                tree.leaf[b],
                boxes[b],
                tolerance,
                found.slots,
                found.squared_depth,
                n_found,
                enlarged > 0.0,
                leaf_size,
            )
            if n_found > n_before and enlarged == 0.0:
                some_count = judge(tree, exclusions, found, n_before, n_found)
                if first_only and some_count:
                    return n_found, 0
            continue
        first = n_waiting
        part = fraction[first]
        if a == b:
            one, two = tree.left[a], tree.right[a]
            n_waiting = _push(stack, n_waiting, one, one)
            n_waiting = _push(stack, n_waiting, two, two)
            if _overlap(boxes, one, two):
                n_waiting = _push(stack, n_waiting, one, two)
        else:
            # Open the larger node of the two.
            if tree.leaf[b] < 0 and (tree.leaf[a] >= 0 or tree.size[a] < tree.size[b]):
                a, b = b, a
            for child in (tree.left[a], tree.right[a]):
                if _overlap(boxes, child, b):
                    n_waiting = _push(stack, n_waiting, child, b)
        for k in range(first, n_waiting):
            fraction[k] = part / (n_waiting - first)
    return n_found, 0


@compiled
def add_vertex_energy(
    tree: FaceTree, found: PairBuffer, n_found: int, vertex_energy: FloatArray
) -> None:
    """Add a sixth of each pair's squared depth to its six vertices: Algorithm 1 of the paper.

    Only pairs that count add energy. `vertex_energy` is (V,) float64, in normalised length squared.
    """
    for pair in range(n_found):
        if found.rule[pair] != COUNTED:
            continue
        energy = found.squared_depth[pair] / 6.0
        for side in range(2):
            slot = found.slots[pair, side]
            base = slot // LEAF_SIZE * 3 * LEAF_SIZE + slot % LEAF_SIZE
            for c in range(3):
                vertex_energy[tree.corners[base + c * LEAF_SIZE]] += energy


@compiled
def remember(
    found: PairBuffer,
    n_found: int,
    remembered: npt.NDArray[np.int32],
    n_remembered: npt.NDArray[np.int64],
) -> None:
    """Remember some of the pairs that count, evenly spaced, in place of the oldest.

    Parameters
    ----------
    remembered, n_remembered : as for `search_poses`
    """
    room, n_counted, last = len(remembered), 0, -1
    for pair in range(n_found):
        n_counted += found.rule[pair] == COUNTED
    share = min(1.0, room / 4.0 / max(n_counted, 1))
    n_counted = 0
    for pair in range(n_found):
        if found.rule[pair] != COUNTED:
            continue
        n_counted += 1
        if int(n_counted * share) == last:
            continue
        last = int(n_counted * share)
        is_new = True
        for k in range(min(n_remembered[0], room)):
            if (
                remembered[k, 0] == found.slots[pair, 0]
                and remembered[k, 1] == found.slots[pair, 1]
            ):
                is_new = False
        if is_new:
            place = n_remembered[0] % room
            remembered[place, 0] = found.slots[pair, 0]
            remembered[place, 1] = found.slots[pair, 1]
            n_remembered[0] += 1


@compiled_part
def _add_cell_energy(tree, found, n_found, folds, cells, cell_energy):
    """Add a sixth of each counted pair's squared depth to the cells of its six corners."""
    for pair in range(n_found):
        if found.rule[pair] != COUNTED:
            continue
        squared_depth = found.squared_depth[pair]
        face_a = tree.slot_face[found.slots[pair, 0]]
        face_b = tree.slot_face[found.slots[pair, 1]]
        row = np.int64(rule_of(face_a, face_b, squared_depth, folds) != COUNTED)
        for c in range(3):
            cell_energy[cells[row, folds.corners[face_a, c]]] += squared_depth / 6.0
            cell_energy[cells[row, folds.corners[face_b, c]]] += squared_depth / 6.0


@compiled
def search_poses(
    poses: FloatArray,
    scale: float,
    tolerance: float,
    tree: FaceTree,
    exclusions: Exclusions,
    uncounted: SkippableNodes,
    work: PoseWorkspace,
    first_only: bool,
    found: PairBuffer,
    leaf_size: int,
    remembered: npt.NDArray[np.int32],
    n_remembered: npt.NDArray[np.int64],
    n_by_rule: npt.NDArray[np.int64],
    vertex_energy: FloatArray,
    folds: Exclusions,
    cells: npt.NDArray[np.int32],
    cell_energy: FloatArray,
) -> int:
    """Search a block of poses in one call, without returning to the interpreter.

    Parameters
    ----------
    poses, scale : as for `load_vertices`, one after another
    others up to leaf_size : as for `search_pose`; `first_only` tests remembered pairs first
    remembered : (R, 2) int32, slots of pairs that counted in earlier poses; overwritten
    n_remembered : (1,) number of pairs remembered so far
    n_by_rule : (B, `N_KINDS`), numbers of pairs by rule, added to
    vertex_energy : (B, V), see `add_vertex_energy`, added to; (0, V) for none
    folds, cells : second rules, and (2, V) the cells of vertices in pairs that count by them, and
        in other pairs
    cell_energy : (B, C), added to; (0, C) for none

    Returns
    -------
    n_done : B, or the index of the pose that `load_vertices` refuses
    """
    nowhere = np.empty((0, 3))
    # Not a plain 0, as above.
    none = int(np.int64(0))
    for p in range(len(poses)):
        if not load_vertices(poses[p], scale, work):
            return p
        if first_only:
            n_known = min(n_remembered[0], len(remembered))
            n_found = test_pairs(tolerance, tree, work, remembered[:n_known], False, found)
            if judge(tree, exclusions, found, none, n_found):
                n_by_rule[p, COUNTED] = 1
                continue
        n_waiting = none
        while True:
            n_found, n_waiting = search_pose(
                scale,
                tolerance,
                tree,
                exclusions,
                uncounted,
                work,
                first_only,
                found,
                0.0,
                nowhere,
                n_waiting,
                leaf_size,
            )
            for pair in range(n_found):
                n_by_rule[p, found.rule[pair]] += 1
            if first_only:
                remember(found, n_found, remembered, n_remembered)
            if len(vertex_energy) > 0:
                add_vertex_energy(tree, found, n_found, vertex_energy[p])
            if len(cell_energy) > 0:
                _add_cell_energy(tree, found, n_found, folds, cells, cell_energy[p])
            if n_waiting == 0:
                break
    return len(poses)
