"""Convert motions of SMPL, SMPL-H and SMPL-X to a skeleton's, for other kinds of bodies."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lcollision_core.files.motion.node_motion import NodeMotion
from lcollision_core.files.motion.smpl_motion import SmplMotion
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import NOMINAL_RATE

_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from z-up coordinates, as in AMASS, to those of the body models."""

_WAYS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "pelvis": ("", (0.0, -0.23, 0.03)),
    "spine1": ("pelvis", (0.0, 0.12, -0.04)),
    "spine2": ("spine1", (0.0, 0.14, 0.03)),
    "spine3": ("spine2", (0.0, 0.05, 0.0)),
    "neck": ("spine3", (0.0, 0.21, -0.03)),
    "head": ("neck", (0.0, 0.09, 0.05)),
    "jaw": ("head", (0.0, 0.0, 0.02)),
    "left_eye": ("head", (0.03, 0.06, 0.06)),
    "left_hip": ("pelvis", (0.06, -0.09, -0.01)),
    "left_knee": ("left_hip", (0.04, -0.38, 0.0)),
    "left_ankle": ("left_knee", (-0.01, -0.42, -0.04)),
    "left_foot": ("left_ankle", (0.04, -0.06, 0.12)),
    "left_collar": ("spine3", (0.07, 0.11, -0.02)),
    "left_shoulder": ("left_collar", (0.12, 0.05, -0.02)),
    "left_elbow": ("left_shoulder", (0.26, -0.02, -0.02)),
    "left_wrist": ("left_elbow", (0.26, 0.01, -0.01)),
    "left_hand": ("left_wrist", (0.09, -0.01, -0.02)),
}
"""T pose of a person of average build: each joint's parent and offset from it in metres, for the
left side and the middle; x is left, y up, z front."""

_FINGERS = {"index": 0.02, "middle": 0.0, "pinky": -0.04, "ring": -0.02, "thumb": 0.03}
"""Offset of each finger in front of the middle one, in metres."""


def _ways() -> dict[str, tuple[str, tuple[float, float, float]]]:
    left = dict(_WAYS)
    for finger, aside in _FINGERS.items():
        first = 0.03 if finger == "thumb" else 0.1
        left[f"left_{finger}1"] = "left_wrist", (first, -0.01, aside)
        for number in (2, 3):
            left[f"left_{finger}{number}"] = f"left_{finger}{number - 1}", (0.03, 0.0, 0.0)
    right = {
        name.replace("left", "right"): (parent.replace("left", "right"), (-x, y, z))
        for name, (parent, (x, y, z)) in left.items()
        if name.startswith("left")
    }
    return left | right


def axes_of_smpl(motion: SmplMotion) -> FloatArray:
    """Return the rotation from the motion's coordinates to the body's, in which y is up.

    Up is y or z, whichever the body mainly stands along.
    """
    up = Rotation.from_rotvec(motion.turns[:, motion.names.index("pelvis")]).apply([0.0, 1.0, 0.0])
    _, y, z = up.mean(axis=0)
    return _FROM_Z_UP if z > y else np.eye(3)


def skeleton_of_smpl(motion: SmplMotion) -> NodeMotion:
    """Return a motion as that of a skeleton of average build, y up."""
    ways, numbers = _ways(), {name: number for number, name in enumerate(motion.names)}
    # Order parents first; leave out joints without rotations.
    depth = {"": 0}
    order: list[str] = []
    while len(order) < len(numbers):
        level = [name for name in motion.names if name not in depth and ways[name][0] in depth]
        depth |= dict.fromkeys(level, 1)
        order += level
        if not level:
            break
    index = {name: place for place, name in enumerate(order)}
    parents = np.array([index.get(ways[name][0], -1) for name in order], dtype=np.int64)
    offsets = np.array([ways[name][1] for name in order])
    frame, n_frames = axes_of_smpl(motion), len(motion)
    joint_turns = motion.turns[:, [numbers[name] for name in order]]
    turns = Rotation.from_rotvec(joint_turns.reshape(-1, 3)).as_matrix()
    turns = turns.reshape(n_frames, len(order), 3, 3)
    turns[:, 0] = frame @ turns[:, 0]
    places = np.tile(offsets, (n_frames, 1, 1))
    places[:, 0] = (offsets[0] + motion.places) @ frame.T
    times = np.arange(n_frames) / (motion.rate or NOMINAL_RATE)
    ends, axes = np.full(offsets.shape, np.nan), np.tile(np.eye(3), (len(order), 1, 1))
    note = "read as an SMPL motion and retargeted; its body shape ('betas') is ignored"
    notes = (note, *motion.notes)
    return NodeMotion(
        "", tuple(order), parents, offsets, ends, axes, times, None, turns, places, notes
    )
