"""The solvers on problems with known nearest points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import Job
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.exact import least_step
from lcollision_core.resolve import Metric, ResolveOptions, Solver
from lcollision_core.resolve.problem import Deadline, ResolveProblem, SolverOutcome
from lcollision_core.resolve.solvers import SqpBatch, solve_nlopt
from tests.core.resolve.toys import Ball, HalfSpace, toy_problem

TARGET = np.array([1.0, 2.0, -1.0, 0.5])
NORMAL = np.array([1.0, 1.0, 0.0, -2.0])
CENTRE = np.array([0.8, 1.5, -1.0, 0.2])


def solve(solver: Solver, problem: ResolveProblem, margin: float = 0.0) -> SolverOutcome:
    if solver == Solver.SQP:
        return SqpBatch(problem, problem.target[None], np.array([margin])).run(60)[0]
    return solve_nlopt(problem, solver, problem.target, margin)


def nearest_below(offset: float) -> FloatArray:
    """Return the nearest point to TARGET in the half-space NORMAL . Z <= offset."""
    excess = NORMAL @ TARGET - offset
    nearest: FloatArray = TARGET - excess * NORMAL / (NORMAL @ NORMAL)
    return nearest


@pytest.mark.parametrize("solver", Solver)
@pytest.mark.parametrize("margin", [0.0, 1.5])
def test_half_space(solver: Solver, margin: float) -> None:
    problem = toy_problem(HalfSpace(NORMAL, 0.5), TARGET)
    outcome = solve(solver, problem, margin)
    assert outcome.feasible
    assert outcome.converged
    np.testing.assert_allclose(outcome.latent, nearest_below(0.5 - margin), atol=2e-2)
    assert NORMAL @ outcome.latent <= 0.5 - margin
    assert 0 < problem.evaluations < 200


@pytest.mark.parametrize("solver", Solver)
def test_out_of_a_ball(solver: Solver) -> None:
    problem = toy_problem(Ball(CENTRE, 1.0), TARGET)
    outcome = solve(solver, problem)
    offset = TARGET - CENTRE
    nearest = CENTRE + offset / np.linalg.norm(offset)
    assert outcome.feasible
    assert np.linalg.norm(outcome.latent - CENTRE) >= 1.0
    np.testing.assert_allclose(outcome.latent, nearest, atol=3e-2)


@pytest.mark.parametrize("solver", Solver)
def test_into_a_ball(solver: Solver) -> None:
    centre = np.array([-1.0, 0.0, 1.0, 0.0])
    problem = toy_problem(Ball(centre, 0.5, sign=-1.0), TARGET)
    outcome = solve(solver, problem)
    offset = TARGET - centre
    nearest = centre + 0.5 * offset / np.linalg.norm(offset)
    assert outcome.feasible
    np.testing.assert_allclose(outcome.latent, nearest, atol=3e-2)


@pytest.mark.parametrize("solver", Solver)
def test_bounds_hold_and_the_other_codes_make_up_for_them(solver: Solver) -> None:
    problem = toy_problem(HalfSpace(NORMAL, -4.0), TARGET)
    problem.low = np.array([0.0, -10.0, -10.0, -10.0])
    problem.high = np.array([10.0, 10.0, 10.0, 1.0])
    # The first and the last code stop at their bounds, 0 and 1, and the second gives the rest, as
    # 0 + z - 2 = -4.
    outcome = solve(solver, problem)
    assert outcome.feasible
    np.testing.assert_allclose(outcome.latent, [0.0, -2.0, -1.0, 1.0], atol=3e-2)


@pytest.mark.parametrize("solver", Solver)
def test_locked_codes_stay_to_the_bit(solver: Solver) -> None:
    problem = toy_problem(HalfSpace(NORMAL, 0.5), TARGET)
    problem.low[[0, 3]] = problem.high[[0, 3]] = TARGET[[0, 3]]
    outcome = solve(solver, problem)
    assert outcome.latent[[0, 3]].tolist() == TARGET[[0, 3]].tolist()
    np.testing.assert_allclose(outcome.latent[1], TARGET[1] - (2.0 - 0.5), atol=2e-2)


@pytest.mark.parametrize("solver", Solver)
def test_dear_codes_move_less(solver: Solver) -> None:
    weights = np.array([4.0, 1.0, 1.0, 1.0])
    problem = toy_problem(HalfSpace(NORMAL, 0.5), TARGET, code_weights=weights)
    direction = NORMAL / weights
    nearest = TARGET - (NORMAL @ TARGET - 0.5) * direction / (NORMAL @ direction)
    np.testing.assert_allclose(solve(solver, problem).latent, nearest, atol=2e-2)


@pytest.mark.parametrize("solver", Solver)
def test_what_cannot_be_reached_ends_in_the_nearest_corner_with_a_status(solver: Solver) -> None:
    problem = toy_problem(HalfSpace(NORMAL, -1e3), TARGET, bound=2.0)
    outcome = solve(solver, problem)
    assert not outcome.feasible
    # NLopt's solvers end with different statuses.
    assert outcome.status == "stopped" if solver == Solver.SQP else outcome.status
    assert (np.abs(outcome.latent) <= 2.0).all()
    # Codes with a zero in NORMAL keep the target's value.
    np.testing.assert_allclose(outcome.latent, [-2.0, -2.0, -1.0, 2.0], atol=1e-6)


@pytest.mark.parametrize("solver", Solver)
def test_same_problem_same_bits(solver: Solver) -> None:
    first, second = (solve(solver, toy_problem(Ball(CENTRE, 1.0), TARGET)) for _ in range(2))
    assert first.latent.tobytes() == second.latent.tobytes()
    assert first.iterations == second.iterations > 0


@pytest.mark.parametrize("solver", Solver)
@pytest.mark.parametrize("at_call", [1, 2, 3])
def test_cancel_stops_before_the_next_evaluation(solver: Solver, at_call: int) -> None:
    token = Job()
    calls = 0

    class Cancelling:
        def logit_and_gradient(self, latent: npt.NDArray) -> tuple[FloatArray, FloatArray]:
            nonlocal calls
            calls += 1
            if calls == at_call:
                token.cancel()
            # Curved, so that no solver converges in one step.
            return 81.0 - (latent**2).sum(axis=1), -2.0 * latent

    problem = toy_problem(Cancelling(), TARGET, deadline=Deadline(job=token))
    with pytest.raises(CancelledError):
        solve(solver, problem)
    assert calls == at_call


@pytest.mark.parametrize("solver", Solver)
def test_no_time_still_returns_a_pose(solver: Solver) -> None:
    half_space = HalfSpace(NORMAL, 0.5)
    outcome = solve(solver, toy_problem(half_space, TARGET, deadline=Deadline(budget=0.0)))
    assert half_space.n_calls == 1
    assert outcome.status == ("stopped" if solver == Solver.SQP else "out of time")
    assert not outcome.converged
    assert outcome.latent.tolist() == TARGET.tolist()


@pytest.mark.parametrize("solver", [Solver.AUGLAG, Solver.SLSQP, Solver.CCSAQ])
def test_a_model_that_breaks_leaves_the_best_pose_so_far(solver: Solver) -> None:
    calls = 0

    class Breaking:
        def logit_and_gradient(self, latent: npt.NDArray) -> tuple[FloatArray, FloatArray]:
            nonlocal calls
            calls += 1
            logit, gradient = HalfSpace(NORMAL, 0.5).logit_and_gradient(latent)
            return (logit, gradient) if calls < 4 else (logit * np.nan, gradient)

    outcome = solve(solver, toy_problem(Breaking(), TARGET))
    assert calls == 4
    assert outcome.status == "prediction not finite"
    assert np.isfinite(outcome.latent).all()
    assert NORMAL @ outcome.latent < NORMAL @ TARGET


@pytest.mark.parametrize("solver", [Solver.AUGLAG, Solver.SLSQP, Solver.CCSAQ])
def test_a_model_that_is_broken_leaves_the_start(solver: Solver) -> None:
    outcome = solve(solver, toy_problem(HalfSpace(NORMAL, np.nan), TARGET, bound=1.5))
    assert outcome.status == "prediction not finite"
    assert not outcome.converged
    assert not outcome.feasible
    assert outcome.latent.tolist() == np.clip(TARGET, -1.5, 1.5).tolist()


@pytest.mark.parametrize("solver", Solver)
def test_from_the_zero_pose(solver: Solver) -> None:
    problem = toy_problem(HalfSpace(NORMAL, -1.0), np.zeros(4))
    outcome = solve(solver, problem)
    assert outcome.feasible
    assert outcome.converged
    np.testing.assert_allclose(outcome.latent, -NORMAL / (NORMAL @ NORMAL), atol=2e-2)


@pytest.mark.parametrize("solver", Solver)
def test_slopes_that_mislead_end_with_the_best_pose_so_far(solver: Solver) -> None:
    """AUGLAG's inner L-BFGS fails on these, and NLopt raises."""

    class Misleading:
        def logit_and_gradient(self, latent: npt.NDArray) -> tuple[FloatArray, FloatArray]:
            logit, gradient = HalfSpace(NORMAL, 0.5).logit_and_gradient(latent)
            return logit, -1e3 * gradient * np.sign(np.sin(1e4 * latent))

    problem = toy_problem(Misleading(), TARGET)
    outcome = solve(solver, problem)
    assert problem.evaluations > 1
    assert (np.abs(outcome.latent) <= 10.0).all()
    assert NORMAL @ outcome.latent < NORMAL @ TARGET


def test_rows_of_a_batch_do_not_know_of_each_other() -> None:
    problem = toy_problem(Ball(CENTRE, 1.0), TARGET)
    starts = np.stack([TARGET, TARGET + 0.2, TARGET])
    margins = np.array([0.0, 0.0, 2.0])
    together = SqpBatch(problem, starts, margins).run(40)
    for start, margin, outcome in zip(starts, margins, together, strict=True):
        alone = SqpBatch(problem, start[None], np.array([margin])).run(40)[0]
        np.testing.assert_allclose(outcome.latent, alone.latent, atol=1e-12)
        assert outcome.iterations == alone.iterations
    reached = [np.linalg.norm(outcome.latent - CENTRE) for outcome in together]
    np.testing.assert_allclose(reached, [1.0, 1.0, 1.2], atol=1e-2)


def test_sqp_run_in_pieces_is_the_same_run() -> None:
    def batch() -> SqpBatch:
        return SqpBatch(toy_problem(Ball(CENTRE, 1.0), TARGET), TARGET[None], np.array([3.0]))

    pieces = batch()
    pieces.run(2)
    assert pieces.run(30)[0].latent.tobytes() == batch().run(32)[0].latent.tobytes()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"solver": "simplex"}, "unknown solver 'simplex'; choose one of sqp, auglag"),
        ({"metric": "taxicab"}, "unknown metric 'taxicab'; choose one of vertices, latent"),
        ({"threshold": 0.0}, "the threshold must be over 0.0, got 0"),
        ({"threshold": 1.0}, "the threshold must be below 1.0, got 1"),
        ({"threshold": float("nan")}, "the threshold must be over 0.0, got nan"),
        ({"margin": -1.0}, "margin must be at least 0.0, got -1"),
        ({"margin": float("inf")}, "margin must be finite, got inf"),
        ({"time_budget": 0.0}, "the time budget must be over 0.0, got 0"),
        ({"group_weights": (1.0, 0.0)}, "weight must be a number above 0"),
        ({"seed": -1}, "the seed must be at least 0, got -1"),
        ({"clearance": 1.0}, "the clearance must be below 1.0, got 1"),
        ({"clearance": -0.1}, "the clearance must be at least 0.0, got -0.1"),
        ({"clearance": float("nan")}, "the clearance must be at least 0.0, got nan"),
        *(
            ({"largest_change": most}, f"the largest change must be {expected}, got {most:g}")
            for most, expected in ((0.0, "over 0.0"), (float("inf"), "finite"))
        ),
    ],
)
def test_options_that_cannot_be_are_refused(change: dict, sentence: str) -> None:
    with pytest.raises(LCollisionError, match=sentence):
        ResolveOptions(**change)


def test_the_older_name_of_a_metric_still_means_it() -> None:
    assert ResolveOptions(metric="eye") == ResolveOptions(metric=Metric.DISPLACEMENT)


def test_the_threshold_is_a_probability() -> None:
    assert ResolveOptions().threshold_logit == 0.0
    assert ResolveOptions(threshold=0.2).threshold_logit == pytest.approx(np.log(0.25))


def quadratic(problem: ResolveProblem) -> Callable[[FloatArray], float]:
    return lambda latent: float(problem.distance(latent))


def test_the_least_step_within_half_spaces_agrees_with_a_general_solver() -> None:
    from scipy.optimize import minimize

    generator = np.random.default_rng(4)
    n_bound = 0
    for _ in range(20):
        size = 6
        root = generator.normal(size=(size, size))
        problem = toy_problem(HalfSpace(np.ones(size), 0.0), generator.normal(size=size))
        problem.metric = root @ root.T + 0.1 * np.eye(size)
        problem.low, problem.high = problem.target - 0.06, problem.target + 0.06
        normals = generator.normal(size=(3, size))
        inside = problem.target + generator.uniform(-0.05, 0.05, size)
        offsets = normals @ inside + generator.uniform(0.0, 0.01, 3)
        nearest = least_step(
            problem.metric,
            np.zeros(size),
            problem.target,
            problem.low,
            problem.high,
            normals,
            offsets,
        )
        expected = minimize(
            quadratic(problem),
            problem.target,
            method="SLSQP",
            bounds=list(zip(problem.low, problem.high, strict=True)),
            constraints={
                "type": "ineq",
                "fun": lambda z, n=normals, o=offsets: o - n @ z,
            },
            options={"maxiter": 500, "ftol": 1e-14},
        )
        assert expected.success
        assert nearest is not None
        np.testing.assert_allclose(nearest, expected.x, atol=1e-4)
        n_bound += int((np.abs(nearest - problem.target) > 0.06 - 1e-9).any())
    assert n_bound > 2


def test_half_spaces_without_a_common_point_have_no_nearest() -> None:
    problem = toy_problem(HalfSpace(NORMAL, 0.0), TARGET)
    normals = np.stack([NORMAL, -NORMAL])
    bounds = problem.low, problem.high
    offsets = np.array([-1.0, -1.0])
    assert least_step(problem.metric, np.zeros(4), TARGET, *bounds, normals, offsets) is None


def test_without_half_spaces_the_centre_is_nearest() -> None:
    problem = toy_problem(HalfSpace(NORMAL, 0.0), TARGET)
    nearest = least_step(
        problem.metric,
        np.zeros(4),
        TARGET,
        problem.low,
        problem.high,
        np.empty((0, 4)),
        np.empty(0),
    )
    assert nearest is not None
    assert nearest.tolist() == TARGET.tolist()
