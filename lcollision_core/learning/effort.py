"""What a quality spends on each stage of learning a model."""

from __future__ import annotations

from dataclasses import dataclass

from lcollision_core.bodies.judging import CARD_POSES
from lcollision_core.embedding.training_run import EmbeddingConfig
from lcollision_core.options import Quality
from lcollision_core.predictor import PRESETS, PredictorConfig


@dataclass(frozen=True)
class Effort:
    """What a quality spends.

    Attributes
    ----------
    n_poses : that a rig is to have, with the frames of its clips
    embedding : how the latent space is trained
    n_samples : mixed samples to label
    predictor : how the predictor is trained
    n_judged : poses of each kind that it is measured on
    """

    n_poses: int
    embedding: EmbeddingConfig
    n_samples: int
    predictor: PredictorConfig
    n_judged: int = CARD_POSES


EFFORTS = {
    # Level 2 stays as the principal components of what level 1 leaves, and nothing is held out.
    Quality.QUICK: Effort(
        100, EmbeddingConfig(level2_epochs=0, held_out_stride=0), 20_000, PRESETS["default"], 200
    ),
    Quality.GOOD: Effort(150, EmbeddingConfig(), 50_000, PRESETS["default"]),
    # As many as it takes for their held-out rows to choose the decision threshold.
    Quality.BEST: Effort(300, EmbeddingConfig(level2_epochs=60), 340_000, PRESETS["default"]),
}
