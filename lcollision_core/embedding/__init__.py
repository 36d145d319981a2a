"""The latent space of poses: bilevel autoencoder, attention masks, stage 1 of the training."""

from lcollision_core.embedding.autoencoders import AutoencoderWeights
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.embedding.config import EmbeddingConfig
from lcollision_core.embedding.decoder import FeatureDecoder
from lcollision_core.embedding.fitting import LatentFit
from lcollision_core.embedding.latent_box import ROWS_PER_BLOCK, LatentBox
from lcollision_core.embedding.masks import MaskQuality, attention_mask, judge_masks
from lcollision_core.embedding.metrics import EmbeddingMetrics
from lcollision_core.embedding.training import train_embedding
from lcollision_core.embedding.training_run import TrainingStatus
