"""The box of latent poses that are labelled, and how its samples are drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding.pose_draws import Uniform
from lcollision_core.model_file import required_array

BOX_SCALE = 1.2
"""A new model's box is this multiple of its training codes' range (Tan et al. 2021)."""

_LEAST_RANGE = 1e-6
"""So that the range of a code that no training pose uses still straddles 0."""
_LARGEST_BOUND = 1e7
"""Far beyond any training code, far below overflow."""

BOX_ARRAYS = frozenset({"box_low", "box_high"})

ROWS_PER_BLOCK = 32
"""Rows that one thread draws, decodes and labels at a time."""


@dataclass(frozen=True, eq=False)
class LatentBox:
    """The box of a model's poses: for labelling, Resolve and the range of sliders.

    Attributes
    ----------
    low, high : (D,) float64 arrays, below 0 and above 0
    """

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]

    @classmethod
    def around(cls, training_latent: npt.NDArray[np.float32]) -> LatentBox:
        """Return the box of a new model: `BOX_SCALE` times the range of its (N, D) codes."""
        low = np.minimum(training_latent.min(axis=0), -_LEAST_RANGE).astype(np.float64)
        high = np.maximum(training_latent.max(axis=0), _LEAST_RANGE).astype(np.float64)
        return cls(BOX_SCALE * low, BOX_SCALE * high)

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, npt.NDArray[Any]], training_latent: npt.NDArray[np.float32]
    ) -> LatentBox:
        """Rebuild a box from what `to_arrays` returned, or as it was before models stored it.

        Raises
        ------
        ValueError : an end is missing, of another type or shape, or on the wrong side of 0.
        """
        if not BOX_ARRAYS & arrays.keys():
            return cls.around(training_latent)
        shape = training_latent.shape[1:]
        low = required_array(arrays, "box_low", np.float64, shape, _LARGEST_BOUND)
        high = required_array(arrays, "box_high", np.float64, shape, _LARGEST_BOUND)
        if low.max() > -_LEAST_RANGE or high.min() < _LEAST_RANGE:
            raise ValueError("its arrays box_low and box_high must lie below 0 and above 0")
        return cls(low, high)

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of a model file, for `from_arrays`."""
        return {"box_low": self.low, "box_high": self.high}

    def draw(self, seed: int, block: int) -> npt.NDArray[np.float32]:
        """Draw one block of the endless sequence of samples.

        Row i of the sequence is row i % `ROWS_PER_BLOCK` of block i // `ROWS_PER_BLOCK`, whoever
        draws it, in whatever order.

        Parameters
        ----------
        seed : >= 0, of the sequence
        block : >= 0

        Returns
        -------
        latent : (ROWS_PER_BLOCK, D) float32 array, in the box up to rounding
        """
        uniform = numbers_of(seed, block)((ROWS_PER_BLOCK, len(self.low)))
        latent: npt.NDArray[np.float32] = (self.low + (self.high - self.low) * uniform).astype(
            np.float32
        )
        return latent


def numbers_of(*key: int) -> Uniform:
    """Return the endless sequence of numbers in [0, 1) of a key of integers >= 0."""
    # NumPy promises to keep seeding and raw bits for good, but not what `Generator` makes of
    # them: a store must go on with the same rows after an update.
    bits = np.random.Philox(np.random.SeedSequence(key))

    def uniform(shape: tuple[int, int]) -> npt.NDArray[np.float64]:
        numbers = bits.random_raw(shape) >> np.uint64(11)
        return numbers.astype(np.float64) * 2.0**-53

    return uniform
