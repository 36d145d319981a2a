"""Exact self-collision: candidates, penetration depths, penetration energy."""

from lcollision_core.contact.depth import penetration_depth
from lcollision_core.contact.detector import (
    DEPTH_TOLERANCE,
    BatchCollisions,
    CollisionDetector,
    SelfCollisions,
)
from lcollision_core.contact.energy import domain_energy

__all__ = [
    "DEPTH_TOLERANCE",
    "BatchCollisions",
    "CollisionDetector",
    "SelfCollisions",
    "domain_energy",
    "penetration_depth",
]
