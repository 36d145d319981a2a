"""The contact rules of a set of poses, proposed from the poses themselves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lcollision_core.characters.default_rules import MOST_NEAR_PAIRS
from lcollision_core.contact import CollisionDetector, ContactRules, touching_patches
from lcollision_core.contact.exclusions import near_pairs_estimate
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.learning.request import LearningRequest
from lcollision_core.meshes import (
    PoseSet,
    body_size,
    groups_by_kind,
    named_group,
    named_pair,
    with_named_groups,
)
from lcollision_core.meshes.contact_rules import TOUCHING_RADIUS
from lcollision_core.meshes.evenly_spaced import evenly_spaced

_NEAR_EXCLUSIONS = (0.0, 0.02, 0.05, 0.1)
"""Normalised lengths that are tried on poses without a rig, the shortest first."""

_FEW = 0.1
"""Share of the poses that may collide where the near exclusion is long enough."""

_MOST_POSES = 40
"""Poses, evenly spaced, that are asked."""


def with_proposed_rules(
    poses: PoseSet,
    request: LearningRequest,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> PoseSet:
    """Give poses the contact rules that a request asks for, and propose what it leaves open.

    The near exclusion of poses that say none is the shortest by which few of them collide, or the
    shortest that is about as good as any. Patches that touch in nearly every pose do not count.

    Parameters
    ----------
    poses : with the rules of their files
    request : what is asked for
    progress : called with (poses looked at, poses in all)
    cancel : polled between poses

    Raises
    ------
    LCollisionError : the request ignores pairs of groups that the mesh does not have.
    CancelledError : `cancel` was set.
    """
    rest = poses.rules.rest_exclusion if request.rest_exclusion is None else request.rest_exclusion
    depth = request.tolerated_depth
    depth = poses.rules.tolerated_depth if depth is None else depth
    rules = replace(poses.rules, rest_exclusion=rest, tolerated_depth=depth)
    if request.ignored == ():
        rules = replace(rules, ignored=())
    chosen = evenly_spaced(len(poses), _MOST_POSES)
    asked = poses.vertices[chosen]
    if request.near_exclusion is not None:
        rules = replace(rules, near_exclusion=request.near_exclusion)
    elif not rules.near_exclusion:
        near = _near_exclusion(poses, rules, chosen, cancel)
        rules = replace(rules, near_exclusion=near)
    kinds = groups_by_kind(poses.groups, poses.topology, poses.vertex_labels)
    names = {group.name for kind in kinds.values() for group in kind}
    left_out = (named_group(entry, names) for entry in request.left_out)
    rules = replace(rules, left_out=tuple(dict.fromkeys((*rules.left_out, *left_out))))

    def ignoring(pairs: Iterable[tuple[str, str]]) -> PoseSet:
        ignored = tuple(dict.fromkeys((*rules.ignored, *pairs)))
        ruled = replace(rules, ignored=ignored)
        groups = with_named_groups(poses.groups, kinds, ruled.named_groups)
        return replace(poses, rules=ruled, groups=groups)

    if request.ignored == ():
        return ignoring(())
    chosen_pairs = [named_pair(entry, names) for entry in request.ignored or ()]
    ruled = ignoring(chosen_pairs)
    touching = touching_patches(_detector(ruled), asked, TOUCHING_RADIUS, progress, cancel)
    if not touching:
        return ruled
    rules = replace(ruled.rules, touching=touching, touching_radius=TOUCHING_RADIUS)
    return replace(ruled, rules=rules)


def _detector(poses: PoseSet) -> CollisionDetector:
    return CollisionDetector(poses.topology, poses.vertices[0], poses.rules, poses.groups)


def _near_exclusion(
    poses: PoseSet,
    rules: ContactRules,
    chosen: npt.NDArray[np.intp],
    cancel: CancelToken | None,
) -> float:
    """Return the shortest near exclusion by which few poses collide, if it can be listed."""
    shares: dict[float, float] = {}
    rest = poses.vertices[0].astype(np.float64)
    size = body_size(rest, poses.topology)
    for near in _NEAR_EXCLUSIONS:
        if near and near_pairs_estimate(poses.topology, rest, near * size) > MOST_NEAR_PAIRS:
            break
        detector = _detector(replace(poses, rules=replace(rules, near_exclusion=near)))
        shares[near] = float(np.mean(detector.are_colliding(poses.vertices[chosen], cancel=cancel)))
        if shares[near] <= _FEW:
            return near
    best = min(shares.values())
    return next(near for near, share in shares.items() if share <= best + _FEW)
