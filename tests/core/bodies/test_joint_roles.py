"""Roles of joints, from the names that common programs give them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.bodies.anatomy import joint_limits, joint_roles
from lcollision_core.meshes.joint_kinds import Role
from tests.rigged_shapes import rigged_tube

ARM = (Role.SHOULDER, Role.UPPER_ARM, Role.FOREARM, Role.HAND, Role.THUMB, Role.FINGER, Role.FINGER)
LEG = (Role.THIGH, Role.SHIN, Role.FOOT, Role.TOE)
TRUNK = (Role.SPINE, Role.SPINE, Role.NECK, Role.HEAD)


def roles_of(tree: str) -> dict[str, Role]:
    """Return the roles of names given in lines, indented below their parents."""
    lines = tree.splitlines()
    depths = [len(line) - len(line.lstrip()) for line in lines]
    parents = [
        max((above for above in range(joint) if depths[above] < depth), default=-1)
        for joint, depth in enumerate(depths)
    ]
    names = [line.strip() for line in lines]
    rig = rigged_tube().rig
    assert rig is not None
    rest = np.tile(np.eye(4), (len(names), 1, 1))
    rest[:, 1, 3] = np.arange(len(names))
    rig = replace(rig, joint_names=tuple(names), parents=np.array(parents), rest=rest)
    return dict(zip(names, joint_roles(rig), strict=True))


def chain(*names: str) -> str:
    return "\n".join(" " * depth + name for depth, name in enumerate(names))


@pytest.mark.parametrize(
    ("root", "trunk", "arm", "leg"),
    [
        pytest.param(
            "mixamorig:Hips",
            "mixamorig:Spine mixamorig:Spine1 mixamorig:Neck mixamorig:Head",
            "mixamorig:LeftShoulder mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand "
            "mixamorig:LeftHandThumb1 mixamorig:LeftHandRing1 mixamorig:LeftHandRing2",
            "mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase",
            id="Mixamo",
        ),
        pytest.param(
            "J_Bip_C_Hips",
            "J_Bip_C_Spine J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
            "J_Bip_L_Shoulder J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand J_Bip_L_Thumb1 "
            "J_Bip_L_Little1 J_Bip_L_Little2",
            "J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_ToeBase",
            id="VRM",
        ),
        pytest.param(
            "hips",
            "spine chest neck head",
            "leftShoulder leftUpperArm leftLowerArm leftHand leftThumbProximal leftIndexProximal "
            "leftIndexDistal",
            "leftUpperLeg leftLowerLeg leftFoot leftToes",
            id="VRM's own words",
        ),
        pytest.param(
            "DEF-spine",
            "DEF-spine.001 DEF-spine.002 DEF-neck DEF-head",
            "DEF-shoulder.L DEF-upper_arm.L DEF-forearm.L DEF-hand.L DEF-thumb.01.L "
            "DEF-f_index.01.L DEF-f_index.02.L",
            "DEF-thigh.L DEF-shin.L DEF-foot.L DEF-toe.L",
            id="Rigify",
        ),
        pytest.param(
            "pelvis",
            "spine_01 spine_02 neck_01 head",
            "clavicle_l upperarm_l lowerarm_l hand_l thumb_01_l pinky_01_l pinky_02_l",
            "thigh_l calf_l foot_l ball_l",
            id="Unreal",
        ),
        pytest.param(
            "Bip001 Pelvis",
            "Bip001 Spine|Bip001 Spine1|Bip001 Neck|Bip001 Head",
            "Bip001 L Clavicle|Bip001 L UpperArm|Bip001 L Forearm|Bip001 L Hand|"
            "Bip001 L Finger0|Bip001 L Finger1|Bip001 L Finger11",
            "Bip001 L Thigh|Bip001 L Calf|Bip001 L Foot|Bip001 L Toe0",
            id="Biped",
        ),
        pytest.param(
            "root",
            "spine_c chest_c neck_c head_c",
            "clavicle_l shoulder_l elbow_l wrist_l thumb1_l index1_l index2_l",
            "hip_l knee_l ankle_l ball_l",
            id="Maya",
        ),
        pytest.param(
            "Root_M",
            "Spine1_M Chest_M Neck_M Head_M",
            "Scapula_L Shoulder_L Elbow_L Wrist_L ThumbFinger1_L IndexFinger1_L IndexFinger2_L",
            "Hip_L Knee_L Ankle_L Toes_L",
            id="Advanced Skeleton",
        ),
        pytest.param(
            "pelvis",
            "spine1 spine2 neck head",
            "left_collar left_shoulder left_elbow left_wrist left_thumb1 left_index1 left_index2",
            "left_hip left_knee left_ankle left_foot",
            id="SMPL",
        ),
        pytest.param(
            "Hips",
            "Chest Chest2 Neck Head",
            "LeftCollar LeftShoulder LeftElbow LeftWrist LeftThumb1 LeftIndex1 LeftIndex2",
            "LeftHip LeftKnee LeftAnkle LeftToe",
            id="BVH",
        ),
        pytest.param(
            "root",
            "spine05 spine01 neck01 head",
            "clavicle.L upperarm01.L lowerarm01.L wrist.L thumb1.L finger2-1.L finger2-2.L",
            "upperleg01.L lowerleg01.L foot.L toe1-1.L",
            id="MakeHuman",
        ),
        pytest.param(
            "hip",
            "abdomenLower chestUpper neckLower head",
            "lCollar lShldrBend lForearmBend lHand lThumb1 lIndex1 lIndex2",
            "lThighBend lShin lFoot lMetatarsals",
            id="Daz",
        ),
    ],
)
def test_the_joints_of_usual_rigs_are_known(root: str, trunk: str, arm: str, leg: str) -> None:
    for names, expected in ((trunk, TRUNK), (arm, ARM), (leg, LEG)):
        joints = [
            name.removeprefix(f"{root}|") for name in names.split("|" if "|" in names else None)
        ]
        roles = roles_of(chain(root, *joints))
        assert tuple(roles[name] for name in joints) == expected
        right = [
            name.replace("Left", "Right").replace("left", "right").replace("_L_", "_R_")
            .replace(".L", ".R").replace(" L ", " R ").replace("_l", "_r")
            for name in joints
        ]  # fmt: skip
        right = [re.sub("^l(?=[A-Z])", "r", re.sub("_L$", "_R", name)) for name in right]
        assert tuple(roles_of(chain(root, *right))[name] for name in right) == expected


def test_the_pieces_of_a_limb_twist_and_its_other_half_is_found_below_them() -> None:
    rigify = roles_of(
        chain("DEF-upper_arm.L", "DEF-upper_arm.L.001", "DEF-forearm.L", "DEF-forearm.L.001")
    )
    assert tuple(rigify.values()) == (Role.UPPER_ARM, Role.TWIST, Role.FOREARM, Role.TWIST)
    unreal = roles_of(chain("thigh_l", "thigh_correctiveRoot_l") + "\n calf_l\n  calf_twist_01_l")
    assert tuple(unreal.values()) == (Role.THIGH, Role.TWIST, Role.SHIN, Role.TWIST)
    arm = roles_of(chain("clavicle_l", "upperarm_l", "lowerarm_l", "lowerarm_twist_01_l"))
    assert tuple(arm.values()) == (Role.SHOULDER, Role.UPPER_ARM, Role.FOREARM, Role.TWIST)
    # If only one half has a role's name, its child may be the other half.
    assert set(roles_of(chain("Arm.L", "Arm.L.001")).values()) == {Role.UPPER_ARM}


def test_pieces_between_a_shoulder_or_a_hip_and_the_next_joint_twist() -> None:
    arm = roles_of(chain("Scapula_L", "Shoulder_L", "ShoulderPart1_L", "Elbow_L", "ElbowPart1_L"))
    assert tuple(arm.values()) == (
        Role.SHOULDER, Role.UPPER_ARM, Role.TWIST, Role.FOREARM, Role.TWIST
    )  # fmt: skip
    leg = roles_of(chain("Root_M", "Hip_L", "HipPart1_L", "Knee_L"))
    assert tuple(leg.values()) == (Role.OTHER, Role.THIGH, Role.TWIST, Role.SHIN)
    # A hip in the middle does not belong to a leg.
    assert roles_of(chain("hip", "knee_l"))["hip"] is Role.OTHER


def test_a_joint_that_repeats_its_parent_does_not_turn() -> None:
    names = [
        "ORG-spine",
        "DEF-spine",
        "ORG-upper_arm.L",
        "DEF-upper_arm.L",
        "DEF-upper_arm.L.001",
        "ORG-forearm.L",
        "DEF-forearm.L",
        "hips",
        "spine_base",
        "spine_01",
    ]
    parents = [-1, 0, 0, 2, 3, 2, 5, 0, 7, 8]
    rest = np.tile(np.eye(4), (len(names), 1, 1))
    rest[:, 1, 3] = [0, 0, 1, 1, 2, 3, 3, 4, 4, 4]
    rig = rigged_tube().rig
    assert rig is not None
    joint_of = np.array([[1, 3, 4, 6, 9]] * 2, dtype=np.int32)
    rig = replace(
        rig, joint_names=tuple(names), parents=np.array(parents), rest=rest,
        joint_of=joint_of, weights=np.full((2, 5), 0.2),
    )  # fmt: skip
    roles = joint_roles(rig)
    assert roles[2:7] == (
        Role.UPPER_ARM, Role.UPPER_ARM, Role.TWIST, Role.FOREARM, Role.FOREARM
    )  # fmt: skip
    still = ~(np.concatenate(joint_limits(rig, roles), axis=1) != 0.0).any(axis=1)
    assert np.flatnonzero(still).tolist() == [1, 3, 6]
    # A joint with its own skin can be turned.
    led = replace(rig, joint_of=np.where(joint_of == 1, 2, joint_of))
    assert (joint_limits(led, joint_roles(led))[1][3] > 0.0).any()


def test_faces_and_palms_are_neither_toes_nor_fingers_nor_unknown() -> None:
    head = roles_of(
        "head\n eyeball_l\n jaw\n DEF-forehead.L\n  DEF-brow.T.L\n DEF-ear.L\nforearm_tail"
    )
    assert list(head.values()) == [Role.HEAD, *[Role.FACE] * 5, Role.OTHER]
    hand = roles_of(chain("hand_l", "index_metacarpal_l", "index_01_l"))
    assert tuple(hand.values()) == (Role.HAND, Role.PALM, Role.FINGER)
    assert roles_of(chain("DEF-hand.L", "DEF-palm.01.L"))["DEF-palm.01.L"] is Role.PALM
    for names in ("Bottom Middle Top", "Armature leg spring controller"):
        assert set(roles_of(chain(*names.split())).values()) == {Role.OTHER}
