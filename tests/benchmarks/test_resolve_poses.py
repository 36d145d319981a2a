"""Poses that the Resolve benchmark makes as a person would."""

from __future__ import annotations

import numpy as np
import pytest

from app.benchmarks.resolve import made_poses, score_drags
from lcollision_core.bodies import RigBody
from lcollision_core.errors import LCollisionError
from lcollision_core.resolve import ResolveOptions
from tests.core.bodies.test_starter_poses import numbered
from tests.skeletons import HORSE, PERSON, character_from


def test_made_poses_collide_within_the_limits_and_turn_no_head() -> None:
    model = RigBody.of(character_from(PERSON, numbered))
    poses = made_poses(model, 5, seed=1).latents
    assert poses.shape == (5, model.latent_size)
    assert not model.exact_check().are_free(poses).any()
    assert (poses >= model.space.low).all()
    assert (poses <= model.space.high).all()
    turned = np.ptp(poses, axis=0) > 0.0
    roles = [model.space.roles[joint].name for joint in model.space.joint_of_code[turned]]
    assert {"UPPER_ARM", "THIGH"} <= set(roles)
    assert "HEAD" not in roles


def test_joints_that_are_not_known_are_refused() -> None:
    with pytest.raises(LCollisionError, match="are not known"):
        made_poses(RigBody.of(character_from(HORSE, numbered)), 1, seed=0)


def test_drags_to_made_poses_end_free_and_near() -> None:
    model = RigBody.of(character_from(PERSON))
    poses = made_poses(model, 2, seed=1)
    row = score_drags(model, poses, ResolveOptions())
    assert (row["poses"], row["exactly_free_rate"]) == (2, 1.0)
    way = np.linalg.norm(model.decode(poses.latents) - model.reference, axis=2).mean()
    assert 0.0 < row["vertex_distance"] < way / model.body_size
    assert row["vertex_distance"] < row["largest_change"]
