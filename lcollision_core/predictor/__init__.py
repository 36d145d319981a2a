"""Latent codes to energy per domain and collision probability: learned, smooth, fast (stage 2)."""

from lcollision_core.predictor.config import PRESETS, Loss, PredictorConfig
from lcollision_core.predictor.metrics import CalibrationBin, KindScores, PredictorMetrics
from lcollision_core.predictor.predictor import (
    CollisionPredictor,
    Prediction,
    PredictorRecord,
    TrainingFacts,
    evaluate_predictor,
)
from lcollision_core.predictor.training.row_split import held_out_rows
from lcollision_core.predictor.training.status import (
    PredictorStatus,
    StatusCallback,
    has_begun,
    patches_path,
)
from lcollision_core.predictor.training.train import train_predictor
