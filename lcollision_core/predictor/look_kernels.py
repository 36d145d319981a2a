"""The compiled loops of `look`: forward and backward passes over every point and its partners.

Array operations spend most of their time on passing temporary arrays through memory; these keep
a point's few numbers at hand. Sums over points run in a fixed order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled

Array = npt.NDArray[np.floating[Any]]

REACH = 0.1
"""Heights over which a far partner's influence falls to 1/e."""

SMALLEST_SQUARED_ANGLE = 1e-12
SMALLEST_SQUARED_DISTANCE = 1e-8


@compiled
def deform(features: Array, rest_frame: Array, frame: Array, rows: Array) -> None:
    """Fill in frames R F (B, P, 3, 3) and gradients R S as rows (B, 3, P, 3)."""
    rotation = np.empty((3, 3), dtype=features.dtype)
    stretch = np.empty((3, 3), dtype=features.dtype)
    for b in range(features.shape[0]):
        for p in range(features.shape[1]):
            _unpack(features[b, p], rotation, stretch)
            for i in range(3):
                for j in range(3):
                    turned = features.dtype.type(0.0)
                    stretched = features.dtype.type(0.0)
                    for k in range(3):
                        turned += rotation[i, k] * rest_frame[p, k, j]
                        stretched += rotation[i, k] * stretch[k, j]
                    frame[b, p, i, j] = turned
                    rows[b, i, p, j] = stretched


@compiled
def deform_backward(
    features: Array, rest_frame: Array, by_frame: Array, by_rows: Array, by_features: Array
) -> None:
    """Pull derivatives by `deform`'s results back to its (B, P, 9) features."""
    rotation = np.empty((3, 3), dtype=features.dtype)
    stretch = np.empty((3, 3), dtype=features.dtype)
    by_rotation = np.empty((3, 3), dtype=features.dtype)
    by_stretch = np.empty((3, 3), dtype=features.dtype)
    for b in range(features.shape[0]):
        for p in range(features.shape[1]):
            _unpack(features[b, p], rotation, stretch)
            for i in range(3):
                for j in range(3):
                    turned = features.dtype.type(0.0)
                    stretched = features.dtype.type(0.0)
                    for k in range(3):
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
def _unpack(features: Array, rotation: Array, stretch: Array) -> None:
    """Write exp of the rotation vector, by Rodrigues' formula, and S of nine features."""
    x, y, z = features[0], features[1], features[2]
    squared = x * x + y * y + z * z + SMALLEST_SQUARED_ANGLE
    angle = math.sqrt(squared)
    half = math.sin(0.5 * angle)
    s = math.sin(angle) / angle
    v = 2.0 * half * half / squared
    c = 1.0 - 2.0 * half * half
    rotation[0, 0], rotation[1, 1], rotation[2, 2] = c + v * x * x, c + v * y * y, c + v * z * z
    rotation[0, 1], rotation[1, 0] = v * x * y - s * z, v * x * y + s * z
    rotation[0, 2], rotation[2, 0] = v * z * x + s * y, v * z * x - s * y
    rotation[1, 2], rotation[2, 1] = v * y * z - s * x, v * y * z + s * x
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


@compiled
def look(frame: Array, places: Array, partners: Array, n_far: int, inputs: Array) -> None:
    """Fill in where each point's partners lie in its frame: (P, B, 3 partners + n_far).

    Far partners' three coordinates are shortened to their closeness; closeness comes after them.
    """
    n_partners = partners.shape[1]
    for b in range(frame.shape[0]):
        for p in range(frame.shape[1]):
            f = frame[b, p]
            out = inputs[p, b]
            for q in range(n_partners):
                other = partners[p, q]
                x = places[b, 0, other] - places[b, 0, p]
                y = places[b, 1, other] - places[b, 1, p]
                z = places[b, 2, other] - places[b, 2, p]
                u = x * f[0, 0] + y * f[1, 0] + z * f[2, 0]
                v = x * f[0, 1] + y * f[1, 1] + z * f[2, 1]
                w = x * f[0, 2] + y * f[1, 2] + z * f[2, 2]
                if q < n_far:
                    distance = math.sqrt(u * u + v * v + w * w + SMALLEST_SQUARED_DISTANCE)
                    closeness = math.exp(-distance / REACH)
                    factor = closeness / distance
                    out[q] = u * factor
                    out[n_far + q] = v * factor
                    out[2 * n_far + q] = w * factor
                    out[3 * n_far + q] = closeness
                else:
                    near = 4 * n_far + q - n_far
                    out[near] = u
                    out[near + n_partners - n_far] = v
                    out[near + 2 * (n_partners - n_far)] = w


@compiled
def look_backward(
    frame: Array,
    places: Array,
    partners: Array,
    n_far: int,
    by_inputs: Array,
    by_frame: Array,
    by_places: Array,
) -> None:
    """Pull derivatives by `look`'s inputs back, adding to frames and places."""
    n_partners = partners.shape[1]
    for b in range(frame.shape[0]):
        for p in range(frame.shape[1]):
            f = frame[b, p]
            by_f = by_frame[b, p]
            given = by_inputs[p, b]
            for q in range(n_partners):
                other = partners[p, q]
                x = places[b, 0, other] - places[b, 0, p]
                y = places[b, 1, other] - places[b, 1, p]
                z = places[b, 2, other] - places[b, 2, p]
                if q < n_far:
                    u = x * f[0, 0] + y * f[1, 0] + z * f[2, 0]
                    v = x * f[0, 1] + y * f[1, 1] + z * f[2, 1]
                    w = x * f[0, 2] + y * f[1, 2] + z * f[2, 2]
                    distance = math.sqrt(u * u + v * v + w * w + SMALLEST_SQUARED_DISTANCE)
                    closeness = math.exp(-distance / REACH)
                    factor = closeness / distance
                    along = given[q] * u + given[n_far + q] * v + given[2 * n_far + q] * w
                    # Of factor and closeness by the distance, over the distance.
                    radial = -along * factor * (1.0 / REACH + 1.0 / distance)
                    radial = (radial - given[3 * n_far + q] * closeness / REACH) / distance
                    by_u = given[q] * factor + radial * u
                    by_v = given[n_far + q] * factor + radial * v
                    by_w = given[2 * n_far + q] * factor + radial * w
                else:
                    near = 4 * n_far + q - n_far
                    by_u = given[near]
                    by_v = given[near + n_partners - n_far]
                    by_w = given[near + 2 * (n_partners - n_far)]
                by_f[0, 0] += x * by_u
                by_f[1, 0] += y * by_u
                by_f[2, 0] += z * by_u
                by_f[0, 1] += x * by_v
                by_f[1, 1] += y * by_v
                by_f[2, 1] += z * by_v
                by_f[0, 2] += x * by_w
                by_f[1, 2] += y * by_w
                by_f[2, 2] += z * by_w
                for i in range(3):
                    by_offset = f[i, 0] * by_u + f[i, 1] * by_v + f[i, 2] * by_w
                    by_places[b, i, other] += by_offset
                    by_places[b, i, p] -= by_offset
