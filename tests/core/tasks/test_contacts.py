"""Contact rules proposed from poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet
from lcollision_core.meshes import ContactRules, Topology
from lcollision_core.options import LearningRequest
from lcollision_core.tasks.sources import with_proposed_rules
from tests.bending_tube import (
    LENGTH_IN_FILES,
    PLACE_IN_FILES,
    bending_tube,
    bent_tube,
    tube_topology,
)
from tests.core.shapes import strip

REQUEST = LearningRequest(("tube.npz",))


def colliding_share(poses: PoseSet) -> float:
    detector = CollisionDetector(poses.topology, poses.vertices[0], poses.rules, poses.groups)
    return float(np.mean(detector.are_colliding(poses.vertices)))


def two_tubes() -> PoseSet:
    """Return poses of a bending tube, and a second one that always penetrates it."""
    poses, topology = bending_tube(12, most=0.6), tube_topology()
    post = bent_tube(0.0, 0.0) * [0.4, 0.15, 0.4] + [0.05, 0.02, 0.0]
    still = np.repeat(post[None] * LENGTH_IN_FILES + PLACE_IN_FILES, len(poses), axis=0)
    both = np.concatenate([poses.vertices, still], axis=1)
    n_vertices = topology.n_vertices
    faces = np.concatenate([topology.faces, topology.faces + n_vertices])
    return PoseSet(both, Topology(faces, 2 * n_vertices), poses.names)


def test_poses_that_are_free_keep_the_strict_rule() -> None:
    poses = bending_tube(12, most=0.6)
    assert colliding_share(poses) == 0.0
    assert with_proposed_rules(poses, REQUEST).rules == ContactRules()


def test_folds_of_most_poses_are_not_counted() -> None:
    # A long strip that crosses itself in a small loop in all poses but the first.
    loop = [[0, 0], [2, 0], [4, 0], [4, 2], [3, 3], [1.5, 1.5], [0, -1]]
    path = [*([x, 0] for x in range(-45, 0)), *loop, *([0, -y] for y in range(2, 50))]
    rest, folded = strip([[x, 0] for x in range(len(path))]), strip(path)
    vertices = np.stack([rest.vertices, *[folded.vertices] * 4])
    poses = PoseSet(vertices, rest.topology, tuple("abcde"))
    assert colliding_share(poses) > 0.5
    proposed = with_proposed_rules(poses, REQUEST)
    assert proposed.rules.near_exclusion == 0.1
    assert colliding_share(proposed) == 0.0
    fixed = with_proposed_rules(poses, replace(REQUEST, near_exclusion=0.0))
    assert fixed.rules == ContactRules()


def test_places_that_always_touch_are_left_out_and_groups_where_the_request_says_so() -> None:
    poses = two_tubes()
    assert colliding_share(poses) == 1.0
    proposed = with_proposed_rules(poses, REQUEST)
    assert proposed.rules.ignored == ()
    assert proposed.rules.touching
    assert colliding_share(proposed) == 0.0
    none = with_proposed_rules(poses, replace(REQUEST, ignored=(), near_exclusion=0.0))
    assert (none.rules.ignored, none.rules.touching) == ((), ())
    named = replace(REQUEST, ignored=("component 2:component 1",))
    assert with_proposed_rules(poses, named).rules.ignored == (("component 2", "component 1"),)
    with pytest.raises(LCollisionError, match=r"names 'hat', which is not a group"):
        with_proposed_rules(poses, replace(REQUEST, ignored=("hat:component 1",)))
