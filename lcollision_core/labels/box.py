"""The box of latent poses that are labelled, and how its samples are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding import Embedding

BOX_SCALE = 1.2
"""Poses are sampled in this multiple of the training codes' range (Tan et al. 2021)."""

ROWS_A_BLOCK = 32
"""Rows that one thread draws, decodes and labels in one go."""


@dataclass(frozen=True, eq=False)
class LatentBox:
    """The uniform distribution that the predictor is trained on.

    Attributes
    ----------
    low, high : (D,) float64 arrays, `BOX_SCALE` times the least and largest training codes
    """

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]

    @classmethod
    def of(cls, embedding: Embedding) -> LatentBox:
        """Return the box of a trained embedding."""
        return cls(
            BOX_SCALE * embedding.latent_min.astype(np.float64),
            BOX_SCALE * embedding.latent_max.astype(np.float64),
        )

    def draw(self, seed: int, block: int) -> npt.NDArray[np.float32]:
        """Draw one block of the endless sequence of samples.

        Row i of the sequence is row i % `ROWS_A_BLOCK` of block i // `ROWS_A_BLOCK`, whoever draws
        it, in whatever order.

        Parameters
        ----------
        seed : >= 0, of the sequence
        block : >= 0

        Returns
        -------
        latent : (ROWS_A_BLOCK, D) float32 array, in the box up to rounding
        """
        # NumPy promises to keep seeding and raw bits for good, but not what `Generator` makes of
        # them: a store must go on with the same rows after an update.
        bits = np.random.Philox(np.random.SeedSequence([seed, block]))
        raw = bits.random_raw((ROWS_A_BLOCK, len(self.low)))
        uniform = (raw >> np.uint64(11)) * 2.0**-53
        latent: npt.NDArray[np.float32] = (self.low + (self.high - self.low) * uniform).astype(
            np.float32
        )
        return latent
