"""Find collision-free poses, for Resolve to fall back to."""

from __future__ import annotations

import numpy as np

from lcollision_core.contact import CollisionDetector
from lcollision_core.embedding import Embedding
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.exact import ExactCheck

MOST_POSES = 200
ENOUGH_POSES = 16
"""With fewer of the training poses free, samples of the box are searched for more."""

SEARCHED_BLOCKS = 64
_SHRINKINGS = (0.75, 0.5, 0.25)
_AT_ONCE = 32


def find_free_poses(
    embedding: Embedding,
    detector: CollisionDetector,
    height: float,
    seed: int = 0,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> FloatArray:
    """Find collision-free latent poses: the mean pose, training poses, then samples.

    Parameters
    ----------
    embedding : decodes
    detector : the exact check, in the data's unit
    height : the body size, in the data's unit
    seed : of the samples
    progress : called with (poses checked, poses to check)
    cancel : polled every few poses

    Returns
    -------
    free_latents : (F, D) float64 array, F at most `MOST_POSES`; the mean pose first if it is free.
        Where fewer than `ENOUGH_POSES` of these are free, training poses drawn towards the mean
        and up to 2048 samples of the latent box are searched too, so that F = 0 says that none of
        some thousand poses is free.

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    check = ExactCheck(embedding, detector, height)
    training = embedding.training_latent.astype(np.float64)
    chosen = np.unique(np.linspace(0, len(training) - 1, MOST_POSES - 1).round().astype(int))
    sources = [np.concatenate([np.zeros((1, embedding.latent_size)), training[chosen]])]
    sources += [share * training[chosen] for share in _SHRINKINGS]
    found: list[FloatArray] = []
    n_checked, total = 0, len(sources[0])
    for number in range(len(sources) + SEARCHED_BLOCKS):
        if number and len(found) >= ENOUGH_POSES:
            break
        poses = (
            sources[number]
            if number < len(sources)
            else embedding.box.draw(seed, number - len(sources)).astype(np.float64)
        )
        total = max(total, n_checked + len(poses))
        for start in range(0, len(poses), _AT_ONCE):
            if cancel is not None:
                cancel.raise_if_cancelled()
            block = poses[start : start + _AT_ONCE]
            found += list(block[check.are_free(block)])
            n_checked += len(block)
            progress(n_checked, total)
    return np.array(found[:MOST_POSES]).reshape(-1, embedding.latent_size)
