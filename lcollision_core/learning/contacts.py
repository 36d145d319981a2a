"""The contact rules of a set of poses, proposed from the poses themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lcollision_core.contact import CollisionDetector, ContactRules, propose_ignored
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.learning.request import LearningRequest
from lcollision_core.meshes import FaceGroup, PoseSet, component_groups, part_groups

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
    groups = {group.name: group for group in poses.groups}
    named = _named_groups(poses, groups)
    pairs = dict.fromkeys(rules.ignored)
    if request.ignored is None:
        detector = CollisionDetector(poses.topology, poses.vertices[0], rules, poses.groups)
        components = component_groups(poses.topology)
        kind = components if len(components) > 1 else tuple(named.values())
        found = propose_ignored(
            detector, asked, kind, counted_only=True, progress=progress, cancel=cancel
        )
        pairs |= dict.fromkeys(pair.groups for pair in found)
    else:
        pairs |= dict.fromkeys(_pair(entry, named) for entry in request.ignored)
    used = {name: named[name] for pair in pairs for name in pair if name not in groups}
    rules = replace(rules, ignored=tuple(pairs))
    return replace(poses, rules=rules, groups=(*poses.groups, *used.values()))


def _near_exclusion(poses: PoseSet, rules: ContactRules, chosen: np.ndarray) -> float:
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


def _named_groups(poses: PoseSet, groups: Mapping[str, FaceGroup]) -> dict[str, FaceGroup]:
    """Return the groups of the files, and the body parts and components of other names."""
    labels = poses.vertex_labels
    parts = () if labels is None else part_groups(poses.topology, labels)
    others = {group.name: group for group in (*parts, *component_groups(poses.topology))}
    return others | dict(groups)


def _pair(entry: str, named: Mapping[str, FaceGroup]) -> tuple[str, str]:
    for at in (place for place, letter in enumerate(entry) if letter == ":"):
        pair = entry[:at].strip(), entry[at + 1 :].strip()
        if all(name in named for name in pair):
            return pair
    listed = ", ".join(sorted(named)[:8]) + (" ..." if len(named) > 8 else "")
    raise LCollisionError(
        "is not A:B with the names of two groups of faces of this mesh",
        f"name two of {listed}",
        where=f"--ignore {entry!r}",
    )
