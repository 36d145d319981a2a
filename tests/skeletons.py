"""Skeletons of people and animals with tubes around their bones and arbitrary names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from lcollision_core.files import Character, Rig
from lcollision_core.meshes import Topology
from tests.rigged_shapes import character_of

FloatArray = npt.NDArray[np.float64]
Joints = Mapping[str, tuple[str, tuple[float, float, float]]]

_N_ROUND, _N_ALONG = 6, 4


def both_sides(joints: Sequence[tuple[str, str, tuple[float, float, float]]]) -> Joints:
    """Return joints of both sides, called L and R, from those of the left."""
    return {
        f"{side} {name}": (f"{side} {parent}" if parent in own else parent, (sign * x, y, z))
        for side, sign in (("L", 1.0), ("R", -1.0))
        for own in [{name for name, _, _ in joints}]
        for name, parent, (x, y, z) in joints
    }


PERSON: Joints = {
    "hips": ("", (0.0, 1.0, 0.0)),
    "spine": ("hips", (0.0, 1.15, 0.0)),
    "chest": ("spine", (0.0, 1.3, 0.0)),
    "neck": ("chest", (0.0, 1.5, 0.0)),
    "head": ("neck", (0.0, 1.6, 0.02)),
    **both_sides(
        [
            ("clavicle", "chest", (0.04, 1.42, 0.0)),
            ("upperarm", "clavicle", (0.18, 1.42, 0.0)),
            ("forearm", "upperarm", (0.45, 1.42, -0.01)),
            ("hand", "forearm", (0.7, 1.42, 0.0)),
            ("thigh", "hips", (0.1, 0.95, 0.0)),
            ("shin", "thigh", (0.1, 0.52, 0.01)),
            ("foot", "shin", (0.1, 0.09, -0.02)),
            ("toe", "foot", (0.1, 0.02, 0.1)),
        ]
    ),
}
"""y is up, and it faces +z."""

HORSE: Joints = {
    "pelvis": ("", (0.0, 1.0, -0.6)),
    "spine": ("pelvis", (0.0, 1.05, -0.2)),
    "chest": ("spine", (0.0, 1.05, 0.3)),
    "neck": ("chest", (0.0, 1.2, 0.5)),
    "head": ("neck", (0.0, 1.6, 0.8)),
    "tail": ("pelvis", (0.0, 1.0, -0.8)),
    **both_sides(
        [
            ("thigh", "pelvis", (0.15, 0.9, -0.6)),
            ("shin", "thigh", (0.15, 0.6, -0.5)),
            ("foot", "shin", (0.15, 0.4, -0.7)),
            ("hoof", "foot", (0.15, 0.08, -0.65)),
            ("upperarm", "chest", (0.15, 0.9, 0.35)),
            ("forearm", "upperarm", (0.15, 0.65, 0.25)),
            ("hand", "forearm", (0.15, 0.35, 0.3)),
            ("fore hoof", "hand", (0.15, 0.08, 0.3)),
        ]
    ),
}

SNAKE: Joints = {
    f"link {number}": (f"link {number - 1}" if number else "", (0.0, 0.05, 0.1 * number))
    for number in range(12)
}


def character_from(
    joints: Joints,
    renamed: Callable[[int, str], str] = lambda _, name: name,
    turn: FloatArray | None = None,
    up: Sequence[float] = (0.0, 1.0, 0.0),
) -> Character:
    """Make a character with a tube from each joint to its first child, or beyond an end joint.

    Parameters
    ----------
    renamed : returns a joint's name from its index and its name here
    turn : (3, 3) rotation of the whole character
    """
    names = list(joints)
    places = np.array([place for _, place in joints.values()])
    parents = np.array([names.index(parent) if parent else -1 for parent, _ in joints.values()])
    points: list[FloatArray] = []
    faces: list[npt.NDArray[np.int64]] = []
    for joint, place in enumerate(places):
        child = next(iter(np.flatnonzero(parents == joint)), -1)
        before = places[parents[joint]] if parents[joint] >= 0 else place - [0.0, 0.1, 0.0]
        end = places[child] if child >= 0 else place + 0.6 * (place - before)
        faces.append(_tube_faces() + sum(map(len, points)))
        points.append(_tube(place, end))
    vertices = np.concatenate(points)
    rest = np.tile(np.eye(4), (len(names), 1, 1))
    rest[:, :3, 3] = places
    moved = np.eye(4)
    moved[:3, :3] = np.eye(3) if turn is None else turn
    vertices = vertices @ moved[:3, :3].T
    joint_of = np.zeros((len(vertices), 3), dtype=np.int32)
    joint_of[:, 0] = np.repeat(np.arange(len(names)), _N_ROUND * _N_ALONG)
    rig = Rig(
        joint_names=tuple(renamed(joint, name) for joint, name in enumerate(names)),
        parents=parents,
        rest=moved @ rest,
        nodes=np.arange(len(names)),
        joint_of=joint_of,
        weights=np.tile([1.0, 0.0, 0.0], (len(vertices), 1)),
        points=np.repeat(vertices[:, None], 3, axis=1),
    )
    topology = Topology(np.concatenate(faces).astype(np.int32), len(vertices))
    return character_of("made", topology, vertices, rig, list(up), 0)


def _tube(start: FloatArray, end: FloatArray) -> FloatArray:
    way = (end - start) / np.linalg.norm(end - start)
    side = np.cross(way, np.eye(3)[np.abs(way).argmin()])
    side /= np.linalg.norm(side)
    angles = 2.0 * np.pi * np.arange(_N_ROUND) / _N_ROUND
    ring = 0.03 * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(way, side))
    along = np.linspace(0.1, 0.9, _N_ALONG)[:, None, None]
    tube: FloatArray = (start + along * (end - start) + ring).reshape(-1, 3)
    return tube


def _tube_faces() -> npt.NDArray[np.int64]:
    return np.array(
        [
            corners
            for row in range(_N_ALONG - 1)
            for at in range(_N_ROUND)
            for a, b in [(row * _N_ROUND + at, row * _N_ROUND + (at + 1) % _N_ROUND)]
            for corners in ((a, b, a + _N_ROUND), (b, b + _N_ROUND, a + _N_ROUND))
        ]
    )
