"""Exact self-collision: candidates, penetration depths, penetration energy.

Two triangles collide when they share no vertex and their penetration depth, the shortest
translation that separates them, exceeds `DEPTH_TOLERANCE` in normalised length. Surfaces that
coincide exactly have depth 0: they touch, and do not collide. `CollisionDetector.summarise` counts
them. With a clearance, triangles nearer than it collide: see `CollisionDetector.with_clearance`.
"""

from lcollision_core.contact.detector import (
    BatchCollisions,
    CollisionDetector,
    SelfCollisions,
)
from lcollision_core.contact.distance import (
    depth_slopes,
    distance_slopes,
    penetration_depth,
    triangle_distance,
)
from lcollision_core.contact.exclusions import DISTANCE_BOUND, NearestPair
from lcollision_core.contact.propose import (
    GroupPair,
    ProposedPair,
    propose_by_kind,
    touching_patches,
)
from lcollision_core.contact.search import DEPTH_TOLERANCE
from lcollision_core.meshes.contact_rules import STRICT, ContactRules, RuleCounts
