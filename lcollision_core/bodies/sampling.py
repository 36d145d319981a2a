"""Random latent poses: all of them, or only those that collide or do not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.verdicts import judge_poses
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import UNWATCHED, Job

_DRAWN_AT_ONCE = 64
_MOST_MISSES = 10_000


def sample_poses(
    model: PosableBody,
    n_poses: int,
    seed: int,
    colliding: bool | None = None,
    job: Job = UNWATCHED,
    clearance: float = 0.0,
    error_bound: float = 0.0,
) -> npt.NDArray[np.float64]:
    """Draw latent poses, as `PosableBody.sample` does.

    Parameters
    ----------
    model : of the poses
    n_poses : how many to return
    seed : equal seeds give equal poses, on any number of cores
    colliding : True and False keep only poses that do and do not intersect themselves, by the
        exact check of the vertices rounded to float32, as they are exported, unless there is an
        error bound; None keeps all
    job : reports (poses found, n_poses)
    clearance : in [0, 1), normalised; with one, poses collide whose parts are nearer than that
    error_bound : share of all poses drawn that may be judged wrongly, as estimates stand for the
        exact check where a trained model is sure; it may be a larger one of those returned, where
        most poses are of the other kind; with 0 no estimates do

    Returns
    -------
    latent : (n_poses, D) float64 array

    Raises
    ------
    ShapeError : the clearance is out of its range.
    LCollisionError : 10 000 poses in a row were not of the kind asked for.
    """
    generator = np.random.default_rng(seed)
    detector = model.detector.with_clearance(clearance)
    if colliding is None:
        return model.sample(n_poses, generator)
    kept = np.empty((n_poses, model.latent_size))
    n_kept = n_misses = 0
    while n_kept < n_poses:
        drawn = model.sample(_DRAWN_AT_ONCE, generator)
        verdicts = judge_poses(model, drawn, error_bound, detector)
        found = drawn[verdicts.colliding == colliding][: n_poses - n_kept]
        kept[n_kept : n_kept + len(found)] = found
        n_kept += len(found)
        n_misses = 0 if len(found) else n_misses + _DRAWN_AT_ONCE
        if n_misses >= _MOST_MISSES:
            kind = "collides" if colliding else "is free"
            raise LCollisionError(
                f"none of {n_misses} poses in a row {kind}", "ask for other poses"
            )
        job.report(n_kept, n_poses)
    return kept
