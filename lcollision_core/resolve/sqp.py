"""Sequential quadratic programming for one constraint, many margins and starts side by side.

With one linearised constraint the quadratic program has a closed form, so an iteration costs
little more than the model's gradients, and those of several problems come as one batch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.problem import ResolveProblem, SolverOutcome

MAX_ITERATIONS = 30
_FEASIBLE = 1e-3
_SETTLED = 0.02
_SHORTEST = 0.1
_BOUND_ROUNDS = 4
_PENALTY = 1.5


def solve_sqp(
    problem: ResolveProblem,
    starts: FloatArray,
    margins: FloatArray,
    max_iterations: int = MAX_ITERATIONS,
    settled: float = _SETTLED,
) -> Sequence[SolverOutcome]:
    """Solve the problem from several starts, each with its own margin, as one batch.

    Parameters
    ----------
    problem : what they share
    starts : (B, D) float64 array within the bounds
    margins : (B,) float64 array >= 0
    max_iterations : at most so many batches of gradients
    settled : a row has converged once its step is this share of its distance from Z*, and its
        constraint holds to 1e-3 in the logit

    Returns
    -------
    outcomes : B of them, in the order given

    Raises
    ------
    CancelledError : the problem's watch said so.

    Notes
    -----
    Each step goes to the minimiser of d under the linearised constraint, damped by halving until
    the exact penalty function d + mu max(0, violation) falls.
    """
    rows = len(starts)
    inverse = _restricted_inverse(problem)
    here = np.clip(starts, problem.low, problem.high)
    excess, slope = problem.excess(here)
    violation = excess + margins
    merit_here = np.full(rows, np.inf)
    best = here.copy()
    best_rank = [
        _rank(distance, over)
        for distance, over in zip(problem.distance(here), violation, strict=True)
    ]
    step = np.zeros_like(here)
    length = np.ones(rows)
    penalty = np.zeros(rows)
    running = np.ones(rows, dtype=bool)
    converged = np.zeros(rows, dtype=bool)
    fresh = np.ones(rows, dtype=bool)
    iterations = np.zeros(rows, dtype=int)
    for _ in range(max_iterations):
        for row in np.flatnonzero(running & fresh):
            goal, multiplier = _minimiser(problem, inverse, here[row], slope[row], violation[row])
            step[row] = goal - here[row]
            length[row] = 1.0
            penalty[row] = max(penalty[row], _PENALTY * multiplier)
            merit_here[row] = _merit(problem, here[row], violation[row], penalty[row])
            size = problem.metric.squared(step[row])
            small = size <= settled**2 * max(problem.distance(goal), 1e-300)
            if small and violation[row] <= _FEASIBLE:
                converged[row], running[row] = True, False
        active = np.flatnonzero(running)
        if len(active) == 0 or problem.watch.expired:
            break
        trial = here[active] + length[active, None] * step[active]
        excess_there, slope_there = problem.excess(trial)
        iterations[active] += 1
        for place, row in enumerate(active):
            there = excess_there[place] + margins[row]
            rank = _rank(problem.distance(trial[place]), there)
            if rank < best_rank[row]:
                best[row], best_rank[row] = trial[place], rank
            merit = _merit(problem, trial[place], there, penalty[row])
            if merit < merit_here[row] or length[row] <= _SHORTEST:
                here[row], slope[row], violation[row] = trial[place], slope_there[place], there
                fresh[row] = True
            else:
                length[row] *= 0.5
                fresh[row] = False
    return [
        SolverOutcome(
            latent=best[row],
            status="converged" if converged[row] else "stopped",
            converged=bool(converged[row]),
            feasible=best_rank[row][0] == 0.0,
            iterations=int(iterations[row]),
        )
        for row in range(rows)
    ]


def _restricted_inverse(problem: ResolveProblem) -> FloatArray:
    """Invert G over the codes that may move; 0 elsewhere."""
    movable = np.flatnonzero(problem.movable)
    inverse = np.zeros_like(problem.metric.gram)
    inverse[np.ix_(movable, movable)] = np.linalg.inv(problem.metric.gram[np.ix_(movable, movable)])
    return inverse


def _minimiser(
    problem: ResolveProblem,
    inverse: FloatArray,
    here: FloatArray,
    slope: FloatArray,
    violation: float,
) -> tuple[FloatArray, float]:
    """Minimise d where slope . (Z - here) + violation <= 0; also return the multiplier of that.

    Codes that would leave the bounds stop there, and the others make up for it.
    """
    goal, share = problem.target, 0.0
    direction = inverse @ slope
    inside = np.ones(len(here), dtype=bool)
    for _ in range(_BOUND_ROUNDS):
        fall = float(slope[inside] @ direction[inside])
        if fall <= 0.0:
            break
        # What the codes at their bounds give is settled; the rest has to come from those inside.
        fixed = float(slope[~inside] @ (goal - here)[~inside])
        missing = violation + fixed + float(slope[inside] @ (problem.target - here)[inside])
        share = max(0.0, missing / fall)
        goal = np.clip(problem.target - share * direction, problem.low, problem.high)
        stopped = inside & (goal != problem.target - share * direction)
        if not stopped.any():
            break
        inside &= ~stopped
    return goal, 2.0 * share


def _merit(problem: ResolveProblem, latent: FloatArray, violation: float, penalty: float) -> float:
    return float(problem.distance(latent)) + penalty * max(0.0, violation)


def _rank(distance: FloatArray, violation: FloatArray) -> tuple[float, float]:
    """Order iterates: feasible ones by distance, before others by violation."""
    over = float(violation)
    return (0.0, float(distance)) if over <= _FEASIBLE else (over, float(distance))
