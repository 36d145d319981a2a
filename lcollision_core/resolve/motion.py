"""How much the correction of a motion changes from frame to frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.result import ResolveResult


def largest_correction_change(
    decode: Callable[[FloatArray], FloatArray],
    latents: FloatArray,
    results: Sequence[ResolveResult],
) -> float:
    """Measure how much a resolved motion flickers.

    Parameters
    ----------
    decode : from (B, D) latent poses to (B, V, 3) vertices, normalised
    latents : (B, D) array, the frames as they were
    results : of them, in order

    Returns
    -------
    change : the largest of all frames of the mean distance over vertices, in normalised length,
        between the displacement of a frame by its correction and that of the frame before; 0 for
        one frame
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
