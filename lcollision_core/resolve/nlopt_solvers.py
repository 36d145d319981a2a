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
from lcollision_core.resolve.options import Solver
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
"""What NLopt raises where it cannot go on; from 2.10 its failures are no more `RuntimeError`."""

_CONVERGED = {nlopt.SUCCESS, nlopt.FTOL_REACHED, nlopt.XTOL_REACHED}


def solve_nlopt(
    problem: ResolveProblem, solver: Solver, start: FloatArray, margin: float
) -> SolverOutcome:
    """Solve the problem from one start.

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
    CancelledError : the problem's watch said so, at the next evaluation.

    Notes
    -----
    The method of Tan et al. 2021 is AUGLAG, there by LOQO; here with LBFGS within, which has
    tolerances of its own.
    """
    return _Run(problem, margin).solve(solver, start)


class _Run:
    """One call of NLopt, over the codes that may move."""

    def __init__(self, problem: ResolveProblem, margin: float) -> None:
        self._problem = problem
        # What holds to the tolerance then holds in truth.
        self._margin = margin + FEASIBLE
        self._movable = np.flatnonzero(problem.movable)
        span = problem.high - problem.low
        least = _LEAST_SIZE * float(span @ span)
        self._scale = 1.0 / max(float(problem.target @ problem.target), least)
        self._best: tuple[tuple[float, float], FloatArray] | None = None
        self._cancelled: CancelledError | None = None
        self._halt = ""

    def solve(self, solver: Solver, start: FloatArray) -> SolverOutcome:
        problem, movable = self._problem, self._movable
        low, high = problem.low[movable], problem.high[movable]
        begin = np.clip(start, problem.low, problem.high)
        optimiser = nlopt.opt(_ALGORITHMS[solver], len(movable))
        if solver == Solver.AUGLAG:
            inner = nlopt.opt(nlopt.LD_LBFGS, len(movable))
            inner.set_xtol_rel(_INNER_TOLERANCE)
            inner.set_ftol_rel(_INNER_TOLERANCE)
            inner.set_maxeval(_INNER_EVALUATIONS)
            optimiser.set_local_optimizer(inner)
        optimiser.set_lower_bounds(low)
        optimiser.set_upper_bounds(high)
        optimiser.set_min_objective(self._objective)
        optimiser.add_inequality_constraint(self._constraint, FEASIBLE)
        optimiser.set_xtol_rel(_TOLERANCE)
        optimiser.set_ftol_rel(_TOLERANCE)
        optimiser.set_maxeval(MAX_EVALUATIONS)
        try:
            optimiser.optimize(begin[movable])
            code = optimiser.last_optimize_result()
            status = _STATUS.get(code, "stopped")
        except nlopt.ForcedStop:
            code, status = None, self._halt
        except _FAILURES:
            # An inner failure ends the outer loop; what the callbacks saw is as good as ever.
            code, status = None, "halted by rounding"
        if self._cancelled is not None:
            raise self._cancelled
        if self._best is None:  # stopped at its first evaluation
            with suppress(nlopt.ForcedStop):
                self._look(begin)
        (over, _), latent = self._best or ((math.inf, 0.0), begin)
        return SolverOutcome(
            latent=latent,
            status=status,
            converged=code in _CONVERGED,
            feasible=over == 0.0,
            iterations=int(optimiser.get_numevals()),
        )

    def _objective(self, codes: npt.NDArray[Any], gradient: npt.NDArray[Any]) -> float:
        moved = self._full(codes) - self._problem.target
        if gradient.size:
            gradient[:] = 2.0 * self._scale * (self._problem.code_weights * moved)[self._movable]
        squared = float(self._problem.code_weights @ moved**2)
        return OBJECTIVE_OFFSET + self._scale * squared

    def _constraint(self, codes: npt.NDArray[Any], gradient: npt.NDArray[Any]) -> float:
        if self._problem.watch.expired:
            self._halt = "out of time"
            raise nlopt.ForcedStop
        try:
            violation, slope = self._look(self._full(codes))
        except CancelledError as error:
            self._cancelled = error
            raise nlopt.ForcedStop from error
        if gradient.size:
            gradient[:] = slope[self._movable]
        return violation

    def _look(self, latent: FloatArray) -> tuple[float, FloatArray]:
        """Ask the model, and keep the pose if it is the best so far."""
        excess, slope = self._problem.excess(latent[None])
        violation = float(excess[0]) + self._margin
        if not math.isfinite(violation):
            self._halt = "prediction not finite"
            raise nlopt.ForcedStop
        placed = rank(float(self._problem.search_distance(latent)), violation)
        if self._best is None or placed < self._best[0]:
            self._best = placed, latent
        return violation, slope[0]

    def _full(self, codes: npt.NDArray[Any]) -> FloatArray:
        latent = self._problem.target.copy()
        latent[self._movable] = codes
        return latent


_ALGORITHMS = {
    Solver.AUGLAG: nlopt.AUGLAG,
    Solver.SLSQP: nlopt.LD_SLSQP,
    Solver.CCSAQ: nlopt.LD_CCSAQ,
}
