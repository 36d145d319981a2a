"""The rotations in 3 x 3 matrices: polar factors and quaternions."""

from __future__ import annotations

import math

import numpy as np

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray

_JACOBI_SWEEPS = 12
_SINGULAR = 1e-14
_AXES = np.eye(3)


@compiled
def _orthogonalise(u: FloatArray, v: FloatArray) -> None:
    """Turn (3, 3) T in `u` into T V with orthogonal columns, V the rotation written to `v`.

    One-sided Jacobi: small singular values keep their digits, which an eigensolver on the square
    of T would lose.
    """
    v[:] = 0.0
    v[0, 0] = v[1, 1] = v[2, 2] = 1.0
    for _ in range(_JACOBI_SWEEPS):
        turned = False
        for p in range(2):
            for q in range(p + 1, 3):
                alpha = u[0, p] * u[0, p] + u[1, p] * u[1, p] + u[2, p] * u[2, p]
                beta = u[0, q] * u[0, q] + u[1, q] * u[1, q] + u[2, q] * u[2, q]
                gamma = u[0, p] * u[0, q] + u[1, p] * u[1, q] + u[2, p] * u[2, q]
                if abs(gamma) <= 1e-15 * math.sqrt(alpha * beta):
                    continue
                turned = True
                zeta = (beta - alpha) / (2.0 * gamma)
                t = 1.0 / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                if zeta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = c * t
                for a in range(3):
                    low, high = u[a, p], u[a, q]
                    u[a, p], u[a, q] = c * low - s * high, s * low + c * high
                    low, high = v[a, p], v[a, q]
                    v[a, p], v[a, q] = c * low - s * high, s * low + c * high
        if not turned:
            break


@compiled
def _write_quaternion(r: FloatArray, quaternion: FloatArray) -> None:
    """Write the unit quaternion (w, x, y, z), w >= 0, of a (3, 3) rotation matrix (Shepperd)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    if trace >= r[0, 0] and trace >= r[1, 1] and trace >= r[2, 2]:
        w, x, y, z = 1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    elif r[0, 0] >= r[1, 1] and r[0, 0] >= r[2, 2]:
        w, x = r[2, 1] - r[1, 2], 1.0 + 2.0 * r[0, 0] - trace
        y, z = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
    elif r[1, 1] >= r[2, 2]:
        w, x = r[0, 2] - r[2, 0], r[0, 1] + r[1, 0]
        y, z = 1.0 + 2.0 * r[1, 1] - trace, r[1, 2] + r[2, 1]
    else:
        w, x = r[1, 0] - r[0, 1], r[0, 2] + r[2, 0]
        y, z = r[1, 2] + r[2, 1], 1.0 + 2.0 * r[2, 2] - trace
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    quaternion[0], quaternion[1] = scale * w, scale * x
    quaternion[2], quaternion[3] = scale * y, scale * z


@compiled
def split_gradients(gradients: FloatArray, quaternions: FloatArray, stretches: FloatArray) -> None:
    """Split every vertex's deformation gradient T = R S into a rotation and a symmetric stretch.

    Where T mirrors, S takes the negative sign in its weakest direction. Where T is singular the
    rotation of the lost directions is arbitrary, but R is still a rotation and R S still is T.

    Parameters
    ----------
    gradients : (V, 3, 3) float64 array, T
    quaternions : (V, 4) float64 array, overwritten with R as (w, x, y, z), w >= 0
    stretches : (V, 6) float64 array, overwritten with the upper triangle of S row by row
    """
    u, v, rotation = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    left, value = np.empty((3, 3)), np.empty(3)
    for i in range(len(gradients)):
        u[:] = gradients[i]
        _orthogonalise(u, v)
        for a in range(3):
            value[a] = math.sqrt(u[0, a] * u[0, a] + u[1, a] * u[1, a] + u[2, a] * u[2, a])
        strong = 0
        for a in range(1, 3):
            if value[a] > value[strong]:
                strong = a
        weak = (strong + 1) % 3
        if value[(strong + 2) % 3] < value[weak]:
            weak = (strong + 2) % 3
        middle = 3 - strong - weak
        handed = 1.0 if (middle - strong) % 3 == 1 else -1.0

        # The rotation takes V's columns to the unit columns of T V, completed to a rotation.
        is_point = not value[strong] > 0.0
        is_line = not value[middle] > _SINGULAR * value[strong]
        for a in range(3):
            left[a, strong] = _AXES[0, a] if is_point else u[a, strong] / value[strong]
        axis = 0 if abs(left[0, strong]) < 0.6 else 1
        along, squared_length = 0.0, 0.0
        for a in range(3):
            left[a, middle] = _AXES[axis, a] if is_line else u[a, middle]
            along += left[a, strong] * left[a, middle]
        for a in range(3):
            left[a, middle] -= along * left[a, strong]
            squared_length += left[a, middle] * left[a, middle]
        for a in range(3):
            left[a, middle] /= math.sqrt(squared_length)
        value[weak] = 0.0
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            normal = left[b, strong] * left[c, middle] - left[c, strong] * left[b, middle]
            left[a, weak] = handed * normal
            value[weak] += left[a, weak] * u[a, weak]

        n = 0
        for a in range(3):
            for b in range(3):
                rotation[a, b] = (
                    left[a, strong] * v[b, strong]
                    + left[a, middle] * v[b, middle]
                    + left[a, weak] * v[b, weak]
                )
            for b in range(a, 3):
                stretches[i, n] = (
                    v[a, strong] * value[strong] * v[b, strong]
                    + v[a, middle] * value[middle] * v[b, middle]
                    + v[a, weak] * value[weak] * v[b, weak]
                )
                n += 1
        _write_quaternion(rotation, quaternions[i])
