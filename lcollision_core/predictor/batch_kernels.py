"""The compiled loops from latent codes to the deformed skin, of many poses side by side.

What `skin_kernels` keeps point by point for each pose lies here with the poses last, so that a
processor's vector holds several poses. Every innermost loop runs over them and writes one row: it
is only then that compilers see that nothing overlaps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled

Array = npt.NDArray[np.float32]
Number = np.floating[Any]

_SMALLEST_SQUARED_ANGLE = np.float32(1e-12)
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1.0), np.float32(2.0)
_OVER_PI = np.float32(1.0 / math.pi)
_PI_HEAD, _PI_TAIL = np.float32(3.140625), np.float32(9.67653589793e-4)
"""They sum up to pi; small multiples of the first are exact in single precision."""

_SINE = tuple(np.float32((-1.0) ** n / math.factorial(2 * n + 1)) for n in range(6, -1, -1))
_COSINE = tuple(np.float32((-1.0) ** n / math.factorial(2 * n)) for n in range(7, -1, -1))
"""Taylor's coefficients, the highest first: enough for single precision up to pi / 2."""


@compiled
def add_features(
    outputs: Array, target: npt.NDArray[np.int32], scale: Array, features: Array
) -> None:
    """Add one group's scaled outputs (n, 9, B) to the features (Q, 9, B) of the points it moves."""
    for n in range(outputs.shape[0]):
        p = target[n]
        for c in range(9):
            for b in range(outputs.shape[2]):
                features[p, c, b] += outputs[n, c, b] * scale[c]


@compiled
def deform(
    features: Array, rest_frame: Array, rows: Array, turned: Array, places_frame: Array
) -> None:
    """Fill in gradients R S as rows, and frames R F of the first points.

    Parameters
    ----------
    features : (Q, 9, B)
    rest_frame : (N, 3, 3)
    rows : (3, Q, 3, B)
    turned : (N, 3, 3, B) the frames
    places_frame : (B, P, 3, 3) the first P of them again, pose by pose
    """
    n_rows = features.shape[2]
    # Each an array of its own: of rows of one, compilers would not see that they are apart.
    angle, s = np.empty(n_rows, dtype=np.float32), np.empty(n_rows, dtype=np.float32)
    v, c = np.empty(n_rows, dtype=np.float32), np.empty(n_rows, dtype=np.float32)
    turn = np.empty((3, 3, n_rows), dtype=np.float32)
    for p in range(features.shape[0]):
        for b in range(n_rows):
            x, y, z = features[p, 0, b], features[p, 1, b], features[p, 2, b]
            angle[b] = math.sqrt(x * x + y * y + z * z + _SMALLEST_SQUARED_ANGLE)
        _rodrigues(angle, s, v, c)
        for i in range(3):
            for b in range(n_rows):
                turn[i, i, b] = c[b] + v[b] * features[p, i, b] * features[p, i, b]
            j, k = (i + 1) % 3, (i + 2) % 3
            for b in range(n_rows):
                x, y, z = features[p, i, b], features[p, j, b], features[p, k, b]
                turn[i, j, b] = v[b] * x * y - s[b] * z
            for b in range(n_rows):
                x, y, z = features[p, i, b], features[p, j, b], features[p, k, b]
                turn[j, i, b] = v[b] * x * y + s[b] * z
        for i in range(3):
            # S is symmetric: 3 to 8 are its xx, xy, xz, yy, yz and zz.
            for j, (k0, k1, k2) in enumerate(((3, 4, 5), (4, 6, 7), (5, 7, 8))):
                for b in range(n_rows):
                    rows[i, p, j, b] = (
                        turn[i, 0, b] * features[p, k0, b]
                        + turn[i, 1, b] * features[p, k1, b]
                        + turn[i, 2, b] * features[p, k2, b]
                    )
        if p >= len(rest_frame):
            continue
        for i in range(3):
            for j in range(3):
                f0, f1, f2 = rest_frame[p, 0, j], rest_frame[p, 1, j], rest_frame[p, 2, j]
                for b in range(n_rows):
                    turned[p, i, j, b] = (
                        turn[i, 0, b] * f0 + turn[i, 1, b] * f1 + turn[i, 2, b] * f2
                    )
        if p < places_frame.shape[1]:
            for b in range(n_rows):
                for i in range(3):
                    for j in range(3):
                        places_frame[b, p, i, j] = turned[p, i, j, b]


@compiled
def _rodrigues(angle: Array, s: Array, v: Array, c: Array) -> None:
    """Fill in what makes rotations: exp [w] = c I + s [w] + v w w^T, of |w|."""
    for b in range(len(angle)):
        half = _HALF * angle[b]
        times = np.floor(half * _OVER_PI + _HALF)
        # Where that turns the sign of the sine, it turns the cosine's, too.
        rest = half - times * _PI_HEAD - times * _PI_TAIL
        squared = rest * rest
        sine, cosine = np.float32(0.0), np.float32(0.0)
        for term in _SINE:
            sine = sine * squared + term
        for term in _COSINE:
            cosine = cosine * squared + term
        sine *= rest
        quotient = sine / half
        s[b] = quotient * cosine
        v[b] = _HALF * quotient * quotient
        c[b] = _ONE - _TWO * sine * sine


@compiled
def fold_view(turned: Array, rows: Array, members: npt.NDArray[np.int32], inputs: Array) -> None:
    """Fill in (S, 9 M, B): the members' gradients in the frame of each site's first member."""
    for site in range(members.shape[0]):
        q = members[site, 0]
        for m in range(members.shape[1]):
            p = members[site, m]
            for i in range(3):
                for j in range(3):
                    n = 9 * m + 3 * i + j
                    for b in range(inputs.shape[2]):
                        inputs[site, n, b] = (
                            turned[q, 0, i, b] * rows[0, p, j, b]
                            + turned[q, 1, i, b] * rows[1, p, j, b]
                            + turned[q, 2, i, b] * rows[2, p, j, b]
                        )
