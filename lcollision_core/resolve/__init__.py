"""The nearest collision-free pose: the paper's problem, then a ladder of exactly checked steps."""

from lcollision_core.options.resolve import Metric, ResolveOptions, Solver
from lcollision_core.resolve.free_poses import find_free_poses
from lcollision_core.resolve.ladder import ALL_LOCKED
from lcollision_core.resolve.motion import largest_correction_change
from lcollision_core.resolve.resolver import PoseResolver
from lcollision_core.resolve.result import ResolveResult, Step
