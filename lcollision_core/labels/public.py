"""The public names of `lcollision_core.labels`, loaded on first use."""

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
