"""The paper's problem with NLopt: the augmented Lagrangian of the paper, SLSQP and CCSAQ."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import nlopt
import numpy as np
import numpy.typing as npt

from lcollision_core.errors import CancelledError
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options.resolve import Solver
from lcollision_core.resolve.problem import FEASIBLE, ResolveProblem, SolverOutcome, rank

MAX_EVALUATIONS = 200
_TOLERANCE = 1e-3
_INNER_TOLERANCE = 1e-3
_INNER_EVALUATIONS = 40

OBJECTIVE_OFFSET = 1.0
"""Added to the objective, which is in units of ||Z*||^2: AUGLAG's first penalty is in proportion
to the objective, and from Z* it would be its least one, with many rounds to grow."""

_LEAST_SIZE = 1e-3
"""Of the bounds' squared diagonal, the least unit of the objective: the zero pose has no length."""

_STATUS = {
    nlopt.SUCCESS: "converged",
    nlopt.STOPVAL_REACHED: "stop value reached",
    nlopt.FTOL_REACHED: "objective settled",
    nlopt.XTOL_REACHED: "pose settled",
    nlopt.MAXEVAL_REACHED: "out of evaluations",
    nlopt.MAXTIME_REACHED: "out of time",
}
_FAILURES = (nlopt.RoundoffLimited, RuntimeError, getattr(nlopt, "runtime_error", RuntimeError))
"""What NLopt raises on failure; from 2.10 no longer `RuntimeError`."""

_CONVERGED = {nlopt.SUCCESS, nlopt.FTOL_REACHED, nlopt.XTOL_REACHED}
_ALGORITHMS = {
    Solver.AUGLAG: nlopt.AUGLAG,
    Solver.SLSQP: nlopt.LD_SLSQP,
    Solver.CCSAQ: nlopt.LD_CCSAQ,
}


def solve_nlopt(
    problem: ResolveProblem, solver: Solver, start: FloatArray, margin: float
) -> SolverOutcome:
    """Solve the problem from one start, over the codes that may move.

    Parameters
    ----------
    problem : the problem
    solver : `AUGLAG`, `SLSQP` or `CCSAQ`
    start : (D,) float64 array, put within the bounds
    margin : >= 0

    Returns
    -------
    outcome : the best iterate of all callbacks, however the solver ended, the start where there
        was none; its iterations are NLopt's evaluations

    Raises
    ------
    CancelledError : the problem's token was set, at the next evaluation.

    Notes
    -----
    The method of Tan et al. 2021 is AUGLAG, there by LOQO; here with LBFGS within, with
    separate tolerances.
    """
    movable = np.flatnonzero(problem.movable)
    target, weights = problem.target, problem.code_weights
    span = problem.high - problem.low
    scale = 1.0 / max(float(target @ target), _LEAST_SIZE * float(span @ span))
    begin = np.clip(start, problem.low, problem.high)
    best: tuple[tuple[float, float], FloatArray] = (math.inf, 0.0), begin
    evaluated, halt = False, ""

    def full(codes: npt.NDArray[Any]) -> FloatArray:
        latent = target.copy()
        latent[movable] = codes
        return latent

    def objective(codes: npt.NDArray[Any], gradient: npt.NDArray[Any]) -> float:
        moved = full(codes) - target
        if gradient.size:
            gradient[:] = 2.0 * scale * (weights * moved)[movable]
        return OBJECTIVE_OFFSET + scale * float(weights @ moved**2)

    def evaluate(latent: FloatArray) -> tuple[float, FloatArray]:
        """Evaluate the model, and keep the pose if it is the best so far."""
        nonlocal best, evaluated, halt
        evaluated = True
        excess, slope = problem.excess(latent[None])
        # What holds to the tolerance then holds exactly.
        violation = float(excess[0]) + margin + FEASIBLE
        if not math.isfinite(violation):
            halt = "prediction not finite"
            raise nlopt.ForcedStop
        placed = rank(float(problem.search_distance(latent)), violation)
        if placed < best[0]:
            best = placed, latent
        return violation, slope[0]

    def constraint(codes: npt.NDArray[Any], gradient: npt.NDArray[Any]) -> float:
        nonlocal halt
        if problem.deadline.expired:
            halt = "out of time"
            raise nlopt.ForcedStop
        try:
            violation, slope = evaluate(full(codes))
        except CancelledError as error:
            raise nlopt.ForcedStop from error
        if gradient.size:
            gradient[:] = slope[movable]
        return violation

    optimiser = nlopt.opt(_ALGORITHMS[solver], len(movable))
    if solver == Solver.AUGLAG:
        inner = nlopt.opt(nlopt.LD_LBFGS, len(movable))
        inner.set_xtol_rel(_INNER_TOLERANCE)
        inner.set_ftol_rel(_INNER_TOLERANCE)
        inner.set_maxeval(_INNER_EVALUATIONS)
        optimiser.set_local_optimizer(inner)
    optimiser.set_lower_bounds(problem.low[movable])
    optimiser.set_upper_bounds(problem.high[movable])
    optimiser.set_min_objective(objective)
    optimiser.add_inequality_constraint(constraint, FEASIBLE)
    optimiser.set_xtol_rel(_TOLERANCE)
    optimiser.set_ftol_rel(_TOLERANCE)
    optimiser.set_maxeval(MAX_EVALUATIONS)
    code = None
    try:
        optimiser.optimize(begin[movable])
        code = optimiser.last_optimize_result()
        status = _STATUS.get(code, "stopped")
    except nlopt.ForcedStop:
        status = halt
    except _FAILURES:
        # An inner failure ends the outer loop; the iterates that the callbacks kept stay valid.
        status = "halted by rounding"
    problem.deadline.poll()
    if not evaluated:  # out of time at the first evaluation
        with suppress(nlopt.ForcedStop):
            evaluate(begin)
    (over, _), latent = best
    return SolverOutcome(
        latent=latent,
        status=status,
        converged=code in _CONVERGED,
        feasible=over == 0.0,
        iterations=int(optimiser.get_numevals()),
    )
