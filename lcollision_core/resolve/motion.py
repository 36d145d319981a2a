"""How much the correction of a motion changes from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.options import ResolveResult


def largest_correction_change(
    embedding: Embedding, latents: FloatArray, results: Sequence[ResolveResult]
) -> float:
    """Measure how much a resolved motion flickers.

    Parameters
    ----------
    embedding : decodes
    latents : (B, D) array, the frames as they were
    results : of them, in order

    Returns
    -------
    change : the largest of all frames of the mean distance over vertices, in normalised length,
        between the displacement of a frame by its correction and that of the frame before; 0 for
        one frame
    """
    displacements = (
        np.subtract(*embedding.decode(np.stack([result.latent, latent])))
        for latent, result in zip(latents, results, strict=True)
    )
    changes = (
        float(np.linalg.norm(after - before, axis=1).mean())
        for before, after in pairwise(displacements)
    )
    return max(changes, default=0.0)
