"""The affine maps that bring a training set's features into the range that networks like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES, N_ROTATION

if TYPE_CHECKING:
    import torch

    Features = TypeVar("Features", npt.NDArray[Any], torch.Tensor)
else:
    Features = TypeVar("Features")

SCALED_BOUND = 0.95
"""Training features fill [-0.95, 0.95] (Gao et al. 2019), inside the reach of tanh."""


_LARGEST_FEATURE, _LARGEST_SCALE = 100.0, 1e18
"""Radians, or a stretch, beyond all that training meets; numbers that hardly differ have large
scales."""


@dataclass(frozen=True)
class FeatureScaling:
    """One affine map for all log R numbers and one for all S numbers.

    Attributes
    ----------
    rotation_centre, rotation_scale : scaled = (log R - centre) * scale, log R in radians
    stretch_centre, stretch_scale : scaled = (S - centre) * scale

    Raises
    ------
    ValueError : no features have such extremes.
    """

    rotation_centre: float
    rotation_scale: float
    stretch_centre: float
    stretch_scale: float

    def __post_init__(self) -> None:
        for name in ("rotation_centre", "stretch_centre"):
            if not abs(getattr(self, name)) <= _LARGEST_FEATURE:
                raise ValueError(f"{name} must be within {_LARGEST_FEATURE:g} of 0")
        for name in ("rotation_scale", "stretch_scale"):
            if not 1.0 / _LARGEST_FEATURE <= getattr(self, name) <= _LARGEST_SCALE:
                raise ValueError(
                    f"{name} must be from {1.0 / _LARGEST_FEATURE:g} to {_LARGEST_SCALE:g}, got "
                    f"{getattr(self, name):g}"
                )

    @classmethod
    def fit(cls, features: npt.NDArray[Any]) -> FeatureScaling:
        """Choose the maps that take the extremes of (..., V, 9) unscaled features to +-0.95.

        Numbers that are all equal, as in a set of one undeformed pose, are only shifted to 0.
        """
        centres_and_scales = []
        for numbers in (features[..., :N_ROTATION], features[..., N_ROTATION:]):
            low, high = float(numbers.min()), float(numbers.max())
            scale = 2.0 * SCALED_BOUND / (high - low) if high > low else 1.0
            centres_and_scales += [0.5 * (low + high), scale]
        return cls(*centres_and_scales)

    def apply(self, features: Features) -> Features:
        """Scale (..., 9) features, array or tensor; dtype and device are kept."""
        centre, scale = self._per_number(features)
        scaled: Features = (features - centre) * scale
        return scaled

    def invert(self, scaled: Features) -> Features:
        """Take scaled (..., 9) features, array or tensor, back to radians and stretches."""
        centre, scale = self._per_number(scaled)
        features: Features = scaled / scale + centre
        return features

    def _per_number(self, like: Features) -> tuple[Features, Features]:
        n_stretch = N_FEATURES - N_ROTATION
        rows = [
            [self.rotation_centre] * N_ROTATION + [self.stretch_centre] * n_stretch,
            [self.rotation_scale] * N_ROTATION + [self.stretch_scale] * n_stretch,
        ]
        if isinstance(like, np.ndarray):
            table: Any = np.array(rows, dtype=like.dtype)
        else:
            table = like.new_tensor(rows)
        return cast("tuple[Features, Features]", (table[0], table[1]))
