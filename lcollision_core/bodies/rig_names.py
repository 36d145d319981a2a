"""What the codes of a rig do, in words: "forward", "twist", "index 1 bend"."""

from __future__ import annotations

import re

import numpy as np

from lcollision_core.bodies.code_names import way_in_words
from lcollision_core.characters import RigPoseSpace
from lcollision_core.meshes.joint_kinds import Role, Side

_WHOLE_BODY = ("move left", "move up", "move forward", "tilt forward", "turn left", "lean right")

_HINGES = {Role.FOREARM, Role.SHIN, Role.FINGER, Role.THUMB, Role.TOE}


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
    words = re.findall(r"[A-Z]?[^\W\dA-Z_]+|[A-Z]+(?![a-z])|\d+", last)
    return [word.lower() for word in words]


def _motion(space: RigPoseSpace, code: int) -> str:
    joint, axis = int(space.joint_of_code[code]), int(space.axis_of_code[code])
    if axis == 1:
        return "twist"
    if space.roles[joint] in _HINGES:
        return "sideways" if axis else "bend"
    left = np.cross(space.up, space.front)
    way = np.cross(space.axes[joint][:, axis], space.axes[joint][:, 1])
    side = {Side.LEFT: 1.0, Side.RIGHT: -1.0}.get(space.sides[joint], 0.0)
    return way_in_words(np.array([way @ space.up, way @ space.front, way @ left]), side)
