"""Resolve a pose by a ladder of solvers and of steps from free poses; report the result."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import chain, pairwise, repeat
from threading import Lock

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import SelfCollisions
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray, evenly_spaced
from lcollision_core.options import Metric, ResolveOptions, Solver
from lcollision_core.posing import ExactCheck, PoseSpace
from lcollision_core.resolve.problem import (
    CollisionModel,
    Deadline,
    ResolveProblem,
    SolverOutcome,
    single_torch_thread,
)
from lcollision_core.resolve.solvers import SqpBatch, polish, solve_nlopt
from lcollision_core.resolve.steps import (
    FAR,
    LeastOverlap,
    Standing,
    draw_nearer,
    fall_back,
    pull_back,
    step_towards,
)
from lcollision_core.sentences import joined, marked, say, say_number


class Step(StrEnum):
    """The step of the ladder that a result comes from.

    After each step the pose is pulled back towards the target: see `pull_back`. Without a predictor
    it is then drawn nearer: see `draw_nearer`.
    """

    UNCHANGED = "unchanged"
    NEIGHBOUR = "neighbour"
    SOLVER = "solver"
    MARGIN = "margin"
    POLISH = "polish"
    RESTART = "start"
    TOWARDS = "towards"
    FALL_BACK = "walk-back"
    PUSH_OUT = "push-out"
    SOFT = "soft"
    NONE = "none"


@dataclass(frozen=True, eq=False)
class ResolveResult:
    """The result of Resolve. Lengths are normalised, energies in squared normalised length.

    Three facts are kept separately: whether the solver converged, whether the predictor calls the
    pose free, and whether it is free by the exact check.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    vertices : (V, 3) array, read-only, in the data's unit, as checked and to be written; float32 in
        the model's coordinates, or float64 if the pose is placed
    solver_status : the status of the solver of the paper's problem at its least margin, "not run"
        if none ran, "no predictor" if there is none
    converged : whether that solver ended by its own tolerances
    predicted_free : whether the collision probability of `latent` is at most the threshold; None
        for a body without a predictor
    exactly_free : verdict of the exact check on the exported vertices, with the clearance; None
        without `verify`
    step : the step of the ladder that resolved the collisions
    energy_before, energy_after : exact penetration energy; None without `verify`. With a clearance,
        depths are the distances that pairs lack.
    pairs_before, pairs_after : exact number of colliding pairs; None without `verify`
    latent_distance : ||Z - Z*|| / ||Z*||, or ||Z - Z*|| if Z* is the zero pose; 0 for a pose that
        did not move
    vertex_distance_mean, vertex_distance_max : from the decoded target
    iterations : of the solver at its least margin, for NLopt its evaluations; larger margins and
        restarts do not count
    evaluations : number of poses for which the predictor was evaluated
    seconds : time spent, without compiling at a first start
    note : a sentence for the user, or None
    clearance : the requested clearance, normalised
    largest_change : the requested largest change of a vertex, normalised; None for no limit
    deepest_after : the largest depth of a colliding pair, 0 for a free pose; None without `verify`
    least_distance : with a clearance, the least signed distance between parts; None if it is at
        least both `DISTANCE_BOUND` and the clearance
    """

    latent: npt.NDArray[np.float64]
    vertices: npt.NDArray[np.floating]
    solver_status: str
    converged: bool
    predicted_free: bool | None
    exactly_free: bool | None
    step: Step
    energy_before: float | None
    energy_after: float | None
    pairs_before: int | None
    pairs_after: int | None
    latent_distance: float
    vertex_distance_mean: float
    vertex_distance_max: float
    iterations: int
    evaluations: int
    seconds: float
    note: str | None = None
    clearance: float = 0.0
    least_distance: float | None = None
    largest_change: float | None = None
    deepest_after: float | None = None


MARGINS = (0.0, 2.0, 8.0)
"""Margins in the logit, added to the user's. Those that no pose reaches still give a direction."""

ITERATIONS = (1, 3, 2, 4, 6, 14)
"""Numbers of iterations after which the poses are checked exactly. The first free pose ends the
search: pulling back then brings it nearer to the target than more iterations would."""

START_MARGIN, START_ITERATIONS = 6.0, 15
_KNOWN_STARTS, _RANDOM_STARTS = 4, 4
_SPREAD = 0.1
_REMEMBERED, _POLISHED = 8, 3

_ITERATIONS_ALONE = 60

ALL_LOCKED = marked("all body parts are locked, so the pose was not changed; unlock one")
"""The note of a result whose pose has no movable code."""
FEET_MOVED = marked("the feet moved, as keeping them on the ground moves the body too far")

_Tried = tuple[Step, FloatArray | None]
"""A step, and the free pose that it found or None."""


@dataclass(eq=False)
class Ladder:
    """One run of the ladder: see `PoseResolver.resolve`.

    Attributes
    ----------
    problem, check, options : of the pose
    known_free : computes `free_latents`, (F, D) float64 array of poses known to be free
    correction : (D,) float64 array to try first, or None
    job : reports (steps done, all steps); the last step is pulling back
    remark : note on the request, whatever the result, or None
    standing : the parts that should stay on the ground, or None
    """

    problem: ResolveProblem
    check: ExactCheck
    options: ResolveOptions
    known_free: Callable[[], FloatArray]
    correction: FloatArray | None
    job: Job
    remark: str | None = None
    standing: Standing | None = None

    def __post_init__(self) -> None:
        self._margin = self.options.margin or 0.0
        self._outcome = SolverOutcome(self.problem.target, "not run", False, False, 0)
        self._nearer: FloatArray | None = None
        self._candidates: deque[FloatArray] = deque(maxlen=_REMEMBERED)

    @cached_property
    def free_latents(self) -> FloatArray:
        """(F, D) poses known to be free; finding them may take long."""
        return self.known_free()

    @cached_property
    def _least(self) -> LeastOverlap:
        assert self.options.largest_change is not None
        return LeastOverlap(self.check, self.problem, self.options.largest_change)

    def climb(self) -> ResolveResult:
        """Try the steps until one resolves the collisions, then pull back."""
        problem, check = self.problem, self.check
        problem.deadline.poll()
        before = check.collisions(problem.target)
        latent, step, note = problem.target, Step.NONE, None
        if not before.colliding:
            step = Step.UNCHANGED
        elif not problem.movable.any():
            note = say(ALL_LOCKED)
        else:
            if problem.model is None:
                self._outcome = replace(self._outcome, status="no predictor")
            for done, (tried, better) in enumerate(self._steps(), 1):
                self.job.report(done, self._n_steps)
                if better is not None:
                    latent, step = self._put_back(pull_back(check, problem, better)), tried
                    break
            else:
                note = self._why_not()
            if self.options.largest_change is not None:
                better = None if step == Step.NONE else latent
                latent, step, note = self._soften(better, step, self.options.largest_change, note)
        result = self._result(latent, step, before, note)
        self.job.report(self._n_steps, self._n_steps)
        return result

    def _put_back(self, free: FloatArray) -> FloatArray:
        """Return a free pose with the target's standing parts put back on the ground."""
        if self.standing is None:
            return free
        self._nearer = free
        return self.standing.put_back(self.check, self.problem, free)

    def _lifted(self, latent: FloatArray, least: LeastOverlap) -> tuple[FloatArray, str | None]:
        """Return a pose lifted above the ground; if that exceeds the bound, the pose and a note."""
        if self.standing is None:
            return latent, None
        lifted = self.standing.lifted(self.check, self.problem, latent)
        return (lifted, None) if least.is_within(lifted) else (latent, say(FEET_MOVED))

    def _soften(
        self, free: FloatArray | None, step: Step, most: float, note: str | None
    ) -> tuple[FloatArray, Step, str | None]:
        """Return a free pose that moves no vertex too far, else the one of least overlap.

        If keeping the feet on the ground moves a free pose too far, return it without that, with a
        note. If no free pose was found at any distance, its note stays.
        """
        least = self._least
        if self.problem.model is None:
            if free is None or least.mean_change(free) > FAR:
                within = free if free is not None and least.is_within(free) else None
                pushed = least.push_out(self._put_back, within)
                if pushed is not None:
                    free, step = pushed, Step.PUSH_OUT
            if free is not None:
                drawn = draw_nearer(
                    self.check,
                    self.problem,
                    free,
                    self.standing,
                    self.options.still_domains,
                    self.options.seed,
                )
                free = least.nearer(free, self._put_back(drawn))
        if free is not None and least.is_within(free):
            return free, step, None
        if free is not None and self._nearer is not None and least.is_within(self._nearer):
            return self._lifted(self._nearer, least)[0], step, say(FEET_MOVED)
        known = self.problem.nearest_first(self.free_latents)
        latent = least.find([*([] if free is None else [free]), *known])
        latent, sunk = self._lifted(latent, least)
        if self.check.is_free(latent):
            return latent, Step.SOFT, sunk
        if free is not None:
            note = (
                say(
                    "no pose with this clearance was found within {most:g} % of the body size",
                    most=100.0 * most,
                )
                if self.check.clearance > 0.0
                else say(
                    "no free pose was found within {most:g} % of the body size", most=100.0 * most
                )
            )
        note = joined([note, sunk]) or None
        is_same = np.array_equal(latent, self.problem.target)
        return latent, Step.NONE if is_same else Step.SOFT, note

    def solve_only(self) -> ResolveResult:
        """Solve the paper's problem without the exact check."""
        problem = self.problem
        if not problem.movable.any():
            excess, _ = problem.excess(problem.target[None])
            if excess[0] + self._margin <= 0.0:
                return self._result(problem.target, Step.UNCHANGED, None)
            return self._result(problem.target, Step.NONE, None, say(ALL_LOCKED))
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
        # The neighbour's correction, the tries, polishing, falling back, and pulling back.
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
        """Restart halfway between Z* and known free poses, and at random poses near Z*."""
        problem = self.problem
        known_starts = np.where(problem.movable, self.free_latents, problem.target)
        order = np.argsort(problem.search_distance(known_starts), kind="stable")[:_KNOWN_STARTS]
        generator = np.random.default_rng(self.options.seed)
        span = problem.high - problem.low
        moves = generator.uniform(-_SPREAD, _SPREAD, (_RANDOM_STARTS, len(span))) * span
        starts = np.concatenate(
            [0.5 * (problem.target + known_starts[order]), problem.target + moves]
        )
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
        """Polish the poses that earlier steps left in the shallowest contact."""
        poses = np.unique(np.stack([self.problem.target, *self._candidates]), axis=0)
        decoded = self.check.exported(self.check.decode(poses))
        energies = [self.check.find(vertices).energy for vertices in decoded]
        for index in np.argsort(energies, kind="stable")[:_POLISHED]:
            yield Step.POLISH, polish(self.check, self.problem, poses[index])

    def _solve(self, margin: float, start: FloatArray) -> SolverOutcome:
        if self.options.solver == Solver.SQP:
            batch = SqpBatch(self.problem, start[None], np.array([margin]))
            return batch.run(_ITERATIONS_ALONE)[0]
        return solve_nlopt(self.problem, Solver(self.options.solver), start, margin)

    def _first_free(self, latents: Sequence[FloatArray]) -> FloatArray | None:
        """Return the nearest free pose of several; remember those that are nearer but collide."""
        for latent in sorted(latents, key=self.problem.distance):
            self.problem.deadline.poll()
            if self.check.is_free(latent):
                return latent
            self._candidates.append(latent)
        return None

    def _why_not(self) -> str:
        """Describe what prevents a free pose; advise only what makes a known pose free."""
        known, check, movable = self.free_latents, self.check, self.problem.movable
        if len(known) == 0:
            return say(
                "no collision-free pose is known to fall back to, so the pose still collides"
            )
        kept = np.where(movable, known, self.problem.target)
        if check.clearance > 0.0 and check.with_clearance(0.0).are_free(kept).any():
            return say("no pose with this clearance was found; choose a smaller one")
        if not movable.all() and check.are_free(known).any():
            return say("no free pose was found that keeps the locked body parts; unlock one")
        return say("no pose without collisions was found")

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
            note=joined([self.remark, note]) or None,
            clearance=self.options.clearance,
            largest_change=self.options.largest_change,
            deepest_after=after.deepest if after else None,
            least_distance=nearest.distance if nearest else None,
        )


def relative_distance(latent: FloatArray, target: FloatArray) -> float:
    """Return ||Z - Z*|| / ||Z*|| of two (D,) poses, or ||Z - Z*|| if Z* is the zero pose."""
    return float(np.linalg.norm(latent - target)) / (float(np.linalg.norm(target)) or 1.0)


_MOST_CLEARANCE = 0.5
"""Normalised: the largest clearance of a body that is small in its scene."""


@dataclass(frozen=True, eq=False)
class BodyAlone:
    """A body of a scene that is resolved separately.

    Attributes
    ----------
    resolver : of its own poses
    codes : (D_k,) where its codes are among those of the scene
    domains : its body parts among those of the scene
    place : from its normalised coordinates to those of the scene
    space_in : its poses among those of the scene
    """

    resolver: PoseResolver
    codes: npt.NDArray[np.intp]
    domains: range
    place: RigidTransform
    space_in: Callable[[PoseSpace], PoseSpace]

    def is_locked(self, options: ResolveOptions) -> bool:
        """Whether options of the scene lock all of it."""
        return options.locked_domains.issuperset(self.domains)

    def own_domains(self, domains: frozenset[int]) -> frozenset[int]:
        """Return its own indices of those scene domains that are its own."""
        return frozenset(part - self.domains.start for part in domains if part in self.domains)

    def up(self, up: npt.ArrayLike) -> tuple[float, float, float]:
        """Convert a (3,) direction of the scene to its own axes."""
        x, y, z = (np.asarray(up) @ self.place.rotation).tolist()
        return x, y, z

    def options(self, options: ResolveOptions) -> ResolveOptions:
        """Convert the scene's options to its own lengths, indices and axes."""
        scale, weights, up = self.place.scale, options.group_weights, options.standing
        most, locked = options.largest_change, options.locked_codes
        own = self.domains.start + 1, self.domains.stop + 1
        return replace(
            options,
            clearance=min(options.clearance / scale, _MOST_CLEARANCE),
            largest_change=None if most is None else most / scale,
            locked_domains=self.own_domains(options.locked_domains),
            still_domains=self.own_domains(options.still_domains),
            locked_codes=frozenset(np.flatnonzero(np.isin(self.codes, list(locked))).tolist()),
            group_weights=None if weights is None else (weights[0], *weights[slice(*own)]),
            standing=None if up is None else self.up(up),
        )


STILL_WEIGHT = 1e4
"""Weight of the squared displacement of parts that should stay: feet then slide by less than a
thousandth of a percent per frame. Locking their codes instead leaves poses colliding."""


class PoseResolver:
    """Resolve the self-collisions of one model's poses; immutable, safe between threads.

    Parameters
    ----------
    check : the exact check of the model's poses
    predictor : a differentiable `CollisionPredictor`; with None, steps from known free poses
        towards the target replace those that need one
    free_latents : (F, D) array of poses known to be collision-free: see `find_free_poses`. Without
        any, a pose that the other steps do not resolve stays colliding.

    Attributes
    ----------
    check : as given
    bodies : those of a scene that can be resolved separately; empty for a single body
    """

    bodies: tuple[BodyAlone, ...] = ()

    def __init__(
        self,
        check: ExactCheck,
        predictor: CollisionModel | None,
        free_latents: npt.ArrayLike,
    ) -> None:
        self.check, self._space, self._predictor = check, check.space, predictor
        self._low, self._high = check.space.low, check.space.high
        size = len(self._low)
        self._free_latents: FloatArray = np.array(free_latents, np.float64).reshape(-1, size)

    def with_check(self, check: ExactCheck) -> PoseResolver:
        """Return the resolver with another check, for example of poses with added detail.

        Parameters
        ----------
        check : of the same space
        """
        # Known poses that collide by the check are left out where they are used.
        other = copy(self)
        other.check, other._space = check, check.space
        return other

    def resolve(
        self,
        latent: npt.ArrayLike,
        options: ResolveOptions | None = None,
        job: Job = UNWATCHED,
        placement: RigidTransform | None = None,
        near: npt.ArrayLike | None = None,
        before: npt.ArrayLike | None = None,
    ) -> ResolveResult:
        """Find the nearest collision-free pose.

        Parameters
        ----------
        latent : (D,) finite array Z*
        options : the defaults if None
        job : reports (steps of the ladder done, all steps); polled at every evaluation
        placement : applied to the pose for export; the exact check is of the placed vertices
        near : (D,) array, a correction Z - Z* to try first, such as that of the neighbouring frame
        before : (D,) array, a further known collision-free pose, such as the neighbouring
            frame; without a predictor, the search may start from it

        Returns
        -------
        result : ResolveResult; a collision-free pose is returned unchanged, and a note says why a
            pose cannot be resolved (all domains locked, no free pose known)

        Raises
        ------
        ShapeError : another shape, a number that is not finite or another number of weights.
        LCollisionError : an unknown locked domain, or neither a predictor nor the exact check.
        CancelledError : the job was cancelled.
        """
        resolve_options = options or ResolveOptions()
        if self._predictor is None and not resolve_options.verify:
            raise LCollisionError(
                "has no predictor, so Resolve needs the exact check",
                "leave the exact check on",
                where="the body",
            )
        target = self._checked(latent)
        outside = int(np.count_nonzero((target < self._low) | (target > self._high)))
        if self._predictor is not None:
            remark = say_number(
                outside,
                "{n} of {all} sliders is outside the trained range",
                "{n} of {all} sliders are outside the trained range",
                all=len(target),
            )
        else:
            # A bare rig has no trained range, and no sliders where a client poses it.
            remark = say_number(
                outside,
                "{n} of {all} values of the pose is outside their usual range",
                "{n} of {all} values of the pose are outside their usual range",
                all=len(target),
            )
        earlier = None if before is None or self._predictor is not None else self._checked(before)
        standing = None
        if resolve_options.standing is not None:
            standing = Standing.of(self.check, target, np.array(resolve_options.standing))
            if not self._space.limbs.is_relative:
                # Nothing else keeps the standing parts in place.
                still = resolve_options.still_domains | standing.domains(self.check)
                resolve_options = replace(resolve_options, still_domains=still)

        def known_free() -> FloatArray:
            free_poses = self._known_free(target)
            return free_poses if earlier is None else np.concatenate([earlier[None], free_poses])

        ladder = Ladder(
            self.problem(target, resolve_options, job),
            replace(self.check.with_clearance(resolve_options.clearance), placement=placement),
            resolve_options,
            known_free,
            None if near is None else self._checked(near),
            job,
            remark if outside else None,
            standing,
        )
        with single_torch_thread():
            return ladder.climb() if resolve_options.verify else ladder.solve_only()

    def _known_free(self, target: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return (F, D) poses known to be free, for a (D,) target."""
        return self._free_latents

    def resolve_many(
        self,
        latents: npt.ArrayLike,
        options: ResolveOptions | None = None,
        workers: int | None = None,
        job: Job = UNWATCHED,
        *,
        placements: Sequence[RigidTransform | None] | None = None,
        sequence: bool = False,
        done: Mapping[int, ResolveResult] | None = None,
        keep: Callable[[int, ResolveResult], None] | None = None,
    ) -> list[ResolveResult]:
        """Resolve (B, D) poses on several threads.

        Parameters
        ----------
        latents : (B, D) finite array
        options : the defaults if None
        workers : threads, one for each available core by default; results do not depend on it
        job : reports (poses done, B), from one thread at a time; polled at every evaluation, and
            before each frame of a sequence is checked
        placements : of each pose for export
        sequence : whether the poses are frames of a motion: a frame then starts from the correction
            of the one before, so that the motion does not flicker. One thread resolves successive
            colliding frames.
        done : results of an earlier run by index, which are not computed again
        keep : called with the index and the result of each new pose at once, from one thread at a
            time, so that an interruption loses nothing

        Returns
        -------
        results : B results, in the order of `latents`

        Raises
        ------
        ShapeError, LCollisionError, CancelledError : as for `resolve`.
        """
        rows = [self._checked(row) for row in np.atleast_2d(np.asarray(latents, np.float64))]
        placed = [None] * len(rows) if placements is None else placements
        # Build the cached parts before threads use them.
        _ = self._space.metric, self._space.decode(np.zeros((1, len(self._low))))
        known_results = done or {}
        results: dict[int, ResolveResult] = {}
        guard = Lock()

        def solve(run: range) -> None:
            near = before = None
            for index in run:
                result = known_results.get(index) or self.resolve(
                    rows[index], options, job.part(), placed[index], near, before
                )
                if sequence:
                    near = result.latent - rows[index]
                    before = result.latent if result.exactly_free else None
                with guard:
                    results[index] = result
                    if keep is not None and index not in known_results:
                        keep(index, result)
                    job.report(len(results), len(rows))

        pool = ThreadPoolExecutor(workers or available_cores(), thread_name_prefix="resolve")
        try:
            if sequence:
                check = self.check.with_clearance((options or ResolveOptions()).clearance)
                colliding = list(pool.map(_is_colliding, repeat(check), rows, placed, repeat(job)))
                starts = [at for at in range(len(rows)) if at == 0 or not colliding[at]]
            else:
                starts = list(range(len(rows)))
            runs = [range(*pair) for pair in pairwise([*starts, len(rows)])]
            for solved in [pool.submit(solve, run) for run in runs]:
                solved.result()
        finally:
            pool.shutdown(cancel_futures=True)
        return [results[index] for index in range(len(rows))]

    def _checked(self, latent: npt.ArrayLike) -> FloatArray:
        target: FloatArray = np.array(latent, dtype=np.float64)
        size = len(self._low)
        if target.shape != (size,):
            raise ShapeError.must_be("a latent pose", f"{size} numbers", f"shape {target.shape}")
        if not np.isfinite(target).all():
            raise ShapeError("a latent pose contains NaN or infinity", "repair the pose")
        return target

    def problem(
        self, target: FloatArray, options: ResolveOptions, job: Job = UNWATCHED
    ) -> ResolveProblem:
        """Return the problem of one pose: its metric and the bounds of its codes.

        Parameters
        ----------
        target : (D,) finite float64 array Z*
        options, job : as for `resolve`

        Raises
        ------
        ShapeError, LCollisionError : as for `resolve`.
        """
        is_displacement = options.metric == Metric.DISPLACEMENT
        metric = self._space.metric if is_displacement else np.eye(len(target))
        if options.still_domains:
            weights = np.zeros(self._space.n_domains)
            weights[sorted(options.still_domains)] = STILL_WEIGHT
            metric = metric + self._space.domain_metrics.weighted(weights)
        sizes = self._space.group_sizes
        group_weights = options.group_weights or (1.0,) * len(sizes)
        if len(group_weights) != len(sizes):
            raise ShapeError.must_be("group weights", f"{len(sizes)} numbers", len(group_weights))
        code_weights = np.ones(len(target))
        code_weights[: sum(sizes)] = np.repeat(group_weights, sizes)
        root = np.sqrt(code_weights)
        low, high = np.minimum(self._low, target), np.maximum(self._high, target)
        for domain in sorted(options.locked_domains):
            if not 0 <= domain < self._space.n_domains:
                raise LCollisionError(
                    f"unknown domain {domain + 1} to lock",
                    f"the model has {self._space.n_domains}",
                )
        locked = self._space.codes_of(options.locked_domains)
        locked[sorted(options.locked_codes)] = True
        locked[sum(sizes) :] = True
        low[locked] = high[locked] = target[locked]
        return ResolveProblem(
            target,
            metric * np.outer(root, root),
            code_weights,
            low,
            high,
            options.threshold_logit,
            self._predictor,
            Deadline(options.time_budget, job),
        )


def _is_colliding(
    check: ExactCheck,
    latent: FloatArray,
    placement: RigidTransform | None,
    job: Job,
) -> bool:
    job.check()
    return not replace(check, placement=placement).is_free(latent)


MOST_POSES = 200
ENOUGH_POSES = 16
"""Number of free training poses below which samples of the box are searched for more."""

SEARCHED_BLOCKS = 64
_SHRINKINGS = (0.75, 0.5, 0.25)
_AT_ONCE = 32


def find_free_poses(embedding: Embedding, check: ExactCheck) -> FloatArray:
    """Find collision-free latent poses: the mean pose, training poses, then samples.

    Parameters
    ----------
    embedding : of the model
    check : of its poses

    Returns
    -------
    free_latents : (F, D) float64 array, F at most `MOST_POSES`; the mean pose first if it is free.
        If fewer than `ENOUGH_POSES` are free, training poses moved towards the mean and up to 2048
        samples of the latent box are searched too, so that F = 0 means that none of about two
        thousand poses is free.
    """
    training = embedding.training_latent.astype(np.float64)
    pose_numbers = evenly_spaced(len(training), MOST_POSES - 1)
    sources = chain(
        [np.concatenate([np.zeros((1, embedding.latent_size)), training[pose_numbers]])],
        (factor * training[pose_numbers] for factor in _SHRINKINGS),
        (embedding.box.draw(0, block).astype(np.float64) for block in range(SEARCHED_BLOCKS)),
    )
    free_poses: list[FloatArray] = []
    for number, poses in enumerate(sources):
        if number and len(free_poses) >= ENOUGH_POSES:
            break
        for start in range(0, len(poses), _AT_ONCE):
            block = poses[start : start + _AT_ONCE]
            free_poses += list(block[check.are_free(block)])
    return np.array(free_poses[:MOST_POSES]).reshape(-1, embedding.latent_size)


def largest_correction_change(
    decode: Callable[[FloatArray], FloatArray],
    latents: FloatArray,
    results: Sequence[ResolveResult],
) -> float:
    """Measure how much a resolved motion flickers.

    Parameters
    ----------
    decode : from (B, D) latent poses to (B, V, 3) vertices, normalised
    latents : (B, D) array, the frames before Resolve
    results : of the frames, in order

    Returns
    -------
    change : the largest change of the correction from one frame to the next: the mean distance over
        vertices, in normalised length, between the two displacements; 0 for one frame
    """
    displacements = (
        np.subtract(*decode(np.stack([result.latent, latent])))
        for latent, result in zip(latents, results, strict=True)
    )
    changes = (
        float(np.linalg.norm(after - before, axis=1).mean())
        for before, after in pairwise(displacements)
    )
    return max(changes, default=0.0)
