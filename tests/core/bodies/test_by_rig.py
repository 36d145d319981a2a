"""Training poses made by a rig."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lcollision_core import jobs
from lcollision_core.bodies import RigBody, poses_by_rig, rest_pose_set
from lcollision_core.bodies.rig_poses import HumanDraws, random_codes
from lcollision_core.errors import CancelledError, LCollisionError, PoseSetError, ShapeError
from lcollision_core.files import PoseSet
from lcollision_core.jobs import Job
from lcollision_core.meshes.joint_kinds import JOINT_KINDS, Role
from tests.rigged_shapes import rigged_body, rigged_tube

SCALE = 100.0


@pytest.fixture(scope="module")
def body() -> RigBody:
    return RigBody.of(rigged_body(SCALE))


@pytest.fixture(scope="module")
def poses(body: RigBody) -> PoseSet:
    return poses_by_rig(body, 150, seed=5)


def joint_of(body: RigBody, name: str) -> int:
    return body.space.rig.joint_names.index(name)


def codes_of(body: RigBody, n: int, seed: int = 0) -> np.ndarray:
    """Draw the codes of poses without checking collisions."""
    return random_codes(body.space, n, np.random.default_rng(seed))


def test_the_rest_pose_comes_first_and_the_others_are_free(body: RigBody, poses: PoseSet) -> None:
    np.testing.assert_array_equal(poses.vertices[0], body.character.rest_vertices)
    assert poses.names[:2] + poses.names[-1:] == ("rest", "rig 1", "rig 150")
    assert (poses.up_axis, poses.groups) == (2, body.character.groups)
    assert poses.rules.rest_exclusion == body.rules.rest_exclusion
    assert poses.vertex_labels is not None
    assert {"Left forearm", "Right shin"} <= set(poses.vertex_labels.tolist())
    made = poses.provenance["by_rig"]
    free = ~body.detector.are_colliding(poses.vertices[1:].astype(np.float32))
    assert (made["seed"], made["drawn"], made["free"]) == (5, 150, int(free.sum()))
    assert free.mean() > 0.85
    bend, twist, aside = made["limits_degrees"]["LeftForeArm"]
    assert (bend, twist, aside) == ([0.0, 135.0], [-60.0, 60.0], [0.0, 0.0])
    assert "HeadEnd" not in made["limits_degrees"]


def test_each_pose_differs(poses: PoseSet) -> None:
    moved = np.abs(poses.vertices - poses.vertices[0]).max(axis=(1, 2))
    assert moved[1:].min() > 0.01 * SCALE
    assert len(np.unique(poses.vertices.reshape(len(poses), -1), axis=0)) == 151


def test_poses_reach_far_into_their_limits_and_combine_few_to_many_limbs(body: RigBody) -> None:
    space, draws = body.space, HumanDraws(body.space)
    codes = codes_of(body, 2000)
    assert (codes >= space.low).all()
    assert (codes <= space.high).all()
    assert not codes[:, :6].any()
    limits = draws.limits[space.joint_of_code[6:], space.axis_of_code[6:]]
    turns = codes[:, 6:]
    assert (turns >= limits[:, 0] - 1e-12).all()
    assert (turns <= limits[:, 1] + 1e-12).all()
    assert (turns.min(axis=0) <= 0.7 * limits[:, 0] + 1e-12).all()
    assert (turns.max(axis=0) >= 0.7 * limits[:, 1] - 1e-12).all()
    limbs = {
        side + first: [joint_of(body, side + first), joint_of(body, side + second)]
        for side in ("Left", "Right")
        for first, second in (("Arm", "Hand"), ("UpLeg", "Leg"))
    }
    moves = np.stack(
        [codes[:, np.isin(space.joint_of_code, joints)].any(axis=1) for joints in limbs.values()]
    )
    shares = np.bincount(moves.sum(axis=0), minlength=5) / len(codes)
    assert shares[1:].min() > 0.05
    # Joints of one limb move together, those of different limbs independently.
    for joints in limbs.values():
        ways = [codes[:, space.joint_of_code == joint].any(axis=1) for joint in joints]
        np.testing.assert_array_equal(ways[0], ways[1])


def test_left_and_right_are_alike(body: RigBody) -> None:
    codes = codes_of(body, 4000)
    vertices = body.decode(codes)
    symmetry = body.symmetry
    assert symmetry is not None
    mean, spread = vertices.mean(axis=0), vertices.std(axis=0)
    np.testing.assert_allclose(symmetry.mirror_vertices(mean), mean, atol=0.02 * SCALE)
    np.testing.assert_allclose(spread[symmetry.partner], spread, atol=0.02 * SCALE)
    # An arm can be lowered as far as a person's, whatever its axes.
    limits = HumanDraws(body.space).limits
    left, right = (
        np.degrees(limits[joint_of(body, side + "Arm"), 2]) for side in ("Left", "Right")
    )
    np.testing.assert_allclose(left, -right[::-1])
    for side in ("Left", "Right"):
        hand = np.array(
            [
                body.space.transforms(pose)[joint_of(body, side + "Hand"), 2, 3]
                for pose in codes[:500]
            ]
        )
        shoulder = 1.45 * SCALE
        assert hand.min() < shoulder - 0.4 * SCALE
        assert hand.max() > shoulder + 0.35 * SCALE


def test_arms_that_hang_at_rest_are_raised_from_there() -> None:
    character = rigged_body()
    rig = character.rig
    assert rig is not None
    hanging = rig.rest.copy()
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        for name, drop in (("ForeArm", 0.3), ("Hand", 0.55), ("HandEnd", 0.7)):
            hanging[rig.joint_names.index(side + name), :3, 3] = [0.2 * sign, 0.0, 1.45 - drop]
    body = RigBody.of(replace(character, rig=replace(rig, rest=hanging)))
    limits = np.degrees(HumanDraws(body.space).limits)
    (down, up), most = JOINT_KINDS[Role.UPPER_ARM].comfortable[2], 120.0
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        aside = sign * limits[joint_of(body, side + "Arm"), 2]
        np.testing.assert_allclose(sorted(aside), [down + 90.0, min(up + 90.0, most)], atol=1e-6)


def test_equal_seeds_give_equal_poses_on_any_number_of_threads(
    body: RigBody, poses: PoseSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lcollision_core.contact.detector.available_cores", lambda: 1)
    monkeypatch.setattr(jobs, "available_cores", lambda: 1)
    np.testing.assert_array_equal(poses_by_rig(body, 150, seed=5).vertices, poses.vertices)
    assert not np.array_equal(poses_by_rig(body, 5, seed=6).vertices, poses.vertices[:6])


def test_a_body_that_always_collides_ends_and_keeps_the_least(body: RigBody) -> None:
    # All its limbs end at one point, the chest.
    character = body.character
    shoved = character.rest_vertices.copy()
    label = rest_pose_set(character).vertex_labels
    assert label is not None
    rig = character.rig
    assert rig is not None
    hand = np.char.startswith(label, "Left hand")
    shift = np.array([-0.9, 0.0, -0.2]) * SCALE
    shoved[hand] += shift
    points = rig.points.copy()
    points[hand] += shift
    crossed = RigBody.of(
        replace(character, rest_vertices=shoved, rig=replace(rig, points=points))
    ).with_rules(replace(body.rules, near_exclusion=0.0, rest_exclusion=None))
    said: list[tuple[int, int]] = []
    poses = poses_by_rig(crossed, 20, job=Job(lambda *counts: said.append(counts)))
    free = ~crossed.detector.are_colliding(poses.vertices[1:].astype(np.float32))
    assert poses.provenance["by_rig"]["free"] == int(free.sum()) < 20
    assert said[-1] == (20, 20)
    assert all(before <= after for before, after in pairwise(said))


def test_unknown_joints_turn_modestly() -> None:
    body = RigBody.of(rigged_tube(n_joints=4))
    made = poses_by_rig(body, 10).provenance["by_rig"]
    assert set(map(str, made["limits_degrees"].values())) == {str([[-30.0, 30.0]] * 3)}


def test_what_cannot_be_posed_gets_a_sentence(body: RigBody) -> None:
    with pytest.raises(ShapeError, match="1 or more"):
        poses_by_rig(body, 0)
    with pytest.raises(PoseSetError, match=r"would have .* coordinates"):
        poses_by_rig(body, 10**7)
    job = Job()
    job.cancel()
    with pytest.raises(CancelledError):
        poses_by_rig(body, 3, job=job)
    with pytest.raises(LCollisionError, match=r"body\.glb has no joints"):
        rest_pose_set(replace(body.character, rig=None))
    flat = body.character.rest_vertices.copy()
    first = body.topology.faces[0]
    flat[first] = flat[first[0]]
    with pytest.raises(PoseSetError, match=f"{Path('body.glb')} cannot be used: .* have no area"):
        rest_pose_set(replace(body.character, rest_vertices=flat))
