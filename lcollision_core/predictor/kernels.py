"""The compiled loops of the predictor's network: field, skin and layers.

Several points are processed at a time, without branches: far ones have weight 0. Most of these are
skipped: in the forward pass, a block of neighbours loops over the points near its box, in parallel
lanes; in the backward pass, which adds to the other points too, each point loops over the blocks
near its own. Sums over points run in a fixed order.

Array operations spend most of their time on passing temporary arrays through memory; these loops
keep a point's few numbers in registers.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part, compiled_sums, inlined

Array = npt.NDArray[np.floating[Any]]
Number = np.floating[Any]

BEHIND, FADE = 0.07, 0.04
"""Normalised distance behind a point's tangent plane beyond which others have weight 0, so that the
far side of a limb does not count, and the distance over which their weight rises."""

RADII = (0.07, 0.14)
"""Normalised distances within which distant skin counts."""

UNITS = np.array([[1.0, *[1.0 / radius] * 4, 1.0, 1.0, 1.0] for radius in RADII])
"""(2, 8) factors of the sums for each radius: heights and offsets are in radii."""

STEEPNESS = (RADII[0] ** -2, RADII[1] ** -2)
"""Computed here: loops that may reorder operations would divide instead."""

FULL, SOME = 0.3, 0.05
"""Sums of weights: the one at half of the scale, and one that keeps empty means at 0."""

BLOCK = 8
"""Number of neighbouring points that are processed, or skipped, together."""


def in_blocks(
    geodesic_neighbours: npt.NDArray[np.float32], order: npt.NDArray[np.int32]
) -> npt.NDArray[np.float32]:
    """Arrange the table of neighbours along the surface in the order in which the loops read it.

    Parameters
    ----------
    geodesic_neighbours, order : (P, P) and (O,) of `SkinGeometry`

    Returns
    -------
    blocks : (O / BLOCK, O, BLOCK), for each block all points in order by the block's points; 1 also
        for points that are repeated in the order
    """
    rows = geodesic_neighbours[np.ix_(order, order)]
    rows[len(geodesic_neighbours) :] = rows[:, len(geodesic_neighbours) :] = 1.0
    return np.ascontiguousarray(rows.reshape(-1, BLOCK, len(order)).transpose(0, 2, 1))


@compiled_sums
def contact_field(
    frame: Array,
    positions: Array,
    order: npt.NDArray[np.int32],
    neighbours: Array,
    field: Array,
) -> None:
    """Fill in the field (P, B, 2, 8) of `geometric_network.ContactField`, block by block.

    Parameters
    ----------
    frame, positions : (B, N, 3, 3), orthonormal, and (B, 3, P), as for `ContactField`
    order : (O,) of `SkinGeometry`
    neighbours : from `in_blocks`
    """
    n_points, n_ordered = positions.shape[2], len(order)
    n_blocks = n_ordered // BLOCK
    # If the compiler knew that the width is `BLOCK`, it would unroll loops point by point.
    width = n_ordered // n_blocks
    dtype = frame.dtype.type
    ordered = np.empty((6, n_ordered), dtype=frame.dtype)
    boxes = np.empty((6, n_blocks), dtype=frame.dtype)
    gap = np.empty(n_points, dtype=frame.dtype)
    near = np.empty(n_points, dtype=np.uintp)
    lanes = np.empty(22 * BLOCK, dtype=frame.dtype)
    for b in range(frame.shape[0]):
        _order(frame[b], positions[b], order, ordered, boxes)
        for own in range(n_blocks):
            first = BLOCK * own
            n_near = _find_near(own, ordered, boxes, gap, near)
            for i in range(BLOCK):
                for c in range(6):
                    lanes[BLOCK * c + i] = ordered[c, first + i]
            lanes[6 * BLOCK :] = dtype(0.0)
            _add_near(near[:n_near], ordered, neighbours[own], width, lanes)
            for i in range(min(BLOCK, n_points - first)):
                p = order[first + i]
                for k in range(2):
                    sums = lanes[(6 + 8 * k) * BLOCK + i :: BLOCK]
                    take_means(sums, frame[b, p], dtype(1.0 / RADII[k]), field[p, b, k])


@inlined
def take_means(sums: Array, frame: Array, per_length: Number, features: Array) -> None:
    """Fill in a point's (8,) features for one radius, of which `per_length` is the inverse.

    Parameters
    ----------
    sums : (8,) of weights, heights, offsets (3) and normals (3), in world axes
    frame : (3, 3) of the point
    """
    dtype = frame.dtype.type
    inverse = dtype(1.0) / (sums[0] + dtype(SOME))
    features[0] = sums[0] / (sums[0] + dtype(FULL))
    features[1] = sums[1] * inverse * per_length
    for c in range(3):
        f0, f1, f2 = frame[0, c], frame[1, c], frame[2, c]
        features[2 + c] = (f0 * sums[2] + f1 * sums[3] + f2 * sums[4]) * inverse * per_length
        features[5 + c] = (f0 * sums[5] + f1 * sums[6] + f2 * sums[7]) * inverse


@compiled_part
def _find_near(
    own: int,
    ordered: Array,
    boxes: Array,
    gap: Array,
    near: npt.NDArray[np.uintp],
) -> int:
    """List the points within the outer radius of a block's box; return their number."""
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
        gap[q] = (dx * dx + dy * dy + dz * dz) * ordered.dtype.type(STEEPNESS[1])
    n_near = 0
    for q in range(len(gap)):
        # Without a branch, which would be mispredicted.
        near[n_near] = q
        n_near += gap[q] < one
    return n_near


@inlined
def pair_weights(squared: Any, ahead: Any, dtype: Any) -> Any:
    """Return a point's weights in another's field, with the inner and with the outer radius.

    Parameters
    ----------
    squared : distance between them
    ahead : signed distance of the point from the other's tangent plane
    dtype : of both
    """
    zero, one, two = dtype(0.0), dtype(1.0), dtype(2.0)
    s = (ahead + dtype(BEHIND)) * dtype(1.0 / FADE)
    s = s if s > zero else zero
    rest = one - s
    rest = rest if rest > zero else zero
    facing = (one - rest) * (one - rest) * (one + two * rest)
    t = one - squared * dtype(STEEPNESS[0])
    t = t if t > zero else zero
    u = one - squared * dtype(STEEPNESS[1])
    u = u if u > zero else zero
    return facing * t * t * t, facing * u * u * u


@compiled_sums
def _add_near(
    near: npt.NDArray[np.uintp],
    ordered: Array,
    neighbours: Array,
    width: int,
    lanes: Array,
) -> None:
    """Add the weighted sums over other points to a block's points.

    Parameters
    ----------
    near : the other points, as indices into the order
    neighbours : (O, BLOCK) of the block
    width : `BLOCK`
    lanes : (22 BLOCK,) for each of the block's points its position and normal, then its sums with
        the inner and with the outer radius: of weights, heights, offsets and normals; one array,
        as the compiler could not tell that several do not overlap
    """
    dtype = ordered.dtype.type
    for n in range(len(near)):
        q = near[n]
        x, y, z = ordered[0, q], ordered[1, q], ordered[2, q]
        nx, ny, nz = ordered[3, q], ordered[4, q], ordered[5, q]
        for i in range(width):
            dx, dy, dz = x - lanes[i], y - lanes[BLOCK + i], z - lanes[2 * BLOCK + i]
            squared = dx * dx + dy * dy + dz * dz + neighbours[q, i]
            ahead = (
                dx * lanes[3 * BLOCK + i] + dy * lanes[4 * BLOCK + i] + dz * lanes[5 * BLOCK + i]
            )
            weight, outer_weight = pair_weights(squared, ahead, dtype)
            above = dx * nx + dy * ny + dz * nz
            lanes[6 * BLOCK + i] += weight
            lanes[7 * BLOCK + i] -= weight * above
            lanes[8 * BLOCK + i] += weight * dx
            lanes[9 * BLOCK + i] += weight * dy
            lanes[10 * BLOCK + i] += weight * dz
            lanes[11 * BLOCK + i] += weight * nx
            lanes[12 * BLOCK + i] += weight * ny
            lanes[13 * BLOCK + i] += weight * nz
            lanes[14 * BLOCK + i] += outer_weight
            lanes[15 * BLOCK + i] -= outer_weight * above
            lanes[16 * BLOCK + i] += outer_weight * dx
            lanes[17 * BLOCK + i] += outer_weight * dy
            lanes[18 * BLOCK + i] += outer_weight * dz
            lanes[19 * BLOCK + i] += outer_weight * nx
            lanes[20 * BLOCK + i] += outer_weight * ny
            lanes[21 * BLOCK + i] += outer_weight * nz


@compiled_sums
def contact_field_backward(
    frame: Array,
    positions: Array,
    order: npt.NDArray[np.int32],
    neighbours: Array,
    field: Array,
    grad_field: Array,
    grad_frame: Array,
    grad_positions: Array,
) -> None:
    """Pull derivatives by `contact_field`'s results back; add them to frames and positions."""
    n_points, n_ordered = positions.shape[2], len(order)
    dtype = frame.dtype.type
    zero, one, two, three, six = dtype(0.0), dtype(1.0), dtype(2.0), dtype(3.0), dtype(6.0)
    behind, sharpness = dtype(BEHIND), dtype(1.0 / FADE)
    steepness = (dtype(STEEPNESS[0]), dtype(STEEPNESS[1]))
    ordered = np.empty((6, n_ordered), dtype=frame.dtype)
    grad_ordered = np.empty((6, n_ordered), dtype=frame.dtype)
    boxes = np.empty((6, n_ordered // BLOCK), dtype=frame.dtype)
    near = np.empty(n_ordered // BLOCK, dtype=np.uintp)
    gathered = np.empty((7, n_ordered), dtype=frame.dtype)
    grad_gathered = np.empty((6, n_ordered), dtype=frame.dtype)
    x, y, z, nx = gathered[0], gathered[1], gathered[2], gathered[3]
    ny, nz, hidden = gathered[4], gathered[5], gathered[6]
    grad_x, grad_y, grad_z = grad_gathered[0], grad_gathered[1], grad_gathered[2]
    grad_nx, grad_ny, grad_nz = grad_gathered[3], grad_gathered[4], grad_gathered[5]
    given = np.empty((2, 8), dtype=frame.dtype)
    pairs = neighbours.reshape(-1)
    for b in range(frame.shape[0]):
        _order(frame[b], positions[b], order, ordered, boxes)
        grad_ordered[:] = zero
        for slot in range(n_points):
            if slot % BLOCK == 0:
                n_gathered = _gather(slot // BLOCK, ordered, boxes, steepness[1], near, gathered)
                grad_gathered[:, :n_gathered] = zero
            p = order[slot]
            _copy_blocks(pairs, BLOCK * slot, n_ordered, near, n_gathered, hidden)
            px, py, pz = ordered[0, slot], ordered[1, slot], ordered[2, slot]
            own_x, own_y, own_z = ordered[3, slot], ordered[4, slot], ordered[5, slot]
            _sums_backward(frame[b, p], field[p, b], grad_field[p, b], given, grad_frame[b, p])
            inner, outer = given[0], given[1]
            grad_sums = (
                (inner[0], inner[1], inner[2], inner[3], inner[4], inner[5], inner[6], inner[7]),
                (outer[0], outer[1], outer[2], outer[3], outer[4], outer[5], outer[6], outer[7]),
            )
            # Derivatives by the point's position and normal.
            at_x, at_y, at_z, own_a, own_b, own_c = zero, zero, zero, zero, zero, zero
            for q in range(n_gathered):
                dx, dy, dz = x[q] - px, y[q] - py, z[q] - pz
                qx, qy, qz = nx[q], ny[q], nz[q]
                squared = dx * dx + dy * dy + dz * dz + hidden[q]
                s = (dx * own_x + dy * own_y + dz * own_z + behind) * sharpness
                s = s if s > zero else zero
                s = s if s < one else one
                facing = s * s * (three - two * s)
                above = dx * qx + dy * qy + dz * qz
                grad_facing = grad_squared = grad_above = zero
                grad_dx = grad_dy = grad_dz = grad_qx = grad_qy = grad_qz = zero
                for k in range(2):
                    of_weight, of_height, of_x, of_y, of_z, of_nx, of_ny, of_nz = grad_sums[k]
                    t = one - squared * steepness[k]
                    t = t if t > zero else zero
                    cube = t * t * t
                    weight = facing * cube
                    grad_weight = of_weight - of_height * above + of_x * dx + of_y * dy
                    grad_weight += of_z * dz + of_nx * qx + of_ny * qy + of_nz * qz
                    grad_facing += grad_weight * cube
                    grad_squared += grad_weight * t * t * steepness[k]
                    grad_above += weight * of_height
                    grad_dx += weight * of_x
                    grad_dy += weight * of_y
                    grad_dz += weight * of_z
                    grad_qx += weight * of_nx
                    grad_qy += weight * of_ny
                    grad_qz += weight * of_nz
                # The derivative of t cubed, and that of the smooth step.
                radial = -six * facing * grad_squared
                grad_ahead = grad_facing * six * s * (one - s) * sharpness
                grad_dx += radial * dx - grad_above * qx + grad_ahead * own_x
                grad_dy += radial * dy - grad_above * qy + grad_ahead * own_y
                grad_dz += radial * dz - grad_above * qz + grad_ahead * own_z
                at_x -= grad_dx
                at_y -= grad_dy
                at_z -= grad_dz
                own_a += grad_ahead * dx
                own_b += grad_ahead * dy
                own_c += grad_ahead * dz
                grad_x[q] += grad_dx
                grad_y[q] += grad_dy
                grad_z[q] += grad_dz
                grad_nx[q] += grad_qx - grad_above * dx
                grad_ny[q] += grad_qy - grad_above * dy
                grad_nz[q] += grad_qz - grad_above * dz
            if slot % BLOCK == BLOCK - 1 or slot == n_points - 1:
                for n in range(n_gathered // BLOCK):
                    start = np.intp(near[n])
                    for c in range(6):
                        for i in range(BLOCK):
                            grad_ordered[c, start + i] += grad_gathered[c, BLOCK * n + i]
            grad_positions[b, 0, p] += at_x
            grad_positions[b, 1, p] += at_y
            grad_positions[b, 2, p] += at_z
            grad_frame[b, p, 0, 0] += own_a
            grad_frame[b, p, 1, 0] += own_b
            grad_frame[b, p, 2, 0] += own_c
        for i in range(n_ordered):
            q = order[i]
            for c in range(3):
                grad_positions[b, c, q] += grad_ordered[c, i]
                grad_frame[b, q, c, 0] += grad_ordered[3 + c, i]


@compiled_part
def _order(
    frame: Array, positions: Array, order: npt.NDArray[np.int32], ordered: Array, boxes: Array
) -> None:
    """Fill in positions and normals in order, and the low and high corner of each block's box."""
    for i in range(len(order)):
        q = order[i]
        for c in range(3):
            ordered[c, i] = positions[c, q]
            ordered[3 + c, i] = frame[q, c, 0]
    for c in range(3):
        for k in range(boxes.shape[1]):
            low = high = ordered[c, BLOCK * k]
            for i in range(BLOCK * k + 1, BLOCK * k + BLOCK):
                low, high = min(low, ordered[c, i]), max(high, ordered[c, i])
            boxes[c, k], boxes[3 + c, k] = low, high


@compiled_part
def _gather(
    own: int,
    ordered: Array,
    boxes: Array,
    outer: Number,
    near: npt.NDArray[np.uintp],
    gathered: Array,
) -> int:
    """List the starts of blocks that may be near a block's points, and copy them side by side.

    Return the number of their points.
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
    # Copying would be compiled once more for plain numbers.
    start, times = int(np.int64(0)), int(np.int64(1))
    for c in range(6):
        _copy_blocks(ordered[c], start, times, near, BLOCK * n_near, gathered[c])
    return BLOCK * n_near


@compiled_part
def _copy_blocks(
    given: Array, start: int, times: int, near: npt.NDArray[np.uintp], n_gathered: int, copy: Array
) -> None:
    """Copy blocks side by side, each at once, which a loop over its points would not do.

    Block n begins at `start` plus `times` times `near[n]`.
    """
    i1, i2, i3, i4 = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)
    i5, i6, i7 = np.uintp(5), np.uintp(6), np.uintp(7)
    for n in range(n_gathered // BLOCK):
        i, j = np.uintp(start) + np.uintp(times) * near[n], np.uintp(BLOCK * n)
        # Read all values before writing any.
        v0, v1, v2, v3 = given[i], given[i + i1], given[i + i2], given[i + i3]
        v4, v5, v6, v7 = given[i + i4], given[i + i5], given[i + i6], given[i + i7]
        copy[j], copy[j + i1], copy[j + i2], copy[j + i3] = v0, v1, v2, v3
        copy[j + i4], copy[j + i5], copy[j + i6], copy[j + i7] = v4, v5, v6, v7


@compiled_part
def _sums_backward(
    frame: Array, field: Array, grad_field: Array, grad_sums: Array, grad_frame: Array
) -> None:
    """Fill in derivatives by a point's sums (2, 8) in world axes; add those by its frame."""
    dtype = frame.dtype.type
    for k in range(2):
        weight = dtype(FULL) * field[k, 0] / (dtype(1.0) - field[k, 0])
        total = weight + dtype(SOME)
        grad_sums[k, 0] = grad_field[k, 0] * dtype(FULL) / (weight + dtype(FULL)) ** 2
        for c in range(1, 8):
            grad_sums[k, 0] -= grad_field[k, c] * field[k, c] / total
        grad_sums[k, 1] = grad_field[k, 1] * dtype(UNITS[k, 1]) / total
        for start in (2, 5):
            for i in range(3):
                # The frame is orthonormal: it turns the sums back to world axes.
                world = turned = dtype(0.0)
                for c in range(start, start + 3):
                    world += frame[i, c - start] * field[k, c]
                    turned += frame[i, c - start] * grad_field[k, c]
                grad_sums[k, start + i] = turned * dtype(UNITS[k, start]) / total
                for c in range(3):
                    grad_frame[i, c] += world * grad_field[k, start + c]


SingleArray = npt.NDArray[np.float32]

_LOG2_E = np.float32(1.0 / math.log(2.0))
_POWER = tuple(np.float32(math.log(2.0) ** n / math.factorial(n)) for n in range(6, -1, -1))
"""Taylor coefficients of 2^r, highest order first: accurate to single precision for |r| <= 1/2."""

_SMALL = 2**15
"""Size of an array up to which allocating it is cheap."""


class Workspace:
    """Large arrays that the next pass reuses: allocating memory costs as much as filling it."""

    def __init__(self) -> None:
        self._memory: dict[str, SingleArray] = {}

    def empty(self, name: str, *shape: int) -> SingleArray:
        """Return an uninitialised array, which may reuse memory."""
        size = math.prod(shape)
        if size < _SMALL:
            return np.empty(shape, dtype=np.float32)
        if name not in self._memory or self._memory[name].size < size:
            self._memory[name] = np.empty(size, dtype=np.float32)
        return self._memory[name][:size].reshape(shape)


class Workspaces:
    """Keeps up to two workspaces between passes, for two sizes of batches or two threads."""

    def __init__(self) -> None:
        self._spare: deque[Workspace] = deque(maxlen=2)

    @contextmanager
    def lent(self) -> Iterator[Workspace]:
        """Lend the workspace of an earlier pass, or a new one."""
        try:
            workspace = self._spare.pop()
        except IndexError:
            workspace = Workspace()
        yield workspace
        self._spare.append(workspace)


@compiled_sums
def add_and_silu(values: SingleArray, bias: SingleArray, outputs: SingleArray) -> None:
    """Add biases (n, m) to (n, B, m) values in place, and fill in x sigmoid(x) of the sums."""
    one = np.float32(1.0)
    for n in range(values.shape[0]):
        for b in range(values.shape[1]):
            for i in range(values.shape[2]):
                x = values[n, b, i] + bias[n, i]
                values[n, b, i] = x
                outputs[n, b, i] = x / (one + _exponential(-x))


@compiled_sums
def silu_backward(values: SingleArray, grad: SingleArray) -> None:
    """Turn derivatives by the outputs x sigmoid(x) into those by flat values x, in place."""
    one = np.float32(1.0)
    for n in range(len(values)):
        x = values[n]
        sigmoid = one / (one + _exponential(-x))
        grad[n] *= sigmoid * (one + x * (one - sigmoid))


@compiled_sums
def _exponential(x: np.float32) -> np.float32:
    """Return exp(x), with x clipped to +-87.3; unlike the library's, it is vectorised."""
    y = min(max(x * _LOG2_E, np.float32(-126.0)), np.float32(126.0))
    whole = np.floor(y + np.float32(0.5))
    rest = y - whole
    power = np.float32(0.0)
    for term in _POWER:
        power = power * rest + term
    # Build a power of two from its bits.
    return power * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)


SMALLEST_SQUARED_ANGLE = 1e-12


@compiled
def add_features(
    outputs: Array, target: npt.NDArray[np.int32], offset: Array, scale: Array, features: Array
) -> None:
    """Add up each point's scaled outputs (B, T, 9) over the groups that move it: (B, Q, 9)."""
    for b in range(outputs.shape[0]):
        # Element by element: assigning arrays takes seconds to compile.
        for q in range(features.shape[1]):
            for c in range(9):
                features[b, q, c] = offset[q, c]
        for n in range(outputs.shape[1]):
            for c in range(9):
                features[b, target[n], c] += outputs[b, n, c] * scale[c]


@compiled
def add_features_backward(
    outputs: Array,
    target: npt.NDArray[np.int32],
    scale: Array,
    grad_features: Array,
    grad_products: Array,
) -> None:
    """Pull derivatives by the features of `add_features` back to the arguments of tanh."""
    one = outputs.dtype.type(1.0)
    for b in range(outputs.shape[0]):
        for n in range(outputs.shape[1]):
            for c in range(9):
                slope = one - outputs[b, n, c] * outputs[b, n, c]
                grad_products[b, 9 * n + c] = grad_features[b, target[n], c] * scale[c] * slope


def rodrigues(features: Array) -> Array:
    """Return s, v and c of each rotation exp [w] = c I + s [w] + v w w^T, and |w|^2: (4, B, Q)."""
    turns = np.empty((4, *features.shape[:2]), dtype=features.dtype)
    s, v, c, squared = turns
    np.einsum("bqi,bqi->bq", features[..., :3], features[..., :3], out=squared)
    squared += SMALLEST_SQUARED_ANGLE
    half = np.sqrt(squared)
    half *= 0.5
    sine = np.sin(half)
    quotient = sine / half
    s[:] = quotient * np.cos(half)
    v[:] = 0.5 * np.square(quotient)
    c[:] = 1.0 - 2.0 * np.square(sine)
    return turns


@compiled
def deform(features: Array, turns: Array, rest_frame: Array, frame: Array, rows: Array) -> None:
    """Fill in gradients R S as rows (B, 3, Q, 3), and frames R F of the first points.

    Parameters
    ----------
    features : (B, Q, 9), log R and the upper triangle of S
    turns : of `rodrigues`
    rest_frame : (N, 3, 3) F
    frame : (B, N, 3, 3)
    rows : the gradients
    """
    for b in range(features.shape[0]):
        for q in range(features.shape[1]):
            deform_point(features[b, q], turns[:, b, q], rest_frame, q, frame[b], rows[b])


@inlined
def deform_point(
    features: Array, turn: Array, rest_frame: Array, q: int, frame: Array, rows: Array
) -> None:
    """Do `deform` for point q of one pose."""
    rotation, stretch = _rotation(features, turn), _symmetric(features)
    for i in range(3):
        for j in range(3):
            (r0, r1, r2), (s0, s1, s2) = rotation[i], stretch[j]
            rows[i, q, j] = r0 * s0 + r1 * s1 + r2 * s2
            if q < len(rest_frame):
                s0, s1, s2 = rest_frame[q, 0, j], rest_frame[q, 1, j], rest_frame[q, 2, j]
                frame[q, i, j] = r0 * s0 + r1 * s1 + r2 * s2


@compiled
def deform_backward(
    features: Array,
    turns: Array,
    rest_frame: Array,
    grad_frame: Array,
    grad_rows: Array,
    grad_features: Array,
) -> None:
    """Pull derivatives by `deform`'s results back to its (B, Q, 9) features."""
    two = features.dtype.type(2.0)
    grad_turn, grad_stretch = np.empty((3, 3), features.dtype), np.empty((3, 3), features.dtype)
    for b in range(features.shape[0]):
        for q in range(features.shape[1]):
            turn = _rotation(features[b, q], turns[:, b, q])
            stretch = _symmetric(features[b, q])
            for i in range(3):
                for k in range(3):
                    by_turn = by_stretch = features.dtype.type(0.0)
                    for j in range(3):
                        by_turn += grad_rows[b, i, q, j] * stretch[k][j]
                        by_stretch += turn[j][i] * grad_rows[b, j, q, k]
                        if q < len(rest_frame):
                            by_turn += grad_frame[b, q, i, j] * rest_frame[q, k, j]
                    grad_turn[i, k], grad_stretch[i, k] = by_turn, by_stretch
            grad = grad_features[b, q]
            grad[3], grad[6], grad[8] = grad_stretch[0, 0], grad_stretch[1, 1], grad_stretch[2, 2]
            grad[4] = grad_stretch[0, 1] + grad_stretch[1, 0]
            grad[5] = grad_stretch[0, 2] + grad_stretch[2, 0]
            grad[7] = grad_stretch[1, 2] + grad_stretch[2, 1]
            # Derivative by w of R = c I + s [w] + v w w^T, where s, v and c depend on |w|.
            x, y, z = features[b, q, 0], features[b, q, 1], features[b, q, 2]
            s, v, c, squared = turns[0, b, q], turns[1, b, q], turns[2, b, q], turns[3, b, q]
            g = grad_turn
            curl = g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]
            twice = (
                two * g[0, 0] * x + (g[0, 1] + g[1, 0]) * y + (g[0, 2] + g[2, 0]) * z,
                (g[0, 1] + g[1, 0]) * x + two * g[1, 1] * y + (g[1, 2] + g[2, 1]) * z,
                (g[0, 2] + g[2, 0]) * x + (g[1, 2] + g[2, 1]) * y + two * g[2, 2] * z,
            )
            along = curl[0] * x + curl[1] * y + curl[2] * z
            across = (twice[0] * x + twice[1] * y + twice[2] * z) / two
            radial = ((c - s) * along + (s - two * v) * across) / squared
            radial -= s * (g[0, 0] + g[1, 1] + g[2, 2])
            for i in range(3):
                grad[i] = radial * features[b, q, i] + s * curl[i] + v * twice[i]


@compiled_part
def _rotation(features: Array, turn: Array) -> tuple[tuple[Number, ...], ...]:
    """Return the rows of the rotation exp [w], see `rodrigues`."""
    x, y, z = features[0], features[1], features[2]
    s, v, c = turn[0], turn[1], turn[2]
    xy, yz, zx = v * x * y, v * y * z, v * z * x
    return (
        (c + v * x * x, xy - s * z, zx + s * y),
        (xy + s * z, c + v * y * y, yz - s * x),
        (zx - s * y, yz + s * x, c + v * z * z),
    )


@compiled_part
def _symmetric(features: Array) -> tuple[tuple[Number, ...], ...]:
    """Return the rows of S."""
    xx, xy, xz = features[3], features[4], features[5]
    yy, yz, zz = features[6], features[7], features[8]
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


@compiled
def fold_view(frame: Array, rows: Array, members: npt.NDArray[np.int32], inputs: Array) -> None:
    """Fill in (S, B, 9 M): the members' gradients in the frame of each site's first member."""
    for b in range(frame.shape[0]):
        for s in range(members.shape[0]):
            view_site(frame[b], rows[b], members[s], inputs[s, b])


@inlined
def view_site(frame: Array, rows: Array, members: npt.NDArray[np.int32], inputs: Array) -> None:
    """Fill in the (9 M,) inputs of a site of one pose, see `fold_view`."""
    q = members[0]
    for i in range(3):
        f0, f1, f2 = frame[q, 0, i], frame[q, 1, i], frame[q, 2, i]
        for m in range(len(members)):
            p = members[m]
            for j in range(3):
                inputs[9 * m + 3 * i + j] = (
                    f0 * rows[0, p, j] + f1 * rows[1, p, j] + f2 * rows[2, p, j]
                )


@compiled
def fold_view_backward(
    frame: Array,
    rows: Array,
    members: npt.NDArray[np.int32],
    grad_inputs: Array,
    grad_frame: Array,
    grad_rows: Array,
) -> None:
    """Pull derivatives by `fold_view`'s inputs back; add them to frames and gradients."""
    for b in range(frame.shape[0]):
        for s in range(members.shape[0]):
            q = members[s, 0]
            for c in range(3):
                f0, f1, f2 = frame[b, q, c, 0], frame[b, q, c, 1], frame[b, q, c, 2]
                total0 = total1 = total2 = frame.dtype.type(0.0)
                for m in range(members.shape[1]):
                    p = members[s, m]
                    for j in range(3):
                        row = rows[b, c, p, j]
                        given = grad_inputs[s, b, 9 * m + j : 9 * m + 9 : 3]
                        total0 += row * given[0]
                        total1 += row * given[1]
                        total2 += row * given[2]
                        grad_rows[b, c, p, j] += f0 * given[0] + f1 * given[1] + f2 * given[2]
                grad_frame[b, q, c, 0] += total0
                grad_frame[b, q, c, 1] += total1
                grad_frame[b, q, c, 2] += total2
