"""What joints are, by the names that usual programs give them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.characters.joint_roles import Role, joint_roles
from tests.rigged_shapes import rigged_tube

ARM = (Role.SHOULDER, Role.UPPER_ARM, Role.FOREARM, Role.HAND, Role.THUMB, Role.FINGER, Role.FINGER)
LEG = (Role.THIGH, Role.SHIN, Role.FOOT, Role.TOE)
TRUNK = (Role.SPINE, Role.SPINE, Role.NECK, Role.HEAD)


def roles_of(tree: str) -> dict[str, Role]:
    """Tell the roles of names in lines, indented below their parents."""
    lines = tree.splitlines()
    depths = [len(line) - len(line.lstrip()) for line in lines]
    parents = [
        max((above for above in range(joint) if depths[above] < depth), default=-1)
        for joint, depth in enumerate(depths)
    ]
    names = [line.strip() for line in lines]
    rig = rigged_tube().rig
    assert rig is not None
    rig = replace(rig, joint_names=tuple(names), parents=np.array(parents))
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
        assert tuple(roles_of(chain(root, *right))[name] for name in right) == expected


def test_the_pieces_of_a_limb_twist_and_its_other_half_is_found_below_them() -> None:
    rigify = roles_of(
        chain("DEF-upper_arm.L", "DEF-upper_arm.L.001", "DEF-forearm.L", "DEF-forearm.L.001")
    )
    assert tuple(rigify.values()) == (Role.UPPER_ARM, Role.TWIST, Role.FOREARM, Role.TWIST)
    unreal = roles_of(chain("thigh_l", "thigh_correctiveRoot_l") + "\n calf_l\n  calf_twist_01_l")
    assert tuple(unreal.values()) == (Role.THIGH, Role.TWIST, Role.SHIN, Role.TWIST)
    # Where only one half has a name, what hangs on it may be the other half.
    assert set(roles_of(chain("Arm.L", "Arm.L.001")).values()) == {Role.UPPER_ARM}


def test_faces_and_palms_are_neither_toes_nor_fingers_nor_unknown() -> None:
    head = roles_of(
        "head\n eyeball_l\n jaw\n DEF-forehead.L\n  DEF-brow.T.L\n DEF-ear.L\nforearm_tail"
    )
    assert list(head.values()) == [Role.HEAD, *[Role.FACE] * 5, Role.OTHER]
    hand = roles_of(chain("hand_l", "index_metacarpal_l", "index_01_l"))
    assert tuple(hand.values()) == (Role.HAND, Role.PALM, Role.FINGER)
    assert roles_of(chain("DEF-hand.L", "DEF-palm.01.L"))["DEF-palm.01.L"] is Role.PALM
    sausage = roles_of(chain("Bottom", "Middle", "Top"))
    assert set(sausage.values()) == {Role.OTHER}
