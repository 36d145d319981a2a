"""Body part names for joints of rigs from several programs."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.meshes.joint_kinds import joint_labels, part_labels, part_names


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        (  # Mixamo
            "mixamorig:Hips mixamorig:Spine2 mixamorig:LeftShoulder mixamorig:LeftArm "
            "mixamorig:LeftForeArm mixamorig:RightHandThumb4 mixamorig:LeftUpLeg "
            "mixamorig:LeftLeg mixamorig:LeftToeBase mixamorig:HeadTop_End",
            "Hips,Torso,Left shoulder,Left upper arm,Left forearm,Right hand,Left thigh,Left shin,"
            "Left foot,Head",
        ),
        (  # Blender's Rigify
            "spine.001 shoulder.L upper_arm.L forearm.L DEF-forearm.L.001 f_index.01.L palm.01.R "
            "thigh.R shin.R foot.R toe.R heel.02.R",
            "Torso,Left shoulder,Left upper arm,Left forearm,Left forearm,Left hand,Right hand,"
            "Right thigh,Right shin,Right foot,Right foot,Right foot",
        ),
        (  # VRM, as VRoid names them and as the format does
            "J_Bip_C_Hips J_Bip_C_UpperChest J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Index1 "
            "J_Bip_R_UpperLeg J_Bip_R_LowerLeg J_Bip_R_ToeBase J_Adj_L_FaceEye leftLowerLeg",
            "Hips,Chest,Left upper arm,Left forearm,Left hand,Right thigh,Right shin,Right foot,"
            "Head,Left shin",
        ),
        (  # Unreal
            "pelvis spine_01 clavicle_l upperarm_l upperarm_twist_01_l lowerarm_l hand_l thigh_r "
            "calf_r ball_r neck_01",
            "Hips,Torso,Left shoulder,Left upper arm,Left upper arm,Left forearm,Left hand,"
            "Right thigh,Right shin,Right foot,Neck",
        ),
        (  # Daz and Maya
            "lShldrBend lForearmBend rThighBend rShin lCollar abdomenLower L_Hip R_Knee L_Elbow",
            "Left upper arm,Left forearm,Right thigh,Right shin,Left shoulder,Torso,Left thigh,"
            "Right shin,Left forearm",
        ),
    ],
)
def test_joints_of_known_programs(names: str, parts: str) -> None:
    assert part_names(names.split()) == tuple(parts.split(","))


def test_biped_names_have_blanks() -> None:
    names = ("Bip01 L Forearm", "Bip01 R Thigh", "Bip01 R Calf", "Bip01 L Finger0", "Bip01")
    assert part_names(names) == (
        "Left forearm", "Right thigh", "Right shin", "Left hand", None
    )  # fmt: skip


def test_the_legs_of_an_animal_with_four_are_apart() -> None:
    ends = ["thigh.L", "shin.L", "foot.L"]
    names = [*(f"front_{end}" for end in ends), *ends, "spine"]
    assert part_names(names) == (
        "Left front thigh", "Left front shin", "Left front foot",
        "Left thigh", "Left shin", "Left foot", "Torso",
    )  # fmt: skip
    names = ["HindUpLeg_Right", "RearKnee_Right", "Fore_Paw_R", "FrontHoof_L"]
    assert part_names(names) == (
        "Right hind thigh", "Right hind shin", "Right front foot", "Left front foot"
    )  # fmt: skip
    # A forearm is not one of them, nor a helper at the front of a thigh.
    names = ["L Fore Arm", "R Fore Arm", "thigh_front_helper.L", "thigh.L"]
    assert part_names(names) == ("Left forearm", "Right forearm", "Left thigh", "Left thigh")


def test_an_arm_is_the_upper_one_only_where_there_is_a_forearm() -> None:
    assert part_names(["arm.L", "leg.L"]) == ("Left arm", "Left leg")
    assert part_names(["LeftArm", "LeftForeArm", "LeftLeg", "LeftUpLeg"]) == (
        "Left upper arm", "Left forearm", "Left shin", "Left thigh"
    )  # fmt: skip
    # So is a shoulder joint, unless the rig names the upper arm.
    assert part_names(["clavicle_l", "shoulder_l", "elbow_l", "shoulder_r"]) == (
        "Left shoulder", "Left upper arm", "Left forearm", "Right shoulder"
    )  # fmt: skip


def test_short_words_for_the_sides() -> None:
    names = ["lt_elbow", "rt_elbow", "lf_knee", "rf_knee", "wheel_lf"]
    assert part_names(names) == (
        "Left forearm", "Right forearm", "Left shin", "Right shin", None
    )  # fmt: skip


@pytest.mark.parametrize("name", ["spring_L", "string.R", "root", "Bone.003", "tail_02.L", "ik"])
def test_other_names_tell_nothing(name: str) -> None:
    assert part_names([name]) == (None,)


def test_labels_follow_the_largest_weight_of_a_part() -> None:
    names = ("Hips", "Spring", "tail_02.L", "LeftHand", "LeftHandIndex1", "LeftForeArm")
    parents = np.array([-1, 0, -1, -1, 3, -1])
    joint_of = np.array([[0, 1, 2], [2, 0, 1], [3, 4, 5]], dtype=np.int32)
    weights = np.array([[0.3, 0.3, 0.4], [0.6, 0.2, 0.2], [0.3, 0.3, 0.4]])
    # The spring is part of the hips; the shares of a hand and its finger are summed.
    labels = part_labels(joint_labels(names, parents), joint_of, weights)
    assert labels.tolist() == ["Hips", "Left tail", "Left hand"]


def test_labels_are_printable_whatever_the_names() -> None:
    names = ("\n", "", "\x00\u202e", "日本")
    joints = np.arange(4, dtype=np.int32)[:, None]
    labels = part_labels(joint_labels(names, np.full(4, -1)), joints, np.ones((4, 1)))
    assert labels.tolist() == ["Part", "Part", "Part", "日本"]


def test_bones_that_have_numbers_alone_keep_them() -> None:
    names = ["Bone", "Bone.001", "Bone.002", "tail_bone_01", "tail_bone_02"]
    labels = joint_labels(names, np.array([-1, 0, 1, 2, 3]))
    assert labels == ("Bone", "Bone.001", "Bone.002", "Tail", "Tail")


def test_a_body_of_one_name_is_many_parts() -> None:
    parents = np.array([-1, 0, 1])
    assert joint_labels(["seg.01", "seg.02", "seg.03"], parents) == ("Seg.01", "Seg.02", "Seg.03")
    assert joint_labels(["tail_01", "tail_02", "fin"], parents) == ("Tail", "Tail", "Fin")
    assert joint_labels(["LeftHand", "LeftHandIndex1", "x"], parents) == ("Left hand",) * 3


def test_of_hundreds_of_unknown_joints_each_chain_is_one_part() -> None:
    # A trunk with ten chains of six joints.
    names = [f"Bone.{joint:03d}" for joint in range(61)]
    parents = np.array([-1, *(0 if joint % 6 == 0 else joint for joint in range(60))])
    labels = joint_labels(names, parents)
    assert labels[:8] == ("Bone.000", *["Bone.001"] * 6, "Bone.007")
    assert len(set(labels)) == 11
    # A few joints are distinguished individually, like the pieces of a snake.
    assert len(set(joint_labels(names[:13], parents[:13]))) == 13
    assert len(set(joint_labels(names[:40], np.arange(40) - 1))) == 40
    assert joint_labels(names, np.arange(61) - 1)[:4] == (
        "Bone.000", "Bone.000", "Bone.002", "Bone.002"
    )  # fmt: skip


def test_a_heel_at_the_back_of_a_foot_is_no_hind_foot() -> None:
    names = ["UpperLeg.L", "UpperLeg.R", "Foot.L", "Foot.R", "FootBack.L", "FootBack.R"]
    assert part_names(names)[4:] == ("Left foot", "Right foot")
