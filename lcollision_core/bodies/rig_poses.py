"""Human poses of a rig: starter poses and random ones.

Angles are in degrees, relative to a body standing with its arms at its sides, whatever its rest
pose. Hands on the body are placed by inverse kinematics.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies.anatomy import limb_children
from lcollision_core.bodies.rig_space import ROOT_CODES, RigPoseSpace
from lcollision_core.bundled import bundled_table
from lcollision_core.errors import LCollisionError
from lcollision_core.files.scene.transforms import from_rotation_vectors
from lcollision_core.meshes.joint_kinds import JOINT_KINDS, Role, Side
from lcollision_core.meshes.topology import FloatArray

_FINGERS = {Role.FINGER, Role.THUMB, Role.PALM}
_ARMS = {Role.SHOULDER, Role.UPPER_ARM, Role.FOREARM, Role.HAND, *_FINGERS}
_NEAR = 0.03
"""Normalised: tolerance within which skin counts as at one height or at one place of a bone."""

_SIDES = (Side.LEFT, Side.RIGHT)


@dataclass(frozen=True, eq=False)
class StarterPose:
    """A pose of one character.

    Attributes
    ----------
    name : of the pose
    codes : (D,) float64 array
    moves : (D,) mask of the codes it sets, those of fingers only; None for all
    """

    name: str
    codes: FloatArray
    moves: npt.NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class _Leg:
    """Degrees: hip forward, out and turned out; knee bend; foot and toes up."""

    hip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    knee: float = 0.0
    foot: float = 0.0
    toes: float = 0.0


@dataclass(frozen=True)
class _Arm:
    """Degrees: shoulder forward, out and turned in; elbow bend; palm turned back.

    With `wrist` the hand reaches for the trunk, see `_Body._at_trunk`; with `thigh` for a point at
    that share of the thigh. Directions (out, up, forward) are where the elbow tends to point, the
    hand points and the palm faces.
    """

    shoulder: tuple[float, float, float] = (0.0, 12.0, 0.0)
    elbow: float = 12.0
    palm: float = 0.0
    wrist: tuple[float, float, float] | None = None
    thigh: float | None = None
    elbow_towards: tuple[float, float, float] = (1.0, -0.5, -0.5)
    hand: tuple[float, float, float] = (0.0, -1.0, 0.0)
    palm_towards: tuple[float, float, float] = (-1.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Hand:
    """Degrees: curl of the finger joints from first to last; spread; curl of the thumb's joints."""

    curl: tuple[float, float, float] = (18.0, 22.0, 14.0)
    index: tuple[float, float, float] | None = None
    spread: float = 0.0
    thumb: tuple[float, float, float] = (8.0, 8.0, 8.0)


@dataclass(frozen=True)
class _Pose:
    """A pose of the whole body, left side first.

    Attributes
    ----------
    lean : degrees of forward tilt of the hips, of the spine, and of neck and head
    """

    legs: tuple[_Leg, _Leg] = (_Leg(), _Leg())
    arms: tuple[_Arm, _Arm] = (_Arm(), _Arm())
    hands: tuple[_Hand, _Hand] = (_Hand(), _Hand())
    lean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    twist: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class PoseTable:
    """Poses by name, in menu order, as in ``resources/starter_poses.toml``."""

    body: dict[str, _Pose]
    hands: dict[str, _Hand]


POSES = bundled_table("starter_poses.toml", PoseTable)


def starter_poses(space: RigPoseSpace, table: PoseTable = POSES) -> tuple[StarterPose, ...]:
    """Return starter poses; none for a character whose joints are unknown.

    Hand poses move only the fingers: see `StarterPose.moves`. Poses may collide.
    """
    body, poses = _Body(space), []
    if body.has_limbs:
        poses = list(map(StarterPose, table.body, body.codes(table.body.values())))
    if len(body.fingers):
        for name, hand in table.hands.items():
            codes = np.zeros(len(space.low))
            body.set_hands(codes, (hand, hand))
            poses.append(StarterPose(name, codes, body.of_fingers))
    return tuple(poses)


class _Body:
    """A character in coordinates along left, up and front."""

    def __init__(self, space: RigPoseSpace) -> None:
        self._space, rig = space, space.rig
        self._axes = space.to_body
        self._places = space.origins @ self._axes.T
        self._bones = np.einsum("ij,njk->nik", self._axes, space.axes)
        """(J, 3, 3) joint axes at rest."""
        self._next = limb_children(rig, space.roles)
        self._limbs = {
            (role, side): joint
            for joint in sorted(self._next, reverse=True)
            for role, side in [(space.roles[joint], space.sides[joint])]
        }
        self.has_limbs = all(
            (role, side) in self._limbs
            for role in (Role.UPPER_ARM, Role.FOREARM, Role.THIGH, Role.SHIN)
            for side in _SIDES
        )
        self._points = space.rest_vertices @ self._axes.T
        turning = set(space.joint_of_code[ROOT_CODES:].tolist())
        self.fingers = [
            joint for joint in sorted(turning) if space.roles[joint] in _FINGERS - {Role.PALM}
        ]
        self._hand = _hands(space)
        self.of_fingers = space.codes_of_joints(np.array(self.fingers, dtype=np.int64))
        self.of_fingers[:ROOT_CODES] = False

    def codes(self, poses: Collection[_Pose]) -> FloatArray:
        """Return the (N, D) codes of poses that stand on the ground of the rest pose."""
        space, rig = self._space, self._space.rig
        turns = np.stack([self._turns(pose) for pose in poses])
        transforms = np.tile(rig.rest, (len(poses), 1, 1, 1))
        transforms[:, :, :3, :3] = (
            np.einsum("ji,pnjk,kl->pnil", self._axes, turns, self._axes) @ rig.rest[:, :3, :3]
        )
        codes = space.codes_of_transforms(transforms)
        codes[:, :3] = 0.0
        codes = np.clip(codes, space.low, space.high)
        for own, pose in zip(codes, poses, strict=True):
            self.set_hands(own, pose.hands)
        ground = (space.rest_vertices @ space.up).min()
        codes[:, 1] = ground - (space.decode(codes) @ space.up).min(axis=1)
        return codes

    def set_hands(self, codes: FloatArray, hands: tuple[_Hand, _Hand]) -> None:
        """Set the codes of fingers and thumbs."""
        space = self._space
        for joint in self.fingers:
            side = _SIDES.index(space.sides[joint]) if space.sides[joint] in _SIDES else 0
            turn = np.radians(self._finger_turn(joint, hands[side]))
            mine = np.flatnonzero(space.joint_of_code == joint)
            mine = mine[mine >= ROOT_CODES]
            codes[mine] = turn[space.axis_of_code[mine]]
        codes[self.of_fingers] = np.clip(codes, space.low, space.high)[self.of_fingers]

    def _finger_turn(self, joint: int, hand: _Hand) -> FloatArray:
        """Return the degrees by which a finger joint turns about its axes."""
        roles, parents = self._space.roles, self._space.rig.parents
        chain = [joint]
        while roles[parents[chain[-1]]] is roles[joint]:
            chain.append(int(parents[chain[-1]]))
        number, first, palm = min(len(chain) - 1, 2), chain[-1], int(self._hand[joint])
        bone, axes = self._bones[joint][:, 1], self._bones[joint]
        firsts = [
            finger
            for finger in self.fingers
            if roles[finger] is Role.FINGER
            and roles[parents[finger]] is not Role.FINGER
            and self._hand[finger] == palm
        ]
        if roles[joint] is Role.THUMB:
            if not firsts:
                return np.zeros(3)
            # Fold the thumb across the palm, towards the curling fingers.
            middle = self._places[firsts].mean(axis=0)
            inwards = np.cross(*self._bones[firsts[0]][:, :2].T)
            inwards *= 0.5 * np.linalg.norm(middle - self._places[palm])
            axis = np.cross(bone, middle + inwards - self._places[joint])
            turn: FloatArray = axes.T @ axis * hand.thumb[number] / np.linalg.norm(axis)
            return turn
        curl, spread = hand.curl[number], 0.0
        if hand.index is not None and first == self._index_of(firsts, palm):
            curl = hand.index[number]
        if number:
            # Measure from a straight finger, whatever its bend at rest.
            before = self._bones[chain[1]][:, 1]
            sine = float(np.cross(before, bone) @ axes[:, 0])
            curl -= float(np.degrees(np.arctan2(sine, before @ bone)))
        else:
            places = self._places[firsts] - self._places[firsts].mean(axis=0)
            offsets = places @ np.cross(axes[:, 2], bone)
            widest = float(np.abs(offsets).max())
            spread = hand.spread * float(offsets[firsts.index(joint)]) / (widest or 1.0)
        return np.array([curl, 0.0, spread])

    def _index_of(self, firsts: list[int], hand: int) -> int:
        """Return the finger nearest to the thumb, -1 without a thumb."""
        thumbs = [
            joint
            for joint in self.fingers
            if self._space.roles[joint] is Role.THUMB and self._hand[joint] == hand
        ]
        if not thumbs:
            return -1
        gaps = np.linalg.norm(self._places[firsts] - self._places[thumbs[0]], axis=1)
        return firsts[int(gaps.argmin())]

    def _turns(self, pose: _Pose) -> FloatArray:
        """Return the (J, 3, 3) rotations from rest of all joints, about left, up and front."""
        joint_turns: dict[int, FloatArray] = {}
        for side in _SIDES:
            joint_turns |= self._leg(self._limbs[Role.THIGH, side], pose.legs[_SIDES.index(side)])
        turns, places = self._carried(pose, joint_turns)
        for side in _SIDES:
            upper = self._limbs[Role.UPPER_ARM, side]
            chest = turns[self._space.rig.parents[upper]]
            joint_turns |= self._arm(upper, pose.arms[_SIDES.index(side)], chest, places)
        return self._carried(pose, joint_turns)[0]

    def _carried(self, pose: _Pose, own: Mapping[int, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return all joints' turns and positions, given the turns of some joints."""
        roles, places = self._space.roles, self._places.copy()
        n_spine = max(1, roles.count(Role.SPINE))
        n_head = max(1, roles.count(Role.NECK) + roles.count(Role.HEAD))
        spine = _turn(pose.lean[1] / n_spine, pose.twist[1] / n_spine, 0.0)
        head = _turn(pose.lean[2] / n_head, -(pose.twist[0] + pose.twist[1]) / n_head, 0.0)
        more = {Role.SPINE: spine, Role.NECK: head, Role.HEAD: head}
        turns = np.empty((len(roles), 3, 3))
        root = _turn(pose.lean[0], pose.twist[0], 0.0)
        for joint, parent in enumerate(self._space.rig.parents.tolist()):
            turn = root
            if parent >= 0:
                turn = turns[parent]
                places[joint] = places[parent] + turn @ (self._places[joint] - self._places[parent])
            turns[joint] = own.get(joint, turn @ more.get(roles[joint], np.eye(3)))
        return turns, places

    @cached_property
    def _standing(self) -> dict[int, FloatArray]:
        """The rotations that point the bones of limbs down, hinges of legs left, of arms right."""
        left, up, _ = np.eye(3)
        turns = {}
        for side, (role, bend) in product(_SIDES, ((Role.THIGH, left), (Role.UPPER_ARM, -left))):
            upper = self._limbs[role, side]
            lower = self._next[upper]
            hinge = self._bones[lower][:, 0]
            for joint in (upper, lower):
                turns[joint] = _frame(bend, -up) @ _frame(hinge, self._bones[joint][:, 1]).T
        return turns

    def _leg(self, thigh: int, leg: _Leg) -> dict[int, FloatArray]:
        shin = self._next[thigh]
        side = self._sign(thigh)
        hip = _turn(-leg.hip[0], 0.0, 0.0) @ _turn(0.0, 0.0, side * leg.hip[1])
        hip = hip @ _turn(0.0, side * leg.hip[2], 0.0)
        knee = hip @ _turn(leg.knee, 0.0, 0.0)
        turns = {
            thigh: hip @ self._standing[thigh],
            shin: knee @ self._standing[shin],
        }
        if shin in self._next:
            foot = self._next[shin]
            ankle = knee @ _turn(-leg.foot, 0.0, 0.0)
            turns[foot] = ankle
            for toe in np.flatnonzero(self._space.rig.parents == foot).tolist():
                if self._space.roles[toe] is Role.TOE:
                    turns[toe] = ankle @ _turn(-leg.toes, 0.0, 0.0)
        return turns

    def _arm(
        self, upper: int, arm: _Arm, chest: FloatArray, places: FloatArray
    ) -> dict[int, FloatArray]:
        fore = self._next[upper]
        side = self._sign(upper)
        mirror = np.array([side, 1.0, 1.0])
        hand = self._next.get(fore)
        if hand is None or (arm.wrist is None and arm.thigh is None):
            shoulder = _turn(-arm.shoulder[0], 0.0, 0.0) @ _turn(0.0, 0.0, side * arm.shoulder[1])
            shoulder = chest @ shoulder @ _turn(0.0, -side * arm.shoulder[2], 0.0)
            elbow = shoulder @ _turn(-arm.elbow, 0.0, 0.0) @ _turn(0.0, -side * arm.palm, 0.0)
            wrist = elbow
        else:
            if arm.wrist is not None:
                target = self._at_trunk(upper, hand, arm.wrist)
            else:
                target = self._on_thigh(upper, hand, arm.thigh or 0.0, places)
            shoulder, elbow = self._reach(upper, places[upper], target, mirror * arm.elbow_towards)
            wrist = _frame(mirror * arm.palm_towards, mirror * arm.hand)
            wrist = wrist @ _frame(np.array([-side, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])).T
            # The forearm twists as much as the hand needs.
            x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(elbow.T @ wrist).as_quat()
            del x, z
            elbow = elbow @ _turn(0.0, np.degrees(2.0 * np.arctan2(y, w)), 0.0)
        turns = {
            upper: shoulder @ self._standing[upper],
            fore: elbow @ self._standing[fore],
        }
        if hand is not None:
            turns[hand] = wrist @ self._standing[fore]
        return turns

    def _reach(
        self, upper: int, start: FloatArray, target: FloatArray, towards: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the turns of an arm's two bones that bring its wrist to a target."""
        fore = self._next[upper]
        shoulder, hinge, end = (
            self._places[segment] for segment in (upper, fore, self._next[fore])
        )
        a, b = float(np.linalg.norm(hinge - shoulder)), float(np.linalg.norm(end - hinge))
        way = target - start
        length = float(np.clip(np.linalg.norm(way), abs(a - b) * 1.01, (a + b) * 0.999))
        way /= np.linalg.norm(way)
        along = (a * a - b * b + length * length) / (2.0 * length)
        side = towards - (towards @ way) * way
        elbow = along * way + np.sqrt(max(a * a - along * along, 0.0)) * side / np.linalg.norm(side)
        bend = np.cross(elbow, length * way - elbow)
        hanging = _frame(-np.eye(3)[0], -np.eye(3)[1]).T
        return _frame(bend, elbow) @ hanging, _frame(bend, length * way - elbow) @ hanging

    def _at_trunk(self, upper: int, hand: int, wrist: tuple[float, float, float]) -> FloatArray:
        """Return the position of a wrist on the trunk, in the rest pose.

        Parameters
        ----------
        wrist : share of half the trunk's width; share of the way up from hips to shoulders; then
            the distance in front of the trunk in forearm thicknesses or, if negative, behind its
            middle in half depths
        """
        hips = self._places[[self._limbs[Role.THIGH, side] for side in _SIDES]].mean(axis=0)
        height = hips[1] + wrist[1] * (self._places[upper][1] - hips[1])
        of_arms = [joint for joint, role in enumerate(self._space.roles) if role in _ARMS]
        level = np.abs(self._points[:, 1] - height) < _NEAR
        trunk = self._points[level & ~np.isin(self._space.rig.heaviest, of_arms)]
        wide = float(np.abs(trunk[:, 0] - hips[0]).max(initial=0.0))
        front = float(trunk[:, 2].max(initial=hips[2]))
        half = 0.5 * (front - float(trunk[:, 2].min(initial=hips[2])))
        thick = self._thickness(hand, self._next[upper])
        deep = (
            front + thick * (2.0 * wrist[2] - 1.0)
            if wrist[2] > 0.0
            else front - half * (1.0 - wrist[2])
        )
        return np.array([hips[0] + self._sign(upper) * wrist[0] * (wide + thick), height, deep])

    def _on_thigh(self, upper: int, hand: int, share: float, places: FloatArray) -> FloatArray:
        """Return the position of a wrist on its side's thigh, at a share of its length."""
        thigh = self._limbs[Role.THIGH, self._space.sides[upper]]
        knee = self._next[thigh]
        on_bone = self._places[thigh] + share * (self._places[knee] - self._places[thigh])
        thick = self._thickness(hand, self._next[upper])
        thick = 1.3 * (thick + self._thickness(thigh, thigh, on_bone))
        target = places[thigh] + share * (places[knee] - places[thigh])
        raised: FloatArray = target + [0.0, thick, 0.0]
        return raised

    def _thickness(self, joint: int, bone: int, place: FloatArray | None = None) -> float:
        """Return the skin's radius about a joint, across a bone's direction, at a place."""
        way = self._bones[bone][:, 1]
        limb_points = self._points[self._space.rig.heaviest == joint] - (
            self._places[joint] if place is None else place
        )
        near = limb_points[np.abs(limb_points @ way) < _NEAR]
        across = np.linalg.norm(near - (near @ way)[:, None] * way, axis=1)
        return float(np.median(across)) if len(near) else _NEAR

    def _sign(self, joint: int) -> float:
        return 1.0 if self._space.sides[joint] is Side.LEFT else -1.0


def _hands(space: RigPoseSpace) -> npt.NDArray[np.int64]:
    """Return the joint that a finger joint's hand hangs on, itself for other joints: (J,)."""
    hands = np.arange(space.n_joints)
    for joint, parent in enumerate(space.rig.parents):
        if parent >= 0 and space.roles[joint] in _FINGERS:
            hands[joint] = hands[parent]
    return hands


def _turn(left: float, up: float, front: float) -> FloatArray:
    """Return the rotation by degrees about one of left, up and front."""
    return from_rotation_vectors(np.radians([left, up, front]))


def _frame(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the rotation with second column along `second` and first column near `first`."""
    second = second / np.linalg.norm(second)
    first = first - (first @ second) * second
    first = first / np.linalg.norm(first)
    return np.stack([first, second, np.cross(first, second)], axis=1)


_SHARED = {Role.SPINE, Role.NECK}
_STILL = {Role.TWIST, Role.FACE}

_CURL_SPREAD = 0.15
"""How much the curl of a hand's fingers varies, as a share of its range."""

_SIZES = (0.4, 1.0)
"""Least and greatest scale of a pose's turns."""


def random_codes(space: RigPoseSpace, n_poses: int, generator: np.random.Generator) -> FloatArray:
    """Draw (n_poses, D) codes of poses within human limits; poses may collide.

    Raises
    ------
    LCollisionError : no joint but the root turns.
    """
    draws = HumanDraws(space)
    return draws.extents(n_poses, generator) * draws.codes(n_poses, generator)


@dataclass(frozen=True, eq=False)
class HumanDraws:
    """Distribution of random poses of a rig.

    Attributes
    ----------
    space : of the poses
    """

    space: RigPoseSpace

    @cached_property
    def _turning(self) -> npt.NDArray[np.bool_]:
        """(J,) mask of the joints with codes of their own."""
        turning = np.zeros(self.space.n_joints, dtype=np.bool_)
        turning[self.space.joint_of_code[ROOT_CODES:]] = True
        return turning

    @cached_property
    def _chain(self) -> npt.NDArray[np.int64]:
        """(J,) first joint of each joint's chain of one role, such as of a spine or a finger."""
        chain = np.arange(self.space.n_joints)
        roles, parents = self.space.roles, self.space.rig.parents
        for joint, parent in enumerate(parents):
            alike = parent >= 0 and roles[joint] is roles[parent] and self._turning[parent]
            if alike and roles[joint] in _SHARED | _FINGERS:
                chain[joint] = chain[parent]
        return chain

    @cached_property
    def _limb(self) -> npt.NDArray[np.int64]:
        """(J,) limb index of each joint, from 0; limbs begin at branches."""
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
        """(J, 3, 2) radians of bend, twist and sideways turn, in the joints' own axes.

        They lie within the limits of drags, and are 0 where a joint has no code.
        """
        space = self.space
        limits = np.radians([JOINT_KINDS[role].comfortable for role in space.roles])
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
        joint_codes = slice(ROOT_CODES, len(space.joint_of_code))
        low, high = space.low[joint_codes, None], space.high[joint_codes, None]
        reached[place] = np.clip(limits[place], low, high)
        return reached

    @property
    def limits_in_degrees(self) -> dict[str, Any]:
        """Least and greatest bend, twist and sideways turn of each turning joint, by name."""
        names = self.space.rig.joint_names
        return {
            names[joint]: np.degrees(self.limits[joint]).round(1).tolist()
            for joint in np.flatnonzero(self._turning)
        }

    def extents(self, n: int, generator: np.random.Generator) -> FloatArray:
        """Return scales of the codes of random poses: (n, D), 0 for limbs at rest, up to 1."""
        n_limbs = int(self._limb.max(initial=-1)) + 1
        if not n_limbs:
            raise LCollisionError(
                "has no joints that turn, apart from its root",
                "leave out poses by the rig",
                where=self.space.rig.joint_names[0],
            )
        # Favour poses that move several limbs.
        n_moving = generator.integers(1, n_limbs + 1, size=(n, 2)).max(axis=1)
        order = generator.random((n, n_limbs)).argsort(axis=1).argsort(axis=1)
        moving = order < n_moving[:, None]
        extents = np.zeros((n, len(self.space.low)))
        extents[:, : len(self._limb_of_code)] = (
            generator.uniform(*_SIZES, size=(n, 1)) * moving[:, self._limb_of_code]
        )
        extents[:, :ROOT_CODES] = 0.0
        return extents

    def codes(self, n: int, generator: np.random.Generator) -> FloatArray:
        """Return (n, D) random codes within the limits; every joint turns."""
        space = self.space
        # Joints of a chain turn together, and so do the fingers of a hand.
        place = generator.random((n, space.n_joints, 3))
        place = place[:, self._chain]
        fingers = np.flatnonzero([role in _FINGERS for role in space.roles])
        curl = generator.random((n, space.n_joints))[:, _hands(space)[fingers]]
        place[:, fingers, 0] += (1.0 - _CURL_SPREAD) * (curl - place[:, fingers, 0])
        low, high = self.limits[:, :, 0], self.limits[:, :, 1]
        turns = low + place * (high - low)
        # Keep bend and sideways turn within the ellipse of their limits.
        furthest = np.where(turns < 0.0, low, high)
        share = np.divide(turns, furthest, out=np.zeros_like(turns), where=furthest != 0.0)
        swing = np.hypot(share[:, :, 0], share[:, :, 2])
        turns[:, :, ::2] /= np.maximum(swing, 1.0)[:, :, None]
        codes = np.zeros((n, len(space.low)))
        axes = np.minimum(space.axis_of_code, 2)
        codes[:, : len(axes)] = turns[:, space.joint_of_code, axes]
        codes[:, :ROOT_CODES] = 0.0
        return codes
