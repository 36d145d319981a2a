"""The public names of `lcollision_core.predictor`, loaded on first use."""

from lcollision_core.predictor.config import (
    PRESETS,
    Loss,
    PredictorConfig,
    PredictorStatus,
    has_begun,
    held_out_index,
    patches_path,
)
from lcollision_core.predictor.evaluation import PartScores, ScoredRows, score_rows
from lcollision_core.predictor.metrics import CalibrationBin, Counts, KindScores, PredictorMetrics
from lcollision_core.predictor.predictor import (
    CollisionPredictor,
    Prediction,
    PredictorRecord,
    TrainingFacts,
)
from lcollision_core.predictor.training import train_predictor
