"""The nearest collision-free pose: the paper's problem, then a ladder of exactly checked steps."""

from lcollision_core.options import Metric, ResolveOptions, Solver
from lcollision_core.resolve.resolver import (
    ALL_LOCKED,
    PoseResolver,
    ResolveResult,
    Step,
    find_free_poses,
    largest_correction_change,
)
