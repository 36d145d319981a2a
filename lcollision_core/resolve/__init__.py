"""The nearest collision-free pose: the paper's problem, then a ladder that ends exactly free."""

from lcollision_core.resolve.options import Metric, ResolveOptions, ResolveResult, Solver, Step
from lcollision_core.resolve.resolver import PoseResolver

__all__ = [
    "Metric",
    "PoseResolver",
    "ResolveOptions",
    "ResolveResult",
    "Solver",
    "Step",
]
