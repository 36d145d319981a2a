"""What is known of each kind of joint, by one table: its names, its body part, how far it turns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import TypeAlias

from lcollision_core.bundled import bundled_table

_Limits: TypeAlias = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


class Role(Enum):
    """What a joint is in a body; of several whose words a name has, it is the first."""

    TWIST = auto()
    PALM = auto()
    THUMB = auto()
    FINGER = auto()
    TOE = auto()
    FOOT = auto()
    HAND = auto()
    FOREARM = auto()
    SHOULDER = auto()
    UPPER_ARM = auto()
    THIGH = auto()
    SHIN = auto()
    NECK = auto()
    HEAD = auto()
    SPINE = auto()
    OTHER = auto()
    FACE = auto()


class Side(Enum):
    """On which side of the body a joint is, as the body itself says it."""

    LEFT = "left"
    RIGHT = "right"
    MIDDLE = ""


@dataclass(frozen=True)
class JointKind:
    """One row of the table.

    Attributes
    ----------
    called : what a user says that such a joint is, without its side
    words : a pattern of its names, in small letters and digits: of English ones, and of MMD's
    limits : degrees of bend, twist and sideways turn from the rest pose. They are wider than a
        person's, as rest poses differ, and a hinge hardly bends backwards.
    part : the body part that it moves; None where that is its parent's
    part_words : a pattern of the names, without blanks, of all joints that belong to the part, also
        where they are no such joint
    is_paired : whether a body has one on each side
    """

    called: str
    words: str
    limits: _Limits
    part: str | None = None
    part_words: str = "$^"
    is_paired: bool = True


JOINT_KINDS = {
    Role[name.upper()]: kind
    for name, kind in bundled_table("joints.toml", dict[str, JointKind]).items()
}
"""In the order in which a user is offered them: that of ``resources/joints.toml``."""
