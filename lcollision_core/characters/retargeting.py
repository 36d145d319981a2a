"""Motions of other skeletons carried over to a character's joints, and back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lcollision_core.characters.anatomy import Anatomy, anatomy_of, rig_of
from lcollision_core.characters.joint_roles import next_in_limb
from lcollision_core.characters.rig_space import RigPoseSpace
from lcollision_core.errors import MeshFileError
from lcollision_core.files.character import Character, ClipFrames, Rig
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.topology import FloatArray, Topology

_ALIGNED = (Role.UPPER_ARM, Role.FOREARM, Role.THIGH, Role.SHIN)
"""Bones that point where the other skeleton's do: in one of them the arms may hang at rest. Feet
stand flat in both, and hips, spines and collar bones are put together differently."""

_ONE_EACH = (*_ALIGNED, Role.SHOULDER, Role.HAND, Role.FOOT, Role.TOE, Role.NECK, Role.HEAD)

_NEEDED = 6
"""Of the eight bones of arms and legs: with fewer, skeletons are not of one kind."""

_SHORT = 1e-9


class SkeletonMotion(Protocol):
    """A skeleton of J joints in motion, all of them turned alike at rest; see `Bvh`."""

    @property
    def names(self) -> tuple[str, ...]:
        """J names."""

    @property
    def parents(self) -> npt.NDArray[np.int64]:
        """(J,) -1 for a root; parents come before children."""

    @property
    def offsets(self) -> FloatArray:
        """(J, 3) where each joint is at rest, seen from its parent."""

    @property
    def ends(self) -> FloatArray:
        """(J, 3) where bones end, seen from their joints; NaN where that is not known."""

    def __len__(self) -> int:
        """T, the number of frames."""

    def turns(self) -> FloatArray:
        """(T, J, 3, 3) rotations of the joints against their parents, to be changed freely."""

    def places(self) -> FloatArray:
        """(T, J, 3) places of the joints seen from their parents, to be changed freely."""


@dataclass(frozen=True, eq=False)
class Retargeting:
    """How a skeleton in motion carries a rig.

    Each joint of the rig that has a partner turns in the world as that does, from rest poses that
    are brought to point the same ways; others go along with what they hang on. The hips' way is
    scaled by the length of the legs.

    Attributes
    ----------
    motion : the skeleton
    space : of the rig
    partner : (J,) int64 array, the skeleton's joint for each of the rig's, -1 for none
    frame : (3, 3) rotation from the skeleton's axes to the character's
    aligned : (J, 3, 3) rotations, from the rig's rest pose to one that points as the skeleton's
    share : (J,) how much of its partner's turn each joint makes, where several of a spine have one
    scale : from the skeleton's unit to the character's
    """

    motion: SkeletonMotion
    space: RigPoseSpace
    partner: npt.NDArray[np.int64]
    frame: FloatArray
    aligned: FloatArray
    share: FloatArray
    scale: float

    @classmethod
    def of(cls, motion: SkeletonMotion, space: RigPoseSpace, path: Path) -> Retargeting:
        """Find partners by the joints' names, else by what they are in the body.

        Parameters
        ----------
        path : of the skeleton, for messages

        Raises
        ------
        MeshFileError : the two have too few limbs in common.
        """
        other = MeshFileError(
            "has joints that match the body's neither by name nor by place",
            "name a body with the same skeleton",
            where=path,
        )
        if len(motion.names) < _NEEDED:
            raise other
        rest, rig = _rest_places(motion), space.rig
        figure = _stick_figure(motion, rest)
        anatomy = anatomy_of(figure)
        partner = _partners(motion, anatomy, space)
        if len(_followed_limbs(partner, space)) < _NEEDED:
            raise other
        frame = _axis_rotation(_axes(space.up, space.front) @ _axes(_up(rest), anatomy.front).T)
        joints = rig.rest[:, :3, 3]
        scale = _leg_length(rig, space.roles) / _leg_length(rig_of(figure), anatomy.roles)
        next_bone = next_in_limb(rig, space.roles)
        aligned = np.broadcast_to(np.eye(3), (len(joints), 3, 3)).copy()
        for joint, (role, parent) in enumerate(zip(space.roles, rig.parents, strict=True)):
            if parent >= 0 and role not in (Role.FOOT, Role.SHOULDER, Role.SPINE):
                aligned[joint] = aligned[parent]
            below = next_bone.get(joint, joint)
            if role in _ALIGNED and min(partner[[joint, below]]) >= 0:
                way = frame @ (rest[partner[below]] - rest[partner[joint]])
                own = aligned[joint] @ (joints[below] - joints[joint])
                aligned[joint] = least_turn(own, way) @ aligned[joint]
        share = np.array(
            [
                np.count_nonzero(partner[: joint + 1] == own) / np.count_nonzero(partner == own)
                for joint, own in enumerate(partner)
            ]
        )
        return cls(motion, space, partner, frame, aligned, share, scale)

    @property
    def _hips(self) -> int:
        """The rig's joint that the skeleton places, -1 where the rig has no such root."""
        return int(self.space.joint_of_code[0])

    def transforms(self) -> FloatArray:
        """Return the global transforms of the rig's joints: (T, J, 4, 4), as `Rig.rest`."""
        rig = self.space.rig
        turns, places = in_world(self.motion)
        n_frames, n_joints = len(turns), len(rig.parents)
        moved = np.broadcast_to(np.eye(3), (n_frames, n_joints, 3, 3)).copy()
        origins = np.broadcast_to(rig.rest[:, :3, 3], (n_frames, n_joints, 3)).copy()
        for joint, parent in enumerate(rig.parents.tolist()):
            partner = int(self.partner[joint])
            if parent >= 0:
                moved[:, joint] = moved[:, parent]
                step = rig.rest[joint, :3, 3] - rig.rest[parent, :3, 3]
                origins[:, joint] = origins[:, parent] + moved[:, parent] @ step
            if partner >= 0:
                turned = turns[:, partner]
                above = int(self.motion.parents[partner])
                if self.share[joint] < 1.0 and above >= 0:
                    local = np.swapaxes(turns[:, above], 1, 2) @ turned
                    part = self.share[joint] * Rotation.from_matrix(local).as_rotvec()
                    turned = turns[:, above] @ Rotation.from_rotvec(part).as_matrix()
                moved[:, joint] = self.frame @ turned @ self.frame.T @ self.aligned[joint]
            if joint == self._hips:
                way = (places[:, partner] - self._rest_of(partner)) @ self.frame.T
                origins[:, joint] = rig.rest[joint, :3, 3] + self.scale * way
        transforms = np.broadcast_to(np.eye(4), (n_frames, n_joints, 4, 4)).copy()
        transforms[..., :3, :3] = moved @ rig.rest[:, :3, :3]
        transforms[..., :3, 3] = origins
        return transforms

    def changed(
        self, frames: Sequence[int], before: FloatArray, after: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return some frames of the skeleton that differ as the rig's do.

        Parameters
        ----------
        frames : n numbers of frames, ascending
        before, after : (n, J, 4, 4) transforms of the rig's joints

        Returns
        -------
        turns : (n, J, 3, 3) rotations of the skeleton's joints against their parents
        roots : (n, 3) places of its root
        """
        chosen = list(frames)
        turns, _ = in_world(self.motion)
        old_turns, local = turns[chosen], self.motion.turns()[chosen]
        rest = np.linalg.inv(self.space.rig.rest)
        difference = (after @ rest)[..., :3, :3] @ np.linalg.inv((before @ rest)[..., :3, :3])
        # Of several that follow one joint, the last carries what hangs on it.
        follower = {int(partner): joint for joint, partner in enumerate(self.partner)}
        new_turns = np.empty_like(old_turns)
        for joint, parent in enumerate(self.motion.parents.tolist()):
            above = new_turns[:, parent] if parent >= 0 else np.eye(3)
            if joint in follower:
                turned = self.frame.T @ difference[:, follower[joint]] @ self.frame
                new_turns[:, joint] = turned @ old_turns[:, joint]
                local[:, joint] = np.swapaxes(above, -2, -1) @ new_turns[:, joint]
            else:
                new_turns[:, joint] = above @ local[:, joint]
        roots: FloatArray = self.motion.places()[chosen, 0]
        if self._hips >= 0:
            roots += (after - before)[:, self._hips, :3, 3] @ self.frame / self.scale
        return local, roots

    def _rest_of(self, joint: int) -> FloatArray:
        """Return where a joint of the skeleton is while the character is at rest."""
        rest = _rest_places(self.motion)
        up = self.frame.T @ self.space.up
        if rest[0] @ up <= 0.0:
            # The root has no place of its own: it stands on the ground.
            ends = rest + np.nan_to_num(self.motion.ends)
            rest = rest - (ends @ up).min() * up
        place: FloatArray = rest[joint]
        return place


def in_world(motion: SkeletonMotion) -> tuple[FloatArray, FloatArray]:
    """Return the joints' turns (T, J, 3, 3) and places (T, J, 3) in the world."""
    turns, places = motion.turns(), motion.places()
    for joint, parent in enumerate(motion.parents.tolist()):
        if parent >= 0:
            moved = np.einsum("txy,ty->tx", turns[:, parent], places[:, joint])
            places[:, joint] = places[:, parent] + moved
            turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return turns, places


def _rest_places(motion: SkeletonMotion) -> FloatArray:
    places = motion.offsets.copy()
    for joint, parent in enumerate(motion.parents.tolist()):
        if parent >= 0:
            places[joint] += places[parent]
    return places


def _up(places: FloatArray) -> FloatArray:
    """Return y, or z where a skeleton is longer that way."""
    extent = np.ptp(places, axis=0)
    up: FloatArray = np.eye(3)[2 if extent[2] > extent[1] else 1]
    return up


def _stick_figure(motion: SkeletonMotion, rest: FloatArray) -> Character:
    """Return a character of lines, by which the joints are recognised."""
    has_end = np.flatnonzero(~np.isnan(motion.ends[:, 0]))
    joint_of = np.concatenate([np.arange(len(rest)), has_end]).astype(np.int32)
    vertices = np.concatenate([rest, rest[has_end] + motion.ends[has_end]])
    transforms = np.broadcast_to(np.eye(4), (len(rest), 4, 4)).copy()
    transforms[:, :3, 3] = rest
    rig = Rig(
        motion.names,
        motion.parents,
        transforms,
        np.arange(len(rest)),
        joint_of[:, None],
        np.ones((len(vertices), 1)),
        vertices[:, None],
    )
    return Character(
        "",
        Path(),
        Topology([[0, 1, 2]], len(vertices)),
        vertices,
        np.arange(len(vertices)),
        _up(rest),
        True,
        1.0,
        (),
        rig,
        {},
        lambda *_: ClipFrames("", (), np.empty(0), None, lambda: np.empty((0, 0, 3))),
    )


def _partners(
    motion: SkeletonMotion, anatomy: Anatomy, space: RigPoseSpace
) -> npt.NDArray[np.int64]:
    """Return for each joint of the rig the skeleton's joint that it follows, -1 for none."""
    names = [_plain(name) for name in space.rig.joint_names]
    own = {_plain(name): joint for joint, name in reversed(list(enumerate(motion.names)))}
    partner = np.array([own.get(name, -1) for name in names])
    if len(_followed_limbs(partner, space)) < _NEEDED:
        partner[:] = -1
    taken = set(partner.tolist())
    own_sides = _sides(anatomy.roles, anatomy.sides, motion.parents)
    in_limb = set(next_in_limb(space.rig, space.roles).values())
    for role in (*_ONE_EACH, Role.SPINE):
        for side in Side:
            theirs = _of_kind(anatomy.roles, own_sides, role, side)
            ours = _of_kind(space.roles, space.sides, role, side)
            if not theirs or not ours or (partner[ours] >= 0).any():
                continue
            if role is Role.SPINE:
                at = np.linspace(0, len(theirs) - 1, len(ours)).round().astype(int)
                partner[ours] = np.array(theirs)[at]
            elif theirs[0] not in taken:
                # Not a target of inverse kinematics, which is called so too.
                partner[min(ours, key=lambda joint: joint not in in_limb)] = theirs[0]
    hips = int(space.joint_of_code[0])
    if hips >= 0 and partner[hips] < 0:
        partner[hips] = _hips(motion, _followed_limbs(partner, space))
    return partner


def _followed_limbs(partner: npt.NDArray[np.int64], space: RigPoseSpace) -> list[int]:
    """Return the skeleton's joints that bones of the rig's arms and legs follow."""
    pairs = zip(partner.tolist(), space.roles, strict=True)
    return [joint for joint, role in pairs if joint >= 0 and role in _ALIGNED]


def _hips(motion: SkeletonMotion, joints: Sequence[int]) -> int:
    """Return the last joint that all of some hang on."""
    ways = []
    for joint in joints:
        way = [joint]
        while motion.parents[way[-1]] >= 0:
            way.append(int(motion.parents[way[-1]]))
        ways.append(set(way))
    return max(set.intersection(*ways), default=0) if ways else 0


def _sides(
    roles: Sequence[Role], sides: Sequence[Side], parents: npt.NDArray[np.integer]
) -> list[Side]:
    """Return the sides of joints; collar bones in the middle are on the side of their arm."""
    own = list(sides)
    for joint in range(len(own) - 1, 0, -1):
        parent = int(parents[joint])
        if parent >= 0 and roles[parent] is Role.SHOULDER and own[parent] is Side.MIDDLE:
            own[parent] = own[joint]
    return own


def _plain(name: str) -> str:
    return re.sub(r"[\W_]", "", re.split("[:|]", name)[-1]).casefold()


def _of_kind(roles: Sequence[Role], sides: Sequence[Side], role: Role, side: Side) -> list[int]:
    pairs = enumerate(zip(roles, sides, strict=True))
    return [joint for joint, kind in pairs if kind == (role, side)]


def _leg_length(rig: Rig, roles: Sequence[Role]) -> float:
    """Return the mean length of thigh and shin together, the rig's extent without legs."""
    places, below = rig.rest[:, :3, 3], next_in_limb(rig, roles)
    bones = [
        float(np.linalg.norm(places[below[joint]] - places[joint]))
        for joint, role in enumerate(roles)
        if role in (Role.THIGH, Role.SHIN) and joint in below
    ]
    extent = float(np.ptp(places, axis=0).max())
    return 2.0 * float(np.mean(bones)) if bones else max(extent, _SHORT)


def _axes(up: FloatArray, front: FloatArray) -> FloatArray:
    """Return left, up and front as columns."""
    return np.stack([np.cross(up, front), up, front], axis=1)


def _axis_rotation(rotation: FloatArray) -> FloatArray:
    """Return the rotation by quarter turns that is nearest to another."""
    quarters = Rotation.create_group("O").as_matrix()
    nearest: FloatArray = quarters[np.einsum("nij,ij->n", quarters, rotation).argmax()].round()
    return nearest


def least_turn(way: FloatArray, other: FloatArray) -> FloatArray:
    """Return the smallest rotation that takes one direction to another."""
    lengths = np.linalg.norm(way), np.linalg.norm(other)
    if min(lengths) < _SHORT:
        return np.eye(3)
    a, b = way / lengths[0], other / lengths[1]
    axis, cosine = np.cross(a, b), float(np.clip(a @ b, -1.0, 1.0))
    sine = float(np.linalg.norm(axis))
    if sine < _SHORT:
        # Opposite ways have no smallest turn; these are no limbs of one kind.
        return np.eye(3)
    turn: FloatArray = Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()
    return turn
