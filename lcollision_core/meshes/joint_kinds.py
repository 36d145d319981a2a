"""What is known of each kind of joint, in one table: its names, its body part, how far it turns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import TypeAlias

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


_ANY_WAY: _Limits = ((-75, 75), (-75, 75), (-75, 75))

JOINT_KINDS: dict[Role, JointKind] = {
    Role.SHOULDER: JointKind(
        "collarbone",
        "shoulder|clavicle|collar|scapula|肩",
        ((-30, 30), (-15, 15), (-30, 30)),
        "shoulder",
        "shoulder|clavicle|collar|scapula",
    ),
    Role.UPPER_ARM: JointKind(
        "shoulder",
        "arm(?!atu|or)|shldr|腕",
        ((-100, 140), (-90, 90), (-120, 120)),
        "upper arm",
        "upperarm|uparm|armupper|bicep|humerus|shldr",
    ),
    Role.FOREARM: JointKind(
        "elbow",
        "forearm|lowerarm|lowarm|loarm|armlower|elbow|ひじ|肘",
        ((-5, 150), (-90, 90), (-5, 5)),
        "forearm",
        "forearm|lowerarm|lowarm|armlower|elbow|ulna|forearmbend",
    ),
    Role.HAND: JointKind(
        "wrist",
        "hand|wrist|手首",
        ((-80, 80), (-40, 40), (-40, 40)),
        "hand",
        "thumb|index|middle|(?<!sp)(?<!st)(?<!ear)ring|pink(y|ie)|little|finger|metacarpal|carpal|"
        "palm|hand|wrist",
    ),
    Role.PALM: JointKind("palm", "palm|carpal", ((-20, 20), (0, 0), (-15, 15)), "hand"),
    Role.THUMB: JointKind(
        "thumb", "thumb|^bip[0-9]*[lr]finger0|親指", ((-30, 60), (-20, 20), (-30, 30)), "hand"
    ),
    Role.FINGER: JointKind(
        "finger",
        "finger|index|middle|(?<!sp)(?<!st)ring|pinky|pinkie|little|[人中薬小][指差]",
        ((-20, 95), (0, 0), (-15, 15)),
        "hand",
    ),
    Role.THIGH: JointKind(
        "hip",
        "thigh|upleg|upperleg|legupper|足(?!.*ik)",
        ((-45, 130), (-50, 50), (-70, 70)),
        "thigh",
        "upleg|upperleg|legupper|thigh|femur",
    ),
    Role.SHIN: JointKind(
        "knee",
        "shin|calf|knee|leg|ひざ|膝",
        ((-5, 150), (-20, 20), (-5, 5)),
        "shin",
        "lowerleg|lowleg|leglower|calf|shin|knee|tibia|cannon|(?<!s)hock",
    ),
    Role.FOOT: JointKind(
        "ankle",
        "foot|ankle|paw|hoof|足首",
        ((-50, 50), (-30, 30), (-30, 30)),
        "foot",
        "toe|ball|foot|feet|ankle|(?<!w)heel|tarsal|hallux|paw|hoof|hooves|pastern|fetlock",
    ),
    Role.TOE: JointKind(
        "toes",
        "toe|(?<!eye)ball|metatarsal|つま先|爪先|足先|足指",
        ((-45, 45), (0, 0), (0, 0)),
        "foot",
    ),
    Role.SPINE: JointKind(
        "spine",
        "spine|chest|torso|waist|abdomen|belly|上半身|胸",
        ((-25, 40), (-35, 35), (-30, 30)),
        "torso",
        "spine|torso|abdomen|waist|belly|stomach|lumbar",
        is_paired=False,
    ),
    Role.NECK: JointKind(
        "neck", "neck|首", ((-40, 40), (-50, 50), (-35, 35)), "neck", "neck", is_paired=False
    ),
    Role.HEAD: JointKind(
        "head",
        "(?<!fore)head|skull|頭",
        ((-40, 40), (-60, 60), (-35, 35)),
        "head",
        "head|skull",
        is_paired=False,
    ),
    # What has no such word and belongs to the head.
    Role.FACE: JointKind("face", "$^", _ANY_WAY, "head", is_paired=False),
    Role.TWIST: JointKind(
        "twist",
        "twist|roll(?!er)|(shoulder|elbow|hip|knee)part[0-9]|捩|キャンセル|肩[pc]",
        ((0, 0), (-60, 60), (0, 0)),
        is_paired=False,
    ),
    Role.OTHER: JointKind("unknown", "", _ANY_WAY, is_paired=False),
}
"""In the order in which a user is offered them."""
