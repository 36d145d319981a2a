"""The nearest pose within half-spaces and bounds: a small quadratic program, solved exactly."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.problem import ResolveProblem

_BOUND_ROUNDS = 5
_INFEASIBLE = 1e-9


def nearest_within(
    problem: ResolveProblem, centre: FloatArray, normals: FloatArray, offsets: FloatArray
) -> FloatArray | None:
    """Minimise d(Z, centre) subject to normals Z <= offsets and the bounds.

    Parameters
    ----------
    problem : gives d and the bounds
    centre : (D,) float64 array within the bounds
    normals : (C, D) float64 array
    offsets : (C,) float64 array

    Returns
    -------
    latent : (D,) float64 array, or None where the half-spaces have no point in common

    Notes
    -----
    Least-distance programming by non-negative least squares: Lawson and Hanson, "Solving Least
    Squares Problems", 1974, chapter 23.
    """
    movable = np.flatnonzero(problem.movable)
    root = problem.whitening
    rows = normals[:, movable] @ root
    room = offsets - normals @ centre
    low, high = (problem.low - centre)[movable], (problem.high - centre)[movable]
    moved = np.zeros(len(movable))
    for _ in range(_BOUND_ROUNDS):
        whitened = _least_distance(rows, room)
        if whitened is None:
            return None
        moved = root @ whitened
        over, under = np.flatnonzero(moved > high + 1e-9), np.flatnonzero(moved < low - 1e-9)
        if len(over) + len(under) == 0:
            break
        rows = np.concatenate([rows, root[over], -root[under]])
        room = np.concatenate([room, high[over], -low[under]])
    latent = centre.copy()
    latent[movable] += np.clip(moved, low, high)
    return latent


def _least_distance(rows: FloatArray, room: FloatArray) -> FloatArray | None:
    """Return the shortest y with rows y <= room, None where there is none."""
    if len(rows) == 0:
        return np.zeros(rows.shape[1])
    size = np.linalg.norm(rows, axis=1)
    size[size == 0.0] = 1.0
    stacked = np.concatenate([-rows.T / size, -(room / size)[None]])
    unit = np.zeros(len(stacked))
    # Lengths near 1, so that the last row does not drown.
    scale = max(float(np.abs(room / size).max(initial=0.0)), 1e-300)
    stacked[-1] /= scale
    unit[-1] = 1.0
    try:
        multipliers, _ = nnls(stacked, unit)
    except RuntimeError:  # no end within its iterations
        return None
    residual = stacked @ multipliers - unit
    if abs(residual[-1]) <= _INFEASIBLE:
        return None
    shortest: FloatArray = scale * -residual[:-1] / residual[-1]
    return shortest
