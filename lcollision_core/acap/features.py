"""The nine numbers per vertex: log R and the upper triangle of S, and their map to T = R S."""

from __future__ import annotations

import math

import numpy as np

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray

N_FEATURES = 9
N_ROTATION = 3
_SERIES_BELOW = 1e-2


@compiled
def exponential_coefficients(angle_squared: float) -> tuple[float, float, float]:
    """Evaluate the functions of theta in the exponential map and its derivative.

    They are sin(theta)/theta, (1 - cos(theta))/theta^2 and (theta - sin(theta))/theta^3; by their
    Taylor series for small theta, where the quotients lose their digits.
    """
    if angle_squared < _SERIES_BELOW:
        t = angle_squared
        return (
            1.0 - t / 6.0 * (1.0 - t / 20.0 * (1.0 - t / 42.0 * (1.0 - t / 72.0))),
            0.5 * (1.0 - t / 12.0 * (1.0 - t / 30.0 * (1.0 - t / 56.0 * (1.0 - t / 90.0)))),
            (1.0 - t / 20.0 * (1.0 - t / 42.0 * (1.0 - t / 72.0 * (1.0 - t / 110.0)))) / 6.0,
        )
    angle = math.sqrt(angle_squared)
    sine = math.sin(angle)
    return (
        sine / angle,
        (1.0 - math.cos(angle)) / angle_squared,
        (angle - sine) / (angle_squared * angle),
    )


@compiled
def exponential(x: float, y: float, z: float, rotation: FloatArray) -> None:
    """Write the rotation matrix of the vector (x, y, z) = theta * axis, any theta (Rodrigues)."""
    a, b, _ = exponential_coefficients(x * x + y * y + z * z)
    rotation[0, 0] = 1.0 - b * (y * y + z * z)
    rotation[0, 1] = b * x * y - a * z
    rotation[0, 2] = b * x * z + a * y
    rotation[1, 0] = b * x * y + a * z
    rotation[1, 1] = 1.0 - b * (x * x + z * z)
    rotation[1, 2] = b * y * z - a * x
    rotation[2, 0] = b * x * z - a * y
    rotation[2, 1] = b * y * z + a * x
    rotation[2, 2] = 1.0 - b * (x * x + y * y)


@compiled
def _stretch_product(r: FloatArray, s: FloatArray, product: FloatArray) -> None:
    """Write R S, the six numbers `s` being the upper triangle of S row by row."""
    for a in range(3):
        product[a, 0] = r[a, 0] * s[0] + r[a, 1] * s[1] + r[a, 2] * s[2]
        product[a, 1] = r[a, 0] * s[1] + r[a, 1] * s[3] + r[a, 2] * s[4]
        product[a, 2] = r[a, 0] * s[2] + r[a, 1] * s[4] + r[a, 2] * s[5]


@compiled
def gradients_from_features(features: FloatArray, gradients: FloatArray) -> FloatArray:
    """Write T_i = exp(log R_i) S_i, (V, 3, 3), of (V, 9) features, and return them."""
    rotation = np.empty((3, 3))
    for i in range(len(features)):
        exponential(features[i, 0], features[i, 1], features[i, 2], rotation)
        _stretch_product(rotation, features[i, 3:], gradients[i])
    return gradients


@compiled
def push_forward(features: FloatArray, tangents: FloatArray, gradients: FloatArray) -> None:
    """Write the derivatives of T along several changes of the features of one pose.

    Parameters
    ----------
    features : (V, 9) float64 array
    tangents : (m, V, 9) float64 array
    gradients : (m, V, 3, 3) float64 array, overwritten

    Notes
    -----
    d exp(a) = [J da]_x exp(a) with the left Jacobian
    J = I + (1 - cos t)/t^2 [a]_x + (t - sin t)/t^3 [a]_x^2, t = |a|.
    """
    rotation = np.empty((3, 3))
    turned = np.empty((3, 3))
    for i in range(len(features)):
        x, y, z = features[i, 0], features[i, 1], features[i, 2]
        exponential(x, y, z, rotation)
        _, b, c = exponential_coefficients(x * x + y * y + z * z)
        _stretch_product(rotation, features[i, 3:], turned)
        for along in range(len(tangents)):
            tangent, out = tangents[along, i], gradients[along, i]
            u, v, w = tangent[0], tangent[1], tangent[2]
            k0, k1, k2 = y * w - z * v, z * u - x * w, x * v - y * u
            p0 = u + b * k0 + c * (y * k2 - z * k1)
            p1 = v + b * k1 + c * (z * k0 - x * k2)
            p2 = w + b * k2 + c * (x * k1 - y * k0)
            _stretch_product(rotation, tangent[3:], out)
            for column in range(3):
                t0, t1, t2 = turned[0, column], turned[1, column], turned[2, column]
                out[0, column] += p1 * t2 - p2 * t1
                out[1, column] += p2 * t0 - p0 * t2
                out[2, column] += p0 * t1 - p1 * t0


@compiled
def pull_back(features: FloatArray, grad_gradient: FloatArray, grad_features: FloatArray) -> None:
    """Write a loss's derivative by the features, given the one by T: `push_forward` transposed.

    Parameters
    ----------
    features : (V, 9) float64 array
    grad_gradient : (V, 3, 3) float64 array
    grad_features : (V, 9) float64 array, overwritten
    """
    rotation = np.empty((3, 3))
    turned = np.empty((3, 3))
    h = np.empty((3, 3))
    for i in range(len(features)):
        x, y, z = features[i, 0], features[i, 1], features[i, 2]
        exponential(x, y, z, rotation)
        _, b, c = exponential_coefficients(x * x + y * y + z * z)
        _stretch_product(rotation, features[i, 3:], turned)
        g = grad_gradient[i]
        p0, p1, p2 = 0.0, 0.0, 0.0
        for k in range(3):
            p0 += turned[1, k] * g[2, k] - turned[2, k] * g[1, k]
            p1 += turned[2, k] * g[0, k] - turned[0, k] * g[2, k]
            p2 += turned[0, k] * g[1, k] - turned[1, k] * g[0, k]
        # The transposed left Jacobian is the left Jacobian of -a.
        k0, k1, k2 = y * p2 - z * p1, z * p0 - x * p2, x * p1 - y * p0
        grad_features[i, 0] = p0 - b * k0 + c * (y * k2 - z * k1)
        grad_features[i, 1] = p1 - b * k1 + c * (z * k0 - x * k2)
        grad_features[i, 2] = p2 - b * k2 + c * (x * k1 - y * k0)
        for a in range(3):
            for column in range(3):
                h[a, column] = (
                    rotation[0, a] * g[0, column]
                    + rotation[1, a] * g[1, column]
                    + rotation[2, a] * g[2, column]
                )
        grad_features[i, 3] = h[0, 0]
        grad_features[i, 4] = h[0, 1] + h[1, 0]
        grad_features[i, 5] = h[0, 2] + h[2, 0]
        grad_features[i, 6] = h[1, 1]
        grad_features[i, 7] = h[1, 2] + h[2, 1]
        grad_features[i, 8] = h[2, 2]


@compiled
def pull_back_means(
    features: FloatArray, by_gradients: FloatArray, grad_features: FloatArray
) -> None:
    """Write the derivatives of patches' means by the features, given those by T.

    Coordinate a of a mean depends on row a of each T_i only, and in the same way for all three, so
    that one row stands for the three matrices that `pull_back` would take.

    Parameters
    ----------
    features : (V, 9) float64 array
    by_gradients : (m, V, 3) float64 array, of m patches' means the derivatives by the rows of T
    grad_features : (m, 3, V, 9) float64 array, overwritten
    """
    rotation = np.empty((3, 3))
    turned = np.empty((3, 3))
    units = np.eye(3)
    for i in range(len(features)):
        x, y, z = features[i, 0], features[i, 1], features[i, 2]
        exponential(x, y, z, rotation)
        _, b, c = exponential_coefficients(x * x + y * y + z * z)
        _stretch_product(rotation, features[i, 3:], turned)
        for patch in range(len(by_gradients)):
            g = by_gradients[patch, i]
            g0, g1, g2 = g[0], g[1], g[2]
            u0 = turned[0, 0] * g0 + turned[0, 1] * g1 + turned[0, 2] * g2
            u1 = turned[1, 0] * g0 + turned[1, 1] * g1 + turned[1, 2] * g2
            u2 = turned[2, 0] * g0 + turned[2, 1] * g1 + turned[2, 2] * g2
            for a in range(3):
                out = grad_features[patch, a, i]
                # As in `pull_back`, p = u x e_a, and the left Jacobian of -log R.
                e0, e1, e2 = units[a, 0], units[a, 1], units[a, 2]
                p0, p1, p2 = u1 * e2 - u2 * e1, u2 * e0 - u0 * e2, u0 * e1 - u1 * e0
                k0, k1, k2 = y * p2 - z * p1, z * p0 - x * p2, x * p1 - y * p0
                out[0] = p0 - b * k0 + c * (y * k2 - z * k1)
                out[1] = p1 - b * k1 + c * (z * k0 - x * k2)
                out[2] = p2 - b * k2 + c * (x * k1 - y * k0)
                r0, r1, r2 = rotation[a, 0], rotation[a, 1], rotation[a, 2]
                out[3] = r0 * g0
                out[4] = r0 * g1 + r1 * g0
                out[5] = r0 * g2 + r2 * g0
                out[6] = r1 * g1
                out[7] = r1 * g2 + r2 * g1
                out[8] = r2 * g2
