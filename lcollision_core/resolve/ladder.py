"""The ladder: what is tried, in which order, until a pose is exactly free."""

from __future__ import annotations

import numpy as np

from lcollision_core.jobs import Progress
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.options import ResolveOptions, ResolveResult, Step
from lcollision_core.resolve.problem import ResolveProblem, SolverOutcome
from lcollision_core.resolve.sqp import solve_sqp
from lcollision_core.resolve.walk_back import bisect, walk_back

MARGINS = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0)


def climb(
    problem: ResolveProblem,
    check: ExactCheck,
    free_latents: FloatArray,
    options: ResolveOptions,
    correction: FloatArray | None,
    progress: Progress,
) -> ResolveResult:
    target = problem.target
    before = check.find(check.decode(target)[0])
    outcome = None
    latent, step = target, Step.UNCHANGED
    if before.colliding:
        margins = np.array(MARGINS)
        outcomes = solve_sqp(problem, np.tile(target, (len(margins), 1)), margins)
        outcome = outcomes[0]
        order = np.argsort([problem.distance(one.latent) for one in outcomes], kind="stable")
        found = None
        for place in order:
            if check.is_free(outcomes[place].latent):
                found = outcomes[place].latent
                step = Step.MARGIN if place else Step.SOLVER
                break
        if found is None:
            found = walk_back(check, problem, free_latents)
            step = Step.WALK_BACK if found is not None else Step.NONE
        if found is not None:
            latent, _ = bisect(check, problem, found, target, 6)
    return _result(problem, check, options, latent, step, outcome, before)


def _result(problem, check, options, latent, step, outcome, before):
    decoded = check.decode(np.stack([problem.target, latent]))
    moved = np.linalg.norm(decoded[1] - decoded[0], axis=1)
    after = check.find(decoded[1])
    excess, _ = problem.excess(latent[None])
    norm = float(np.linalg.norm(problem.target))
    way = float(np.linalg.norm(latent - problem.target))
    return ResolveResult(
        latent=latent,
        solver_status=outcome.status if outcome else "not run",
        converged=bool(outcome and outcome.converged),
        predicted_free=bool(excess[0] <= 0.0),
        exactly_free=not after.colliding,
        step=step,
        energy_before=before.energy,
        energy_after=after.energy,
        pairs_before=len(before.pairs),
        pairs_after=len(after.pairs),
        latent_distance=way / norm if way else 0.0,
        vertex_distance_mean=float(moved.mean()),
        vertex_distance_max=float(moved.max()),
        iterations=outcome.iterations if outcome else 0,
        evaluations=problem.evaluations,
        seconds=problem.watch.seconds,
    )
