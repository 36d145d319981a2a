"""What the codes of a rig do, in words: "forward", "twist", "index 1 bend"."""

from __future__ import annotations

import re

import numpy as np

from lcollision_core.characters import RigPoseSpace
from lcollision_core.characters.joint_roles import Role
from lcollision_core.model.code_names import way_in_words

_WHOLE_BODY = ("move left", "move up", "move forward", "tilt forward", "turn left", "lean right")

_HINGES = {Role.FOREARM, Role.SHIN, Role.FINGER, Role.THUMB, Role.TOE}

_MIDDLE = 0.02
"""Normalised: joints this near to the middle plane are on neither side."""


def motion_names(space: RigPoseSpace) -> list[str]:
    """Name the motion that raising each code makes: D names.

    Hinges bend. Of other joints the far end goes up, down, forward, back, or, away from the middle
    of the body, out and in. Where a body part has several joints their names come first, without
    what the part's own name says.
    """
    names, words = list(_WHOLE_BODY), [_words(name) for name in space.rig.joint_names]
    ends = np.cumsum(space.group_sizes)
    for part, start, end in zip(space.part_names, ends[:-1], ends[1:], strict=True):
        joints = space.joint_of_code[start:end]
        several = len(np.unique(joints)) > 1
        for code, joint in enumerate(joints.tolist(), start):
            motion = _motion(space, code)
            if several:
                own = [word for word in words[joint] if word not in _words(part)]
                if own and not any(map(str.isalpha, own)):
                    own.insert(0, "joint")
                motion = " ".join((*own, motion))
            names.append(motion)
    return names


def _words(name: str) -> list[str]:
    """Return a joint's name in words, without its prefix: "left", "hand", "index", "1"."""
    last = re.split("[:|]", name)[-1]
    return [
        word.lower()
        for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+|[^\W\da-zA-Z_]+", last)
    ]


def _motion(space: RigPoseSpace, code: int) -> str:
    joint, axis = int(space.joint_of_code[code]), int(space.axis_of_code[code])
    if axis == 1:
        return "twist"
    if space.roles[joint] in _HINGES:
        return "sideways" if axis else "bend"
    left = np.cross(space.up, space.front)
    way = np.cross(space.axes[joint][:, axis], space.axes[joint][:, 1])
    place = float(left @ (space.origins[joint] - space.origins.mean(axis=0)))
    side = {"left": 1.0, "right": -1.0}.get(side_of(place), 0.0)
    return way_in_words(np.array([way @ space.up, way @ space.front, way @ left]), side)


def side_of(place: float) -> str:
    """Name the side of the body, "" in the middle, by the normalised way to its left."""
    return ("left" if place > 0.0 else "right") if abs(place) > _MIDDLE else ""
