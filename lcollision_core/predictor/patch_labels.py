"""What the default network is taught beside the rows' labels: which patches of skin are hit."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding import Embedding
from lcollision_core.errors import CancelledError
from lcollision_core.jobs import CancelToken, Progress, available_cores, no_progress
from lcollision_core.labels import LabelRows
from lcollision_core.predictor.folds import FoldDetector

_ROWS_A_BLOCK = 256
_PATCH_SHARE, _FOLD_SHARE = 0.05, 0.005
"""A patch that is hit has about this share of its pose's energy; so has a fold."""

_TIMES_KEPT = 20

_LEAST_ROOT = 1e-3
"""So that the shallowest touch is still told from none in half precision."""


@dataclass(frozen=True, eq=False)
class SkinCells:
    """How the skin is divided, twice.

    Attributes
    ----------
    patch : (V,) the patch of each vertex, 0 to P - 1, for contact between parts
    fold : (V,) the site of each vertex, 0 to S - 1, for folds; all -1 where there are none
    """

    patch: npt.NDArray[np.int64]
    fold: npt.NDArray[np.int64]

    @property
    def n_patches(self) -> int:
        """P."""
        return int(self.patch.max()) + 1

    @property
    def n_folds(self) -> int:
        """S."""
        return int(self.fold.max()) + 1


def patch_roots(
    embedding: Embedding,
    rows: LabelRows,
    index: npt.NDArray[np.int64],
    cells: SkinCells,
    near_exclusion: float,
    energy_scale: float,
    known: npt.NDArray[np.float16] | None = None,
    keep: Callable[[npt.NDArray[np.float16]], None] | None = None,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> npt.NDArray[np.float16]:
    """Find the exact energy of each patch of skin in some poses, and of each fold.

    Poses that are labelled free have none, and are not looked at again.

    Parameters
    ----------
    embedding : decodes
    rows : labelled poses
    index : (n,) those wanted
    cells : pairs within `FOLD_REACH` of each other along the surface go to the folds, if any
    near_exclusion : in heights
    energy_scale : the mean energy of a colliding pose, in squared heights
    known : (m, P + S) what an earlier call found in the first m of the rows
    keep : is given what is known so far, after each twentieth of the work and when it is cancelled
    progress : in rows that collide
    cancel : polled for every block of rows

    Returns
    -------
    roots : (n, P + S) float16 array: square roots of the sums of PDe, in units that make them
        about 1 where a patch or a fold is hit; 0 where it is not

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    n_patches, n_folds = cells.n_patches, cells.n_folds
    detector = FoldDetector(embedding, near_exclusion)
    faces = embedding.topology.faces
    roots = np.zeros((len(index), n_patches + n_folds), dtype=np.float16)
    unit = np.repeat([_PATCH_SHARE, _FOLD_SHARE], [n_patches, n_folds]) * energy_scale

    places = np.flatnonzero(rows.colliding[index])
    n_known = 0
    if known is not None:
        roots[: len(known)] = known
        n_known = int(np.searchsorted(places, len(known)))

    def label(start: int) -> None:
        if cancel is not None:
            cancel.raise_if_cancelled()
        block = places[start : start + _ROWS_A_BLOCK]
        poses = embedding.decode(rows.latent[index[block]], n_threads=1).astype(np.float32)
        for row, vertices in zip(block, poses, strict=True):
            contacts, pairs, depth = detector.detect(vertices)
            energy = np.zeros(n_patches + n_folds)
            energy[:n_patches] = np.bincount(cells.patch, contacts.vertex_energy, n_patches)
            corners, shares = faces[pairs].ravel(), np.repeat(depth**2 / 6.0, 6)
            cell = n_patches + cells.fold[corners] if n_folds else cells.patch[corners]
            np.add.at(energy, cell, shares)
            hit = energy > 0.0
            roots[row, hit] = np.maximum(np.sqrt(energy[hit] / unit[hit]), _LEAST_ROOT)

    starts = range(n_known, len(places), _ROWS_A_BLOCK)
    kept_every = -(-len(starts) // _TIMES_KEPT)
    _ = embedding.codec, embedding.decoder
    with ThreadPoolExecutor(available_cores()) as pool:
        try:
            for done, _ in enumerate(pool.map(label, starts), start=1):
                n_known = min(starts[done - 1] + _ROWS_A_BLOCK, len(places))
                progress(n_known, len(places))
                if keep is not None and done % kept_every == 0:
                    keep(roots[: places[n_known - 1] + 1])
        except CancelledError:
            if keep is not None and n_known:
                keep(roots[: places[n_known - 1] + 1])
            raise
    return roots
