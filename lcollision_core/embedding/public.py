"""The public names of `lcollision_core.embedding`, loaded on first use."""

from lcollision_core.embedding.bilevel import (
    ROWS_PER_BLOCK,
    Embedding,
    EmbeddingMetrics,
    LatentBox,
    LatentFit,
)
from lcollision_core.embedding.decoder import AutoencoderWeights, FeatureDecoder
from lcollision_core.embedding.seeding import MaskQuality, attention_mask, judge_masks
from lcollision_core.embedding.training import train_embedding
from lcollision_core.embedding.training_run import EmbeddingConfig, TrainingStatus
