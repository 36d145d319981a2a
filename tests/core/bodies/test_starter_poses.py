"""Starter poses: the same for different rest poses, on the ground, within limits."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.rig_poses import POSES, starter_poses
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.files import Character
from tests.skeletons import HORSE, PERSON, character_from

FloatArray = npt.NDArray[np.float64]

FINGERS = {
    f"{side} {name}{number}": (f"{side} {parent}", (sign * x, y, z))
    for side, sign in (("L", 1.0), ("R", -1.0))
    for name, out, depth, ahead in (
        ("thumb", 0.73, 0.05, 0.015),
        ("index", 0.8, 0.03, 0.0),
        ("middle", 0.8, 0.0, 0.0),
        ("ring", 0.8, -0.03, 0.0),
    )
    for number, parent, (x, y, z) in (
        (1, "hand", (out, 1.42, depth)),
        (2, f"{name}1", (out + 0.03, 1.42, depth + ahead)),
        (3, f"{name}2", (out + 0.06, 1.42, depth + 2.0 * ahead)),
    )
}
WITH_FINGERS = {**PERSON, **FINGERS}


def numbered(joint: int, _: str) -> str:
    return f"Bone.{joint:03d}"


def places(space: RigPoseSpace, name: str) -> dict[str, FloatArray]:
    """Return a person's joint positions in a pose: left, up and forward of the hips."""
    (pose,) = (pose for pose in starter_poses(space) if pose.name == name)
    axes = np.stack([np.cross(space.up, space.front), space.up, space.front])
    moved = space.transforms(pose.codes)[:, :3, 3] / space.body_size @ axes.T
    return dict(zip(PERSON, moved - moved[0], strict=False))


def with_arms_down(degrees: float) -> Character:
    """Return the person with its arms down at rest, as if modelled that way."""
    joints = dict(PERSON)
    turn = np.radians(degrees)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        shoulder = np.array(PERSON[f"{side} upperarm"][1])
        for name in ("forearm", "hand"):
            x, y, z = np.array(PERSON[f"{side} {name}"][1]) - shoulder
            lowered = (np.cos(turn) * x, y - np.sin(turn) * sign * x, z)
            joints[f"{side} {name}"] = (
                PERSON[f"{side} {name}"][0],
                tuple(shoulder + lowered),
            )
    return character_from(joints, numbered)


def test_poses_are_the_same_whatever_the_rest_pose_is_and_joints_are_called() -> None:
    spread = RigPoseSpace(character_from(PERSON))
    for other in (45.0, 75.0):
        lowered = RigPoseSpace(with_arms_down(other))
        for name in POSES.body:
            expected, got = places(spread, name), places(lowered, name)
            scale = lowered.body_size / spread.body_size
            for joint, place in expected.items():
                np.testing.assert_allclose(got[joint] * scale, place, atol=0.06, err_msg=joint)


def test_what_the_poses_are() -> None:
    space = RigPoseSpace(character_from(PERSON, numbered))
    stand = places(space, "Stand")
    assert abs(stand["L hand"][0] - stand["L upperarm"][0]) < 0.1
    assert stand["L hand"][1] < stand["L upperarm"][1] - 0.2
    sit = places(space, "Sit")
    assert abs(sit["L shin"][1] - sit["L thigh"][1]) < 0.1 < sit["L shin"][2] - sit["L thigh"][2]
    assert sit["L foot"][1] < sit["L shin"][1] - 0.2
    kneel = places(space, "Kneel")
    assert kneel["R shin"][1] < kneel["L shin"][1] - 0.15
    walk = places(space, "Walk")
    assert walk["L foot"][2] > walk["R foot"][2] + 0.1
    assert walk["L hand"][2] < walk["R hand"][2]
    crossed = places(space, "Arms crossed")
    assert crossed["L hand"][0] < 0.02
    assert crossed["R hand"][0] > -0.02
    assert min(crossed["L hand"][2], crossed["R hand"][2]) > 0.02
    hips = places(space, "Hands on hips")
    assert hips["L forearm"][0] > hips["L hand"][0] > 0.0
    assert abs(hips["L hand"][1] - hips["L thigh"][1]) < 0.2


def test_poses_stand_on_the_ground_within_the_limits_of_the_joints() -> None:
    body = RigBody.of(character_from(WITH_FINGERS, numbered))
    space = body.space
    names = [pose.name for pose in body.starter_poses]
    assert names == [*POSES.body, *POSES.hands]
    assert len(names) == 12
    ground = (space.rest_vertices @ space.up).min()
    for pose in body.starter_poses:
        assert (pose.codes >= space.low - 1e-9).all()
        assert (pose.codes <= space.high + 1e-9).all()
        if pose.moves is None:
            assert (space.decode(pose.codes[None])[0] @ space.up).min() == pytest.approx(ground)


def test_poses_of_hands_move_fingers_only() -> None:
    space = RigPoseSpace(character_from(WITH_FINGERS, numbered))
    poses = {pose.name: pose for pose in starter_poses(space)}
    fist, names = poses["Fists"], list(WITH_FINGERS)
    assert fist.moves is not None
    moved = {names[joint] for joint in np.unique(space.joint_of_code[fist.moves])}
    assert moved == set(FINGERS)
    assert (fist.codes[~fist.moves] == 0.0).all()
    rest, closed, open_hand, pointing = (
        space.transforms(codes)[:, :3, 3] / space.body_size
        for codes in (np.zeros(len(space.low)), *(poses[name].codes for name in
                      ("Fists", "Open hands", "Pointing hands")))
    )  # fmt: skip
    middle, index = names.index("L middle3"), names.index("L index3")
    assert closed[middle, 1] < rest[middle, 1] - 0.01
    np.testing.assert_allclose(pointing[index], rest[index], atol=0.01)
    np.testing.assert_allclose(open_hand[middle], rest[middle], atol=0.01)


def test_what_is_no_person_has_none() -> None:
    assert starter_poses(RigPoseSpace(character_from(HORSE))) == ()
    arm = {name: joint for name, joint in PERSON.items() if name != "L shin" and name != "L foot"}
    arm["L toe"] = ("L thigh", (0.1, 0.02, 0.1))
    assert starter_poses(RigPoseSpace(character_from(arm))) == ()
