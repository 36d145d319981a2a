"""What a quality spends on each stage of learning a model."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from lcollision_core.embedding.config import EmbeddingConfig
from lcollision_core.predictor import PRESETS, PredictorConfig


class Quality(StrEnum):
    """How much time is spent for how good a model."""

    QUICK = "quick"
    GOOD = "good"
    BEST = "best"


@dataclass(frozen=True)
class Effort:
    """What a quality spends.

    Attributes
    ----------
    n_poses : that a rig is to have, with the frames of its clips
    embedding : how the latent space is trained
    n_samples : of the latent box that are labelled
    predictor : how the predictor is trained
    """

    n_poses: int
    embedding: EmbeddingConfig
    n_samples: int
    predictor: PredictorConfig


EFFORTS = {
    Quality.QUICK: Effort(
        100, EmbeddingConfig(held_out_stride=0, level2_epochs=10), 20_000, PRESETS["default"]
    ),
    Quality.GOOD: Effort(150, EmbeddingConfig(), 50_000, PRESETS["default"]),
    Quality.BEST: Effort(300, EmbeddingConfig(), 300_000, PRESETS["default"]),
}
