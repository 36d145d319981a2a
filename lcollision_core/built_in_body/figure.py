"""A figure: a pose described in human terms and converted to joint angles."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lcollision_core.built_in_body.skeleton import (
    BONES,
    MIRROR,
    TRUNK_ANGLES,
    Skeleton,
    turn_x,
    turn_y,
    turn_z,
)
from lcollision_core.meshes.topology import FloatArray

STRAIGHT = 0.998
"""Fraction of its full length to which a standing leg stretches: a knee bend of seven degrees."""


_ARM_ANGLES = ("arm raise", "arm plane", "arm turn", "elbow", "pronation", "wrist bend", "shrug")
_LEG_ANGLES = ("hip flexion", "hip spread", "hip turn", "knee", "ankle", "toes")
"""Names of the joint angles in the fields of `Arm` and `Leg`, in order."""


@dataclass(frozen=True)
class Arm:
    """Joint angles of one arm, in degrees.

    Attributes
    ----------
    lift : from hanging (0) to straight up (180); negative swings to the other side
    plane : plane of the lift: 0 sideways, 90 forward, more across the chest, less behind
    turn : twist about its own axis, inward positive; at 0, a hanging arm bends its elbow forward
    elbow : 0 is straight
    pronation : at 0, the thumb of a hanging arm points forward; positive turns the palm back
    wrist : bend, towards the palm positive
    shrug : lift of the shoulder in addition to what follows from `lift`
    """

    lift: float
    plane: float = 20.0
    turn: float = 0.0
    elbow: float = 15.0
    pronation: float = 20.0
    wrist: float = 5.0
    shrug: float = 0.0


@dataclass(frozen=True)
class Leg:
    """Joint angles of one leg, in degrees: flexion and spread of the hip, then downwards."""

    flexion: float
    spread: float = 5.0
    turn: float = 5.0
    knee: float = 5.0
    ankle: float = 0.0
    toes: float = 0.0


@dataclass(frozen=True)
class Foot:
    """The placement of a standing foot, from which the leg's joint angles follow.

    Attributes
    ----------
    out : distance of its ankle from the midline, to its own side, metres
    ahead : distance of its ankle in front of the pelvis at rest, metres
    heading : direction of its toes, outward positive, degrees
    heel : lift of the heel about the ball of the foot, degrees
    height : height of the sole above the floor, metres
    """

    out: float = 0.12
    ahead: float = 0.0
    heading: float = 8.0
    heel: float = 0.0
    height: float = 0.0


@dataclass(frozen=True)
class Figure:
    """One authored pose.

    Attributes
    ----------
    left_arm, right_arm : `Arm`
    left_leg, right_leg : `Leg` for a free leg, `Foot` for a standing one
    spine, neck : forward bend, lean to the left, turn to the left, degrees
    drop, shift, ahead : shift of the pelvis, metres: down from where the legs are straight, to the
        left, forward
    lean, roll, turn : rotation of the pelvis, degrees: forward, to the left, about the vertical to
        the left
    rise : height of the pelvis above its rest position, metres; overrides `drop`
    """

    left_arm: Arm = Arm(14)
    right_arm: Arm = Arm(14)
    left_leg: Leg | Foot = Foot()
    right_leg: Leg | Foot = Foot()
    spine: tuple[float, ...] = (0.0, 0.0, 0.0)
    neck: tuple[float, ...] = (0.0, 0.0, 0.0)
    drop: float = 0.0
    shift: float = 0.0
    ahead: float = 0.0
    lean: float = 0.0
    roll: float = 0.0
    turn: float = 0.0
    rise: float | None = None

    def pelvis(self, skeleton: Skeleton) -> tuple[FloatArray, FloatArray]:
        """Return the orientation (3, 3) and location (3,) of the pelvis."""
        orientation = turn_z(self.turn) @ turn_x(self.lean) @ turn_y(self.roll)
        location = skeleton.positions[0] + [self.shift, -self.ahead, 0.0]
        if self.rise is not None:
            location[2] += self.rise
            return orientation, location
        heights = [
            _straight_height(skeleton, orientation, location, leg, side)
            for side, leg in (("left", self.left_leg), ("right", self.right_leg))
            if isinstance(leg, Foot)
        ]
        location[2] = min(heights, default=location[2]) - self.drop
        return orientation, location

    def angles(self, skeleton: Skeleton) -> dict[str, float]:
        """Return the joint angles by name, in degrees."""
        angles = dict(zip(TRUNK_ANGLES, (*self.spine, *self.neck), strict=True))
        for side, arm, leg in (
            ("left", self.left_arm, self.left_leg),
            ("right", self.right_arm, self.right_leg),
        ):
            limb_angles = dict(zip(_ARM_ANGLES, astuple(arm), strict=True))
            if isinstance(leg, Foot):
                limb_angles |= _leg_angles(skeleton, *self.pelvis(skeleton), leg, side)
            else:
                limb_angles |= zip(_LEG_ANGLES, astuple(leg), strict=True)
            angles |= {f"{side} {name}": value for name, value in limb_angles.items()}
        return angles


def straight_rise(figure: Figure, skeleton: Skeleton) -> float:
    """Return the pelvis height above rest when `figure` stands on straight legs, metres."""
    _, location = figure.pelvis(skeleton)
    return float(location[2] + figure.drop - skeleton.positions[0][2])


def _straight_height(
    skeleton: Skeleton, orientation: FloatArray, location: FloatArray, foot: Foot, side: str
) -> float:
    """Return the height of the pelvis at which the leg to `foot` is almost straight."""
    hip, ankle, length = _standing_leg(skeleton, orientation, location, foot, side)
    level = np.hypot(*(hip - ankle)[:2])
    rise = np.sqrt(max((STRAIGHT * length) ** 2 - level**2, (0.3 * length) ** 2))
    return float(location[2] + ankle[2] + rise - hip[2])


def _standing_leg(
    skeleton: Skeleton, orientation: FloatArray, location: FloatArray, foot: Foot, side: str
) -> tuple[FloatArray, FloatArray, float]:
    """Return hip (3,) and ankle (3,), mirrored for the right leg, and the leg's length."""
    reflect = np.eye(3) if side == "left" else MIRROR
    hip, knee, ankle, ball = _leg_joints(skeleton)
    length = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
    position = np.array([foot.out, -foot.ahead, ankle[2] + foot.height])
    heading = turn_z(foot.heading)
    sole = heading @ turn_x(foot.heel)
    target = position + heading @ (ball - ankle) + sole @ (ankle - ball)
    offset = reflect @ orientation @ reflect @ (hip - skeleton.positions[0])
    return reflect @ location + offset, target, length


def _leg_joints(skeleton: Skeleton) -> list[FloatArray]:
    names = ("thigh", "shin", "foot", "toes")
    return [skeleton.positions[BONES.index(f"left {name}")] for name in names]


def _leg_angles(
    skeleton: Skeleton, orientation: FloatArray, location: FloatArray, foot: Foot, side: str
) -> dict[str, float]:
    """Return the joint angles of a leg that stands at `foot`: law of cosines, knee over toes."""
    reflect = np.eye(3) if side == "left" else MIRROR
    orientation = reflect @ orientation @ reflect
    hip, knee, ankle, _ = _leg_joints(skeleton)
    thigh = float(np.linalg.norm(knee - hip))
    shin = float(np.linalg.norm(ankle - knee))
    sole = turn_z(foot.heading) @ turn_x(foot.heel)
    start, target, _ = _standing_leg(
        skeleton, reflect @ orientation @ reflect, location, foot, side
    )
    to_foot = orientation.T @ (target - start)
    distance = min(float(np.linalg.norm(to_foot)), 0.9995 * (thigh + shin))
    cosine = (thigh**2 + shin**2 - distance**2) / (2 * thigh * shin)
    bend = np.pi - np.arccos(np.clip(cosine, -1.0, 1.0))
    local = np.array([0.0, shin * np.sin(bend), -thigh - shin * np.cos(bend)])
    heading = orientation.T @ turn_z(foot.heading) @ [0.0, -1.0, 0.0]
    swing = _frame(to_foot, heading) @ _frame(local, np.array([0.0, -1.0, 0.0])).T
    flexion, spread, turn = Rotation.from_matrix(swing).as_euler("XYZ", degrees=True)
    lower = orientation @ swing @ turn_x(np.degrees(bend))
    lift, tilt, _ = Rotation.from_matrix(lower.T @ sole).as_euler("XYZ", degrees=True)
    return {
        "hip flexion": -float(flexion),
        "hip spread": -float(spread),
        "hip turn": float(turn),
        "knee": float(np.degrees(bend)),
        "ankle": -float(lift),
        "foot tilt": float(tilt),
        # Toes stay flat on the floor and straighten as they leave it.
        "toes": max(0.0, foot.heel) * max(0.0, 1.0 - foot.height / 0.12),
    }


def _frame(along: FloatArray, towards: FloatArray) -> FloatArray:
    first = along / np.linalg.norm(along)
    second = towards - (towards @ first) * first
    second /= np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)])
