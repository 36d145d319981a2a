"""Table of the kinds of joints: names, parts, limits; and the body parts of joints by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from lcollision_core.bundled import bundled_table
from lcollision_core.meshes.topology import FloatArray

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
    comfortable : the same for random poses, see ``resources/joints.toml``
    part : the body part that it moves; None for that of its parent
    part_words : pattern of the names, without blanks, of all joints of the part, even if they are
        of another kind
    is_paired : whether a body has one on each side
    """

    label: str
    words: str
    limits: _Limits
    comfortable: _Limits
    part: str | None = None
    part_words: str = "$^"
    is_paired: bool = True


JOINT_KINDS = {
    Role[name.upper()]: kind
    for name, kind in bundled_table("joints.toml", dict[str, JointKind]).items()
}
"""In the order in which users are offered them: that of ``resources/joints.toml``."""


_WORDS = bundled_table("body_parts.toml", dict[str, Any])
_PREFIXES, _FACE = frozenset(_WORDS["prefixes"]), frozenset(_WORDS["face"])
_SIDES, _ENDS = (
    {word: name for name, words in _WORDS[kind].items() for word in words}
    for kind in ("sides", "ends")
)

_PAIRED = (
    Role.FOOT,
    Role.HAND,
    Role.FOREARM,
    Role.UPPER_ARM,
    Role.SHOULDER,
    Role.THIGH,
    Role.SHIN,
)
"""Roles whose body parts exist on both sides, in the order in which their words are matched."""

_PAIRED_WORDS = {"arm": ("upper arm", "forearm"), "leg": ("shin", "thigh")}
"""Words that mean the first part if the rig also names the second, else the whole limb."""

_MOST_PARTS = 48
"""Most body parts that a list and colours can show; some rigs have hundreds of unknown joints."""

_SINGLE = (
    (JOINT_KINDS[Role.HEAD].part_words, "Head"),
    (JOINT_KINDS[Role.NECK].part_words, "Neck"),
    ("chest|thorax|rib|breast|pectoral|bust", "Chest"),
    (JOINT_KINDS[Role.SPINE].part_words, "Torso"),
    ("pelvis|hips?$|butt(ock)?", "Hips"),
)


def part_names(names: Sequence[str]) -> tuple[str | None, ...]:
    """Return the body part of each joint, such as "Left forearm"; None if the name is unknown.

    Fingers belong to the hand, toes to the foot, the face to the head.

    Parameters
    ----------
    names : names of all joints of a rig, such as of Mixamo, Blender, VRM, Unreal, Biped or Daz
    """
    words = [_words(name) for name in names]
    plain = [_part(*word) for word in words]
    present = set(plain)
    parts = [
        part if part is not None else _limb(*word, present)
        for word, part in zip(words, plain, strict=True)
    ]
    for side in ("Left", "Right"):
        # Rigs that name an arm's joints clavicle, shoulder, elbow, wrist.
        if f"{side} forearm" in parts and f"{side} upper arm" not in parts:
            for joint, (part, (_, own)) in enumerate(zip(parts, words, strict=True)):
                if part == f"{side} shoulder" and "shoulder" in "".join(own):
                    parts[joint] = f"{side} upper arm"
    legs = [_with_end(part, *word) for word, part in zip(words, parts, strict=True)]
    # A single such part is a helper joint, as at the front of a thigh or the back of a foot.
    ended = (leg for leg, part in zip(legs, parts, strict=True) if leg and leg != part)
    pieces = {leg.split(" ", 1)[1] for leg in ended}
    return tuple(legs if len(pieces) > 1 else parts)


def joint_labels(
    names: Sequence[str],
    parents: npt.NDArray[np.int64],
    parts: Sequence[str | None] | None = None,
) -> tuple[str, ...]:
    """Name the body part of each joint.

    A joint with an unknown name belongs to the part of its parent, or, if that is unknown too, to
    one of its own name. If this makes more than `_MOST_PARTS`, as with hundreds of "Bone.017",
    each chain without branches becomes one part. If it makes a single unknown part, as with a
    snake's "seg.01" and "seg.02", joints keep their numbers, at most `_MOST_PARTS` of them.

    Parameters
    ----------
    names, parents : names and parents of J joints, parents before children
    parts : J body parts, None for a joint without one; those of `part_names` by default

    Returns
    -------
    J printable names
    """
    part_of_joint = part_names(names) if parts is None else parts
    labels: list[str] = []
    is_named: list[bool] = []
    for joint, (name, parent) in enumerate(zip(names, parents.tolist(), strict=True)):
        inherits = part_of_joint[joint] is None and parent >= 0 and is_named[parent]
        labels.append(part_of_joint[joint] or (labels[parent] if inherits else _spelled_out(name)))
        is_named.append(part_of_joint[joint] is not None or inherits)
    if len(set(labels)) > _MOST_PARTS:
        n_children = np.bincount(parents[parents >= 0], minlength=len(parents))
        for joint, parent in enumerate(parents.tolist()):
            if not is_named[joint] and parent >= 0 and n_children[parent] == 1:
                labels[joint] = labels[parent]
    if len(set(labels)) == 1 and not any(is_named):
        every = -(-len(names) // _MOST_PARTS)
        labels = [_printable(names[joint // every * every]) for joint in range(len(names))]
    return tuple(labels)


def part_labels(
    labels: Sequence[str], joint_of: npt.NDArray[np.int32], weights: FloatArray
) -> npt.NDArray[np.str_]:
    """Label each vertex with the body part whose joints have the most weight.

    Parameters
    ----------
    labels : J names, see `joint_labels`
    joint_of, weights : (V, I) arrays of a rig

    Returns
    -------
    (V,) array of printable strings
    """
    parts, part_of_joint = np.unique(np.array(labels), return_inverse=True)
    share = np.zeros((len(joint_of), len(parts)))
    rows = np.arange(len(joint_of))
    for column in range(joint_of.shape[1]):
        np.add.at(share, (rows, part_of_joint[joint_of[:, column]]), weights[:, column])
    result: npt.NDArray[np.str_] = parts[share.argmax(axis=1)]
    return result


def _words(name: str) -> tuple[str, tuple[str, ...]]:
    """Return the side, "Left", "Right" or "", and the words of a joint's name in lower case."""
    local = re.split(r"[:|]", name)[-1]
    split = re.sub(r"([a-z])([A-Z])|([A-Z])([A-Z][a-z])", r"\1\3 \2\4", local)
    words = [word.lower() for word in re.findall(r"[^\W\d_]+", split)]
    side = ""
    rest = []
    for word in words:
        if word in _SIDES and not side:
            side = _SIDES[word]
            continue
        long = re.fullmatch(r"(left|right)(\w+)|(\w+?)(left|right)", word)
        if long and not side:
            side = _SIDES[long[1] or long[4]]
            word = long[2] or long[3]
        rest.append(word)
    return side, tuple(word for word in rest if word not in _PREFIXES)


def _part(side: str, words: tuple[str, ...]) -> str | None:
    joined = "".join(words)
    if side and not _FACE.intersection(words):
        for kind in (JOINT_KINDS[role] for role in _PAIRED):
            if re.search(kind.part_words, joined):
                return f"{side} {kind.part}"
        if joined in ("hip", "hipjoint"):
            return f"{side} thigh"
    for pattern, part in _SINGLE:
        if re.search(pattern, joined):
            return part
    return "Head" if _FACE.intersection(words) else None


def _limb(side: str, words: tuple[str, ...], present: set[str | None]) -> str | None:
    """Return the body part of a joint called just "arm" or "leg"."""
    for word, (part, other) in _PAIRED_WORDS.items():
        if side and word in words:
            return f"{side} {part}" if f"{side} {other}" in present else f"{side} {word}"
    return None


def _with_end(part: str | None, side: str, words: tuple[str, ...]) -> str | None:
    """Return "Left front thigh" for a "Left thigh" whose joint's name contains "front"."""
    ends = [
        _ENDS[word]
        for word, after in zip(words, (*words, "")[1:], strict=True)
        if word in _ENDS and (word, after) != ("fore", "arm")
    ]
    paired = part is not None and side and part.startswith(f"{side} ")
    return f"{side} {ends[0]} {part.removeprefix(f'{side} ')}" if part and paired and ends else part


def _spelled_out(name: str) -> str:
    """Return a readable name: "tail_02.L" becomes "Left tail"."""
    side, words = _words(name)
    printable = _printable(" ".join([side, *words]).strip() or name)
    return printable[:1].upper() + printable[1:].lower() if side else printable


def _printable(name: str) -> str:
    text = "".join(filter(str.isprintable, " ".join(name.split())))
    return (text.strip() or "Part").capitalize()
