"""The affine maps that bring a training set's features into the range of the networks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES, N_ROTATION
from lcollision_core.meshes.topology import FloatArray

SCALED_BOUND = 0.95
"""Training features fill [-0.95, 0.95] (Gao et al. 2019), inside the range of tanh."""


_LARGEST_FEATURE, _LARGEST_SCALE = 100.0, 1e18
"""Radians, or a stretch, beyond what any training set holds; the scales of numbers that hardly
differ are large."""


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

    @property
    def scale(self) -> FloatArray:
        """The scales of a feature's numbers, (9,)."""
        return _per_number(self.rotation_scale, self.stretch_scale)

    def apply(self, features: npt.NDArray[Any]) -> FloatArray:
        """Scale (..., 9) features."""
        centre = _per_number(self.rotation_centre, self.stretch_centre)
        scaled: FloatArray = (features - centre) * self.scale
        return scaled

    def invert(self, scaled: npt.NDArray[Any]) -> FloatArray:
        """Take scaled (..., 9) features back to radians and stretches."""
        centre = _per_number(self.rotation_centre, self.stretch_centre)
        features: FloatArray = scaled / self.scale + centre
        return features


def _per_number(rotation: float, stretch: float) -> FloatArray:
    return np.repeat([rotation, stretch], [N_ROTATION, N_FEATURES - N_ROTATION])
