"""Two authored motions of 150 frames: a swing dance and a jump."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from lcollision_core.meshes.body.figure import Arm, Figure, Foot, straight_rise
from lcollision_core.meshes.body.skeleton import Skeleton

FloatArray = npt.NDArray[np.float64]

N_FRAMES = 150
JUMP_FRAME_RATE = 60.0
"""Frames a second; the dance has 30."""

_FRAMES = np.arange(N_FRAMES, dtype=np.float64)


def jump_motion(skeleton: Skeleton) -> list[Figure]:
    """Jump on the spot: arms back and down into the knees, take-off, flight, soft landing.

    The pelvis flies on a parabola under 9.81 m/s². At take-off and landing the feet follow
    the stretched legs.
    """
    crouch, take_off, landing, absorbed, standing = 46.0, 63.0, 99.0, 115.0, 146.0
    flight = (landing - take_off) / JUMP_FRAME_RATE
    speed = 9.81 * flight / 2 / JUMP_FRAME_RATE
    pelvis = CubicHermiteSpline(
        [0, 10, crouch, take_off, landing, absorbed, standing, 149],
        [0.0, 0.0, -0.30, 0.09, 0.09, -0.22, 0.0, 0.0],
        [0, 0, 0, speed, -speed, 0, 0, 0],
    )(_FRAMES)
    heel = _eased([0, 44, take_off, 80, landing, 108, 149], [0, 4, 50, 40, 30, 0, 0])
    tuck = 0.09 * np.sin(np.pi * np.clip((_FRAMES - take_off) / 36, 0, 1)) ** 2
    lift = _eased([0, 10, 40, 64, 82, 104, 120, 146], [14, 14, -44, 138, 152, 74, 40, 14], 2.5)
    elbow = _eased([0, 10, 38, 52, 66, 100, 146], [15, 15, 22, 40, 12, 25, 15], 2.5)
    lean = _eased([0, 12, crouch, 64, 84, landing, 115, 146], [0, 0, 34, 0, -3, 8, 26, 0], 2.5)
    bend = _eased([0, 12, crouch, 64, 82, landing, 115, 146], [0, 0, 20, -8, -4, 8, 18, 0], 2.5)
    nod = _eased([0, 14, crouch, 64, 115, 146], [0, 0, -26, -14, -20, 0], 2.5)
    back = _eased([0, 12, crouch, 63, 100, 115, 146], [0, 0, -0.12, 0, -0.02, -0.09, 0], 2.5)
    figures = []
    for frame in range(N_FRAMES):
        foot = Foot(0.13, heading=9, heel=heel[frame])
        stance = Figure(left_leg=foot, right_leg=foot, lean=lean[frame], ahead=back[frame])
        # A soft maximum: the feet leave the floor as the legs end, without a jolt.
        slack = pelvis[frame] - straight_rise(stance, skeleton) + 0.02
        height = 0.025 * np.logaddexp(0.0, slack / 0.025) + tuck[frame]
        foot = Foot(0.13, heading=9, heel=heel[frame], height=float(height))
        arm = Arm(lift[frame], 76, 0, elbow[frame], 15)
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


class _Step(NamedTuple):
    """A foot's step: lifted at `start`, down at `end`, at (x, ahead) metres, heading degrees."""

    start: float
    end: float
    x: float
    ahead: float
    heading: float


# Two six-count basics (rock step, triple step, triple step) and a travelling turn to the left.
_LEFT_STEPS = (
    _Step(4, 13, 0.13, -0.24, 0),
    _Step(26, 34, 0.30, 0.00, 0),
    _Step(40, 47, 0.38, 0.00, 0),
    _Step(60, 67, 0.23, 0.02, 0),
    _Step(78, 85, 0.16, 0.06, 45),
    _Step(93, 100, 0.02, 0.22, 135),
    _Step(108, 115, 0.00, 0.00, 225),
    _Step(123, 130, 0.16, -0.06, 315),
    _Step(137, 144, 0.20, 0.02, 360),
)
_RIGHT_STEPS = (
    _Step(15, 24, -0.09, 0.05, 0),
    _Step(33, 40, 0.10, 0.00, 0),
    _Step(53, 60, 0.02, 0.00, 0),
    _Step(67, 74, -0.04, 0.00, 10),
    _Step(85, 93, 0.04, 0.02, 90),
    _Step(100, 108, 0.20, 0.12, 180),
    _Step(115, 123, 0.02, -0.14, 270),
    _Step(130, 137, -0.04, 0.00, 350),
)


def swing_motion() -> list[Figure]:
    """Lead a swing dance: two basics on the spot, then a turn under the raised left arm."""
    left = _walk((0.12, 0.0, 0.0), _LEFT_STEPS)
    right = _walk((-0.12, 0.0, 0.0), _RIGHT_STEPS)
    # The weight goes to the foot that stands, ahead of the other's lift.
    share = gaussian_filter1d(0.5 + 0.5 * (right.lift - left.lift), 2.5, mode="nearest")
    middle = left.place * share[:, None] + right.place * (1 - share)[:, None]
    middle = gaussian_filter1d(0.5 * middle + 0.25 * (left.place + right.place), 3.5, axis=0)
    turn = gaussian_filter1d((left.heading + right.heading) / 2, 3.0, mode="nearest")
    beat = 2 * np.pi * _FRAMES / 13.4
    rise = -0.035 + 0.012 * np.cos(beat)
    sway = 4.0 * np.sin(beat / 2)
    holding = _eased([0, 74, 92, 124, 144], [44, 46, 128, 130, 48], 3.0)
    guiding = _eased([0, 20, 44, 70, 92, 124, 144], [52, 60, 46, 56, 40, 42, 52], 3.0)
    offer = _eased([0, 12, 24, 40, 56, 74, 92, 124, 144], [62, 34, 66, 78, 60, 70, 44, 44, 62], 3.0)
    return [
        Figure(
            Arm(holding[frame], 52, 0, offer[frame], 10),
            Arm(guiding[frame], 62 + sway[frame], 30, 62 + 2 * sway[frame], 30),
            _foot(left, frame, 1.0),
            _foot(right, frame, -1.0),
            spine=(5.0, 0.8 * sway[frame], -1.5 * sway[frame]),
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
    """A foot's way: (T, 2) place, (T,) heading in degrees, (T,) lift from 0 down to 1 highest."""

    place: FloatArray
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
    x, ahead = (float(value) for value in walk.place[frame])
    lift = float(walk.lift[frame])
    return Foot(
        out=side * x,
        ahead=ahead,
        heading=8.0 + side * float(walk.heading[frame]),
        heel=18.0 * lift,
        height=0.05 * lift,
    )


def _eased(frames: list[float], values: list[float], blur: float = 2.0) -> FloatArray:
    """Values at all frames: monotone between the given ones, without corners."""
    curve = PchipInterpolator([*frames, 1e3], [*values, values[-1]])(_FRAMES)
    return np.asarray(gaussian_filter1d(curve, blur, mode="nearest"))
