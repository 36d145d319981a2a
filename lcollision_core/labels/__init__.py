"""Exact labels of samples of the latent box, and the folder that stores them."""

from lcollision_core.labels.labeller import (
    Labeller,
    LabelRows,
    StoreIdentity,
    is_held_out,
    is_of_box,
    measures,
)
from lcollision_core.labels.labelling_run import LabelStatus, label_poses
from lcollision_core.labels.store import ROWS_PER_CHUNK, LabelStore
