"""Find the nearest collision-free pose: a ladder of steps, each ended by the exact check."""

from lcollision_core.options import Metric, ResolveOptions, Solver
from lcollision_core.resolve.resolver import (
    ALL_LOCKED,
    BodyAlone,
    PoseResolver,
    ResolveResult,
    Step,
    find_free_poses,
    largest_correction_change,
)
