"""Roles of joints, from the skeleton, the names and the user's choices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.anatomy import anatomy_of, front_by_sides
from lcollision_core.bodies.rig_poses import HumanDraws, random_codes
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.files import Character, read_character
from lcollision_core.meshes.joint_kinds import Role, Side
from tests.skeletons import HORSE, PERSON, SNAKE, both_sides, character_from

FloatArray = npt.NDArray[np.float64]

CASES = Path(__file__).parents[4] / "shared" / "cases"

GERMAN = {
    "hips": "Becken",
    "spine": "Wirbelsäule",
    "chest": "Brustkorb",
    "neck": "Hals",
    "head": "Kopf",
    "clavicle": "Schlüsselbein",
    "upperarm": "Oberarm",
    "forearm": "Unterarm",
    "hand": "Hand",
    "thigh": "Oberschenkel",
    "shin": "Unterschenkel",
    "foot": "Fuß",
    "toe": "Zehen",
}
MMD = {
    "hips": "下半身",
    "spine": "上半身",
    "chest": "上半身2",
    "neck": "首",
    "head": "頭",
    "clavicle": "肩",
    "upperarm": "腕",
    "forearm": "ひじ",
    "hand": "手首",
    "thigh": "足",
    "shin": "ひざ",
    "foot": "足首",
    "toe": "つま先",
}
RIGIFY = {
    "hips": "DEF-spine",
    "spine": "DEF-spine.001",
    "chest": "DEF-spine.003",
    "neck": "DEF-spine.004",
    "head": "DEF-spine.006",
}
_SHUFFLED = np.random.default_rng(3).permutation(list(PERSON)).tolist()


def translated(words: dict[str, str], name: str, left: str, right: str) -> str:
    side, _, part = name.rpartition(" ")
    return {"L": left, "R": right, "": ""}[side] + words[part]


NAMINGS = {
    "numbers": lambda joint, _: f"Bone.{joint:03d}",
    "nodes without names": lambda joint, _: f"node {joint}",
    "German": lambda _, name: translated(GERMAN, name, "li_", "re_"),
    "MMD": lambda _, name: translated(MMD, name, "左", "右"),
    "Rigify": lambda _, name: RIGIFY.get(name, f"DEF-{name[2:]}.{name[0]}"),
    "shuffled": lambda joint, _: _SHUFFLED[joint],
    "legs and arms exchanged": lambda _, name: (
        name.replace("thigh", "x").replace("upperarm", "thigh").replace("x", "upperarm")
    ),
}


def bends(space: RigPoseSpace, upper: str, lower: str, end: str) -> FloatArray:
    """Return how far an end moves forward, up and left, in bone lengths, when its hinge turns.

    The upper bone is where it is at rest; those of 80 random poses that bend by 3 degrees or more.
    """
    names = list(PERSON)
    rest, moved = space.rig.rest, []
    body = np.stack([space.front, space.up, np.cross(space.up, space.front)])
    for side in "LR":
        hip, knee, ankle = (names.index(f"{side} {name}") for name in (upper, lower, end))
        before = rest[ankle, :3, 3] - rest[knee, :3, 3]
        for codes in random_codes(space, 80, np.random.default_rng(0)):
            turns = space.transforms(codes)[:, :3, :3] @ np.linalg.inv(rest[:, :3, :3])
            after = turns[hip].T @ turns[knee] @ before
            moved.append(body @ (after - before) / np.linalg.norm(before))
    return np.array([way for way in moved if np.linalg.norm(way) > 0.05])


@pytest.mark.parametrize("renamed", NAMINGS.values(), ids=NAMINGS)
def test_a_person_has_its_limits_under_any_names(renamed) -> None:  # type: ignore[no-untyped-def]
    english = RigPoseSpace(character_from(PERSON))
    space = RigPoseSpace(character_from(PERSON, renamed))
    assert space.roles == english.roles
    assert space.sides == english.sides
    assert space.anatomy.notes == ()
    labels = dict(zip(PERSON, space.anatomy.labels, strict=True))
    assert [labels[name] for name in ("spine", "neck", "head")] == ["Torso", "Neck", "Head"]
    np.testing.assert_allclose(HumanDraws(space).limits, HumanDraws(english).limits, atol=1e-9)
    np.testing.assert_allclose(space.axes, english.axes, atol=1e-9)
    knees = bends(space, "thigh", "shin", "foot")
    assert len(knees) > 60
    assert (knees[:, 0] < 0.0).all()
    assert np.abs(knees[:, 2]).max() < 0.1
    elbows = bends(space, "upperarm", "forearm", "hand")
    assert len(elbows) > 60
    assert (elbows[:, 0] > 0.0).all()


@pytest.mark.parametrize(
    ("turn", "up"),
    [
        pytest.param(Rotation.from_euler("x", 90, degrees=True), (0.0, 0.0, 1.0), id="z up"),
        pytest.param(Rotation.from_euler("y", 90, degrees=True), (0.0, 1.0, 0.0), id="facing x"),
        pytest.param(Rotation.from_euler("y", 215, degrees=True), (0.0, 1.0, 0.0), id="askew"),
        pytest.param(Rotation.from_euler("z", 90, degrees=True), (-1.0, 0.0, 0.0), id="-x up"),
    ],
)
def test_it_does_not_matter_how_a_body_stands(turn: Rotation, up: tuple[float, ...]) -> None:
    matrix = turn.as_matrix()
    space = RigPoseSpace(character_from(PERSON, NAMINGS["numbers"], matrix, up))
    np.testing.assert_allclose(space.front, matrix @ [0.0, 0.0, 1.0], atol=1e-9)
    assert space.roles == RigPoseSpace(character_from(PERSON)).roles
    assert (bends(space, "thigh", "shin", "foot")[:, 0] < 0.0).all()


def test_knees_that_lie_behind_at_rest_still_bend_backwards() -> None:
    place = {side: (sign * 0.1, 0.52, -0.04) for side, sign in (("L", 1.0), ("R", -1.0))}
    joints = {**PERSON, **{f"{side} shin": (f"{side} thigh", place[side]) for side in place}}
    knees = bends(RigPoseSpace(character_from(joints)), "thigh", "shin", "foot")
    assert (knees[:, 0] < 0.05).all()
    assert knees[:, 0].min() < -0.5


def test_twists_ends_and_targets_do_not_hide_a_limb() -> None:
    joints = dict(PERSON)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        joints[f"{side} a"] = (f"{side} thigh", (0.1 * sign, 0.7, 0.0))
        joints[f"{side} b"] = (f"{side} forearm", (0.6 * sign, 1.42, 0.0))
        joints[f"{side} end"] = (f"{side} toe", (0.1 * sign, 0.01, 0.15))
    joints["sword"] = ("R hand", (-0.75, 1.42, 0.9))
    joints = {"root": ("", (0.0, 0.0, 0.0)), **joints, "hips": ("root", (0.0, 1.0, 0.0))}
    space = RigPoseSpace(character_from(joints, NAMINGS["numbers"]))
    roles = dict(zip(joints, space.roles, strict=True))
    english = RigPoseSpace(character_from(PERSON))
    assert [roles[name] for name in PERSON] == list(english.roles)
    assert {roles["L a"], roles["R b"]} == {Role.TWIST}
    assert (roles["L end"], roles["sword"]) == (Role.TOE, Role.OTHER)


@pytest.mark.parametrize("renamed", [lambda _, name: name, NAMINGS["numbers"]])
def test_an_animal_has_no_knees_of_a_person(renamed) -> None:  # type: ignore[no-untyped-def]
    space = RigPoseSpace(character_from(HORSE, renamed))
    (note,) = space.anatomy.notes
    assert "four legs" in note
    legs = [joint for joint, name in enumerate(HORSE) if name[0] in "LR"]
    assert np.abs(HumanDraws(space).limits[legs]).max() < np.radians(31.0)
    np.testing.assert_allclose(space.front, [0.0, 0.0, 1.0], atol=0.1)


def test_the_bent_hind_legs_of_a_rat_are_no_arms() -> None:
    """They are aside of a trunk from which the forelegs hang."""
    rat = {
        "body": ("", (0.0, 0.9, 0.0)),
        "shoulders": ("body", (0.0, 1.3, 0.4)),
        "neck": ("shoulders", (0.0, 1.3, 0.8)),
        "head": ("neck", (0.0, 1.4, 1.3)),
        **both_sides(
            [
                ("FrontLeg", "body", (0.15, 1.1, 0.5)),
                ("FrontUpLeg", "FrontLeg", (0.45, 1.1, 0.5)),
                ("FrontLowLeg", "FrontUpLeg", (0.45, 0.3, 0.8)),
                ("FrontFoot", "FrontLowLeg", (0.45, 0.05, 1.2)),
                ("BackLeg", "body", (0.2, 1.2, -0.7)),
                ("BackUpLeg", "BackLeg", (0.55, 1.2, -0.7)),
                ("BackLowLeg", "BackUpLeg", (0.55, 0.95, -1.3)),
                ("BackFoot", "BackLowLeg", (0.55, 0.05, -1.4)),
            ]
        ),
    }
    anatomy = anatomy_of(character_from(rat))
    assert not {Role.FOREARM, Role.HAND, Role.SHIN}.intersection(anatomy.roles)
    assert "four legs" in anatomy.notes[0]
    np.testing.assert_allclose(anatomy.front, [0.0, 0.0, 1.0], atol=0.1)


def test_what_is_not_known_is_said_and_turns_little() -> None:
    space = RigPoseSpace(character_from(SNAKE))
    (note,) = space.anatomy.notes
    assert "not recognised" in note
    assert np.abs(HumanDraws(space).limits).max() < np.radians(31.0)


def test_what_the_user_says_counts() -> None:
    character = character_from(SNAKE, NAMINGS["numbers"])
    assert character.rig is not None
    chosen = {"Bone.003": "hip-left", "Bone.004": "knee-left"}
    said = replace(character, rig=replace(character.rig, chosen=chosen))
    space = RigPoseSpace(said)
    assert space.roles[3:5] == (Role.THIGH, Role.SHIN)
    assert [space.sides[joint].value for joint in (3, 4)] == ["left", "left"]
    assert space.part_names[space.part_of_joint[4]] == "Left shin"
    # A joint with a person's name that is not a person's.
    person = character_from(PERSON)
    assert person.rig is not None
    person = replace(person, rig=replace(person.rig, chosen={"L shin": "unknown"}))
    assert RigPoseSpace(person).roles[list(PERSON).index("L shin")] is Role.OTHER


@pytest.mark.skipif(not CASES.is_dir(), reason="needs the shared cases")
def test_one_body_with_two_namings_has_the_same_limits() -> None:
    spaces = [RigPoseSpace(_read(name)) for name in ("english", "mmd")]
    assert spaces[0].roles == spaces[1].roles
    limits = [HumanDraws(space).limits for space in spaces]
    np.testing.assert_array_equal(limits[0], limits[1])


def _read(name: str) -> Character:
    return read_character(CASES / f"{name}.glb")


def test_limbs_without_a_common_root_and_long_chains_are_read() -> None:
    apart = {
        name: ("" if parent in ("hips", "chest") and name[:2] in ("L ", "R ") else parent, place)
        for name, (parent, place) in PERSON.items()
    }
    space = RigPoseSpace(character_from(apart, NAMINGS["numbers"]))
    roles = dict(zip(PERSON, space.roles, strict=True))
    assert [roles[f"L {name}"] for name in ("thigh", "shin", "forearm")] == [
        Role.THIGH, Role.SHIN, Role.FOREARM
    ]  # fmt: skip
    worm = {
        f"{number}": (f"{number - 1}" if number else "", (0.0, 0.0, 0.01 * number))
        for number in range(1100)
    }
    assert set(anatomy_of(character_from(worm)).roles) == {Role.OTHER}


def test_many_strands_of_hair_are_no_limbs() -> None:
    joints = dict(PERSON)
    for strand in range(40):
        angle = 2.0 * np.pi * (strand + 0.5) / 40
        for number in range(3):
            place = (0.1 * np.sin(angle), 1.6 - 0.25 * number, 0.1 * np.cos(angle))
            parent = f"hair {strand} {number - 1}" if number else "head"
            joints[f"hair {strand} {number}"] = parent, place
    roles = RigPoseSpace(character_from(joints, NAMINGS["numbers"])).roles
    assert roles[: len(PERSON)] == RigPoseSpace(character_from(PERSON)).roles


def test_what_is_above_a_thigh_is_no_shin() -> None:
    """Animal rigs may call the haunch a leg, and its bones upper and lower leg."""
    names = {
        "pelvis": "Back",
        **{
            f"{side} {ours}": f"{theirs}.{side}"
            for side in ("L", "R")
            for ours, theirs in (
                ("thigh", "BackLeg"),
                ("shin", "BackUpperLeg"),
                ("foot", "BackLowerLeg"),
                ("hoof", "BackFoot"),
                ("upperarm", "FrontLeg"),
                ("forearm", "FrontUpperLeg"),
                ("hand", "FrontLowerLeg"),
                ("fore hoof", "FrontFoot"),
            )
        },
    }
    horse = character_from(HORSE, lambda _, name: names.get(name, name))
    labels = dict(zip(horse.rig.joint_names, anatomy_of(horse).labels, strict=True))
    assert labels["BackLeg.L"] == "Left haunch"
    assert labels["FrontLeg.R"] == "Right shoulder"
    assert labels["BackUpperLeg.L"] == "Left hind thigh"
    assert labels["FrontLowerLeg.R"] == "Right front shin"


def test_eyebrows_and_a_ball_of_hair_are_of_one_head() -> None:
    x, y, z = PERSON["head"][1]
    more = {
        "brow1.l": ("head", (x + 0.04, y, z + 0.1)),
        "brow1.r": ("head", (x - 0.04, y, z + 0.1)),
        "HairBall_L": ("head", (x + 0.1, y, z - 0.1)),
        "HairBall_L_End": ("HairBall_L", (x + 0.2, y, z - 0.1)),
    }
    anatomy = anatomy_of(character_from({**PERSON, **more}))
    assert set(anatomy.labels[-4:]) == {"Head"}
    assert set(anatomy.roles[-4:]) == {Role.FACE}


def test_ears_above_short_legs_are_no_legs() -> None:
    """Ears of a toy are as long as legs, and its body seems to hang from them."""
    toy = dict(PERSON)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        for name, parent, (x, y, z) in (
            ("shin", "thigh", (0.1, 0.8, 0.01)),
            ("foot", "shin", (0.1, 0.65, -0.01)),
            ("toe", "foot", (0.1, 0.62, 0.03)),
            ("ear1", "head", (0.1, 1.75, 0.0)),
            ("ear2", "ear1", (0.12, 2.1, 0.0)),
            ("ear3", "ear2", (0.14, 2.5, -0.1)),
        ):
            toy[f"{side} {name}"] = (
                parent if parent == "head" else f"{side} {parent}",
                ((sign * x, y, z)),
            )
    anatomy = anatomy_of(character_from(toy))
    roles = dict(zip(toy, anatomy.roles, strict=True))
    assert {roles[f"{side} ear{number}"] for side in "LR" for number in (1, 2, 3)} == {Role.FACE}
    assert roles["L thigh"] is Role.THIGH
    assert anatomy.front @ [0.0, 0.0, 1.0] > 0.99


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_body_without_a_trunk_faces_where_its_names_of_sides_say(degrees: int) -> None:
    walker = {
        name: ("" if name == "hips" else parent, place)
        for name, (parent, place) in PERSON.items()
        if name == "hips" or name[2:] in ("thigh", "shin", "foot")
    }
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    anatomy = anatomy_of(character_from(walker, turn=turn))
    assert anatomy.front @ turn[:, 2] > 0.99
    assert {anatomy.labels[list(walker).index("L thigh")]} == {"Left thigh"}


def test_a_fighter_who_leans_at_rest_has_two_sides() -> None:
    """Its legs and feet point to a side, and its trunk is in front of its limbs."""
    trunk = ("hips", "spine", "chest", "neck", "head")
    fighter = {
        name: (parent, (x, y, z + 0.2 * (name in trunk)))
        for name, (parent, (x, y, z)) in PERSON.items()
    }
    for side, sign in (("L", 1.0), ("R", -1.0)):
        for name, parent, height, z in (
            ("thigh", "hips", 0.95, 0.0),
            ("shin", f"{side} thigh", 0.52, 0.01),
            ("foot", f"{side} shin", 0.09, -0.02),
        ):
            x, _, z = Rotation.from_euler("y", 15, True).apply([sign * 0.1, 0.0, z])
            fighter[f"{side} {name}"] = parent, (x, height, z)
        fighter[f"{side} toe"] = f"{side} foot", (sign * 0.1 + 0.06, 0.02, 0.084)
    anatomy = anatomy_of(character_from(fighter))
    sides = dict(zip(fighter, anatomy.sides, strict=True))
    assert {sides[f"L {name}"] for name in ("thigh", "foot", "upperarm", "hand")} == {Side.LEFT}
    assert {sides[f"R {name}"] for name in ("thigh", "foot", "upperarm", "hand")} == {Side.RIGHT}
    assert {sides[name] for name in trunk[:-1]} == {Side.MIDDLE}


def test_a_front_that_agrees_with_the_names_of_sides_stays_to_the_bit() -> None:
    """Poses of an earlier version belong to a rig of the same axes."""
    places = np.array([[1.0, 0.0, 0.001], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    up, front = np.eye(3)[1], np.eye(3)[2]
    assert front_by_sides([1, -1, 0], places, up, front) is front
    assert front_by_sides([1, -1, 0], places, up, -front) @ front > 0.99
    assert front_by_sides([1, 0, 0], places, up, front) is front
