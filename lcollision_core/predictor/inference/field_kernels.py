"""The compiled loops of `field`: what points feel of each other, forward and backward.

Several points are taken at a time, without branches: far ones weigh 0. Those are mostly left out
all the same: forward, a block of neighbours goes through the points near its box, side by side;
backward, where the others are added to as well, each point goes through the blocks that are near
its own. Sums over points run in a fixed order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_sums

Array = npt.NDArray[np.floating[Any]]
Number = np.floating[Any]

BEHIND, FADE = 0.07, 0.04
"""Heights behind a point's tangent plane at which others are not seen any more, so that the far
side of a limb is not, and over which they fade in."""

REACHES = (0.07, 0.14)
"""Heights within which distant skin is felt."""

SUMS_A_REACH = 8
FULL, SOME = 0.3, 0.05
"""Sums of weights: one that fills half of the scale, and one that keeps means of nothing at 0."""

BLOCK = 8
"""Neighbours that are taken, or left out, together."""


def by_blocks(apart: Array, order: npt.NDArray[np.int32]) -> Array:
    """Lay out which pairs are apart as the loops read it.

    Parameters
    ----------
    apart, order : (P, O) and (O,), as of `field.contact_field`; the same both ways

    Returns
    -------
    apart : (O / BLOCK, O, BLOCK) of each block, all points in order, and the block's
    """
    rows = apart[order]
    rows[len(apart) :] = 1.0
    return np.ascontiguousarray(rows.reshape(-1, BLOCK, len(order)).transpose(0, 2, 1))


@compiled_sums
def contact_field(
    frame: Array,
    places: Array,
    order: npt.NDArray[np.int32],
    apart: Array,
    steepness: Array,
    sums: Array,
) -> None:
    """Fill in the sums (P, B, 2, 8) of `field.contact_field`: a block's points side by side.

    Parameters
    ----------
    frame, places, order : as there
    apart : as `by_blocks` returns it
    steepness : (2,) one over the squared reaches; passed on, as loops that reorder sums would
        divide by what is inverted in them
    """
    n_points, n_ordered = places.shape[2], len(order)
    n_blocks = n_ordered // BLOCK
    # What compilers know to be `BLOCK` they write out, point by point.
    width = n_ordered // n_blocks
    ordered = np.empty((6, n_ordered), dtype=frame.dtype)
    boxes = np.empty((6, n_blocks), dtype=frame.dtype)
    gap = np.empty(n_points, dtype=frame.dtype)
    near = np.empty(n_points, dtype=np.uintp)
    lanes = np.empty(22 * BLOCK, dtype=frame.dtype)
    for b in range(frame.shape[0]):
        _order(frame[b], places[b], order, ordered, boxes)
        for own in range(n_blocks):
            first = BLOCK * own
            n_near = _find_near(own, ordered, boxes, steepness[1], gap, near)
            for i in range(BLOCK):
                for c in range(6):
                    lanes[BLOCK * c + i] = ordered[c, first + i]
            lanes[6 * BLOCK :] = frame.dtype.type(0.0)
            _feel(near[:n_near], ordered, apart[own], width, steepness, lanes)
            for i in range(min(BLOCK, n_points - first)):
                p = order[first + i]
                for k in range(2):
                    start = (6 + 8 * k) * BLOCK + i
                    sums[p, b, k, 0], sums[p, b, k, 1] = lanes[start], lanes[start + BLOCK]
                    # Offsets and normals turned into the point's frame.
                    for c in range(3):
                        f0, f1, f2 = frame[b, p, 0, c], frame[b, p, 1, c], frame[b, p, 2, c]
                        sums[p, b, k, 2 + c] = (
                            f0 * lanes[start + 2 * BLOCK]
                            + f1 * lanes[start + 3 * BLOCK]
                            + f2 * lanes[start + 4 * BLOCK]
                        )
                        sums[p, b, k, 5 + c] = (
                            f0 * lanes[start + 5 * BLOCK]
                            + f1 * lanes[start + 6 * BLOCK]
                            + f2 * lanes[start + 7 * BLOCK]
                        )


@compiled
def _find_near(
    own: int,
    ordered: Array,
    boxes: Array,
    steepness: Number,
    gap: Array,
    near: npt.NDArray[np.uintp],
) -> int:
    """List the points within reach of a block's box; returns how many there are."""
    zero, one = ordered.dtype.type(0.0), ordered.dtype.type(1.0)
    low_x, low_y, low_z = boxes[0, own], boxes[1, own], boxes[2, own]
    high_x, high_y, high_z = boxes[3, own], boxes[4, own], boxes[5, own]
    for q in range(len(gap)):
        x, y, z = ordered[0, q], ordered[1, q], ordered[2, q]
        dx = low_x - x if low_x - x > x - high_x else x - high_x
        dy = low_y - y if low_y - y > y - high_y else y - high_y
        dz = low_z - z if low_z - z > z - high_z else z - high_z
        dx = dx if dx > zero else zero
        dy = dy if dy > zero else zero
        dz = dz if dz > zero else zero
        gap[q] = (dx * dx + dy * dy + dz * dz) * steepness
    n_near = 0
    for q in range(len(gap)):
        # Without a branch, which would be mispredicted.
        near[n_near] = q
        n_near += gap[q] < one
    return n_near


@compiled_sums
def _feel(
    near: npt.NDArray[np.uintp],
    ordered: Array,
    apart: Array,
    width: int,
    steepness: Array,
    lanes: Array,
) -> None:
    """Add what a block's points feel of some others.

    Parameters
    ----------
    near : the others, of those in order
    apart : (O, BLOCK) of the block
    width : `BLOCK`
    lanes : (22 BLOCK,) of each of its points place and normal, then its sums with the inner reach,
        then with the outer one: of weights, heights, offsets and normals; in one array, or else
        compilers would not see that nothing overlaps
    """
    kind = ordered.dtype.type
    zero, one, two = kind(0.0), kind(1.0), kind(2.0)
    behind, sharpness = kind(BEHIND), kind(1.0 / FADE)
    inner, outer = steepness[0], steepness[1]
    for n in range(len(near)):
        q = near[n]
        x, y, z = ordered[0, q], ordered[1, q], ordered[2, q]
        nx, ny, nz = ordered[3, q], ordered[4, q], ordered[5, q]
        for i in range(width):
            dx, dy, dz = x - lanes[i], y - lanes[BLOCK + i], z - lanes[2 * BLOCK + i]
            squared = dx * dx + dy * dy + dz * dz + apart[q, i]
            ahead = (
                dx * lanes[3 * BLOCK + i] + dy * lanes[4 * BLOCK + i] + dz * lanes[5 * BLOCK + i]
            )
            s = (ahead + behind) * sharpness
            s = s if s > zero else zero
            rest = one - s
            rest = rest if rest > zero else zero
            facing = (one - rest) * (one - rest) * (one + two * rest)
            above = dx * nx + dy * ny + dz * nz
            t = one - squared * inner
            t = t if t > zero else zero
            weight = facing * t * t * t
            lanes[6 * BLOCK + i] += weight
            lanes[7 * BLOCK + i] -= weight * above
            lanes[8 * BLOCK + i] += weight * dx
            lanes[9 * BLOCK + i] += weight * dy
            lanes[10 * BLOCK + i] += weight * dz
            lanes[11 * BLOCK + i] += weight * nx
            lanes[12 * BLOCK + i] += weight * ny
            lanes[13 * BLOCK + i] += weight * nz
            t = one - squared * outer
            t = t if t > zero else zero
            weight = facing * t * t * t
            lanes[14 * BLOCK + i] += weight
            lanes[15 * BLOCK + i] -= weight * above
            lanes[16 * BLOCK + i] += weight * dx
            lanes[17 * BLOCK + i] += weight * dy
            lanes[18 * BLOCK + i] += weight * dz
            lanes[19 * BLOCK + i] += weight * nx
            lanes[20 * BLOCK + i] += weight * ny
            lanes[21 * BLOCK + i] += weight * nz


@compiled_sums
def contact_field_backward(
    frame: Array,
    places: Array,
    order: npt.NDArray[np.int32],
    apart: Array,
    steepness: Array,
    grad_sums: Array,
    grad_frame: Array,
    grad_places: Array,
) -> None:
    """Pull derivatives by `contact_field`'s sums back, adding to frames and places."""
    n_points, n_ordered = places.shape[2], len(order)
    kind = frame.dtype.type
    zero, one, two, three, six = kind(0.0), kind(1.0), kind(2.0), kind(3.0), kind(6.0)
    behind, sharpness = kind(BEHIND), kind(1.0 / FADE)
    inner, outer = steepness[0], steepness[1]
    ordered = np.empty((6, n_ordered), dtype=frame.dtype)
    by_ordered = np.empty((6, n_ordered), dtype=frame.dtype)
    boxes = np.empty((6, n_ordered // BLOCK), dtype=frame.dtype)
    near = np.empty(n_ordered // BLOCK, dtype=np.uintp)
    seen = np.empty((7, n_ordered), dtype=frame.dtype)
    by_seen = np.empty((6, n_ordered), dtype=frame.dtype)
    x, y, z, nx, ny, nz, away = seen[0], seen[1], seen[2], seen[3], seen[4], seen[5], seen[6]
    by_x, by_y, by_z = by_seen[0], by_seen[1], by_seen[2]
    by_nx, by_ny, by_nz = by_seen[3], by_seen[4], by_seen[5]
    given = np.empty((2, 8), dtype=frame.dtype)
    pairs = apart.reshape(-1)
    for b in range(frame.shape[0]):
        _order(frame[b], places[b], order, ordered, boxes)
        by_ordered[:] = zero
        for place in range(n_points):
            if place % BLOCK == 0:
                n_seen = _see(place // BLOCK, ordered, boxes, outer, near, seen)
                by_seen[:, :n_seen] = zero
            p = order[place]
            _copy_blocks(pairs, BLOCK * place, n_ordered, near, n_seen, away)
            px, py, pz = ordered[0, place], ordered[1, place], ordered[2, place]
            own_x, own_y, own_z = ordered[3, place], ordered[4, place], ordered[5, place]
            _turn_back(frame[b, p], grad_sums[p, b], given)
            w0, h0, x0, y0 = given[0, 0], given[0, 1], given[0, 2], given[0, 3]
            z0, a0, b0, c0 = given[0, 4], given[0, 5], given[0, 6], given[0, 7]
            w1, h1, x1, y1 = given[1, 0], given[1, 1], given[1, 2], given[1, 3]
            z1, a1, b1, c1 = given[1, 4], given[1, 5], given[1, 6], given[1, 7]
            # By the point's place and normal, and the sums that its frame turned.
            at_x, at_y, at_z, own_a, own_b, own_c = zero, zero, zero, zero, zero, zero
            dx0, dy0, dz0, nx0, ny0, nz0 = zero, zero, zero, zero, zero, zero
            dx1, dy1, dz1, nx1, ny1, nz1 = zero, zero, zero, zero, zero, zero
            for q in range(n_seen):
                dx, dy, dz = x[q] - px, y[q] - py, z[q] - pz
                qx, qy, qz = nx[q], ny[q], nz[q]
                squared = dx * dx + dy * dy + dz * dz + away[q]
                s = (dx * own_x + dy * own_y + dz * own_z + behind) * sharpness
                s = s if s > zero else zero
                s = s if s < one else one
                facing = s * s * (three - two * s)
                above = dx * qx + dy * qy + dz * qz
                t = one - squared * inner
                t = t if t > zero else zero
                cube = t * t * t
                weight = facing * cube
                grad_weight = w0 - h0 * above + x0 * dx + y0 * dy + z0 * dz
                grad_weight += a0 * qx + b0 * qy + c0 * qz
                by_facing = grad_weight * cube
                by_squared = grad_weight * t * t * inner
                by_above = weight * h0
                by_dx, by_dy, by_dz = weight * x0, weight * y0, weight * z0
                by_qx, by_qy, by_qz = weight * a0, weight * b0, weight * c0
                dx0 += weight * dx
                dy0 += weight * dy
                dz0 += weight * dz
                nx0 += weight * qx
                ny0 += weight * qy
                nz0 += weight * qz
                t = one - squared * outer
                t = t if t > zero else zero
                cube = t * t * t
                weight = facing * cube
                grad_weight = w1 - h1 * above + x1 * dx + y1 * dy + z1 * dz
                grad_weight += a1 * qx + b1 * qy + c1 * qz
                by_facing += grad_weight * cube
                by_squared += grad_weight * t * t * outer
                by_above += weight * h1
                by_dx += weight * x1
                by_dy += weight * y1
                by_dz += weight * z1
                by_qx += weight * a1
                by_qy += weight * b1
                by_qz += weight * c1
                dx1 += weight * dx
                dy1 += weight * dy
                dz1 += weight * dz
                nx1 += weight * qx
                ny1 += weight * qy
                nz1 += weight * qz
                # Of t cubed; and the slope of the smooth step.
                twice = -six * facing * by_squared
                by_ahead = by_facing * six * s * (one - s) * sharpness
                by_dx += twice * dx - by_above * qx + by_ahead * own_x
                by_dy += twice * dy - by_above * qy + by_ahead * own_y
                by_dz += twice * dz - by_above * qz + by_ahead * own_z
                at_x -= by_dx
                at_y -= by_dy
                at_z -= by_dz
                own_a += by_ahead * dx
                own_b += by_ahead * dy
                own_c += by_ahead * dz
                by_x[q] += by_dx
                by_y[q] += by_dy
                by_z[q] += by_dz
                by_nx[q] += by_qx - by_above * dx
                by_ny[q] += by_qy - by_above * dy
                by_nz[q] += by_qz - by_above * dz
            if place % BLOCK == BLOCK - 1 or place == n_points - 1:
                for n in range(n_seen // BLOCK):
                    start = np.intp(near[n])
                    for c in range(6):
                        for i in range(BLOCK):
                            by_ordered[c, start + i] += by_seen[c, BLOCK * n + i]
            grad_places[b, 0, p] += at_x
            grad_places[b, 1, p] += at_y
            grad_places[b, 2, p] += at_z
            by = grad_frame[b, p]
            by[0, 0] += own_a
            by[1, 0] += own_b
            by[2, 0] += own_c
            _add_turn(grad_sums[p, b, 0], dx0, dy0, dz0, nx0, ny0, nz0, by)
            _add_turn(grad_sums[p, b, 1], dx1, dy1, dz1, nx1, ny1, nz1, by)
        for i in range(n_ordered):
            q = order[i]
            for c in range(3):
                grad_places[b, c, q] += by_ordered[c, i]
                grad_frame[b, q, c, 0] += by_ordered[3 + c, i]


@compiled
def _order(
    frame: Array, places: Array, order: npt.NDArray[np.int32], ordered: Array, boxes: Array
) -> None:
    """Fill in places and normals in their order, and the box round each block: low and high."""
    for i in range(len(order)):
        q = order[i]
        for c in range(3):
            ordered[c, i] = places[c, q]
            ordered[3 + c, i] = frame[q, c, 0]
    for c in range(3):
        for k in range(boxes.shape[1]):
            low = high = ordered[c, BLOCK * k]
            for i in range(BLOCK * k + 1, BLOCK * k + BLOCK):
                low, high = min(low, ordered[c, i]), max(high, ordered[c, i])
            boxes[c, k], boxes[3 + c, k] = low, high


@compiled
def _see(
    own: int,
    ordered: Array,
    boxes: Array,
    outer: Number,
    near: npt.NDArray[np.uintp],
    seen: Array,
) -> int:
    """List where the blocks start that a block's points may feel, and copy them side by side.

    Returns how many points they have.
    """
    zero, one = ordered.dtype.type(0.0), ordered.dtype.type(1.0)
    n_near = 0
    for k in range(boxes.shape[1]):
        x = max(boxes[0, own] - boxes[3, k], boxes[0, k] - boxes[3, own], zero)
        y = max(boxes[1, own] - boxes[4, k], boxes[1, k] - boxes[4, own], zero)
        z = max(boxes[2, own] - boxes[5, k], boxes[2, k] - boxes[5, own], zero)
        # Without a branch, which would be mispredicted.
        near[n_near] = BLOCK * k
        n_near += (x * x + y * y + z * z) * outer < one
    for c in range(6):
        _copy_blocks(ordered[c], 0, 1, near, BLOCK * n_near, seen[c])
    return BLOCK * n_near


@compiled
def _copy_blocks(
    given: Array, start: int, times: int, near: npt.NDArray[np.uintp], n_seen: int, copy: Array
) -> None:
    """Copy blocks side by side, each in one piece, as a loop over its points would not.

    They begin at so many times their numbers after a start.
    """
    i1, i2, i3, i4 = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)
    i5, i6, i7 = np.uintp(5), np.uintp(6), np.uintp(7)
    for n in range(n_seen // BLOCK):
        i, j = np.uintp(start) + np.uintp(times) * near[n], np.uintp(BLOCK * n)
        # All are read before any is written.
        v0, v1, v2, v3 = given[i], given[i + i1], given[i + i2], given[i + i3]
        v4, v5, v6, v7 = given[i + i4], given[i + i5], given[i + i6], given[i + i7]
        copy[j], copy[j + i1], copy[j + i2], copy[j + i3] = v0, v1, v2, v3
        copy[j + i4], copy[j + i5], copy[j + i6], copy[j + i7] = v4, v5, v6, v7


@compiled
def _turn_back(frame: Array, grad_sums: Array, given: Array) -> None:
    """Turn the derivatives by a point's sums (2, 8) from its frame into the world."""
    for k in range(2):
        given[k, 0], given[k, 1] = grad_sums[k, 0], grad_sums[k, 1]
        for i in range(3):
            for start in (2, 5):
                given[k, start + i] = (
                    frame[i, 0] * grad_sums[k, start]
                    + frame[i, 1] * grad_sums[k, start + 1]
                    + frame[i, 2] * grad_sums[k, start + 2]
                )


@compiled
def _add_turn(
    grad_sums: Array,
    x: Number,
    y: Number,
    z: Number,
    normal_x: Number,
    normal_y: Number,
    normal_z: Number,
    grad_frame: Array,
) -> None:
    """Add derivatives by the frame that turned a point's offsets and normals."""
    for c in range(3):
        grad_offset, grad_normal = grad_sums[2 + c], grad_sums[5 + c]
        grad_frame[0, c] += x * grad_offset + normal_x * grad_normal
        grad_frame[1, c] += y * grad_offset + normal_y * grad_normal
        grad_frame[2, c] += z * grad_offset + normal_z * grad_normal


@compiled
def normalised(sums: Array, reach: Array, full: float, some: float, inputs: Array) -> None:
    """Fill in `field.normalised` of the sums (P, B, R, 8)."""
    kind = sums.dtype.type
    one = kind(1.0)
    for p in range(sums.shape[0]):
        for b in range(sums.shape[1]):
            for k in range(sums.shape[2]):
                own, out = sums[p, b, k], inputs[p, b, k]
                share = one / (own[0] + kind(some))
                out[0] = own[0] / (own[0] + kind(full))
                for c in range(1, 5):
                    out[c] = own[c] * share / reach[k]
                for c in range(5, 8):
                    out[c] = own[c] * share


@compiled
def normalised_backward(
    sums: Array, reach: Array, grad_inputs: Array, full: float, some: float, grad_sums: Array
) -> None:
    """Pull derivatives by `normalised`'s inputs back to the sums."""
    for p in range(sums.shape[0]):
        for b in range(sums.shape[1]):
            for k in range(sums.shape[2]):
                own, given, out = sums[p, b, k], grad_inputs[p, b, k], grad_sums[p, b, k]
                share = 1.0 / (own[0] + some)
                grad_weight = given[0] * full / (own[0] + full) ** 2
                for c in range(1, 8):
                    unit = reach[k] if c < 5 else 1.0
                    out[c] = given[c] * share / unit
                    grad_weight -= out[c] * own[c] * share
                out[0] = grad_weight
