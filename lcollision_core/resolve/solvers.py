"""Solvers of a problem: sequential quadratic programming, and those of NLopt.

With one linearised constraint the quadratic program has nearly a closed form, so an iteration
costs little more than the model's gradients, which are evaluated in batches. A further solver has
its name in `options.Solver`; if it is not NLopt's, `resolver.py` calls it.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import nlopt
import numpy as np
import numpy.typing as npt

from lcollision_core.errors import CancelledError
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options import Solver
from lcollision_core.posing import ExactCheck
from lcollision_core.posing.exact import Contacts
from lcollision_core.resolve.problem import FEASIBLE, ResolveProblem, SolverOutcome, rank

_SETTLED = 0.02
"""A row has converged when its step is this fraction of its distance from Z*; the exact check and
pulling back follow, so more digits would be wasted."""

_PATIENCE = 20
_SHORTEST = 0.1
_PENALTY = 1.5
_BOUND_ROUNDS = 6


class SqpBatch:
    """Rows that solve one problem, each from its own start and with its own margin.

    Each step goes to the minimiser of the search distance under the linearised constraint and the
    bounds, damped by halving until the exact penalty function (distance + mu max(0, violation))
    falls.

    Parameters
    ----------
    problem : shared by the rows
    starts : (B, D) float64 array, clipped to the bounds
    margins : (B,) float64 array >= 0

    Raises
    ------
    CancelledError : the job was cancelled.
    """

    def __init__(self, problem: ResolveProblem, starts: FloatArray, margins: FloatArray) -> None:
        n_rows = len(starts)
        # A constraint that holds within the tolerance then holds exactly.
        self._problem, self._margins = problem, margins + FEASIBLE
        self._here = np.clip(starts, problem.low, problem.high)
        # Rows that start at one pose share its evaluation.
        starts, shared = np.unique(self._here, axis=0, return_inverse=True)
        excess, slopes = problem.excess(starts)
        self._slope = slopes[shared]
        self._violation: FloatArray = excess[shared] + self._margins
        self._step = np.zeros_like(self._here)
        self._length = np.ones(n_rows)
        self._penalty = np.zeros(n_rows)
        self._fresh = np.ones(n_rows, dtype=np.bool_)
        self._running = np.ones(n_rows, dtype=np.bool_)
        self._iterations = np.zeros(n_rows, dtype=np.int64)
        self._best = self._here.copy()
        distances = problem.search_distance(self._here)
        self._best_rank = [
            rank(float(distance), float(over))
            for distance, over in zip(distances, self._violation, strict=True)
        ]

    def run(self, n_iterations: int) -> list[SolverOutcome]:
        """Run at most `n_iterations` more iterations; return the outcome of each row, in order.

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        for _ in range(n_iterations):
            for row in np.flatnonzero(self._running & self._fresh).tolist():
                self._aim(row)
            active = np.flatnonzero(self._running)
            if len(active) == 0 or self._problem.deadline.expired:
                break
            trials = self._here[active] + self._length[active, None] * self._step[active]
            excess, slopes = self._problem.excess(trials)
            self._iterations[active] += 1
            for row, trial, over, slope in zip(
                active.tolist(), trials, excess, slopes, strict=True
            ):
                self._judge(row, trial, float(over + self._margins[row]), slope)
        return [
            SolverOutcome(
                latent=self._best[row].copy(),
                status="stopped" if self._running[row] else "converged",
                converged=not self._running[row],
                feasible=self._best_rank[row][0] == 0.0,
                iterations=int(self._iterations[row]),
            )
            for row in range(len(self._best))
        ]

    def _aim(self, row: int) -> None:
        """Choose a row's next step, or stop it if it has converged."""
        problem, here = self._problem, self._here[row]
        violation = float(self._violation[row])
        slope = self._slope[row]
        goal, multiplier = _minimiser(problem, problem.target, here, slope, violation)
        length_squared = float(problem.code_weights @ (goal - here) ** 2)
        settled = length_squared <= _SETTLED**2 * float(problem.search_distance(goal))
        if settled and violation <= FEASIBLE:
            self._running[row] = False
        elif violation > FEASIBLE and (settled or self._iterations[row] >= _PATIENCE):
            # Along a curved border, each step reduces the violation by a few percent, or steps
            # oscillate; a direct step to the border ends nearly as near.
            goal, _ = _minimiser(problem, here, here, slope, violation)
        self._step[row] = goal - here
        self._length[row] = 1.0
        self._penalty[row] = max(self._penalty[row], _PENALTY * multiplier)

    def _judge(self, row: int, trial: FloatArray, violation: float, slope: FloatArray) -> None:
        """Accept a trial step, or halve it."""
        distance = float(self._problem.search_distance(trial))
        placed = rank(distance, violation)
        if placed < self._best_rank[row]:
            self._best[row], self._best_rank[row] = trial, placed
        penalty = float(self._penalty[row])
        merit_here = float(self._problem.search_distance(self._here[row]))
        merit_here += penalty * max(0.0, float(self._violation[row]))
        merit = distance + penalty * max(0.0, violation)
        self._fresh[row] = merit < merit_here or self._length[row] <= _SHORTEST
        if self._fresh[row]:
            self._here[row], self._slope[row], self._violation[row] = trial, slope, violation
        else:
            self._length[row] *= 0.5


def _minimiser(
    problem: ResolveProblem,
    centre: FloatArray,
    here: FloatArray,
    slope: FloatArray,
    violation: float,
) -> tuple[FloatArray, float]:
    """Find the pose nearest to a centre with slope . (Z - here) + violation <= 0 in the bounds.

    Codes that would leave the bounds stop there, and the others compensate. Also return the
    constraint's multiplier.
    """
    goal, multiplier = centre, 0.0
    direction = np.where(problem.movable, slope / problem.code_weights, 0.0)
    inside = np.ones(len(here), dtype=np.bool_)
    for _ in range(_BOUND_ROUNDS):
        fall = float(slope[inside] @ direction[inside])
        if fall <= 0.0:
            break
        settled = float(slope[~inside] @ (goal - here)[~inside])
        missing = violation + settled + float(slope[inside] @ (centre - here)[inside])
        multiplier = max(0.0, missing / fall)
        unbounded = centre - multiplier * direction
        goal = np.clip(unbounded, problem.low, problem.high)
        stopped = inside & (goal != unbounded)
        if not stopped.any():
            break
        inside &= ~stopped
    return goal, 2.0 * multiplier


POLISH_ROUNDS = 6


def polish(
    check: ExactCheck,
    problem: ResolveProblem,
    start: FloatArray,
    contacts: Contacts | None = None,
) -> FloatArray | None:
    """Leave shallow contact by a small move.

    Newton's method on the depths of the contacts: each round takes the smallest move that separates
    all contacts found so far. Depths of pairs of faces saturate where bodies penetrate deeply, and
    then give no direction: such poses fail.

    Parameters
    ----------
    check, problem : of the pose
    start : (D,) float64 array
    contacts : receives those met on the way, if given

    Returns
    -------
    latent : (D,) float64 array, collision-free, or None

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    contacts = contacts or Contacts(check)
    latent = start
    for _ in range(POLISH_ROUNDS):
        problem.deadline.poll()
        if not contacts.add(latent):
            return latent
        goal = problem.nearest(start, contacts)
        if goal is None or problem.deadline.expired:
            return None
        latent = goal
    return latent if check.is_free(latent) else None


MAX_EVALUATIONS = 200
_TOLERANCE = 1e-3
_INNER_TOLERANCE = 1e-3
_INNER_EVALUATIONS = 40

OBJECTIVE_OFFSET = 1.0
"""Added to the objective, which is in units of ||Z*||^2: AUGLAG's first penalty is proportional to
the objective, and from Z* it would be the least possible and take many rounds to grow."""

_LEAST_SIZE = 1e-3
"""Least unit of the objective, as a share of the bounds' squared diagonal: Z* may be zero."""

_STATUS = {
    nlopt.SUCCESS: "converged",
    nlopt.STOPVAL_REACHED: "stop value reached",
    nlopt.FTOL_REACHED: "objective settled",
    nlopt.XTOL_REACHED: "pose settled",
    nlopt.MAXEVAL_REACHED: "out of evaluations",
    nlopt.MAXTIME_REACHED: "out of time",
}
_FAILURES = (nlopt.RoundoffLimited, RuntimeError, getattr(nlopt, "runtime_error", RuntimeError))
"""Exceptions that NLopt raises on failure; from 2.10 no longer `RuntimeError`."""

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
    start : (D,) float64 array, clipped to the bounds
    margin : >= 0

    Returns
    -------
    outcome : the best iterate of all callbacks, however the solver ended, or the start if there
        was none; its iterations are NLopt's evaluations

    Raises
    ------
    CancelledError : the job was cancelled, at the next evaluation.

    Notes
    -----
    The method of Tan et al. 2021 is AUGLAG, there by LOQO; here with LBFGS as the inner solver and
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
        """Evaluate the model and keep the pose if it is the best so far."""
        nonlocal best, evaluated, halt
        evaluated = True
        excess, slope = problem.excess(latent[None])
        # A constraint that holds within the tolerance then holds exactly.
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
        # An inner failure ends the outer loop; the iterates kept by the callbacks stay valid.
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
