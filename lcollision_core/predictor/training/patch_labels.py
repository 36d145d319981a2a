"""Further labels of the default network: which patches of skin collide."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding import Embedding
from lcollision_core.jobs import CancelToken, Progress, for_blocks, no_progress
from lcollision_core.labels import LabelRows
from lcollision_core.meshes import ContactRules, FaceGroup
from lcollision_core.predictor.geometric.folds import FoldDetector
from lcollision_core.predictor.network_base import SkinCells

_ROWS_PER_BLOCK = 32
_PATCH_FRACTION, _FOLD_FRACTION = 0.05, 0.005
"""Typical fractions of a pose's energy in a colliding patch, and in a colliding fold."""

_LEAST_ROOT = 1e-3
"""Keeps the shallowest contact distinct from none in half precision."""


class PatchLabeller:
    """Finds the exact energy of each patch of skin, and of each fold.

    Parameters
    ----------
    embedding : decodes
    rows : labelled poses
    cells : pairs within `FOLD_RADIUS` of each other along the surface go to the folds, if any
    energy_scale : the mean energy of a colliding pose, in normalised length squared
    rules, groups : by which the rows were labelled: which pairs of faces do not count
    """

    def __init__(
        self,
        embedding: Embedding,
        rows: LabelRows,
        cells: SkinCells,
        energy_scale: float,
        rules: ContactRules,
        groups: Sequence[FaceGroup] = (),
    ) -> None:
        self._embedding, self._rows, self._cells = embedding, rows, cells
        self._detector = FoldDetector(embedding, rules, groups)
        fractions = np.repeat([_PATCH_FRACTION, _FOLD_FRACTION], [cells.n_patches, cells.n_folds])
        self._unit = fractions * energy_scale
        _ = embedding.codec, embedding.decoder

    def roots(
        self,
        index: npt.NDArray[np.int64],
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
    ) -> npt.NDArray[np.float16]:
        """Label some of the rows, on all cores.

        Poses that are labelled free have no energy, and are not looked at again.

        Parameters
        ----------
        index : (n,) the rows
        progress : in rows that collide
        cancel : polled for every block of rows

        Returns
        -------
        roots : (n, P + S) float16 array: square roots of the sums of PDe, in units that make them
            about 1 where a patch or a fold collides; 0 where it does not

        Raises
        ------
        CancelledError : `cancel` was set.
        """
        roots = np.zeros((len(index), len(self._unit)), dtype=np.float16)
        colliding = np.flatnonzero(self._rows.colliding[index])

        def label(start: int, stop: int) -> None:
            block = colliding[start:stop]
            latent = self._rows.latent[index[block]]
            poses = self._embedding.decode(latent, n_threads=1).astype(np.float32)
            for row, vertices in zip(block, poses, strict=True):
                roots[row] = self._roots_of(vertices)

        for_blocks(label, len(colliding), _ROWS_PER_BLOCK, progress=progress, cancel=cancel)
        return roots

    def _roots_of(self, vertices: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Return the (P + S,) roots of one pose."""
        cells, faces = self._cells, self._embedding.topology.faces
        found, are_folds = self._detector.detect(vertices)
        corners = faces[found.pairs].reshape(-1, 6)
        cell = cells.patch[corners]
        if cells.n_folds:
            cell[are_folds] = cells.n_patches + cells.fold[corners[are_folds]]
        # Algorithm 1 of the paper: a sixth of the squared depth to each corner.
        energies = np.repeat(found.penetration_depth**2 / 6.0, 6)
        energy = np.bincount(cell.ravel(), energies, len(self._unit))
        roots = np.sqrt(energy / self._unit)
        return np.where(energy > 0.0, np.maximum(roots, _LEAST_ROOT), 0.0)
