"""Table of the kinds of joints: their names, body parts and rotation limits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import TypeAlias

from lcollision_core.bundled import bundled_table

_Limits: TypeAlias = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


class Role(Enum):
    """Role of a joint in a body; if a name matches the words of several, the first applies."""

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
    """Side of a joint, from the body's own point of view."""

    LEFT = "left"
    RIGHT = "right"
    MIDDLE = ""


@dataclass(frozen=True)
class JointKind:
    """One row of the table.

    Attributes
    ----------
    label : name of such a joint for users, without its side
    words : pattern of its names, English ones and those of MMD, in lower case letters and digits
    limits : degrees of bend, twist and sideways turn from the rest pose. They are wider than a
        person's, as rest poses differ; a hinge hardly bends backwards.
    part : the body part that it moves; None for that of its parent
    part_words : pattern of the names, without blanks, of all joints of the part, even if they are
        of another kind
    is_paired : whether a body has one on each side
    """

    label: str
    words: str
    limits: _Limits
    part: str | None = None
    part_words: str = "$^"
    is_paired: bool = True


JOINT_KINDS = {
    Role[name.upper()]: kind
    for name, kind in bundled_table("joints.toml", dict[str, JointKind]).items()
}
"""In the order in which users are offered them: that of ``resources/joints.toml``."""
