"""The contact rules of a set of poses, proposed from the poses themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.rig_body import MOST_NEAR_PAIRS
from lcollision_core.contact import CollisionDetector, touching_patches
from lcollision_core.contact.exclusions import near_pairs_estimate
from lcollision_core.files import PoseSet
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import body_size
from lcollision_core.meshes.contact_rules import TOUCHING_RADIUS
from lcollision_core.meshes.evenly_spaced import evenly_spaced
from lcollision_core.options import LearningRequest

_NEAR_EXCLUSIONS = (0.0, 0.02, 0.05, 0.1)
"""Normalised lengths that are tried on poses without a rig, the shortest first."""

_FEW = 0.1
"""Share of the poses that may collide where the near exclusion is long enough."""

_MOST_POSES = 40
"""Poses, evenly spaced, that are asked."""


def with_proposed_rules(
    poses: PoseSet,
    request: LearningRequest,
    job: Job = UNWATCHED,
) -> PoseSet:
    """Give poses the contact rules that a request asks for, and propose what it leaves open.

    The near exclusion of poses that say none is the shortest by which few of them collide, or the
    shortest that is about as good as any. Patches that touch in nearly every pose do not count.

    Parameters
    ----------
    poses : with the rules of their files
    request : what is asked for
    job : reports (poses looked at, poses in all); polled between poses

    Raises
    ------
    LCollisionError : the request ignores pairs of groups that the mesh does not have.
    CancelledError : the job was cancelled.
    """
    rules, groups = request.applied(poses.rules, poses.groups, poses.topology, poses.vertex_labels)
    if request.ignored == ():
        rules = replace(rules, ignored=())
    ruled = replace(poses, rules=rules, groups=groups)
    chosen = evenly_spaced(len(poses), _MOST_POSES)
    if request.near_exclusion is None and not rules.near_exclusion:
        rules = replace(rules, near_exclusion=_near_exclusion(ruled, chosen, job.part()))
        ruled = replace(ruled, rules=rules)
    if request.ignored == ():
        return ruled
    asked = poses.vertices[chosen]
    touching = touching_patches(_detector(ruled), asked, TOUCHING_RADIUS, job)
    if not touching:
        return ruled
    return replace(ruled, rules=replace(rules, touching=touching, touching_radius=TOUCHING_RADIUS))


def _detector(poses: PoseSet) -> CollisionDetector:
    return CollisionDetector(poses.topology, poses.vertices[0], poses.rules, poses.groups)


def _near_exclusion(poses: PoseSet, chosen: npt.NDArray[np.intp], job: Job) -> float:
    """Return the shortest near exclusion by which few poses collide, if it can be listed."""
    shares: dict[float, float] = {}
    rest = poses.vertices[0].astype(np.float64)
    size = body_size(rest, poses.topology)
    for near in _NEAR_EXCLUSIONS:
        if near and near_pairs_estimate(poses.topology, rest, near * size) > MOST_NEAR_PAIRS:
            break
        detector = _detector(replace(poses, rules=replace(poses.rules, near_exclusion=near)))
        shares[near] = float(np.mean(detector.are_colliding(poses.vertices[chosen], job=job)))
        if shares[near] <= _FEW:
            return near
    best = min(shares.values())
    return next(near for near, share in shares.items() if share <= best + _FEW)
