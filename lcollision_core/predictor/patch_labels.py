"""What the default network is taught beside the rows' labels: which patches of skin are hit."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector
from lcollision_core.embedding import Embedding
from lcollision_core.jobs import CancelToken, Progress, available_cores, no_progress

_ROWS_A_BLOCK = 256
_PATCH_SHARE = 0.05
"""A patch that is hit has about this share of its pose's energy."""

_LEAST_ROOT = 1e-3
"""So that the shallowest touch is still told from none in half precision."""


def patch_roots(
    embedding: Embedding,
    latent: npt.NDArray[np.float32],
    index: npt.NDArray[np.int64],
    patch: npt.NDArray[np.int64],
    near_exclusion: float,
    energy_scale: float,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> npt.NDArray[np.float16]:
    """Find the exact energy of each patch of skin in some poses.

    Parameters
    ----------
    embedding : decodes
    latent : (M, D) codes
    index : (n,) the rows wanted
    patch : (V,) the patch of each vertex, 0 to P - 1
    near_exclusion : in heights
    energy_scale : the mean energy of a colliding pose, in squared heights
    progress : in rows
    cancel : polled for every block of rows

    Returns
    -------
    roots : (n, P) float16 array: square roots of the patches' sums of PDe, in units that make them
        about 1 where a patch is hit; 0 where it is not

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    detector = CollisionDetector(
        embedding.topology, embedding.rest_vertices, near_exclusion=near_exclusion
    )
    n_patches = int(patch.max()) + 1
    roots = np.zeros((len(index), n_patches), dtype=np.float16)
    unit = _PATCH_SHARE * energy_scale

    def label(start: int) -> None:
        if cancel is not None:
            cancel.raise_if_cancelled()
        part = slice(start, start + _ROWS_A_BLOCK)
        vertices = embedding.decode(latent[index[part]], n_threads=1)
        found = detector.detect_batch(vertices.astype(np.float32), workers=1)
        for row, vertex_energy in enumerate(found.vertex_energy, start):
            touched = np.flatnonzero(vertex_energy)
            energy = np.bincount(patch[touched], vertex_energy[touched], n_patches)
            hit = energy > 0.0
            roots[row, hit] = np.maximum(np.sqrt(energy[hit] / unit), _LEAST_ROOT)

    starts = range(0, len(index), _ROWS_A_BLOCK)
    _ = embedding.codec, embedding.decoder
    with ThreadPoolExecutor(available_cores()) as pool:
        for done, _ in enumerate(pool.map(label, starts), start=1):
            progress(min(done * _ROWS_A_BLOCK, len(index)), len(index))
    return roots
