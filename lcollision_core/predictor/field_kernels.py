"""The compiled loops of `field`: forward and backward passes over every point of the body.

Array operations spend most of their time on passing temporary arrays through memory; these keep
a point's few numbers at hand. Sums over points run in a fixed order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_sums

Array = npt.NDArray[np.floating[Any]]
Number = np.floating[Any]

BEHIND, FADE = 0.07, 0.04
"""Heights behind a point's tangent plane at which others are not seen any more, so that the far
side of a limb is not, and over which they fade in."""

SMALLEST_SQUARED_ANGLE = 1e-12

REACHES = (0.07, 0.14)
"""Heights within which distant skin is felt."""

SUMS_A_REACH = 8
FULL, SOME = 0.3, 0.05
"""Sums of weights: one that fills half of the scale, and one that keeps means of nothing at 0."""

_COLUMNS_AT_ONCE = 512
"""Of a table, whose rows then stay in the first cache."""


@compiled
def products(latent: Array, tables: Array, blocks: npt.NDArray[np.int64], outputs: Array) -> None:
    """Fill in every group's codes times its table: (B, n)."""
    table = 0
    for group in range(len(blocks)):
        first, last, left, right = blocks[group]
        width = right - left
        for start in range(0, width, _COLUMNS_AT_ONCE):
            stop = min(start + _COLUMNS_AT_ONCE, width)
            for b in range(latent.shape[0]):
                out = outputs[b, left + start : left + stop]
                out[:] = 0.0
                for k in range(last - first):
                    code = latent[b, first + k]
                    row = tables[table + k * width + start : table + k * width + stop]
                    for n in range(len(out)):
                        out[n] += code * row[n]
        table += (last - first) * width


@compiled_sums
def products_backward(
    by_outputs: Array, tables: Array, blocks: npt.NDArray[np.int64], by_latent: Array
) -> None:
    """Pull derivatives by `products`' outputs back to the codes (B, D)."""
    table = 0
    for group in range(len(blocks)):
        first, last, left, right = blocks[group]
        width = right - left
        for k in range(last - first):
            row = tables[table + k * width : table + (k + 1) * width]
            for b in range(by_outputs.shape[0]):
                given = by_outputs[b, left:right]
                total = by_outputs.dtype.type(0.0)
                for n in range(width):
                    total += given[n] * row[n]
                by_latent[b, first + k] = total
        table += (last - first) * width


@compiled
def add_features(
    outputs: Array, target: npt.NDArray[np.int32], offset: Array, scale: Array, features: Array
) -> None:
    """Sum up each point's scaled outputs (B, n, 9) over the groups that move it: (B, P, 9)."""
    for b in range(outputs.shape[0]):
        features[b] = offset
        for n in range(outputs.shape[1]):
            given, out = outputs[b, n], features[b, target[n]]
            for c in range(9):
                out[c] += given[c] * scale[c]


@compiled
def add_features_backward(
    outputs: Array,
    target: npt.NDArray[np.int32],
    scale: Array,
    by_features: Array,
    by_inputs: Array,
) -> None:
    """Pull derivatives by `add_features`' features back to what the tanh was taken of."""
    one = outputs.dtype.type(1.0)
    for b in range(outputs.shape[0]):
        for n in range(outputs.shape[1]):
            for c in range(outputs.shape[2]):
                slope = one - outputs[b, n, c] * outputs[b, n, c]
                by_inputs[b, n, c] = by_features[b, target[n], c] * scale[c] * slope


@compiled
def deform(features: Array, rest_frame: Array, frame: Array, rows: Array) -> None:
    """Fill in gradients R S as rows (B, 3, Q, 3), and frames R F of the first points."""
    rotation = np.empty((3, 3), dtype=features.dtype)
    for b in range(features.shape[0]):
        for p in range(features.shape[1]):
            given = features[b, p]
            _rotate(given, rotation)
            if p < len(rest_frame):
                rest = rest_frame[p]
                for i in range(3):
                    x, y, z = rotation[i, 0], rotation[i, 1], rotation[i, 2]
                    for j in range(3):
                        frame[b, p, i, j] = x * rest[0, j] + y * rest[1, j] + z * rest[2, j]
            for i in range(3):
                x, y, z = rotation[i, 0], rotation[i, 1], rotation[i, 2]
                out = rows[b, i, p]
                out[0] = x * given[3] + y * given[4] + z * given[5]
                out[1] = x * given[4] + y * given[6] + z * given[7]
                out[2] = x * given[5] + y * given[7] + z * given[8]


@compiled
def deform_backward(
    features: Array, rest_frame: Array, by_frame: Array, by_rows: Array, by_features: Array
) -> None:
    """Pull derivatives by `deform`'s results back to its (B, Q, 9) features."""
    rotation = np.empty((3, 3), dtype=features.dtype)
    stretch = np.empty((3, 3), dtype=features.dtype)
    by_rotation = np.empty((3, 3), dtype=features.dtype)
    by_stretch = np.empty((3, 3), dtype=features.dtype)
    for b in range(features.shape[0]):
        for p in range(features.shape[1]):
            _rotate(features[b, p], rotation)
            _stretch(features[b, p], stretch)
            for i in range(3):
                for j in range(3):
                    turned = features.dtype.type(0.0)
                    stretched = features.dtype.type(0.0)
                    for k in range(3):
                        if p < len(rest_frame):
                            turned += by_frame[b, p, i, k] * rest_frame[p, j, k]
                        turned += by_rows[b, i, p, k] * stretch[j, k]
                        stretched += rotation[k, i] * by_rows[b, k, p, j]
                    by_rotation[i, j] = turned
                    by_stretch[i, j] = stretched
            _pull_rotation(features[b, p], by_rotation, by_features[b, p])
            by_features[b, p, 3] = by_stretch[0, 0]
            by_features[b, p, 4] = by_stretch[0, 1] + by_stretch[1, 0]
            by_features[b, p, 5] = by_stretch[0, 2] + by_stretch[2, 0]
            by_features[b, p, 6] = by_stretch[1, 1]
            by_features[b, p, 7] = by_stretch[1, 2] + by_stretch[2, 1]
            by_features[b, p, 8] = by_stretch[2, 2]


@compiled
def _rotate(w: Array, rotation: Array) -> None:
    """Write exp of a rotation vector, by Rodrigues' formula."""
    kind = w.dtype.type
    x, y, z = w[0], w[1], w[2]
    squared = x * x + y * y + z * z + kind(SMALLEST_SQUARED_ANGLE)
    angle = math.sqrt(squared)
    half = math.sin(kind(0.5) * angle)
    versine = kind(2.0) * half * half
    s, v, c = math.sin(angle) / angle, versine / squared, kind(1.0) - versine
    rotation[0, 0], rotation[1, 1], rotation[2, 2] = c + v * x * x, c + v * y * y, c + v * z * z
    rotation[0, 1], rotation[1, 0] = v * x * y - s * z, v * x * y + s * z
    rotation[0, 2], rotation[2, 0] = v * z * x + s * y, v * z * x - s * y
    rotation[1, 2], rotation[2, 1] = v * y * z - s * x, v * y * z + s * x


@compiled
def _stretch(features: Array, stretch: Array) -> None:
    """Write S of nine features."""
    stretch[0, 0], stretch[0, 1], stretch[0, 2] = features[3], features[4], features[5]
    stretch[1, 0], stretch[1, 1], stretch[1, 2] = features[4], features[6], features[7]
    stretch[2, 0], stretch[2, 1], stretch[2, 2] = features[5], features[7], features[8]


@compiled
def _pull_rotation(w: Array, by_rotation: Array, by_w: Array) -> None:
    """Pull a derivative by R = cos I + s [w] + v w w^T back to the rotation vector w."""
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2] + SMALLEST_SQUARED_ANGLE
    angle = math.sqrt(squared)
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    versine = 2.0 * half * half
    s, v = sine / angle, versine / squared
    # Derivatives of s and v by the angle.
    by_s = ((1.0 - versine) - s) / angle
    by_v = (sine - 2.0 * versine / angle) / squared
    trace, along, twice = 0.0, 0.0, 0.0
    for i in range(3):
        trace += by_rotation[i, i]
        j, k = (i + 1) % 3, (i + 2) % 3
        along += (by_rotation[k, j] - by_rotation[j, k]) * w[i]
        for m in range(3):
            twice += w[i] * by_rotation[i, m] * w[m]
    radial = (by_s * along + by_v * twice - sine * trace) / angle
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        total = radial * w[i] + s * (by_rotation[k, j] - by_rotation[j, k])
        for m in range(3):
            total += v * (by_rotation[i, m] + by_rotation[m, i]) * w[m]
        by_w[i] = total


@compiled_sums
def contact_field(frame: Array, places: Array, apart: Array, reach: Array, sums: Array) -> None:
    """Fill in the sums (P, B, 2, 8) of `field.contact_field`, for two reaches.

    Far points weigh 0 rather than being left out, and both reaches are summed up in one pass:
    without branches and lists, several points are added at a time, which is faster.
    """
    n_points = places.shape[2]
    kind = frame.dtype.type
    zero, one, two, three = kind(0.0), kind(1.0), kind(2.0), kind(3.0)
    behind, sharpness = kind(BEHIND), kind(1.0 / FADE)
    inner, outer = one / (reach[0] * reach[0]), one / (reach[1] * reach[1])
    normal = np.empty((3, n_points), dtype=frame.dtype)
    nx, ny, nz = normal[0], normal[1], normal[2]
    for b in range(frame.shape[0]):
        x, y, z = places[b, 0], places[b, 1], places[b, 2]
        for p in range(n_points):
            nx[p], ny[p], nz[p] = frame[b, p, 0, 0], frame[b, p, 1, 0], frame[b, p, 2, 0]
        for p in range(n_points):
            px, py, pz, own_x, own_y, own_z = x[p], y[p], z[p], nx[p], ny[p], nz[p]
            away = apart[p]
            # Sums with the inner reach, then with the outer one: of weights, heights, offsets and
            # normals. Local numbers, as only those stay in registers.
            w0, h0, x0, y0, z0, a0, b0, c0 = zero, zero, zero, zero, zero, zero, zero, zero
            w1, h1, x1, y1, z1, a1, b1, c1 = zero, zero, zero, zero, zero, zero, zero, zero
            for q in range(n_points):
                dx, dy, dz = x[q] - px, y[q] - py, z[q] - pz
                squared = dx * dx + dy * dy + dz * dz + away[q]
                s = (dx * own_x + dy * own_y + dz * own_z + behind) * sharpness
                s = s if s > zero else zero
                s = s if s < one else one
                facing = s * s * (three - two * s)
                above = dx * nx[q] + dy * ny[q] + dz * nz[q]
                t = one - squared * inner
                t = t if t > zero else zero
                weight = facing * t * t * t
                w0 += weight
                h0 -= weight * above
                x0 += weight * dx
                y0 += weight * dy
                z0 += weight * dz
                a0 += weight * nx[q]
                b0 += weight * ny[q]
                c0 += weight * nz[q]
                t = one - squared * outer
                t = t if t > zero else zero
                weight = facing * t * t * t
                w1 += weight
                h1 -= weight * above
                x1 += weight * dx
                y1 += weight * dy
                z1 += weight * dz
                a1 += weight * nx[q]
                b1 += weight * ny[q]
                c1 += weight * nz[q]
            f = frame[b, p]
            _write_sums(f, w0, h0, x0, y0, z0, a0, b0, c0, sums[p, b, 0])
            _write_sums(f, w1, h1, x1, y1, z1, a1, b1, c1, sums[p, b, 1])


@compiled
def _write_sums(
    frame: Array,
    weight: Number,
    height: Number,
    x: Number,
    y: Number,
    z: Number,
    normal_x: Number,
    normal_y: Number,
    normal_z: Number,
    out: Array,
) -> None:
    """Write a point's eight sums, vectors among them turned into its frame."""
    out[0], out[1] = weight, height
    for c in range(3):
        out[2 + c] = frame[0, c] * x + frame[1, c] * y + frame[2, c] * z
        out[5 + c] = frame[0, c] * normal_x + frame[1, c] * normal_y + frame[2, c] * normal_z


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
    sums: Array, reach: Array, by_inputs: Array, full: float, some: float, by_sums: Array
) -> None:
    """Pull derivatives by `normalised`'s inputs back to the sums."""
    for p in range(sums.shape[0]):
        for b in range(sums.shape[1]):
            for k in range(sums.shape[2]):
                own, given, out = sums[p, b, k], by_inputs[p, b, k], by_sums[p, b, k]
                share = 1.0 / (own[0] + some)
                by_weight = given[0] * full / (own[0] + full) ** 2
                for c in range(1, 8):
                    unit = reach[k] if c < 5 else 1.0
                    out[c] = given[c] * share / unit
                    by_weight -= out[c] * own[c] * share
                out[0] = by_weight


@compiled
def contact_field_backward(
    frame: Array,
    places: Array,
    apart: Array,
    reach: Array,
    by_sums: Array,
    by_frame: Array,
    by_places: Array,
) -> None:
    """Pull derivatives by `contact_field`'s sums back, adding to frames and places."""
    n_points, n_reaches = places.shape[2], len(reach)
    largest, inverse = reach[-1] * reach[-1], 1.0 / (reach * reach)
    squared = np.empty(n_points, dtype=frame.dtype)
    near = np.empty(n_points, dtype=np.int32)
    given = np.empty((n_reaches, 8), dtype=frame.dtype)
    total = np.empty((n_reaches, 6), dtype=frame.dtype)
    for b in range(frame.shape[0]):
        x, y, z = places[b, 0], places[b, 1], places[b, 2]
        for p in range(n_points):
            n_near = _near(places[b], apart[p], p, largest, squared, near)
            f, by_f = frame[b, p], by_frame[b, p]
            for k in range(n_reaches):
                # The offsets' and normals' derivatives, turned from the point's frame.
                by = by_sums[p, b, k]
                given[k, 0], given[k, 1] = by[0], by[1]
                for i in range(3):
                    given[k, 2 + i] = f[i, 0] * by[2] + f[i, 1] * by[3] + f[i, 2] * by[4]
                    given[k, 5 + i] = f[i, 0] * by[5] + f[i, 1] * by[6] + f[i, 2] * by[7]
            total[:] = 0.0
            for place in range(n_near):
                q = near[place]
                dx, dy, dz = x[q] - x[p], y[q] - y[p], z[q] - z[p]
                ahead = dx * f[0, 0] + dy * f[1, 0] + dz * f[2, 0]
                facing = _facing(ahead)
                if facing == 0.0:
                    continue
                qx, qy, qz = frame[b, q, 0, 0], frame[b, q, 1, 0], frame[b, q, 2, 0]
                above = -(dx * qx + dy * qy + dz * qz)
                by_facing, by_squared, by_above = 0.0, 0.0, 0.0
                by_x, by_y, by_z, by_qx, by_qy, by_qz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(n_reaches):
                    t = 1.0 - squared[q] * inverse[k]
                    if t <= 0.0:
                        continue
                    g, own = given[k], total[k]
                    cube = t * t * t
                    weight = facing * cube
                    by_weight = g[0] + g[1] * above + g[2] * dx + g[3] * dy + g[4] * dz
                    by_weight += g[5] * qx + g[6] * qy + g[7] * qz
                    by_x += weight * g[2]
                    by_y += weight * g[3]
                    by_z += weight * g[4]
                    by_qx += weight * g[5]
                    by_qy += weight * g[6]
                    by_qz += weight * g[7]
                    own[0] += weight * dx
                    own[1] += weight * dy
                    own[2] += weight * dz
                    own[3] += weight * qx
                    own[4] += weight * qy
                    own[5] += weight * qz
                    by_above += weight * g[1]
                    by_facing += by_weight * cube
                    by_squared -= by_weight * facing * 3.0 * t * t * inverse[k]
                by_ahead = by_facing * _facing_slope(ahead)
                by_frame[b, q, 0, 0] += by_qx - by_above * dx
                by_frame[b, q, 1, 0] += by_qy - by_above * dy
                by_frame[b, q, 2, 0] += by_qz - by_above * dz
                by_f[0, 0] += by_ahead * dx
                by_f[1, 0] += by_ahead * dy
                by_f[2, 0] += by_ahead * dz
                twice = 2.0 * by_squared
                by_x += twice * dx - by_above * qx + by_ahead * f[0, 0]
                by_y += twice * dy - by_above * qy + by_ahead * f[1, 0]
                by_z += twice * dz - by_above * qz + by_ahead * f[2, 0]
                by_places[b, 0, q] += by_x
                by_places[b, 1, q] += by_y
                by_places[b, 2, q] += by_z
                by_places[b, 0, p] -= by_x
                by_places[b, 1, p] -= by_y
                by_places[b, 2, p] -= by_z
            for k in range(n_reaches):
                # Of the turned sums by the rotation.
                by, own = by_sums[p, b, k], total[k]
                for i in range(3):
                    for c in range(3):
                        by_f[i, c] += own[i] * by[2 + c] + own[3 + i] * by[5 + c]


@compiled
def _near(
    places: Array,
    apart: Array,
    p: int,
    largest: float,
    squared: Array,
    near: npt.NDArray[np.int32],
) -> int:
    """Fill in p's squared distances to all points, and list those near it; return how many."""
    x, y, z = places[0], places[1], places[2]
    px, py, pz = x[p], y[p], z[p]
    for q in range(len(x)):
        dx, dy, dz = x[q] - px, y[q] - py, z[q] - pz
        squared[q] = dx * dx + dy * dy + dz * dz + apart[q]
    n_near = 0
    for q in range(len(x)):
        # Without a branch, which would be mispredicted.
        near[n_near] = q
        n_near += squared[q] < largest
    return n_near


@compiled
def _facing(ahead: float) -> float:
    """Return a smooth step of how far ahead along the normal another point is."""
    s = min(max((ahead + BEHIND) / FADE, 0.0), 1.0)
    return s * s * (3.0 - 2.0 * s)


@compiled
def _facing_slope(ahead: float) -> float:
    """Return the derivative of `_facing`."""
    s = min(max((ahead + BEHIND) / FADE, 0.0), 1.0)
    return 6.0 * s * (1.0 - s) / FADE


@compiled
def fold_view(frame: Array, rows: Array, members: npt.NDArray[np.int32], inputs: Array) -> None:
    """Fill in (S, B, 9 M): the members' gradients in the frame of each site's first member."""
    for b in range(frame.shape[0]):
        for s in range(members.shape[0]):
            f, out = frame[b, members[s, 0]], inputs[s, b]
            for m in range(members.shape[1]):
                vertex = members[s, m]
                for k in range(3):
                    for j in range(3):
                        out[9 * m + 3 * k + j] = (
                            f[0, k] * rows[b, 0, vertex, j]
                            + f[1, k] * rows[b, 1, vertex, j]
                            + f[2, k] * rows[b, 2, vertex, j]
                        )


@compiled
def fold_view_backward(
    frame: Array,
    rows: Array,
    members: npt.NDArray[np.int32],
    by_inputs: Array,
    by_frame: Array,
    by_rows: Array,
) -> None:
    """Pull derivatives by `fold_view`'s inputs back, adding to frames and gradients."""
    for b in range(frame.shape[0]):
        for s in range(members.shape[0]):
            centre, given = members[s, 0], by_inputs[s, b]
            f, by_f = frame[b, centre], by_frame[b, centre]
            for m in range(members.shape[1]):
                vertex = members[s, m]
                for i in range(3):
                    row, by_row = rows[b, i, vertex], by_rows[b, i, vertex]
                    for k in range(3):
                        g = given[9 * m + 3 * k : 9 * m + 3 * k + 3]
                        by_f[i, k] += g[0] * row[0] + g[1] * row[1] + g[2] * row[2]
                        for j in range(3):
                            by_row[j] += f[i, k] * g[j]
