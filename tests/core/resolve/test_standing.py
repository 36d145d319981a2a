"""Feet on the ground stay there when a pose's collisions are resolved."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve import ResolveOptions
from tests.rigged_shapes import rigged_body

GROUND = 0.002


@pytest.fixture(scope="module")
def body() -> RigBody:
    return RigBody.of(rigged_body())


def heights(model: RigBody, latent: FloatArray) -> FloatArray:
    return model.space.decode(latent[None])[0] @ model.space.up


def crouching(model: RigBody, thigh: float = 2.2, knee: float = 2.4) -> FloatArray:
    """Return a pose with the thighs in the trunk and the feet where they are at rest."""
    space: RigPoseSpace = model.space
    names = space.rig.joint_names
    codes = np.zeros(model.latent_size)
    for side in ("Left", "Right"):
        for joint, bend in (("UpLeg", thigh), ("Leg", knee), ("Foot", 0.2)):
            chosen = space.joint_of_code == names.index(side + joint)
            codes[chosen & (space.axis_of_code == 0)] = bend
    lowered = heights(model, np.zeros_like(codes)).min() - heights(model, codes).min()
    return space.shifted(codes, lowered * space.up)


def test_feet_stay_on_the_ground_and_none_sinks(body: RigBody) -> None:
    pose = crouching(body)
    ground = heights(body, pose).min()
    assert not body.exact_check().is_free(pose)
    before = body.resolve(pose)
    assert before.exactly_free
    assert heights(body, before.latent).min() < ground - 2.0 * GROUND
    result = body.resolve(pose, ResolveOptions(standing=body.up))
    assert result.exactly_free
    assert heights(body, result.latent).min() == pytest.approx(ground, abs=GROUND)
    stood = heights(body, pose) < ground + 1e-6
    moved = body.decode(result.latent)[stood] - body.decode(pose)[stood]
    assert np.linalg.norm(moved, axis=1).max() < 0.1 * body.body_size


def test_a_locked_trunk_is_not_moved(body: RigBody) -> None:
    pose = crouching(body)
    locked = frozenset({body.space._root_part})
    result = body.resolve(pose, ResolveOptions(standing=body.up, locked_domains=locked))
    np.testing.assert_array_equal(result.latent[:6], pose[:6])


def change(model: RigBody, latent: FloatArray, pose: FloatArray) -> float:
    """Return the largest displacement of a vertex, normalised."""
    moved = model.space.decode(latent[None])[0] - model.space.decode(pose[None])[0]
    return float(np.linalg.norm(moved, axis=1).max())


def test_feet_move_where_keeping_them_moves_the_body_too_far(body: RigBody) -> None:
    pose = crouching(body, 2.4, 1.6)
    free = body.resolve(pose, ResolveOptions(largest_change=None)).latent
    kept = body.resolve(pose, ResolveOptions(standing=body.up, largest_change=None)).latent
    near, far = change(body, free, pose), change(body, kept, pose)
    assert near < 0.8 * far
    options = ResolveOptions(standing=body.up, largest_change=0.5 * (near + far))
    result = body.resolve(pose, options)
    assert result.exactly_free
    assert change(body, result.latent, pose) <= 0.5 * (near + far)
    assert result.note is not None
    assert "the feet moved" in result.note


@pytest.mark.parametrize("most", [0.02, 0.03])
def test_a_pose_of_less_overlap_does_not_sink_unsaid(body: RigBody, most: float) -> None:
    """It is moved up as a whole unless that moves a vertex too far."""
    pose = crouching(body)
    ground = heights(body, pose).min()
    result = body.resolve(pose, ResolveOptions(standing=body.up, largest_change=most))
    assert result.step == "soft"
    assert not result.exactly_free
    assert change(body, result.latent, pose) <= most
    sinks = heights(body, result.latent).min() < ground - 1e-6
    assert result.note is not None
    assert ("the feet moved" in result.note) == sinks == (most > 0.02)
