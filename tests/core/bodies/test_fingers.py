# ruff: noqa: RUF001 - names of MMD are used as they are
"""Fingers of various programs' skeletons, segment by segment."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies.partners import FINGERS, finger_joints
from lcollision_core.meshes.joint_kinds import Role, Side

_MMD = {"thumb": "親指", "index": "人指", "middle": "中指", "ring": "薬指", "little": "小指"}
_VRM = ("Proximal", "Intermediate", "Distal")


def _unreal(finger: str) -> list[str]:
    name = {"little": "pinky"}.get(finger, finger)
    palm = [] if finger == "thumb" else [f"{name}_metacarpal_l"]
    return [*palm, *(f"{name}_0{number}_l" for number in (1, 2, 3))]


def _vrm(finger: str) -> list[str]:
    places = ("Metacarpal", "Proximal", "Distal") if finger == "thumb" else _VRM
    return [f"left{finger.capitalize()}{place}" for place in places]


def _mixamo(finger: str) -> list[str]:
    name = {"little": "Pinky"}.get(finger, finger.capitalize())
    return [f"mixamorig:LeftHand{name}{number}" for number in (1, 2, 3, 4)]


def _soma(finger: str) -> list[str]:
    name = {"little": "Pinky"}.get(finger, finger.capitalize())
    numbers = (1, 2, 3) if finger == "thumb" else (1, 2, 3, 4)
    return [*(f"LeftHand{name}{number}" for number in numbers), f"LeftHand{name}End"]


def _rigify(finger: str) -> list[str]:
    name = {"thumb": "thumb", "little": "f_pinky"}.get(finger, f"f_{finger}")
    return [f"DEF-{name}.0{number}.L" for number in (1, 2, 3)]


def _smplx(finger: str) -> list[str]:
    name = {"little": "pinky"}.get(finger, finger)
    return [f"left_{name}{number}" for number in (1, 2, 3)]


def _mmd(finger: str) -> list[str]:
    digits = "０１２" if finger == "thumb" else "１２３"
    return [f"左{_MMD[finger]}{digit}" for digit in digits] + [f"左{_MMD[finger]}先"]


@pytest.mark.parametrize("program", [_mixamo, _vrm, _rigify, _unreal, _mmd, _smplx, _soma])
def test_each_programs_fingers_are_told_by_segment(program: object) -> None:
    assert callable(program)
    names, parents, expected = ["hand"], [-1], {}
    for finger in FINGERS:
        chain = program(finger)
        parents += [0, *range(len(names), len(names) + len(chain) - 1)]
        n_palm = int(finger != "thumb" and program in (_unreal, _soma))
        numbered = enumerate(chain, 1 - n_palm)
        expected |= {(Side.LEFT, finger, n): len(names) + n + n_palm - 1 for n, _ in numbered}
        names += chain
    roles = [Role.HAND, *[Role.FINGER] * (len(names) - 1)]
    found = finger_joints(names, np.array(parents), roles, [Side.LEFT] * len(names))
    assert found == expected


def test_what_hangs_on_no_hand_is_no_finger() -> None:
    roles, sides = [Role.SPINE, Role.OTHER], [Side.MIDDLE] * 2
    assert not finger_joints(["spine", "spring_ring"], np.array([-1, 0]), roles, sides)
