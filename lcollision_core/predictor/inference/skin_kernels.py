"""The compiled loops from deformation features to the deformed skin, and back for derivatives.

Array operations spend most of their time on passing temporary arrays through memory; these keep
a point's few numbers at hand.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled

Array = npt.NDArray[np.floating[Any]]
Number = np.floating[Any]

SMALLEST_SQUARED_ANGLE = 1e-12


@compiled
def add_features(
    outputs: Array, target: npt.NDArray[np.int32], offset: Array, scale: Array, features: Array
) -> None:
    """Sum up each point's scaled outputs (B, T, 9) over the groups that move it: (B, Q, 9)."""
    for b in range(outputs.shape[0]):
        # Number by number: assigning arrays takes seconds to compile.
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
    """Pull derivatives by `add_features`' features back to what the tanh was taken of."""
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
            turn = _rotation(features[b, q], turns[:, b, q])
            stretch = _symmetric(features[b, q])
            for i in range(3):
                for j in range(3):
                    (r0, r1, r2), (s0, s1, s2) = turn[i], stretch[j]
                    rows[b, i, q, j] = r0 * s0 + r1 * s1 + r2 * s2
                    if q < len(rest_frame):
                        s0, s1, s2 = rest_frame[q, 0, j], rest_frame[q, 1, j], rest_frame[q, 2, j]
                        frame[b, q, i, j] = r0 * s0 + r1 * s1 + r2 * s2


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
            # By w: of R = c I + s [w] + v w w^T, and of s, v and c, which follow from |w|.
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


@compiled
def _rotation(features: Array, turn: Array) -> tuple[tuple[Number, ...], ...]:
    """Return the rows of the rotation about w, see `rodrigues`."""
    x, y, z = features[0], features[1], features[2]
    s, v, c = turn[0], turn[1], turn[2]
    xy, yz, zx = v * x * y, v * y * z, v * z * x
    return (
        (c + v * x * x, xy - s * z, zx + s * y),
        (xy + s * z, c + v * y * y, yz - s * x),
        (zx - s * y, yz + s * x, c + v * z * z),
    )


@compiled
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
            q = members[s, 0]
            for i in range(3):
                f0, f1, f2 = frame[b, q, 0, i], frame[b, q, 1, i], frame[b, q, 2, i]
                for m in range(members.shape[1]):
                    p = members[s, m]
                    for j in range(3):
                        inputs[s, b, 9 * m + 3 * i + j] = (
                            f0 * rows[b, 0, p, j] + f1 * rows[b, 1, p, j] + f2 * rows[b, 2, p, j]
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
    """Pull derivatives by `fold_view`'s inputs back, adding to frames and gradients."""
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
