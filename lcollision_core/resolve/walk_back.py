"""The last step of the ladder: along a segment to a pose that is known to be free."""

from __future__ import annotations

import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.problem import ResolveProblem
from lcollision_core.resolve.shorten import bisect

WALKS = 6
"""Known free poses that are walked to, the nearest ones: the nearest of all often has not the
shortest walk."""

HALVINGS = 8


def walk_back(
    check: ExactCheck, problem: ResolveProblem, free_latents: FloatArray
) -> FloatArray | None:
    """Walk from Z* towards known free poses until free, and take the shortest walk.

    Locked codes stay, so that a known free pose may collide for want of them; such are left out.

    Parameters
    ----------
    check, problem : of the pose
    free_latents : (F, D) float64 array

    Returns
    -------
    latent : (D,) float64 array, exactly free, or None where no walk is

    Raises
    ------
    CancelledError : the problem's watch said so.
    """
    ends = np.where(problem.movable, free_latents, problem.target)
    ends = ends[np.argsort(problem.distance(ends), kind="stable")]
    best = None
    n_walks = 0
    for end in ends:
        problem.watch.poll()
        if n_walks == WALKS or (best is not None and problem.watch.expired):
            break
        if not check.is_free(end):
            continue
        n_walks += 1
        reached, _ = bisect(check, problem, end, problem.target, HALVINGS)
        if best is None or problem.distance(reached) < problem.distance(best):
            best = reached
    return best
