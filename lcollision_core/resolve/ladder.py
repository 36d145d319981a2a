"""The ladder: the steps that Resolve tries in turn until a pose is collision-free."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from lcollision_core.contact import SelfCollisions
from lcollision_core.jobs import Progress
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options.resolve import ResolveOptions, Solver
from lcollision_core.posing import ExactCheck
from lcollision_core.resolve.polish import polish
from lcollision_core.resolve.problem import ResolveProblem, SolverOutcome
from lcollision_core.resolve.pull_back import fall_back, pull_back
from lcollision_core.resolve.result import ResolveResult, Step
from lcollision_core.resolve.soft import LeastOverlap
from lcollision_core.resolve.sqp import SqpBatch
from lcollision_core.resolve.standing import Standing
from lcollision_core.resolve.towards import step_towards

MARGINS = (0.0, 2.0, 8.0)
"""In the logit, above the user's own. Those that no pose reaches still lead the right way."""

ITERATIONS = (1, 3, 2, 4, 6, 14)
"""After each of these the poses are checked exactly, and the first that is free ends the search:
pulling back then brings it nearer to the target than further iterations do."""

START_MARGIN, START_ITERATIONS = 6.0, 15
_KNOWN_STARTS, _RANDOM_STARTS = 4, 4
_SPREAD = 0.1
_REMEMBERED, _POLISHED = 8, 3

_ITERATIONS_ALONE = 60

ALL_LOCKED = "all body parts are locked, so the pose was not changed; unlock one"
"""The note of a result whose pose had no code that may move."""

_Tried = tuple[Step, FloatArray | None]
"""A step, and the free pose that it found or None."""


@dataclass(eq=False)
class Ladder:
    """One run of the ladder: see `PoseResolver.resolve`.

    Attributes
    ----------
    problem, check, options : of the pose
    free_latents : (F, D) float64 array of poses known to be free
    correction : (D,) float64 array to try first, or None
    progress : called with (steps done, all steps), the last step being to pull back
    remark : on the request, whatever its result, or None
    standing : what is to stay on the ground, or None
    """

    problem: ResolveProblem
    check: ExactCheck
    options: ResolveOptions
    free_latents: FloatArray
    correction: FloatArray | None
    progress: Progress
    remark: str | None = None
    standing: Standing | None = None

    def __post_init__(self) -> None:
        self._margin = self.options.margin or 0.0
        self._outcome = SolverOutcome(self.problem.target, "not run", False, False, 0)
        self._candidates: deque[FloatArray] = deque(maxlen=_REMEMBERED)

    def climb(self) -> ResolveResult:
        """Try the steps until one resolves the collisions, then pull back."""
        problem, check = self.problem, self.check
        problem.deadline.poll()
        before = check.find(check.exported(check.decode(problem.target)[0]))
        latent, step, note = problem.target, Step.NONE, None
        if not before.colliding:
            step = Step.UNCHANGED
        elif not problem.movable.any():
            note = ALL_LOCKED
        else:
            if problem.model is None:
                self._outcome = replace(self._outcome, status="no predictor")
            for done, (tried, found) in enumerate(self._steps(), 1):
                self.progress(done, self._n_steps)
                if found is not None:
                    latent, step = self._put_back(pull_back(check, problem, found)), tried
                    break
            else:
                note = self._why_not()
            if self.options.largest_change is not None:
                found = None if step == Step.NONE else latent
                latent, step, note = self._soften(found, step, self.options.largest_change, note)
        result = self._result(latent, step, before, note)
        self.progress(self._n_steps, self._n_steps)
        return result

    def _put_back(self, free: FloatArray) -> FloatArray:
        """Return a free pose with what stood in the target on the ground."""
        if self.standing is None:
            return free
        return self.standing.put_back(self.check, self.problem, free)

    def _soften(
        self, found: FloatArray | None, step: Step, most: float, note: str | None
    ) -> tuple[FloatArray, Step, str | None]:
        """Return a free pose that moves no vertex too far, else the one of least overlap.

        Where no pose was found free, however far, the note of that stays.
        """
        least = LeastOverlap(self.check, self.problem, most)
        if found is not None and least.is_within(found):
            return found, step, None
        known = np.where(self.problem.movable, self.free_latents, self.problem.target)
        nearest = known[np.argsort(self.problem.distance(known), kind="stable")]
        latent = least.find([*([] if found is None else [found]), *nearest])
        if self.check.is_free(latent):
            return latent, Step.SOFT, None
        if found is not None:
            note = f"no free pose was found within {100.0 * most:g} % of the body size"
        is_same = np.array_equal(latent, self.problem.target)
        return latent, Step.NONE if is_same else Step.SOFT, note

    def solve_only(self) -> ResolveResult:
        """Solve the paper's problem and check nothing exactly."""
        problem = self.problem
        if not problem.movable.any():
            excess, _ = problem.excess(problem.target[None])
            if excess[0] + self._margin <= 0.0:
                return self._result(problem.target, Step.UNCHANGED, None)
            return self._result(problem.target, Step.NONE, None, ALL_LOCKED)
        outcome = self._outcome = self._solve(self._margin, problem.target)
        moved = not np.array_equal(outcome.latent, problem.target)
        step = Step.NONE if not outcome.feasible else Step.SOLVER if moved else Step.UNCHANGED
        return self._result(outcome.latent, step, None)

    @property
    def _n_steps(self) -> int:
        """Return the most steps that `_steps` yields, plus pulling back."""
        if self.problem.model is None:
            n_tries = 1
        elif self.options.solver == Solver.SQP:
            n_tries = len(ITERATIONS) + 1
        else:
            n_tries = len(MARGINS) + min(len(self.free_latents), _KNOWN_STARTS) + _RANDOM_STARTS
        # The neighbour's correction, the tries, polishing, falling back and pulling back.
        return int(self.correction is not None) + n_tries + _POLISHED + 2

    def _steps(self) -> Iterator[_Tried]:
        problem = self.problem
        if self.correction is not None:
            near = np.clip(problem.target + self.correction, problem.low, problem.high)
            yield Step.NEIGHBOUR, self._first_free([near])
        if problem.model is None:
            tries = chain(self._by_polish(), self._from_free_poses())
        else:
            tries = chain(self._by_margins(), self._by_polish(), self._by_restarts())
        while not problem.deadline.expired and (tried := next(tries, None)) is not None:
            yield tried
        yield Step.FALL_BACK, fall_back(self.check, problem, self.free_latents)

    def _by_margins(self) -> Iterator[_Tried]:
        problem = self.problem
        margins = np.array(MARGINS) + self._margin
        if self.options.solver != Solver.SQP:
            reached, step = problem.target, Step.SOLVER
            for margin in margins:
                outcome = self._solve(float(margin), reached)
                if step == Step.SOLVER:
                    self._outcome = outcome
                reached = outcome.latent
                yield step, self._first_free([reached])
                step = Step.MARGIN
            return
        batch = SqpBatch(problem, np.tile(problem.target, (len(margins), 1)), margins)
        for n_iterations in ITERATIONS:
            outcomes = batch.run(n_iterations)
            self._outcome = outcomes[0]
            latent = self._first_free([outcome.latent for outcome in outcomes])
            is_first = latent is not None and np.array_equal(latent, outcomes[0].latent)
            yield Step.SOLVER if is_first else Step.MARGIN, latent

    def _by_restarts(self) -> Iterator[_Tried]:
        """Start between Z* and known free poses, and at random poses near Z*."""
        problem = self.problem
        known = np.where(problem.movable, self.free_latents, problem.target)
        order = np.argsort(problem.search_distance(known), kind="stable")[:_KNOWN_STARTS]
        generator = np.random.default_rng(self.options.seed)
        span = problem.high - problem.low
        moves = generator.uniform(-_SPREAD, _SPREAD, (_RANDOM_STARTS, len(span))) * span
        starts = np.concatenate([0.5 * (problem.target + known[order]), problem.target + moves])
        margin = START_MARGIN + self._margin
        if self.options.solver == Solver.SQP:
            batch = SqpBatch(problem, starts, np.full(len(starts), margin))
            outcomes = batch.run(START_ITERATIONS)
            yield Step.RESTART, self._first_free([outcome.latent for outcome in outcomes])
            return
        for start in starts:
            yield Step.RESTART, self._first_free([self._solve(margin, start).latent])

    def _from_free_poses(self) -> Iterator[_Tried]:
        yield Step.TOWARDS, step_towards(self.check, self.problem, self.free_latents)

    def _by_polish(self) -> Iterator[_Tried]:
        """Polish the poses that the steps before left in the shallowest contact."""
        poses = np.unique(np.stack([self.problem.target, *self._candidates]), axis=0)
        decoded = self.check.exported(self.check.decode(poses))
        energies = [self.check.find(vertices).energy for vertices in decoded]
        for index in np.argsort(energies, kind="stable")[:_POLISHED]:
            yield Step.POLISH, polish(self.check, self.problem, poses[index])

    def _solve(self, margin: float, start: FloatArray) -> SolverOutcome:
        if self.options.solver == Solver.SQP:
            batch = SqpBatch(self.problem, start[None], np.array([margin]))
            return batch.run(_ITERATIONS_ALONE)[0]
        from lcollision_core.resolve.nlopt_solvers import solve_nlopt

        return solve_nlopt(self.problem, Solver(self.options.solver), start, margin)

    def _first_free(self, latents: Sequence[FloatArray]) -> FloatArray | None:
        """Return the nearest of some poses that is free; remember those that are not."""
        for latent in sorted(latents, key=self.problem.distance):
            self.problem.deadline.poll()
            if self.check.is_free(latent):
                return latent
            self._candidates.append(latent)
        return None

    def _why_not(self) -> str:
        if len(self.free_latents) == 0:
            return "no collision-free pose is known to fall back to, so the pose still collides"
        if self.problem.movable.all():
            if self.check.clearance > 0.0:
                return "no pose with this clearance was found; choose a smaller one"
            return "no pose without collisions was found"
        return "no free pose was found that keeps the locked body parts; unlock one"

    def _result(
        self,
        latent: FloatArray,
        step: Step,
        before: SelfCollisions | None,
        note: str | None = None,
    ) -> ResolveResult:
        problem, check = self.problem, self.check
        target, decoded = (check.decode(pose)[0] for pose in (problem.target, latent))
        moved = np.linalg.norm(decoded - target, axis=1)
        vertices = check.exported(decoded)
        after = before if step == Step.UNCHANGED else check.find(vertices) if before else None
        predicted_free = None
        if problem.model is not None:
            predicted_free = bool(problem.excess(latent[None])[0][0] <= 0.0)
        nearest = check.least_distance(vertices) if before and check.clearance > 0.0 else None
        answer = latent.copy()
        answer.flags.writeable = vertices.flags.writeable = False
        return ResolveResult(
            latent=answer,
            vertices=vertices,
            solver_status=self._outcome.status,
            converged=self._outcome.converged,
            predicted_free=predicted_free,
            exactly_free=not after.colliding if after else None,
            step=step,
            energy_before=before.energy if before else None,
            energy_after=after.energy if after else None,
            pairs_before=len(before.pairs) if before else None,
            pairs_after=len(after.pairs) if after else None,
            latent_distance=relative_distance(latent, problem.target),
            vertex_distance_mean=float(moved.mean()),
            vertex_distance_max=float(moved.max()),
            iterations=self._outcome.iterations,
            evaluations=problem.evaluations,
            seconds=problem.deadline.seconds,
            note="; ".join(filter(None, (self.remark, note))) or None,
            clearance=self.options.clearance,
            largest_change=self.options.largest_change,
            deepest_after=after.deepest if after else None,
            least_distance=nearest.distance if nearest else None,
        )


def relative_distance(latent: FloatArray, target: FloatArray) -> float:
    """Measure ||Z - Z*|| / ||Z*|| of two (D,) poses, or ||Z - Z*|| where Z* is the zero pose."""
    return float(np.linalg.norm(latent - target)) / (float(np.linalg.norm(target)) or 1.0)
