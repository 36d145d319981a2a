"""The nearest pose within half-spaces and bounds: a small quadratic program, solved exactly."""

from __future__ import annotations

import daqp
import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.problem import ResolveProblem

_OPTIMAL = 1
_TOLERANCE = 1e-9


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
    Dual active sets: Arnström, Bemporad and Axehill, "A dual active-set solver for embedded
    quadratic programming using recursive LDL^T updates", 2022.
    """
    movable = np.flatnonzero(problem.movable)
    gram = problem.metric.gram[np.ix_(movable, movable)]
    # The bounds of the moves come first, then the half-spaces.
    most = np.concatenate([(problem.high - centre)[movable], offsets - normals @ centre])
    least = np.concatenate([(problem.low - centre)[movable], np.full(len(normals), -np.inf)])
    moved, _, status, _ = daqp.solve(
        gram * (len(gram) / np.trace(gram)),
        np.zeros(len(movable)),
        np.ascontiguousarray(normals[:, movable]),
        most,
        least,
        primal_tol=_TOLERANCE,
    )
    if status != _OPTIMAL:
        return None
    latent = centre.copy()
    latent[movable] += moved
    return np.clip(latent, problem.low, problem.high)
