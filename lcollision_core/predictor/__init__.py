"""Predict energies per domain and collision probability from latent codes (stage 2)."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.predictor.public import *  # noqa: F403
else:
    from lcollision_core.lazy import public_names

    __getattr__ = public_names(__name__)
