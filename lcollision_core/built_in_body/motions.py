"""Poses and motions of the built-in body.

Each pose in the file lists the attributes of `Figure` that are not at their default. A free leg is
under "left_leg" or "right_leg", a standing one under "left_foot" or "right_foot".
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from lcollision_core.built_in_body.figure import Arm, Figure, Foot, Leg, straight_rise
from lcollision_core.built_in_body.skeleton import Skeleton
from lcollision_core.bundled import bundled_file
from lcollision_core.meshes.topology import FloatArray

N_FRAMES = 150
JUMP_FRAME_RATE = 60.0
"""Frames per second; the dance has 30."""

_FRAMES = np.arange(N_FRAMES, dtype=np.float64)


def jump_motion(skeleton: Skeleton) -> list[Figure]:
    """Jump on the spot: swing the arms back and crouch, take off, fly, land softly.

    In flight the pelvis follows a parabola under 9.81 m/s². At take-off and landing the feet follow
    the stretched legs.
    """
    crouch, take_off, landing, absorbed, standing = 46.0, 63.0, 99.0, 115.0, 146.0
    upright = straight_rise(Figure(left_leg=Foot(0.13), right_leg=Foot(0.13)), skeleton) - 0.002
    flight = (landing - take_off) / JUMP_FRAME_RATE
    speed = 9.81 * flight / 2 / JUMP_FRAME_RATE
    pelvis = CubicHermiteSpline(
        [0, 10, crouch, take_off, landing, absorbed, standing, 149],
        [upright, upright, -0.27, 0.10, 0.10, -0.22, upright, upright],
        [0, 0, 0, speed, -speed, 0, 0, 0],
    )(_FRAMES)
    heel = _eased([0, 44, take_off, 80, landing, 108, 149], [0, 4, 50, 40, 30, 0, 0])
    tuck = 0.09 * np.sin(np.pi * np.clip((_FRAMES - take_off) / 36, 0, 1)) ** 2
    swing = _eased([0, 10, 40, 64, 82, 104, 120, 146], [6, 6, -48, 134, 150, 74, 40, 6], 2.5)
    elbow = _eased([0, 10, 38, 52, 66, 100, 146], [15, 15, 22, 40, 12, 25, 15], 2.5)
    lean = _eased([0, 12, crouch, 64, 84, landing, 115, 146], [0, 0, 27, 0, -3, 8, 24, 0], 2.5)
    bend = _eased([0, 12, crouch, 64, 82, landing, 115, 146], [0, 0, 17, -8, -4, 8, 15, 0], 2.5)
    nod = _eased([0, 14, crouch, 64, 115, 146], [0, 0, -26, -14, -20, 0], 2.5)
    back = _eased([0, 12, crouch, 63, 100, 115, 146], [0, 0, -0.12, 0, -0.02, -0.09, 0], 2.5)
    figures = []
    for frame in range(N_FRAMES):
        foot = Foot(0.13, heading=9, heel=heel[frame])
        stance = Figure(left_leg=foot, right_leg=foot, lean=lean[frame], ahead=back[frame])
        height = 0.0
        if crouch <= frame <= absorbed:
            # A soft maximum: the feet leave the floor without a jolt once the legs are stretched.
            # It is almost 0 in the crouch, where it starts and ends.
            slack = pelvis[frame] - straight_rise(stance, skeleton) + 0.03
            height = float(0.035 * np.logaddexp(0.0, slack / 0.035) + tuck[frame])
        foot = Foot(0.13, heading=9, heel=heel[frame], height=height)
        arm = _swung_arm(swing[frame], elbow[frame])
        figures.append(
            Figure(
                arm,
                arm,
                foot,
                foot,
                spine=(bend[frame], 0, 0),
                neck=(nod[frame], 0, 0),
                ahead=back[frame],
                lean=lean[frame],
                rise=float(pelvis[frame]),
            )
        )
    return figures


def _swung_arm(swing: float, elbow: float) -> Arm:
    """Return an arm swung forward by `swing` degrees, clear of the hip."""
    clear, swing = np.radians(16.0), np.radians(swing)
    down, forward = np.cos(clear) * np.cos(swing), np.cos(clear) * np.sin(swing)
    return Arm(
        lift=float(np.degrees(np.arccos(down))),
        plane=float(np.degrees(np.arctan2(forward, np.sin(clear)))),
        elbow=elbow,
        pronation=15,
    )


class _Step(NamedTuple):
    """A foot's step: lifted at `start`, down at `end` at (x, ahead) metres, heading in degrees."""

    start: float
    end: float
    x: float
    ahead: float
    heading: float


def _around(side: float, start: float, end: float, heading: float) -> _Step:
    """Return the step that puts a foot under a body turned by `heading` degrees."""
    turned = np.radians(heading)
    x = 0.10 + side * 0.12 * np.cos(turned)
    return _Step(start, end, float(x), float(0.03 - side * 0.12 * np.sin(turned)), heading)


_TURN = (
    (1.0, 75, 84, 40.0),
    (-1.0, 83, 92, 85.0),
    (1.0, 91, 100, 130.0),
    (-1.0, 99, 108, 175.0),
    (1.0, 107, 116, 220.0),
    (-1.0, 115, 124, 265.0),
    (1.0, 123, 132, 310.0),
    (-1.0, 131, 140, 350.0),
    (1.0, 138, 147, 360.0),
)
"""Side, first and last frame and heading of the turn's steps."""

# Two six-count basics (rock step, triple step, triple step) and a travelling turn to the left.
_LEFT_STEPS = (
    _Step(4, 13, 0.13, -0.24, 0),
    _Step(26, 34, 0.30, 0.00, 0),
    _Step(40, 47, 0.38, 0.00, 0),
    _Step(60, 68, 0.23, 0.02, 0),
    *(_around(*step) for step in _TURN[0::2]),
)
_RIGHT_STEPS = (
    _Step(15, 24, -0.09, 0.05, 0),
    _Step(33, 40, 0.10, 0.00, 0),
    _Step(53, 60, 0.02, 0.00, 0),
    _Step(67, 75, -0.03, 0.00, 0),
    *(_around(*step) for step in _TURN[1::2]),
)


def swing_motion() -> list[Figure]:
    """Dance swing as the leader: two basics on the spot, then a turn under the raised left arm."""
    left = _walk((0.12, 0.0, 0.0), _LEFT_STEPS)
    right = _walk((-0.12, 0.0, 0.0), _RIGHT_STEPS)
    # The weight shifts to the standing foot before the other one is lifted.
    share = gaussian_filter1d(0.5 + 0.5 * (right.lift - left.lift), 2.5, mode="nearest")
    middle = left.position * share[:, None] + right.position * (1 - share)[:, None]
    middle = gaussian_filter1d(0.5 * middle + 0.25 * (left.position + right.position), 3.5, axis=0)
    turn = gaussian_filter1d((left.heading + right.heading) / 2, 3.0, mode="nearest")
    beat = 2 * np.pi * _FRAMES / 13.4
    rise = -0.032 + 0.014 * np.cos(beat)
    sway = 5.0 * np.sin(beat / 2)
    turn += 1.4 * sway
    holding = _eased([0, 74, 92, 124, 144], [44, 46, 128, 130, 48], 3.0)
    guiding = _eased([0, 20, 44, 70, 92, 124, 144], [52, 60, 46, 56, 40, 42, 52], 3.0)
    offer = _eased([0, 12, 24, 40, 56, 74, 92, 124, 144], [62, 34, 66, 78, 60, 70, 44, 44, 62], 3.0)
    return [
        Figure(
            Arm(holding[frame], 52, 0, offer[frame], 10),
            Arm(guiding[frame], 62 + sway[frame], 30, 62 + 2 * sway[frame], 30),
            _foot(left, frame, 1.0),
            _foot(right, frame, -1.0),
            spine=(5.0, 0.9 * sway[frame], -2.2 * sway[frame]),
            neck=(2.0, -0.5 * sway[frame], sway[frame]),
            shift=float(middle[frame, 0]),
            ahead=float(middle[frame, 1]) - 0.03,
            lean=5.0,
            roll=0.5 * sway[frame],
            turn=float(turn[frame]),
            rise=float(rise[frame]),
        )
        for frame in range(N_FRAMES)
    ]


class _Walk(NamedTuple):
    """A foot's path: (T, 2) position, (T,) heading in degrees, (T,) lift from 0 (down) to 1."""

    position: FloatArray
    heading: FloatArray
    lift: FloatArray


def _walk(start: tuple[float, float, float], steps: tuple[_Step, ...]) -> _Walk:
    way = np.tile(np.array(start), (N_FRAMES, 1))
    lift = np.zeros(N_FRAMES)
    for step in steps:
        u = np.clip((_FRAMES - step.start) / (step.end - step.start), 0.0, 1.0)
        # Minimum jerk: the foot leaves and lands without a jolt (Flash and Hogan 1985).
        eased = (u**3 * (10 - 15 * u + 6 * u**2))[:, None]
        way += eased * ([step.x, step.ahead, step.heading] - way)
        lift += 64 * u**3 * (1 - u) ** 3
    return _Walk(way[:, :2], way[:, 2], lift)


def _foot(walk: _Walk, frame: int, side: float) -> Foot:
    x, ahead = (float(value) for value in walk.position[frame])
    lift = float(walk.lift[frame])
    return Foot(
        out=side * x,
        ahead=ahead,
        heading=8.0 + side * float(walk.heading[frame]),
        heel=16.0 * lift,
        height=0.04 * lift,
    )


def _eased(frames: list[float], values: list[float], blur: float = 2.0) -> FloatArray:
    """Interpolate values at all frames, monotone between the given ones and smoothed."""
    curve = PchipInterpolator([*frames, 1e3], [*values, values[-1]])(_FRAMES)
    return np.asarray(gaussian_filter1d(curve, blur, mode="nearest"))


_LIMBS = {"arm": Arm, "leg": Leg, "foot": Foot}


@cache
def authored_poses() -> dict[str, Figure]:
    """Return figures by name; the first is the rest pose, free of contact."""
    poses = json.loads(bundled_file("body_poses.json").read_text(encoding="utf-8"))
    return {name: _figure(attributes) for name, attributes in poses.items()}


def _figure(attributes: dict[str, Any]) -> Figure:
    given: dict[str, Any] = {}
    for key, value in attributes.items():
        limb = _LIMBS.get(key.partition("_")[2])
        if limb is not None:
            given[key.replace("foot", "leg")] = limb(**value)
        else:
            given[key] = tuple(value) if isinstance(value, list) else value
    return Figure(**given)
