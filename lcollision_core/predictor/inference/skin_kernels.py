"""The compiled loops from latent codes to the deformed skin, and back again for derivatives.

Array operations spend most of their time on passing temporary arrays through memory; these keep
a point's few numbers at hand. Small matrices are written out: loops over them, and views of them,
take several times as long.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_sums

Array = npt.NDArray[np.floating[Any]]

SMALLEST_SQUARED_ANGLE = 1e-12

_COLUMNS_AT_ONCE = 512
"""Of a table, whose rows then stay in the first cache."""

_PI_HEAD, _PI_TAIL = 3.140625, 9.67653589793e-4
"""They sum up to pi; small multiples of the first are exact in single precision."""

_SINE = tuple((-1.0) ** n / math.factorial(2 * n + 1) for n in range(10, -1, -1))
_COSINE = tuple((-1.0) ** n / math.factorial(2 * n) for n in range(11, -1, -1))
"""Taylor's coefficients, the highest first: enough for double precision up to pi / 2."""


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
                out[:] = latent.dtype.type(0.0)
                # Four codes at a time, so that the outputs are touched less often.
                for k in range(first, last - 3, 4):
                    place = table + (k - first) * width + start
                    row0, row1 = tables[place:], tables[place + width :]
                    row2, row3 = tables[place + 2 * width :], tables[place + 3 * width :]
                    c0, c1 = latent[b, k], latent[b, k + 1]
                    c2, c3 = latent[b, k + 2], latent[b, k + 3]
                    for n in range(len(out)):
                        out[n] += c0 * row0[n] + c1 * row1[n] + c2 * row2[n] + c3 * row3[n]
                for k in range(last - (last - first) % 4, last):
                    place = table + (k - first) * width + start
                    code, row0 = latent[b, k], tables[place:]
                    for n in range(len(out)):
                        out[n] += code * row0[n]
        table += (last - first) * width


@compiled_sums
def products_backward(
    grad_outputs: Array, tables: Array, blocks: npt.NDArray[np.int64], grad_latent: Array
) -> None:
    """Pull derivatives by `products`' outputs back to the codes (B, D)."""
    table = 0
    for group in range(len(blocks)):
        first, last, left, right = blocks[group]
        width = right - left
        for k in range(last - first):
            row = tables[table + k * width : table + (k + 1) * width]
            for b in range(grad_outputs.shape[0]):
                given = grad_outputs[b, left:right]
                total = grad_outputs.dtype.type(0.0)
                for n in range(width):
                    total += given[n] * row[n]
                grad_latent[b, first + k] = total
        table += (last - first) * width


@compiled
def add_features(
    outputs: Array, target: npt.NDArray[np.int32], offset: Array, scale: Array, features: Array
) -> None:
    """Sum up each point's scaled outputs (B, n, 9) over the groups that move it: (B, P, 9)."""
    s0, s1, s2, s3, s4 = scale[0], scale[1], scale[2], scale[3], scale[4]
    s5, s6, s7, s8 = scale[5], scale[6], scale[7], scale[8]
    for b in range(outputs.shape[0]):
        # Number by number: assigning arrays takes seconds to compile.
        for q in range(features.shape[1]):
            for c in range(9):
                features[b, q, c] = offset[q, c]
        for n in range(outputs.shape[1]):
            p = target[n]
            # All are read before any is written, so that several are computed at a time.
            f0 = features[b, p, 0] + outputs[b, n, 0] * s0
            f1 = features[b, p, 1] + outputs[b, n, 1] * s1
            f2 = features[b, p, 2] + outputs[b, n, 2] * s2
            f3 = features[b, p, 3] + outputs[b, n, 3] * s3
            f4 = features[b, p, 4] + outputs[b, n, 4] * s4
            f5 = features[b, p, 5] + outputs[b, n, 5] * s5
            f6 = features[b, p, 6] + outputs[b, n, 6] * s6
            f7 = features[b, p, 7] + outputs[b, n, 7] * s7
            f8 = features[b, p, 8] + outputs[b, n, 8] * s8
            features[b, p, 0], features[b, p, 1], features[b, p, 2] = f0, f1, f2
            features[b, p, 3], features[b, p, 4], features[b, p, 5] = f3, f4, f5
            features[b, p, 6], features[b, p, 7], features[b, p, 8] = f6, f7, f8


@compiled
def add_features_backward(
    outputs: Array,
    target: npt.NDArray[np.int32],
    scale: Array,
    grad_features: Array,
    grad_inputs: Array,
) -> None:
    """Pull derivatives by `add_features`' features back to what the tanh was taken of."""
    one = outputs.dtype.type(1.0)
    for b in range(outputs.shape[0]):
        for n in range(outputs.shape[1]):
            p = target[n]
            for c in range(9):
                slope = one - outputs[b, n, c] * outputs[b, n, c]
                grad_inputs[b, n, c] = grad_features[b, p, c] * scale[c] * slope


@compiled
def deform(features: Array, rest_frame: Array, frame: Array, rows: Array) -> None:
    """Fill in gradients R S as rows (B, 3, Q, 3), and frames R F of the first points."""
    turns = np.empty((4, features.shape[1]), dtype=features.dtype)
    for b in range(features.shape[0]):
        _rodrigues(features[b], turns)
        for p in range(features.shape[1]):
            x, y, z = features[b, p, 0], features[b, p, 1], features[b, p, 2]
            turn = _rotation(x, y, z, turns[0, p], turns[1, p], turns[2, p])
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = turn
            if p < len(rest_frame):
                for j in range(3):
                    x, y, z = rest_frame[p, 0, j], rest_frame[p, 1, j], rest_frame[p, 2, j]
                    frame[b, p, 0, j] = r00 * x + r01 * y + r02 * z
                    frame[b, p, 1, j] = r10 * x + r11 * y + r12 * z
                    frame[b, p, 2, j] = r20 * x + r21 * y + r22 * z
            xx, xy, xz = features[b, p, 3], features[b, p, 4], features[b, p, 5]
            yy, yz, zz = features[b, p, 6], features[b, p, 7], features[b, p, 8]
            rows[b, 0, p, 0] = r00 * xx + r01 * xy + r02 * xz
            rows[b, 0, p, 1] = r00 * xy + r01 * yy + r02 * yz
            rows[b, 0, p, 2] = r00 * xz + r01 * yz + r02 * zz
            rows[b, 1, p, 0] = r10 * xx + r11 * xy + r12 * xz
            rows[b, 1, p, 1] = r10 * xy + r11 * yy + r12 * yz
            rows[b, 1, p, 2] = r10 * xz + r11 * yz + r12 * zz
            rows[b, 2, p, 0] = r20 * xx + r21 * xy + r22 * xz
            rows[b, 2, p, 1] = r20 * xy + r21 * yy + r22 * yz
            rows[b, 2, p, 2] = r20 * xz + r21 * yz + r22 * zz


@compiled
def deform_backward(
    features: Array, rest_frame: Array, grad_frame: Array, grad_rows: Array, grad_features: Array
) -> None:
    """Pull derivatives by `deform`'s results back to its (B, Q, 9) features."""
    turns = np.empty((4, features.shape[1]), dtype=features.dtype)
    two = features.dtype.type(2.0)
    for b in range(features.shape[0]):
        _rodrigues(features[b], turns)
        for p in range(features.shape[1]):
            x, y, z = features[b, p, 0], features[b, p, 1], features[b, p, 2]
            xx, xy, xz = features[b, p, 3], features[b, p, 4], features[b, p, 5]
            yy, yz, zz = features[b, p, 6], features[b, p, 7], features[b, p, 8]
            s, v, c, squared = turns[0, p], turns[1, p], turns[2, p], turns[3, p]
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(x, y, z, s, v, c)
            b00, b01, b02 = grad_rows[b, 0, p, 0], grad_rows[b, 0, p, 1], grad_rows[b, 0, p, 2]
            b10, b11, b12 = grad_rows[b, 1, p, 0], grad_rows[b, 1, p, 1], grad_rows[b, 1, p, 2]
            b20, b21, b22 = grad_rows[b, 2, p, 0], grad_rows[b, 2, p, 1], grad_rows[b, 2, p, 2]
            # By S: R^T times what is given, both of its halves.
            grad_features[b, p, 3] = r00 * b00 + r10 * b10 + r20 * b20
            grad_features[b, p, 4] = (
                (r00 * b01 + r10 * b11 + r20 * b21) + (r01 * b00 + r11 * b10 + r21 * b20)
            )  # fmt: skip
            grad_features[b, p, 5] = (
                (r00 * b02 + r10 * b12 + r20 * b22) + (r02 * b00 + r12 * b10 + r22 * b20)
            )  # fmt: skip
            grad_features[b, p, 6] = r01 * b01 + r11 * b11 + r21 * b21
            grad_features[b, p, 7] = (
                (r01 * b02 + r11 * b12 + r21 * b22) + (r02 * b01 + r12 * b11 + r22 * b21)
            )  # fmt: skip
            grad_features[b, p, 8] = r02 * b02 + r12 * b12 + r22 * b22
            # By R: what is given times S, and for the frames times F^T.
            g00, g01, g02 = _times_symmetric(b00, b01, b02, xx, xy, xz, yy, yz, zz)
            g10, g11, g12 = _times_symmetric(b10, b11, b12, xx, xy, xz, yy, yz, zz)
            g20, g21, g22 = _times_symmetric(b20, b21, b22, xx, xy, xz, yy, yz, zz)
            if p < len(rest_frame):
                for j in range(3):
                    e, f, g = rest_frame[p, 0, j], rest_frame[p, 1, j], rest_frame[p, 2, j]
                    first, second = grad_frame[b, p, 0, j], grad_frame[b, p, 1, j]
                    third = grad_frame[b, p, 2, j]
                    g00, g01, g02 = g00 + first * e, g01 + first * f, g02 + first * g
                    g10, g11, g12 = g10 + second * e, g11 + second * f, g12 + second * g
                    g20, g21, g22 = g20 + third * e, g21 + third * f, g22 + third * g
            # By w: of R = c I + s [w] + v w w^T, and of s, v and c, which follow from |w|.
            curl_x, curl_y, curl_z = g21 - g12, g02 - g20, g10 - g01
            twice_x = two * g00 * x + (g01 + g10) * y + (g02 + g20) * z
            twice_y = (g01 + g10) * x + two * g11 * y + (g12 + g21) * z
            twice_z = (g02 + g20) * x + (g12 + g21) * y + two * g22 * z
            along = curl_x * x + curl_y * y + curl_z * z
            across = (twice_x * x + twice_y * y + twice_z * z) / two
            radial = ((c - s) * along + (s - two * v) * across) / squared - s * (g00 + g11 + g22)
            grad_features[b, p, 0] = radial * x + s * curl_x + v * twice_x
            grad_features[b, p, 1] = radial * y + s * curl_y + v * twice_y
            grad_features[b, p, 2] = radial * z + s * curl_z + v * twice_z


@compiled
def _rodrigues(features: Array, turns: Array) -> None:
    """Fill in s, v and c of each rotation exp [w] = c I + s [w] + v w w^T, and |w|^2: (4, Q).

    By polynomials, of which several are computed at a time, as the library's sines are not.
    """
    kind = features.dtype.type
    n_points = features.shape[0]
    s, v, c, squared = turns[0], turns[1], turns[2], turns[3]
    # First v is half the angle less multiples of pi, s the quotient of its sine, c its cosine:
    # where that turns the sign of one, it turns the other's too.
    for p in range(n_points):
        x, y, z = features[p, 0], features[p, 1], features[p, 2]
        squared[p] = x * x + y * y + z * z + kind(SMALLEST_SQUARED_ANGLE)
        half = kind(0.5) * math.sqrt(squared[p])
        times = np.floor(half * kind(1.0 / math.pi) + kind(0.5))
        v[p] = half - times * kind(_PI_HEAD) - times * kind(_PI_TAIL)
        s[p] = c[p] = kind(0.0)
    for k in range(len(_SINE)):
        coefficient = kind(_SINE[k])
        for p in range(n_points):
            s[p] = s[p] * (v[p] * v[p]) + coefficient
    for k in range(len(_COSINE)):
        coefficient = kind(_COSINE[k])
        for p in range(n_points):
            c[p] = c[p] * (v[p] * v[p]) + coefficient
    for p in range(n_points):
        sine, cosine = s[p] * v[p], c[p]
        quotient = sine / (kind(0.5) * math.sqrt(squared[p]))
        s[p] = quotient * cosine
        v[p] = kind(0.5) * quotient * quotient
        c[p] = kind(1.0) - kind(2.0) * sine * sine


@compiled
def _rotation(x: float, y: float, z: float, s: float, v: float, c: float) -> tuple[float, ...]:
    """Return the rows of the rotation about w, see `_rodrigues`."""
    xy, yz, zx = v * x * y, v * y * z, v * z * x
    return (
        c + v * x * x, xy - s * z, zx + s * y,
        xy + s * z, c + v * y * y, yz - s * x,
        zx - s * y, yz + s * x, c + v * z * z,
    )  # fmt: skip


@compiled
def _times_symmetric(
    x: float, y: float, z: float, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float]:
    """Return a row times a symmetric matrix."""
    return x * xx + y * xy + z * xz, x * xy + y * yy + z * yz, x * xz + y * yz + z * zz


@compiled
def fold_view(frame: Array, rows: Array, members: npt.NDArray[np.int32], inputs: Array) -> None:
    """Fill in (S, B, 9 M): the members' gradients in the frame of each site's first member."""
    for b in range(frame.shape[0]):
        for s in range(members.shape[0]):
            q = members[s, 0]
            f00, f01, f02 = frame[b, q, 0, 0], frame[b, q, 0, 1], frame[b, q, 0, 2]
            f10, f11, f12 = frame[b, q, 1, 0], frame[b, q, 1, 1], frame[b, q, 1, 2]
            f20, f21, f22 = frame[b, q, 2, 0], frame[b, q, 2, 1], frame[b, q, 2, 2]
            for m in range(members.shape[1]):
                p = members[s, m]
                r00, r01, r02 = rows[b, 0, p, 0], rows[b, 0, p, 1], rows[b, 0, p, 2]
                r10, r11, r12 = rows[b, 1, p, 0], rows[b, 1, p, 1], rows[b, 1, p, 2]
                r20, r21, r22 = rows[b, 2, p, 0], rows[b, 2, p, 1], rows[b, 2, p, 2]
                out = inputs[s, b, 9 * m : 9 * m + 9]
                out[0] = f00 * r00 + f10 * r10 + f20 * r20
                out[1] = f00 * r01 + f10 * r11 + f20 * r21
                out[2] = f00 * r02 + f10 * r12 + f20 * r22
                out[3] = f01 * r00 + f11 * r10 + f21 * r20
                out[4] = f01 * r01 + f11 * r11 + f21 * r21
                out[5] = f01 * r02 + f11 * r12 + f21 * r22
                out[6] = f02 * r00 + f12 * r10 + f22 * r20
                out[7] = f02 * r01 + f12 * r11 + f22 * r21
                out[8] = f02 * r02 + f12 * r12 + f22 * r22


@compiled
def fold_view_backward(
    frame: Array,
    rows: Array,
    members: npt.NDArray[np.int32],
    grad_inputs: Array,
    grad_frame: Array,
    grad_rows: Array,
) -> None:
    """Pull derivatives by `fold_view`'s inputs back, adding to frames and gradients."""
    zero = frame.dtype.type(0.0)
    for b in range(frame.shape[0]):
        for s in range(members.shape[0]):
            q = members[s, 0]
            f00, f01, f02 = frame[b, q, 0, 0], frame[b, q, 0, 1], frame[b, q, 0, 2]
            f10, f11, f12 = frame[b, q, 1, 0], frame[b, q, 1, 1], frame[b, q, 1, 2]
            f20, f21, f22 = frame[b, q, 2, 0], frame[b, q, 2, 1], frame[b, q, 2, 2]
            b00, b01, b02, b10, b11, b12 = zero, zero, zero, zero, zero, zero
            b20, b21, b22 = zero, zero, zero
            for m in range(members.shape[1]):
                p = members[s, m]
                for j in range(3):
                    x, y, z = rows[b, 0, p, j], rows[b, 1, p, j], rows[b, 2, p, j]
                    first = grad_inputs[s, b, 9 * m + j]
                    second = grad_inputs[s, b, 9 * m + 3 + j]
                    third = grad_inputs[s, b, 9 * m + 6 + j]
                    b00, b01, b02 = b00 + x * first, b01 + x * second, b02 + x * third
                    b10, b11, b12 = b10 + y * first, b11 + y * second, b12 + y * third
                    b20, b21, b22 = b20 + z * first, b21 + z * second, b22 + z * third
                    grad_rows[b, 0, p, j] += f00 * first + f01 * second + f02 * third
                    grad_rows[b, 1, p, j] += f10 * first + f11 * second + f12 * third
                    grad_rows[b, 2, p, j] += f20 * first + f21 * second + f22 * third
            by = grad_frame[b, q]
            by[0, 0], by[0, 1], by[0, 2] = by[0, 0] + b00, by[0, 1] + b01, by[0, 2] + b02
            by[1, 0], by[1, 1], by[1, 2] = by[1, 0] + b10, by[1, 1] + b11, by[1, 2] + b12
            by[2, 0], by[2, 1], by[2, 2] = by[2, 0] + b20, by[2, 1] + b21, by[2, 2] + b22
