"""Random poses of a rig, within limits of a person."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.characters.rig_space import ROOT_CODES, RigPoseSpace
from lcollision_core.errors import LCollisionError
from lcollision_core.meshes.joint_kinds import Role
from lcollision_core.meshes.topology import FloatArray

_Range = tuple[float, float]

HUMAN: dict[Role, tuple[_Range, _Range, _Range]] = {
    Role.TWIST: ((0, 0), (0, 0), (0, 0)),
    Role.PALM: ((0, 5), (0, 0), (0, 0)),
    Role.THUMB: ((-10, 35), (0, 0), (-10, 10)),
    Role.FINGER: ((-5, 75), (0, 0), (-8, 8)),
    Role.TOE: ((-20, 30), (0, 0), (0, 0)),
    Role.FOOT: ((-25, 25), (-10, 10), (-15, 15)),
    Role.HAND: ((-35, 35), (-20, 20), (-35, 35)),
    Role.FOREARM: ((0, 135), (-60, 60), (0, 0)),
    Role.SHOULDER: ((-10, 15), (0, 0), (-8, 15)),
    Role.UPPER_ARM: ((-25, 100), (-40, 40), (-80, 70)),
    Role.THIGH: ((-25, 100), (-25, 25), (-15, 45)),
    Role.SHIN: ((0, 130), (0, 0), (0, 0)),
    Role.NECK: ((-20, 25), (-30, 30), (-20, 20)),
    Role.HEAD: ((-20, 25), (-35, 35), (-15, 15)),
    Role.SPINE: ((-20, 60), (-40, 40), (-30, 30)),
    Role.OTHER: ((-30, 30), (-30, 30), (-30, 30)),
    Role.FACE: ((0, 0), (0, 0), (0, 0)),
}
"""Degrees of bend, twist and turn sideways that a person reaches with ease: tighter than those that
drags allow. Sideways is away from the middle and up. An upper arm's is measured from the horizontal
and not from the rest pose, in which arms are spread or hang. A chain of joints of the spine or the
neck has them together. Faces keep still, as what they can do is not in their names."""

_SHARED = {Role.SPINE, Role.NECK}
_STILL = {Role.TWIST, Role.FACE}
_FINGERS = {Role.FINGER, Role.THUMB, Role.PALM}

_CURL_SPREAD = 0.15
"""Of their range: how much the fingers of a hand differ in their curl."""

_SIZES = (0.4, 1.0)
"""Least and most by which the turns of a pose are scaled."""


def random_codes(space: RigPoseSpace, n_poses: int, generator: np.random.Generator) -> FloatArray:
    """Draw (n_poses, D) codes of poses within limits of a person, which may collide.

    Raises
    ------
    LCollisionError : no joint turns but the one that moves all.
    """
    draws = HumanDraws(space)
    return draws.extents(n_poses, generator) * draws.codes(n_poses, generator)


@dataclass(frozen=True, eq=False)
class HumanDraws:
    """What random poses of a rig are drawn from.

    Attributes
    ----------
    space : of the poses
    """

    space: RigPoseSpace

    @cached_property
    def _turning(self) -> npt.NDArray[np.bool_]:
        """(J,) whether a joint has codes of its own."""
        turning = np.zeros(self.space.n_joints, dtype=np.bool_)
        turning[self.space.joint_of_code[ROOT_CODES:]] = True
        return turning

    @cached_property
    def _chain(self) -> npt.NDArray[np.int64]:
        """(J,) the first joint of each joint's chain of one role, as of a spine or a finger."""
        chain = np.arange(self.space.n_joints)
        roles, parents = self.space.roles, self.space.rig.parents
        for joint, parent in enumerate(parents):
            alike = parent >= 0 and roles[joint] is roles[parent] and self._turning[parent]
            if alike and roles[joint] in _SHARED | _FINGERS:
                chain[joint] = chain[parent]
        return chain

    @cached_property
    def _hand(self) -> npt.NDArray[np.int64]:
        """(J,) for each joint of a finger what the fingers hang on, else the joint itself."""
        hand = np.arange(self.space.n_joints)
        roles, parents = self.space.roles, self.space.rig.parents
        for joint, parent in enumerate(parents):
            if parent >= 0 and roles[joint] in _FINGERS:
                hand[joint] = hand[parent]
        return hand

    @cached_property
    def _limb(self) -> npt.NDArray[np.int64]:
        """(J,) numbers from 0: the limb of each joint; a limb begins where others branch off."""
        roles, parents = self.space.roles, self.space.rig.parents
        bends = self._turning & np.array([role not in _STILL for role in roles])
        branches = np.bincount(parents[bends & (parents >= 0)], minlength=len(parents))
        limb = np.arange(len(parents))
        for joint, parent in enumerate(parents):
            if parent < 0 or not self._turning[parent]:
                continue
            if branches[parent] == 1 or not bends[joint] or roles[joint] in _FINGERS:
                limb[joint] = limb[parent]
        numbers = np.full(len(parents), -1, dtype=np.int64)
        numbers[self._turning] = np.unique(limb[self._turning], return_inverse=True)[1]
        return numbers

    @property
    def _limb_of_code(self) -> npt.NDArray[np.int64]:
        limbs: npt.NDArray[np.int64] = self._limb[self.space.joint_of_code]
        return limbs

    @cached_property
    def limits(self) -> FloatArray:
        """(J, 3, 2) radians of bend, twist and turn sideways, in the joints' own axes.

        They are within those of drags; 0 where a joint has no code.
        """
        space = self.space
        limits = np.radians(np.array([HUMAN[role] for role in space.roles], dtype=np.float64))
        left = np.cross(space.up, space.front)
        middle = float(np.median(space.origins[self._turning] @ left))
        lengths = np.bincount(self._chain[self._turning], minlength=space.n_joints)
        for joint in np.flatnonzero(self._turning):
            role, (_, bone, _) = space.roles[joint], space.axes[joint].T
            if role is Role.UPPER_ARM:
                limits[joint, 2] -= np.arcsin(np.clip(bone @ space.up, -1.0, 1.0))
            if role in _SHARED:
                limits[joint] /= lengths[self._chain[joint]]
            way = np.cross(space.axes[joint][:, 2], bone)
            out = np.sign(space.origins[joint] @ left - middle) * (left @ way)
            if out + space.up @ way < 0.0:
                limits[joint, 2] = -limits[joint, 2, ::-1]
        reached = np.zeros_like(limits)
        place = space.joint_of_code[ROOT_CODES:], space.axis_of_code[ROOT_CODES:]
        low, high = space.low[ROOT_CODES:, None], space.high[ROOT_CODES:, None]
        reached[place] = np.clip(limits[place], low, high)
        return reached

    @property
    def limits_in_degrees(self) -> dict[str, Any]:
        """Of each joint that turns by its name: least and most bend, twist and turn sideways."""
        names = self.space.rig.joint_names
        return {
            names[joint]: np.degrees(self.limits[joint]).round(1).tolist()
            for joint in np.flatnonzero(self._turning)
        }

    def extents(self, n: int, generator: np.random.Generator) -> FloatArray:
        """Return how far the codes of random poses go: (n, D) from 0, for limbs at rest, to 1."""
        n_limbs = int(self._limb.max(initial=-1)) + 1
        if not n_limbs:
            raise LCollisionError(
                "has no joints that turn, apart from its root",
                "leave out poses by the rig",
                where=self.space.rig.joint_names[0],
            )
        # More of them move several limbs than one.
        n_moving = generator.integers(1, n_limbs + 1, size=(n, 2)).max(axis=1)
        order = generator.random((n, n_limbs)).argsort(axis=1).argsort(axis=1)
        moving = order < n_moving[:, None]
        extents: FloatArray = (
            generator.uniform(*_SIZES, size=(n, 1)) * moving[:, self._limb_of_code]
        )
        extents[:, :ROOT_CODES] = 0.0
        return extents

    def codes(self, n: int, generator: np.random.Generator) -> FloatArray:
        """Return (n, D) random codes within the limits, in which every joint turns."""
        space = self.space
        # Joints of a chain turn alike, and the fingers of a hand curl together.
        place = generator.random((n, space.n_joints, 3))
        place = place[:, self._chain]
        fingers = np.flatnonzero([role in _FINGERS for role in space.roles])
        curl = generator.random((n, space.n_joints))[:, self._hand[fingers]]
        place[:, fingers, 0] += (1.0 - _CURL_SPREAD) * (curl - place[:, fingers, 0])
        low, high = self.limits[:, :, 0], self.limits[:, :, 1]
        turns = low + place * (high - low)
        # Bend and sideways turn together stay within the ellipse of their limits.
        furthest = np.where(turns < 0.0, low, high)
        share = np.divide(turns, furthest, out=np.zeros_like(turns), where=furthest != 0.0)
        swing = np.hypot(share[:, :, 0], share[:, :, 2])
        turns[:, :, ::2] /= np.maximum(swing, 1.0)[:, :, None]
        codes: FloatArray = turns[:, space.joint_of_code, np.minimum(space.axis_of_code, 2)]
        codes[:, :ROOT_CODES] = 0.0
        return codes
