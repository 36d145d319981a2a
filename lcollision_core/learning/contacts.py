"""The contact rules of a set of poses, proposed from the poses themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector, ContactRules, propose_by_kind
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.learning.request import LearningRequest
from lcollision_core.meshes import PoseSet, groups_by_kind, named_pair

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
    shortest that is about as good as any. Pairs of groups of faces that still collide in nearly
    every pose are ignored: pairs of components where there are several, else of body parts.

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
    depth = request.tolerated_depth or poses.rules.tolerated_depth
    rules = replace(poses.rules, rest_exclusion=rest, tolerated_depth=depth)
    chosen = np.unique(np.linspace(0, len(poses) - 1, _MOST_POSES).round().astype(int))
    asked = poses.vertices[chosen]
    if request.near_exclusion is not None:
        rules = replace(rules, near_exclusion=request.near_exclusion)
    elif not rules.near_exclusion:
        near = _near_exclusion(poses, rules, chosen)
        rules = replace(rules, near_exclusion=near)
    kinds = groups_by_kind(poses.groups, poses.topology, poses.vertex_labels)
    named = {group.name: group for kind in kinds.values() for group in kind}
    named |= {group.name: group for group in poses.groups}
    if request.ignored is None:
        detector = CollisionDetector(poses.topology, poses.vertices[0], rules, poses.groups)
        *_, parts, components = kinds
        asked_kind = components if len(kinds[components]) > 1 else parts
        found = propose_by_kind(
            detector,
            asked,
            {asked_kind: kinds[asked_kind]},
            counted_only=True,
            progress=progress,
            cancel=cancel,
        )
        new = [pair.groups for pair in found[asked_kind]]
    else:
        new = [named_pair(entry, named) for entry in request.ignored]
    ignored = tuple(dict.fromkeys((*rules.ignored, *new)))
    held = {group.name for group in poses.groups}
    used = dict.fromkeys(name for pair in ignored for name in pair if name not in held)
    groups = (*poses.groups, *(named[name] for name in used))
    return replace(poses, rules=replace(rules, ignored=ignored), groups=groups)


def _near_exclusion(poses: PoseSet, rules: ContactRules, chosen: npt.NDArray[np.intp]) -> float:
    """Return the shortest near exclusion by which few poses collide."""
    shares: dict[float, float] = {}
    for near in _NEAR_EXCLUSIONS:
        detector = CollisionDetector(
            poses.topology, poses.vertices[0], replace(rules, near_exclusion=near), poses.groups
        )
        shares[near] = float(np.mean(detector.are_colliding(poses.vertices[chosen])))
        if shares[near] <= _FEW:
            return near
    best = min(shares.values())
    return next(near for near, share in shares.items() if share <= best + _FEW)
