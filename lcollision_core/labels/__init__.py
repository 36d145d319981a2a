"""The latent box, exact labels of samples in it, and the folder that keeps them."""

from lcollision_core.labels.box import BOX_SCALE, ROWS_A_BLOCK, LatentBox
from lcollision_core.labels.identity import StoreIdentity, is_held_out
from lcollision_core.labels.labeller import Labeller, LabelRows
from lcollision_core.labels.run import LabelStatus, StatusCallback, label_poses, no_status
from lcollision_core.labels.store import ROWS_A_CHUNK, LabelStore

__all__ = [
    "BOX_SCALE",
    "ROWS_A_BLOCK",
    "ROWS_A_CHUNK",
    "LabelRows",
    "LabelStatus",
    "LabelStore",
    "Labeller",
    "LatentBox",
    "StatusCallback",
    "StoreIdentity",
    "is_held_out",
    "label_poses",
    "no_status",
]
