"""The rig: bones, joint angles within human limits, forward kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lcollision_core.meshes.topology import FloatArray

_TRUNK: dict[str, tuple[str | None, str]] = {
    "pelvis": (None, "root"),
    "lumbar 1": ("pelvis", "spine05"),
    "lumbar 2": ("lumbar 1", "spine04"),
    "lumbar 3": ("lumbar 2", "spine03"),
    "thorax 1": ("lumbar 3", "spine02"),
    "thorax 2": ("thorax 1", "spine01"),
    "neck 1": ("thorax 2", "neck01"),
    "neck 2": ("neck 1", "neck02"),
    "neck 3": ("neck 2", "neck03"),
    "head": ("neck 3", "head"),
}
_LIMBS: dict[str, tuple[str, str]] = {
    "collar": ("thorax 2", "clavicle"),
    "upper arm": ("collar", "upperarm01"),
    "upper arm end": ("upper arm", "upperarm02"),
    "forearm": ("upper arm end", "lowerarm01"),
    "forearm end": ("forearm", "lowerarm02"),
    "hand": ("forearm end", "wrist"),
    "thigh": ("pelvis", "upperleg01"),
    "thigh end": ("thigh", "upperleg02"),
    "shin": ("thigh end", "lowerleg01"),
    "shin end": ("shin", "lowerleg02"),
    "foot": ("shin end", "foot"),
    "toes": ("foot", "toe1-1"),
}


def _bones() -> dict[str, tuple[str | None, str]]:
    bones = dict(_TRUNK)
    for side, suffix in (("left", ".L"), ("right", ".R")):
        for name, (parent, anny) in _LIMBS.items():
            parent = parent if parent in _TRUNK else f"{side} {parent}"
            bones[f"{side} {name}"] = (parent, anny + suffix)
    return bones


_RIG = _bones()
BONES: list[str] = list(_RIG)
"""Bone names, parents first. A limb whose twist is spread along it has two bones."""

PARENTS: list[int] = [-1 if p is None else BONES.index(p) for p, _ in _RIG.values()]

_OPPOSITE = {"left": "right", "right": "left"}
OTHER_SIDE: list[int] = [
    BONES.index(" ".join(_OPPOSITE.get(word, word) for word in bone.split())) for bone in BONES
]
"""For each bone, its counterpart on the other side; itself if there is only one."""


def bone_of_anny(label: str) -> str:
    """Return the bone of `BONES` that stands for anny's bone `label`."""
    for bone, (_, anny) in _RIG.items():
        if anny == label:
            return bone
    stem, _, suffix = label.partition(".")
    side = {"L": "left ", "R": "right "}.get(suffix, "")
    if stem.startswith(("finger", "metacarpal")):
        return side + "hand"
    if stem.startswith("toe"):
        return side + "toes"
    if stem == "shoulder01":
        return side + "collar"
    return {"pelvis": "pelvis", "eye": "head"}[stem]


# A twist that is spread over two bones must not sway the limb, whose joints lie off its axis, so
# these joints follow the bone that turns by the full twist.
_CARRIERS: dict[int, int] = {
    BONES.index(f"{side} {joint}"): BONES.index(f"{side} {carrier}")
    for side in ("left", "right")
    for joint, carrier in (
        ("upper arm end", "upper arm end"),
        ("thigh end", "thigh end"),
        ("hand", "forearm"),
    )
}


# Degrees, within clinical ranges of motion of healthy adults. The arm includes the collarbone's
# share; the ankle has the range of a weight-bearing foot.
LIMITS: dict[str, tuple[float, float]] = {
    "spine bend": (-35.0, 75.0),
    "spine side": (-32.0, 32.0),
    "spine twist": (-45.0, 45.0),
    "neck bend": (-50.0, 45.0),
    "neck side": (-35.0, 35.0),
    "neck twist": (-70.0, 70.0),
    "shrug": (-10.0, 25.0),
    "arm raise": (0.0, 175.0),
    "arm plane": (-90.0, 135.0),
    "arm turn": (-90.0, 95.0),
    "elbow": (0.0, 140.0),
    "pronation": (-80.0, 85.0),
    "wrist bend": (-70.0, 75.0),
    "wrist side": (-30.0, 20.0),
    "hip flexion": (-25.0, 120.0),
    "hip spread": (-25.0, 60.0),
    "hip turn": (-40.0, 50.0),
    "knee": (0.0, 140.0),
    "ankle": (-50.0, 38.0),
    "foot tilt": (-35.0, 35.0),
    "toes": (-35.0, 65.0),
}
"""Least and greatest value of each joint angle; those of limbs apply to both sides."""

TRUNK_ANGLES = [name for name in LIMITS if name.startswith(("spine", "neck"))]
_LIMB_ANGLES = [name for name in LIMITS if name not in TRUNK_ANGLES]


def limits_of(angle: str) -> tuple[float, float]:
    """Return the least and greatest value of a joint angle, in degrees."""
    return LIMITS[angle.removeprefix("left ").removeprefix("right ")]


def rotation_about(axis: npt.ArrayLike, angle: float) -> FloatArray:
    """Return the (3, 3) rotation by `angle` radians about `axis` (3,) of any length."""
    direction = np.asarray(axis, dtype=np.float64)
    unit = direction / (np.linalg.norm(direction) or 1.0)
    return np.asarray(Rotation.from_rotvec(angle * unit).as_matrix())


def turn_x(degrees: float) -> FloatArray:
    """Return the rotation about x, the body's left: a positive angle leans forward."""
    return rotation_about((1.0, 0.0, 0.0), np.radians(degrees))


def turn_y(degrees: float) -> FloatArray:
    """Return the rotation about y, the body's back: a positive angle leans to its left."""
    return rotation_about((0.0, 1.0, 0.0), np.radians(degrees))


def turn_z(degrees: float) -> FloatArray:
    """Return the rotation about z, up: a positive angle turns to the body's left."""
    return rotation_about((0.0, 0.0, 1.0), np.radians(degrees))


MIRROR = np.diag([-1.0, 1.0, 1.0])

_SPINE_SHARES = {
    "lumbar 1": 0.22,
    "lumbar 2": 0.23,
    "lumbar 3": 0.22,
    "thorax 1": 0.2,
    "thorax 2": 0.13,
}
_NECK_SHARES = {"neck 1": 0.3, "neck 2": 0.2, "neck 3": 0.2, "head": 0.3}


@dataclass(frozen=True)
class Skeleton:
    """Joint positions at rest and the rotations from rest to the zero pose.

    In the zero pose the body stands upright with arms hanging, palms to the thighs, legs straight
    and parallel; all joint angles are zero there.

    Attributes
    ----------
    positions : (J, 3) float64 array, metres, the joints at which `BONES` begin
    zeros : (3, 3) rotations of the left limb bones to the zero pose, by bone name without side
    """

    positions: FloatArray
    zeros: Mapping[str, FloatArray]

    @classmethod
    def from_anny(cls, heads: Mapping[str, FloatArray]) -> Skeleton:
        """Measure anny's resting bones from their `heads`, (3,) in metres by bone label."""
        positions = np.array([heads[anny] for _, anny in _RIG.values()])
        for side, suffix in (("left", ".L"), ("right", ".R")):
            toes = np.mean([heads[f"toe{k}-1{suffix}"] for k in (1, 2, 3, 4)], axis=0)
            positions[BONES.index(f"{side} toes")] = toes
        positions = _symmetric(positions)
        at = {name: positions[BONES.index(f"left {name}")] for name in _LIMBS}
        zeros: dict[str, FloatArray] = {}
        upper = _unit(at["forearm"] - at["upper arm"])
        lower = _unit(at["hand"] - at["forearm"])
        hinge = _unit(np.cross(upper, lower))
        rest = np.column_stack([hinge, upper, np.cross(hinge, upper)])
        hanging = np.column_stack([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
        zeros["upper arm"] = np.asarray(hanging @ rest.T)
        bend = np.arccos(np.clip(upper @ lower, -1.0, 1.0))
        zeros["forearm"] = zeros["upper arm"] @ rotation_about(hinge, -float(bend))
        knuckles = np.mean([heads[f"finger{k}-1.L"] for k in (2, 3, 4, 5)], axis=0)
        along = _unit(knuckles - at["hand"])
        across = heads["finger2-1.L"] - heads["finger5-1.L"]
        across = _unit(across - (across @ along) * along)
        rest = np.column_stack([across, along, np.cross(across, along)])
        hanging = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
        zeros["hand"] = hanging @ rest.T
        down = np.array([0.0, 0.0, -1.0])
        zeros["thigh"] = _shortest_turn(at["shin"] - at["thigh"], down)
        zeros["shin"] = _shortest_turn(at["foot"] - at["shin"], down)
        zeros["foot"] = np.eye(3)
        return cls(positions, zeros)

    def pose(
        self, angles: Mapping[str, float], orientation: FloatArray, location: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Compute forward kinematics.

        Parameters
        ----------
        angles : degrees by name; missing ones are zero
        orientation : (3, 3) rotation of the pelvis
        location : (3,) position of the pelvis joint, metres

        Returns
        -------
        rotations : (J, 3, 3) float64 array, each bone's world rotation from rest
        positions : (J, 3) float64 array, each bone's joint, metres
        """
        rotations = np.zeros((len(BONES), 3, 3))
        rotations[0] = orientation
        for shares, part in ((_SPINE_SHARES, "spine"), (_NECK_SHARES, "neck")):
            bend, lean, twist = (angles.get(f"{part} {n}", 0.0) for n in ("bend", "side", "twist"))
            for bone, share in shares.items():
                index = BONES.index(bone)
                step = turn_x(share * bend) @ turn_y(share * lean) @ turn_z(share * twist)
                rotations[index] = rotations[PARENTS[index]] @ step
        chest = rotations[BONES.index("thorax 2")]
        for side in ("left", "right"):
            # The right limbs mirror the left ones.
            reflect = np.eye(3) if side == "left" else MIRROR
            limb_angles = {n: angles.get(f"{side} {n}", 0.0) for n in _LIMB_ANGLES}
            local = self._arm(limb_angles) | self._leg(limb_angles)
            for name, rotation in local.items():
                base = chest if name in _ARM_BONES else orientation
                rotations[BONES.index(f"{side} {name}")] = base @ reflect @ rotation @ reflect
        positions = np.zeros((len(BONES), 3))
        positions[0] = location
        for index in range(1, len(BONES)):
            parent = PARENTS[index]
            offset = self.positions[index] - self.positions[parent]
            carrier = rotations[_CARRIERS.get(index, parent)]
            positions[index] = positions[parent] + carrier @ offset
        return rotations, positions

    def _arm(self, angle: Mapping[str, float]) -> dict[str, FloatArray]:
        """Return the rotations of the left arm's bones relative to the chest."""
        plane = np.radians(angle["arm plane"])
        raise_ = angle["arm raise"]
        swing = rotation_about((-np.sin(plane), -np.cos(plane), 0.0), np.radians(raise_))
        # The shoulder girdle follows a raised arm and a forward reach (scapulohumeral rhythm).
        follow = 4.4 * float(np.logaddexp(0.0, (raise_ - 40.0) / 20.0))
        reach = 14.0 * np.sin(np.radians(raise_)) * np.sin(plane)
        upper = swing @ turn_z(-0.5 * angle["arm turn"]) @ self.zeros["upper arm"]
        turned = swing @ turn_z(-angle["arm turn"])
        bent = turned @ turn_x(-angle["elbow"])
        twisted = bent @ turn_z(-angle["pronation"])
        hand = twisted @ turn_y(angle["wrist bend"]) @ turn_x(-angle["wrist side"])
        return {
            "collar": turn_z(-reach) @ turn_y(-(follow + angle["shrug"])),
            "upper arm": upper,
            "upper arm end": turned @ self.zeros["upper arm"],
            "forearm": bent @ self.zeros["forearm"],
            "forearm end": bent @ turn_z(-0.6 * angle["pronation"]) @ self._forearm_end(),
            "hand": hand @ self.zeros["hand"],
        }

    def _forearm_end(self) -> FloatArray:
        """Return the zero rotation of the forearm's end: 0.6 of the twist from elbow to wrist."""
        between = self.zeros["hand"] @ self.zeros["forearm"].T
        twist = np.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])
        return turn_z(0.6 * np.degrees(twist)) @ self.zeros["forearm"]

    def _leg(self, angle: Mapping[str, float]) -> dict[str, FloatArray]:
        """Return the rotations of the left leg's bones relative to the pelvis."""
        swing = turn_x(-angle["hip flexion"]) @ turn_y(-angle["hip spread"])
        turned = swing @ turn_z(angle["hip turn"])
        bent = turned @ turn_x(angle["knee"])
        foot = bent @ turn_x(-angle["ankle"]) @ turn_y(angle["foot tilt"])
        return {
            "thigh": swing @ turn_z(0.5 * angle["hip turn"]) @ self.zeros["thigh"],
            "thigh end": turned @ self.zeros["thigh"],
            "shin": bent @ self.zeros["shin"],
            "shin end": bent @ self.zeros["shin"],
            "foot": foot @ self.zeros["foot"],
            "toes": foot @ turn_x(-angle["toes"]) @ self.zeros["foot"],
        }


_ARM_BONES = {"collar", "upper arm", "upper arm end", "forearm", "forearm end", "hand"}


def _symmetric(positions: FloatArray) -> FloatArray:
    return np.asarray((positions + positions[OTHER_SIDE] @ MIRROR) / 2)


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


def _shortest_turn(start: FloatArray, end: FloatArray) -> FloatArray:
    a, b = _unit(start), _unit(end)
    axis = np.cross(a, b)
    return rotation_about(axis, float(np.arctan2(np.linalg.norm(axis), a @ b)))
