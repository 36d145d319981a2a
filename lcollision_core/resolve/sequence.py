"""How much the correction of a motion changes from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.options import ResolveResult

_FRAMES_AT_ONCE = 16


def largest_correction_change(
    embedding: Embedding, latents: FloatArray, results: Sequence[ResolveResult]
) -> float:
    """Measure how much a repaired motion flickers.

    Parameters
    ----------
    embedding : decodes
    latents : (B, D) array, the frames as they were
    results : of them, in order

    Returns
    -------
    change : the largest of all frames of the mean distance over vertices, in heights, between the
        displacement of a frame by its correction and that of the frame before; 0 for one frame
    """
    corrected = np.array([result.latent for result in results])
    before = np.zeros((0, embedding.topology.n_vertices, 3))
    largest = 0.0
    for start in range(0, len(latents), _FRAMES_AT_ONCE):
        rows = slice(start, start + _FRAMES_AT_ONCE)
        moved = embedding.decode(corrected[rows]) - embedding.decode(latents[rows])
        changes = np.diff(np.concatenate([before, moved]), axis=0)
        if len(changes):
            largest = max(largest, float(np.linalg.norm(changes, axis=2).mean(axis=1).max()))
        before = moved[-1:]
    return largest
