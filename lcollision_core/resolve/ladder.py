"""The ladder: what is tried, in which order, until a pose is exactly free."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lcollision_core.contact import SelfCollisions
from lcollision_core.jobs import Progress
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.metric import relative_distance
from lcollision_core.resolve.options import ResolveOptions, ResolveResult, Solver, Step
from lcollision_core.resolve.polish import polish
from lcollision_core.resolve.problem import ResolveProblem, SolverOutcome
from lcollision_core.resolve.shorten import shorten
from lcollision_core.resolve.sqp import SqpBatch
from lcollision_core.resolve.walk_back import walk_back

MARGINS = (0.0, 2.0, 4.0, 8.0, 16.0)
"""In the logit, above the user's own. Those that no pose reaches still push in the right way."""

ITERATIONS = (1, 1, 2, 2, 24)
"""After each of these the poses are checked exactly, and the first that is free ends the search:
what it lacks in nearness, shortening makes up for better than further iterations do."""

START_MARGIN, START_ITERATIONS = 6.0, 15
_KNOWN_STARTS, _RANDOM_STARTS = 4, 4
_SPREAD = 0.1
_REMEMBERED, _POLISHED = 8, 3

_ITERATIONS_ALONE = 60

ALL_LOCKED = "all body parts are locked, so the pose stays as it is; unlock one"
"""The note of a result that no lock let move."""


class Ladder:
    """One climb: see `PoseResolver.resolve`.

    Parameters
    ----------
    problem, check, options : of the pose
    free_latents : (F, D) float64 array of poses known to be free
    correction : (D,) float64 array to try first, or None
    progress : called with (steps done, all steps), the last step being to shorten
    remark : what there is to say of the request whatever comes of it, or None
    """

    def __init__(
        self,
        problem: ResolveProblem,
        check: ExactCheck,
        options: ResolveOptions,
        free_latents: FloatArray,
        correction: FloatArray | None,
        progress: Progress,
        remark: str | None = None,
    ) -> None:
        self._problem, self._check, self._options = problem, check, options
        self._free_latents, self._correction = free_latents, correction
        self._progress, self._remark = progress, remark
        self._status, self._converged, self._iterations = "not run", False, 0
        self._candidates: list[FloatArray] = []

    def climb(self) -> ResolveResult:
        """Try the steps until one frees the pose, then shorten."""
        result = self._climb()
        self._progress(self._n_steps, self._n_steps)
        return result

    def _climb(self) -> ResolveResult:
        problem, check = self._problem, self._check
        problem.watch.poll()
        before = check.find(check.decode(problem.target)[0])
        if not before.colliding:
            return self._result(problem.target, Step.UNCHANGED, before)
        if not problem.movable.any():
            return self._result(problem.target, Step.NONE, before, ALL_LOCKED)
        for done, (step, latent) in enumerate(self._steps(), 1):
            self._progress(done, self._n_steps)
            if latent is not None:
                return self._result(shorten(check, problem, latent), step, before)
        return self._result(problem.target, Step.NONE, before, self._why_not())

    def solve_only(self) -> ResolveResult:
        """Solve the paper's problem and check nothing exactly."""
        problem, margin = self._problem, self._options.margin or 0.0
        if not problem.movable.any():
            excess, _ = problem.excess(problem.target[None])
            if excess[0] + margin <= 0.0:
                return self._result(problem.target, Step.UNCHANGED, None)
            return self._result(problem.target, Step.NONE, None, ALL_LOCKED)
        outcome = self._solve(margin)
        self._keep(outcome)
        moved = not np.array_equal(outcome.latent, problem.target)
        step = Step.NONE if not outcome.feasible else Step.SOLVER if moved else Step.UNCHANGED
        return self._result(outcome.latent, step, None)

    @property
    def _n_steps(self) -> int:
        """Count, at most, what `_steps` yields and the shortening."""
        if self._options.solver == Solver.SQP:
            n_tries = len(ITERATIONS) + 1
        else:
            n_tries = len(MARGINS) + min(len(self._free_latents), _KNOWN_STARTS) + _RANDOM_STARTS
        # The neighbour's correction, the tries, polishing, the walk back and the shortening.
        return int(self._correction is not None) + n_tries + _POLISHED + 2

    def _steps(self) -> Iterator[tuple[Step, FloatArray | None]]:
        """Yield each try: its step, and the free pose that it found or None."""
        problem = self._problem
        if self._correction is not None:
            near = np.clip(problem.target + self._correction, problem.low, problem.high)
            yield Step.NEIGHBOUR, self._first_free([near])
        for find in (self._by_margins, self._by_polish, self._by_starts):
            if not problem.watch.expired:
                yield from find()
        yield Step.WALK_BACK, walk_back(self._check, problem, self._free_latents)

    def _by_margins(self) -> Iterator[tuple[Step, FloatArray | None]]:
        problem = self._problem
        margins = np.array(MARGINS) + (self._options.margin or 0.0)
        if self._options.solver != Solver.SQP:
            reached = problem.target
            for margin in margins:
                outcome = self._solve(float(margin), reached)
                if margin == margins[0]:
                    self._keep(outcome)
                reached = outcome.latent
                step = Step.SOLVER if margin == margins[0] else Step.MARGIN
                yield step, self._first_free([reached])
                if problem.watch.expired:
                    return
            return
        batch = SqpBatch(problem, np.tile(problem.target, (len(margins), 1)), margins)
        for n_iterations in ITERATIONS:
            outcomes = batch.run(n_iterations)
            self._keep(outcomes[0])
            latent = self._first_free([outcome.latent for outcome in outcomes])
            is_first = latent is not None and np.array_equal(latent, outcomes[0].latent)
            yield Step.SOLVER if is_first else Step.MARGIN, latent
            if problem.watch.expired:
                return

    def _by_starts(self) -> Iterator[tuple[Step, FloatArray | None]]:
        """Start between Z* and known free poses, and at random about Z*."""
        problem = self._problem
        known = np.where(problem.movable, self._free_latents, problem.target)
        order = np.argsort(problem.search_distance(known), kind="stable")[:_KNOWN_STARTS]
        generator = np.random.default_rng(self._options.seed)
        span = problem.high - problem.low
        chance = generator.uniform(-_SPREAD, _SPREAD, (_RANDOM_STARTS, len(span))) * span
        starts = np.concatenate([0.5 * (problem.target + known[order]), problem.target + chance])
        margin = START_MARGIN + (self._options.margin or 0.0)
        if self._options.solver == Solver.SQP:
            batch = SqpBatch(problem, starts, np.full(len(starts), margin))
            outcomes = batch.run(START_ITERATIONS)
            yield Step.START, self._first_free([outcome.latent for outcome in outcomes])
            return
        for start in starts:
            if problem.watch.expired:
                return
            yield Step.START, self._first_free([self._solve(margin, start).latent])

    def _by_polish(self) -> Iterator[tuple[Step, FloatArray | None]]:
        """Polish the poses that the steps before left in the shallowest contact."""
        poses = np.unique(np.stack([self._problem.target, *self._candidates]), axis=0)
        energies = [self._check.find(vertices).energy for vertices in self._check.decode(poses)]
        for place in np.argsort(energies, kind="stable")[:_POLISHED]:
            yield Step.POLISH, polish(self._check, self._problem, poses[place])
            if self._problem.watch.expired:
                return

    def _solve(self, margin: float, start: FloatArray | None = None) -> SolverOutcome:
        problem = self._problem
        begin = problem.target if start is None else start
        if self._options.solver == Solver.SQP:
            batch = SqpBatch(problem, begin[None], np.array([margin]))
            return batch.run(_ITERATIONS_ALONE)[0]
        from lcollision_core.resolve.nlopt_solvers import solve_nlopt

        return solve_nlopt(problem, Solver(self._options.solver), begin, margin)

    def _keep(self, outcome: SolverOutcome) -> None:
        self._status, self._converged = outcome.status, outcome.converged
        self._iterations = outcome.iterations

    def _first_free(self, latents: Sequence[FloatArray]) -> FloatArray | None:
        """Return the nearest of some poses that is exactly free; remember those that are not."""
        for latent in sorted(latents, key=lambda one: float(self._problem.distance(one))):
            self._problem.watch.poll()
            if self._check.is_free(latent):
                return latent
            self._candidates = [*self._candidates[1 - _REMEMBERED :], latent]
        return None

    def _why_not(self) -> str:
        if len(self._free_latents) == 0:
            return "no free pose of the model is known to walk back to, so the pose still collides"
        if self._problem.movable.all():
            return "the poses that the model knows as free collide, so the pose still collides"
        return "no free pose was found that keeps the locked body parts; unlock one"

    def _result(
        self,
        latent: FloatArray,
        step: Step,
        before: SelfCollisions | None,
        note: str | None = None,
    ) -> ResolveResult:
        problem, check = self._problem, self._check
        decoded = check.decode(np.stack([problem.target, latent]))
        moved = np.linalg.norm(decoded[1] - decoded[0], axis=1)
        after = before if step == Step.UNCHANGED else check.find(decoded[1]) if before else None
        excess, _ = problem.excess(latent[None])
        answer = latent.copy()
        answer.flags.writeable = False
        return ResolveResult(
            latent=answer,
            solver_status=self._status,
            converged=self._converged,
            predicted_free=bool(excess[0] <= 0.0),
            exactly_free=not after.colliding if after else None,
            step=step,
            energy_before=before.energy if before else None,
            energy_after=after.energy if after else None,
            pairs_before=len(before.pairs) if before else None,
            pairs_after=len(after.pairs) if after else None,
            latent_distance=relative_distance(latent, problem.target),
            vertex_distance_mean=float(moved.mean()),
            vertex_distance_max=float(moved.max()),
            iterations=self._iterations,
            evaluations=problem.evaluations,
            seconds=problem.watch.seconds,
            note="; ".join(filter(None, (self._remark, note))) or None,
        )
