"""The way in: from free poses towards the target, stopping or sliding where it touches itself."""

from __future__ import annotations

import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import DragOptions, ExactCheck, PoseDragger
from lcollision_core.resolve.problem import ResolveProblem

STARTS = 3
"""Known free poses, the nearest ones, that the way begins at."""

_MOST_EVENTS = 60
"""Of a drag, each of a few steps: far more than the way across the space takes."""


def step_towards(
    check: ExactCheck,
    problem: ResolveProblem,
    free_latents: FloatArray,
) -> FloatArray | None:
    """Drag the codes from known free poses to Z*, with the contacts as constraints.

    Parameters
    ----------
    check, problem : of the pose
    free_latents : (F, D) float64 array of poses known to be free; those that collide with the
        locked codes of Z* are left out

    Returns
    -------
    latent : (D,) float64 array, collision-free, the nearest to Z* that was reached, or None if all
        known poses collide

    Raises
    ------
    CancelledError : the problem's token was set.
    """
    dragger = PoseDragger(check)
    locked = frozenset(np.flatnonzero(~problem.movable).tolist())
    options = DragOptions(solid=True, locked_codes=locked, clearance=check.clearance)
    ends = np.where(problem.movable, free_latents, problem.target)
    reached: list[FloatArray] = []
    for end in ends[np.argsort(problem.distance(ends), kind="stable")]:
        problem.deadline.poll()
        if len(reached) == STARTS or (reached and problem.deadline.expired):
            break
        step = dragger.begin(end, None, options=options)
        if not step.exactly_free:
            continue
        for _ in range(_MOST_EVENTS):
            problem.deadline.poll()
            step = dragger.move(problem.target)
            if step.settled or problem.deadline.expired:
                break
        reached.append(step.latent.copy())
    return min(reached, key=problem.distance, default=None)
