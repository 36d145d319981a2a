"""The rotations in 3 x 3 matrices: polar factors and quaternions."""

from __future__ import annotations

import math

import numpy as np

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray

_JACOBI_SWEEPS = 12


@compiled
def polar_factors(matrix: FloatArray, rotation: FloatArray, stretch: FloatArray) -> None:
    """Split a 3 x 3 matrix T = R S into a rotation (det +1) and a symmetric stretch, in place.

    Where T mirrors, S takes the negative sign in its weakest direction. Where T is singular the
    rotation of the lost directions is arbitrary, but R is still a rotation and R S still is T.

    Parameters
    ----------
    matrix : (3, 3) float64 array, T
    rotation, stretch : (3, 3) float64 arrays, overwritten with R and S

    Notes
    -----
    One-sided Jacobi: the columns of T V are made orthogonal, so that small singular values keep
    their digits, which an eigensolver on the square of T would lose.
    """
    u = matrix.copy()
    v = np.eye(3)
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
                    u[a, p] = c * low - s * high
                    u[a, q] = s * low + c * high
                    low, high = v[a, p], v[a, q]
                    v[a, p] = c * low - s * high
                    v[a, q] = s * low + c * high
        if not turned:
            break
    sigma = np.empty(3)
    for a in range(3):
        sigma[a] = math.sqrt(u[0, a] * u[0, a] + u[1, a] * u[1, a] + u[2, a] * u[2, a])
    # Cyclic relabelling keeps det V = +1: strongest first, weakest last.
    strong = 0
    for a in range(1, 3):
        if sigma[a] > sigma[strong]:
            strong = a
    weak = (strong + 1) % 3
    if sigma[(strong + 2) % 3] < sigma[weak]:
        weak = (strong + 2) % 3
    middle = 3 - strong - weak
    handed = 1.0 if (middle - strong) % 3 == 1 else -1.0

    x0, x1, x2 = 1.0, 0.0, 0.0
    if sigma[strong] > 0.0:
        x0, x1, x2 = (
            u[0, strong] / sigma[strong],
            u[1, strong] / sigma[strong],
            u[2, strong] / sigma[strong],
        )
    if sigma[middle] > 1e-14 * sigma[strong] and sigma[middle] > 0.0:
        y0, y1, y2 = u[0, middle], u[1, middle], u[2, middle]
    elif abs(x0) < 0.6:
        y0, y1, y2 = 1.0, 0.0, 0.0
    else:
        y0, y1, y2 = 0.0, 1.0, 0.0
    along = x0 * y0 + x1 * y1 + x2 * y2
    y0, y1, y2 = y0 - along * x0, y1 - along * x1, y2 - along * x2
    length = math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    y0, y1, y2 = y0 / length, y1 / length, y2 / length
    z0 = handed * (x1 * y2 - x2 * y1)
    z1 = handed * (x2 * y0 - x0 * y2)
    z2 = handed * (x0 * y1 - x1 * y0)
    weakest = z0 * u[0, weak] + z1 * u[1, weak] + z2 * u[2, weak]
    for b in range(3):
        rotation[0, b] = x0 * v[b, strong] + y0 * v[b, middle] + z0 * v[b, weak]
        rotation[1, b] = x1 * v[b, strong] + y1 * v[b, middle] + z1 * v[b, weak]
        rotation[2, b] = x2 * v[b, strong] + y2 * v[b, middle] + z2 * v[b, weak]
        for a in range(3):
            stretch[a, b] = (
                v[a, strong] * sigma[strong] * v[b, strong]
                + v[a, middle] * sigma[middle] * v[b, middle]
                + v[a, weak] * weakest * v[b, weak]
            )


@compiled
def quaternion_of(r: FloatArray, quaternion: FloatArray) -> None:
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
    quaternion[0] = scale * w
    quaternion[1] = scale * x
    quaternion[2] = scale * y
    quaternion[3] = scale * z


@compiled
def split_gradients(gradients: FloatArray, quaternions: FloatArray, stretches: FloatArray) -> None:
    """Write the rotation and the stretch of every vertex's deformation gradient T = R S.

    Parameters
    ----------
    gradients : (V, 3, 3) float64 array, T
    quaternions : (V, 4) float64 array, overwritten with R as in `quaternion_of`
    stretches : (V, 6) float64 array, overwritten with the upper triangle of S row by row
    """
    rotation = np.empty((3, 3))
    stretch = np.empty((3, 3))
    for i in range(len(gradients)):
        polar_factors(gradients[i], rotation, stretch)
        quaternion_of(rotation, quaternions[i])
        stretches[i, 0] = stretch[0, 0]
        stretches[i, 1] = stretch[0, 1]
        stretches[i, 2] = stretch[0, 2]
        stretches[i, 3] = stretch[1, 1]
        stretches[i, 4] = stretch[1, 2]
        stretches[i, 5] = stretch[2, 2]
