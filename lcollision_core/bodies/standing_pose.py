"""A standing rest pose for skeletons in motion that are stored without one.

Motion capture often stores each joint in the axes of its own bone, or a rest pose that lies. The
offsets of such a file, put together, are nobody's pose; only its frames are certain. One frame that
stands is brought to a plain pose, with straight legs, and with head, hands and feet as they are on
average. It becomes the rest pose; no limb of any frame is turned by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.skeletons import anatomy_of, joint_roles, next_in_limb, rig_of
from lcollision_core.files.character import Character, ClipFrames, Rig
from lcollision_core.files.motion.node_motion import least_turns
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.part_names import part_names
from lcollision_core.meshes.topology import FloatArray, Topology

_MOST_SAMPLES, _MOST_FIGURES = 64, 8
"""Frames that are looked at, and those of them in which joints are sought by the tree."""

_STRAIGHT, _UPRIGHT = 0.5, 0.5
"""Cosines: of legs to the trunk drawn out, of a trunk to an axis."""

_SHORT = 1e-9

_AS_ON_AVERAGE = (Role.FOOT, Role.HAND, Role.NECK, Role.HEAD)


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
class RestedMotion:
    """A skeleton in motion with another rest pose; it shows the same.

    Attributes
    ----------
    stored : the skeleton as its file has it
    rest_turns : (J, 3, 3) rotations of its joints in the world, in the other rest pose
    up : (3,) unit vector, an axis
    front : (3,) unit vector, an axis; None where the file's own rest pose has to tell
    frame : of the motion that gave the rest pose; None where that is the file's own
    """

    stored: SkeletonMotion
    rest_turns: FloatArray
    up: FloatArray
    front: FloatArray | None = None
    frame: int | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """J names."""
        return self.stored.names

    @property
    def parents(self) -> npt.NDArray[np.int64]:
        """(J,) -1 for a root."""
        return self.stored.parents

    @property
    def offsets(self) -> FloatArray:
        """(J, 3) where each joint is at rest, seen from its parent; a frame says no place."""
        offsets: FloatArray = np.einsum("jxy,jy->jx", self._above(), self.stored.offsets)
        return offsets if self.frame is None else offsets * (self.parents >= 0)[:, None]

    @property
    def ends(self) -> FloatArray:
        """(J, 3) where bones end, seen from their joints."""
        ends: FloatArray = np.einsum("jxy,jy->jx", self.rest_turns, self.stored.ends)
        return ends

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.stored)

    def turns(self) -> FloatArray:
        """Return (T, J, 3, 3) rotations of the joints against their parents."""
        turns: FloatArray = self._above() @ self.stored.turns()
        return turns @ np.swapaxes(self.rest_turns, 1, 2)

    def places(self) -> FloatArray:
        """Return (T, J, 3) places of the joints seen from their parents."""
        places: FloatArray = np.einsum("jxy,tjy->tjx", self._above(), self.stored.places())
        return places

    def turns_as_stored(self, turns: FloatArray) -> FloatArray:
        """Return (n, J, 3, 3) rotations against the parents as the file has them."""
        stored: FloatArray = np.swapaxes(self._above(), 1, 2) @ turns @ self.rest_turns
        return stored

    def _above(self) -> FloatArray:
        """Return how the parent of each joint is turned at rest."""
        is_root = (self.parents < 0)[:, None, None]
        above: FloatArray = np.where(is_root, np.eye(3), self.rest_turns[self.parents])
        return above


@dataclass(frozen=True)
class _Landmarks:
    """Joints by which a pose is told to stand; each a left and a right one.

    Attributes
    ----------
    feet : where shins end
    """

    thighs: tuple[int, int]
    shins: tuple[int, int]
    feet: tuple[int, int]
    arms: tuple[int, int]
    forearms: tuple[int, int]

    @classmethod
    def of(cls, roles: Sequence[Role], sides: Sequence[Side], rig: Rig) -> _Landmarks | None:
        """Find them; None where the skeleton lacks some."""
        below = next_in_limb(rig, roles)
        limbs = []
        for role in (Role.THIGH, Role.UPPER_ARM):
            firsts = {
                side: joint
                for joint, (own, side) in enumerate(zip(roles, sides, strict=True))
                if own is role and joint in below
            }
            if not {Side.LEFT, Side.RIGHT} <= firsts.keys():
                return None
            left, right = firsts[Side.LEFT], firsts[Side.RIGHT]
            hinges = below[left], below[right]
            ends = below.get(hinges[0], hinges[0]), below.get(hinges[1], hinges[1])
            limbs += [(left, right), hinges, ends]
        return cls(*limbs[:5])

    def trunk(self, places: FloatArray) -> FloatArray:
        """Return the ways from the hips to the shoulders, of (..., J, 3) places."""
        return _unit(_middle(places, self.arms) - _middle(places, self.thighs))

    def axes(self, places: FloatArray, pair: tuple[int, int]) -> FloatArray:
        """Return left, up and front of the hips or the shoulders as columns."""
        up = self.trunk(places)
        left = places[pair[0]] - places[pair[1]]
        left = _unit(left - (left @ up) * up)
        return np.stack([left, up, np.cross(left, up)], axis=1)

    def legs(self, places: FloatArray) -> FloatArray:
        """Return the mean ways of both thighs."""
        return _unit(_middle(places, self.shins) - _middle(places, self.thighs))

    def stand(self, places: FloatArray) -> bool:
        """Whether legs draw out the trunk, and left is beside right."""
        across = places[self.thighs[0]] - places[self.thighs[1]]
        trunk = self.trunk(places)
        beside = float(np.linalg.norm(across - (across @ trunk) * trunk))
        return bool(
            trunk @ self.legs(places) < -_STRAIGHT and beside > 0.5 * np.linalg.norm(across) > 0.0
        )


def with_standing_rest(motion: SkeletonMotion) -> RestedMotion:
    """Return a motion whose rest pose stands: its own, or one that its frames show.

    It keeps its own where that stands along y or as its frames do, and where no frame stands.
    """
    rest = rest_places(motion)
    own_turns = np.broadcast_to(np.eye(3), (len(motion.names), 3, 3))
    as_stored = RestedMotion(motion, own_turns, longer_axis(rest))
    samples = np.linspace(0, len(motion) - 1, min(len(motion), _MOST_SAMPLES)).round().astype(int)
    turns, places = in_world(motion, samples)
    marks = _named_landmarks(motion, rest)
    of_rest = marks if marks is not None and marks.stand(rest) else None
    if marks is None:
        steps = np.linspace(0, len(places) - 1, min(len(places), _MOST_FIGURES)).round().astype(int)
        of_rest, *of_frames = (_landmarks(motion, shown) for shown in (rest, *places[steps]))
        # A rest pose that is none may look like a person, with other limbs.
        marks = max(
            filter(None, (of_rest, *of_frames)),
            key=lambda own: (
                own == of_rest and own.trunk(rest)[1] > _UPRIGHT,
                of_frames.count(own),
            ),
            default=None,
        )
    if marks is None:
        return as_stored
    stands = marks == of_rest
    mean = marks.trunk(places).mean(axis=0)
    up = np.eye(3)[2 if mean[2] > max(mean[1], _UPRIGHT) else 1]
    own_way = marks.trunk(rest)
    is_level = mean @ up < _UPRIGHT
    if stands and (own_way[1] > _UPRIGHT or own_way @ up > _UPRIGHT or is_level):
        return as_stored
    best = int(np.argmax([_likeness(marks, shown, up) for shown in places]))
    if not marks.stand(places[best]):
        return as_stored
    hips = marks.axes(places[best], marks.thighs)
    level = hips[:, 2] * (1.0 - up)
    front = np.sign(level[np.abs(level).argmax()]) * np.eye(3)[np.abs(level).argmax()]
    upright = np.stack([np.cross(up, front), up, front], axis=1)
    rested = _plain_pose(motion, marks, turns, places[best], best, upright)
    return RestedMotion(motion, rested, up, front, int(samples[best]))


def _named_landmarks(motion: SkeletonMotion, rest: FloatArray) -> _Landmarks | None:
    """Return the landmarks that the joints' names tell."""
    rig = rig_of(stick_figure(motion, rest, longer_axis(rest)))
    called = {"Left": Side.LEFT, "Right": Side.RIGHT}
    words = [(name or "").split(" ")[0] for name in part_names(motion.names)]
    sides = [called.get(word, Side.MIDDLE) for word in words]
    return _Landmarks.of(joint_roles(rig), sides, rig)


def _landmarks(motion: SkeletonMotion, places: FloatArray) -> _Landmarks | None:
    """Return the landmarks of a pose that stands, by the tree; None of others."""
    figure = stick_figure(motion, places, longer_axis(places))
    anatomy = anatomy_of(figure)
    marks = _Landmarks.of(anatomy.roles, anatomy.sides, rig_of(figure))
    return marks if marks is not None and marks.stand(places) else None


def _likeness(marks: _Landmarks, places: FloatArray, up: FloatArray) -> float:
    """Return how much a frame stands: upright, legs down, one arm as the other."""
    shins = _unit(places[list(marks.feet)] - places[list(marks.shins)])
    arms = _unit(places[list(marks.forearms)] - places[list(marks.arms)]) @ marks.axes(
        places, marks.thighs
    )
    alike = float(arms[0] @ (arms[1] * [-1.0, 1.0, 1.0]))
    legs = float(marks.legs(places) @ -up) + 0.5 * float((shins @ -up).sum())
    return float(marks.trunk(places) @ up) + legs + 0.5 * alike


def _plain_pose(
    motion: SkeletonMotion,
    marks: _Landmarks,
    turns: FloatArray,
    places: FloatArray,
    frame: int,
    upright: FloatArray,
) -> FloatArray:
    """Return (J, 3, 3) rotations of the joints in the world in a plain standing pose.

    Parameters
    ----------
    turns : (N, J, 3, 3) of some frames, in the world
    places : (J, 3) of the frame that stands
    frame : its number among them
    upright : (3, 3) left, up and front of the plain pose as columns
    """
    up = upright[:, 1]
    corrections: dict[int, FloatArray] = {-1: upright @ marks.axes(places, marks.thighs).T}
    chest = _chest(motion, marks)
    roles = anatomy_of(stick_figure(motion, places, up))
    straight = dict(zip((*marks.thighs, *marks.shins), (*marks.shins, *marks.feet), strict=True))
    rested: FloatArray = turns[frame].copy()
    for joint, parent in enumerate(motion.parents.tolist()):
        correction = corrections[parent]
        if joint == chest:
            correction = upright @ marks.axes(places, marks.arms).T
        elif joint in straight:
            way = corrections[-1] @ (places[straight[joint]] - places[joint])
            correction = least_turn(way, -up) @ corrections[-1]
        elif parent >= 0 and roles.roles[joint] in _AS_ON_AVERAGE:
            local = np.swapaxes(turns[:, parent], 1, 2) @ turns[:, joint]
            usual = Rotation.from_matrix(local).mean().as_matrix()
            correction = rested[parent] @ usual @ turns[frame, joint].T
        corrections[joint] = correction
        rested[joint] = correction @ turns[frame, joint]
    return rested


def _chest(motion: SkeletonMotion, marks: _Landmarks) -> int:
    """Return the last joint that both arms hang on, -1 where that is the hips' as well."""
    chest = last_in_common(motion, marks.arms)
    above_thighs = {int(motion.parents[thigh]) for thigh in marks.thighs}
    return -1 if chest in above_thighs else chest


def last_in_common(motion: SkeletonMotion, joints: Sequence[int]) -> int:
    """Return the last joint that all of some hang on, or are."""
    ways = []
    for joint in joints:
        way = [joint]
        while motion.parents[way[-1]] >= 0:
            way.append(int(motion.parents[way[-1]]))
        ways.append(set(way))
    return max(set.intersection(*ways), default=0) if ways else 0


def in_world(
    motion: SkeletonMotion, frames: npt.NDArray[np.int64] | slice = slice(None)
) -> tuple[FloatArray, FloatArray]:
    """Return the joints' turns (T, J, 3, 3) and places (T, J, 3) in the world, of some frames."""
    turns, places = motion.turns()[frames], motion.places()[frames]
    for joint, parent in enumerate(motion.parents.tolist()):
        if parent >= 0:
            moved = np.einsum("txy,ty->tx", turns[:, parent], places[:, joint])
            places[:, joint] = places[:, parent] + moved
            turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return turns, places


def rest_places(motion: SkeletonMotion) -> FloatArray:
    """Return where the joints are at rest: (J, 3)."""
    places = motion.offsets.copy()
    for joint, parent in enumerate(motion.parents.tolist()):
        if parent >= 0:
            places[joint] += places[parent]
    return places


def longer_axis(places: FloatArray) -> FloatArray:
    """Return y, or z where a skeleton is longer that way."""
    extent = np.ptp(places, axis=0)
    up: FloatArray = np.eye(3)[2 if extent[2] > extent[1] else 1]
    return up


def stick_figure(motion: SkeletonMotion, rest: FloatArray, up: FloatArray) -> Character:
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
        up,
        True,
        1.0,
        (),
        rig,
        {},
        lambda *_: ClipFrames("", (), np.empty(0), None, lambda: np.empty((0, 0, 3))),
    )


def least_turn(way: FloatArray, other: FloatArray) -> FloatArray:
    """Return the smallest rotation that takes one direction to another: see `least_turns`."""
    turn: FloatArray = least_turns(way[None], other[None])[0]
    return turn


def _middle(places: FloatArray, pair: tuple[int, int]) -> FloatArray:
    middle: FloatArray = places[..., list(pair), :].mean(axis=-2)
    return middle


def _unit(vectors: FloatArray) -> FloatArray:
    """Return (..., 3) vectors of length 1; what has no length stays."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: FloatArray = vectors / np.where(lengths > _SHORT, lengths, 1.0)
    return units
