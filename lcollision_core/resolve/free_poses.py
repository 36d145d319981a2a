"""Find collision-free poses, for Resolve to fall back to."""

from __future__ import annotations

from itertools import chain

import numpy as np

from lcollision_core.embedding import Embedding
from lcollision_core.meshes.evenly_spaced import evenly_spaced
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import ExactCheck

MOST_POSES = 200
ENOUGH_POSES = 16
"""With fewer of the training poses free, samples of the box are searched for more."""

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
        Where fewer than `ENOUGH_POSES` of these are free, training poses drawn towards the mean
        and up to 2048 samples of the latent box are searched too, so that F = 0 says that none of
        some thousand poses is free.
    """
    training = embedding.training_latent.astype(np.float64)
    chosen = evenly_spaced(len(training), MOST_POSES - 1)
    sources = chain(
        [np.concatenate([np.zeros((1, embedding.latent_size)), training[chosen]])],
        (factor * training[chosen] for factor in _SHRINKINGS),
        (embedding.box.draw(0, block).astype(np.float64) for block in range(SEARCHED_BLOCKS)),
    )
    found: list[FloatArray] = []
    for number, poses in enumerate(sources):
        if number and len(found) >= ENOUGH_POSES:
            break
        for start in range(0, len(poses), _AT_ONCE):
            block = poses[start : start + _AT_ONCE]
            found += list(block[check.are_free(block)])
    return np.array(found[:MOST_POSES]).reshape(-1, embedding.latent_size)
