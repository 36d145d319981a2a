"""Derive a standing rest pose for skeletal motions stored without one.

Motion capture often stores each joint in its bone's axes, or a rest pose that lies down. The stored
offsets alone then form no real pose; only frames are reliable. The frame that stands best is
turned into a plain pose, with straight legs, and with head, hands and feet in their mean
orientation. It becomes the rest pose; the frames' poses do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies.anatomy import anatomy_of, axes_of, joint_roles, limb_children, rig_of
from lcollision_core.files.character import Character, Rig
from lcollision_core.files.motion.skeleton import SkeletonMotion, least_turns
from lcollision_core.meshes.joint_kinds import Role, Side, part_names
from lcollision_core.meshes.topology import FloatArray, Topology
from lcollision_core.meshes.trees import lineage

_MOST_SAMPLES, _MOST_FIGURES = 64, 8
"""Number of frames sampled, and of those in which the joint tree is recognised."""

_STRAIGHT, _UPRIGHT = 0.5, 0.5
"""Least cosines: of the legs to the trunk's extension, and of the trunk to the up axis."""

_ON_END, _NEARLY = 0.9, 0.2
"""Cosine of a trunk along z; and by how much of its legs' length a skeleton's hips may be higher or
lower in its frames than at rest."""

_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From axes with y up to those with z up."""

_SHORT = 1e-9

_AS_ON_AVERAGE = (Role.FOOT, Role.HAND, Role.NECK, Role.HEAD)


@dataclass(frozen=True, eq=False, kw_only=True)
class ReposedMotion(SkeletonMotion):
    """The same motion with another rest pose.

    Attributes
    ----------
    rest_turns : (J, 3, 3) world rotations of its joints in the new rest pose
    up : (3,) unit vector, an axis, y or z in most files
    front : (3,) unit vector, an axis; None to take it from the file's own rest pose
    frame : the frame that the rest pose was taken from, with the root at 0; None for the file's own
    """

    up: FloatArray
    rest_turns: FloatArray
    front: FloatArray | None = None
    frame: int | None = None

    @classmethod
    def of(
        cls,
        stored: SkeletonMotion,
        rest_turns: FloatArray,
        up: FloatArray,
        front: FloatArray | None = None,
        frame: int | None = None,
    ) -> ReposedMotion:
        """Give the skeleton of a file another rest pose."""
        above = _above(stored.parents, rest_turns)
        offsets = np.einsum("jxy,jy->jx", above, stored.offsets)
        if frame is not None:
            offsets = offsets * (stored.parents >= 0)[:, None]
        return cls(
            name=stored.name,
            names=stored.names,
            parents=stored.parents,
            offsets=offsets,
            ends=np.einsum("jxy,jy->jx", rest_turns, stored.ends),
            axes=stored.axes,
            times=stored.times,
            turns=above @ stored.turns @ np.swapaxes(rest_turns, 1, 2),
            places=np.einsum("jxy,tjy->tjx", above, stored.places),
            notes=stored.notes,
            rest_turns=rest_turns,
            up=up,
            front=front,
            frame=frame,
        )

    def turns_as_stored(self, turns: FloatArray) -> FloatArray:
        """Convert (n, J, 3, 3) rotations relative to the parents to those of the file."""
        above = _above(self.parents, self.rest_turns)
        stored: FloatArray = np.swapaxes(above, 1, 2) @ turns @ self.rest_turns
        return stored

    @property
    def turns_y_up(self) -> bool:
        """Whether the file's own rest pose has y up, and its frames z."""
        return self.frame is None and np.array_equal(self.rest_turns[0], _TO_Z_UP)


def _above(parents: npt.NDArray[np.int64], rest_turns: FloatArray) -> FloatArray:
    """Return the world rotation of each joint's parent at rest."""
    is_root = (parents < 0)[:, None, None]
    above: FloatArray = np.where(is_root, np.eye(3), rest_turns[parents])
    return above


@dataclass(frozen=True)
class _Landmarks:
    """Joints that determine whether a pose stands; pairs of left and right.

    Attributes
    ----------
    feet : ends of the shins
    """

    thighs: tuple[int, int]
    shins: tuple[int, int]
    feet: tuple[int, int]
    arms: tuple[int, int]
    forearms: tuple[int, int]

    @classmethod
    def of(cls, roles: Sequence[Role], sides: Sequence[Side], rig: Rig) -> _Landmarks | None:
        """Find them; None if the skeleton lacks some."""
        below = limb_children(rig, roles)
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
        """Return unit vectors from hips to shoulders, for (..., J, 3) positions."""
        return _unit(_middle(places, self.arms) - _middle(places, self.thighs))

    def axes(self, places: FloatArray, pair: tuple[int, int]) -> FloatArray:
        """Return left, up and front of the hips or the shoulders, as columns."""
        up = self.trunk(places)
        left = places[pair[0]] - places[pair[1]]
        left = _unit(left - (left @ up) * up)
        return np.stack([left, up, np.cross(left, up)], axis=1)

    def legs(self, places: FloatArray) -> FloatArray:
        """Return the mean direction of both thighs."""
        return _unit(_middle(places, self.shins) - _middle(places, self.thighs))

    def stand(self, places: FloatArray) -> bool:
        """Whether the legs extend the trunk, and left lies beside right."""
        across = places[self.thighs[0]] - places[self.thighs[1]]
        trunk = self.trunk(places)
        beside = float(np.linalg.norm(across - (across @ trunk) * trunk))
        return bool(
            trunk @ self.legs(places) < -_STRAIGHT and beside > 0.5 * np.linalg.norm(across) > 0.0
        )


def with_standing_rest(motion: SkeletonMotion) -> ReposedMotion:
    """Return a motion with a standing rest pose: its own, or one taken from its frames.

    It keeps its own if that stands, along y or the frames' up axis, or if no frame stands.
    """
    rest = rest_places(motion)
    own_turns = np.broadcast_to(np.eye(3), (len(motion.names), 3, 3))
    samples = np.linspace(0, len(motion) - 1, min(len(motion), _MOST_SAMPLES)).round().astype(int)
    turns, places = in_world(motion, samples)
    marks = _named_landmarks(motion, rest)
    of_rest = marks if marks is not None and marks.stand(rest) else None
    if marks is None:
        steps = np.linspace(0, len(places) - 1, min(len(places), _MOST_FIGURES)).round().astype(int)
        of_rest, *of_frames = (_landmarks(motion, shown) for shown in (rest, *places[steps]))
        # A bogus rest pose may look like a person with other limbs.
        marks = max(
            filter(None, (of_rest, *of_frames)),
            key=lambda own: (
                own == of_rest and own.trunk(rest)[1] > _UPRIGHT,
                of_frames.count(own),
            ),
            default=None,
        )
    if marks is None:
        return ReposedMotion.of(motion, own_turns, longer_axis(rest))
    way, mean = marks.trunk(rest), marks.trunk(places).mean(axis=0)
    up = np.eye(3)[2 if mean[2] > max(mean[1], _UPRIGHT) else 1]
    if marks == of_rest:
        if way[1] > _UPRIGHT and _stands_on_z(marks, rest, places):
            return ReposedMotion.of(motion, np.broadcast_to(_TO_Z_UP, own_turns.shape), up)
        if max(way[1], way @ up) > _UPRIGHT or mean @ up < _UPRIGHT:
            axis = int(np.abs(way).argmax())
            return ReposedMotion.of(motion, own_turns, np.sign(way[axis]) * np.eye(3)[axis])
    best = int(np.argmax([_likeness(marks, shown, up) for shown in places]))
    if not marks.stand(places[best]):
        return ReposedMotion.of(motion, own_turns, longer_axis(rest))
    hips = marks.axes(places[best], marks.thighs)
    level = hips[:, 2] * (1.0 - up)
    front = np.sign(level[np.abs(level).argmax()]) * np.eye(3)[np.abs(level).argmax()]
    upright = axes_of(up, front)
    rested = _plain_pose(motion, marks, turns, places[best], best, upright)
    return ReposedMotion.of(motion, rested, up, front, int(samples[best]))


def _stands_on_z(marks: _Landmarks, rest: FloatArray, places: FloatArray) -> bool:
    """Whether a skeleton that stands along y at rest walks on the plane z = 0 in its frames.

    One that lies there has no hips as high along z as its legs are long.
    """
    leg = float(marks.trunk(rest) @ (_middle(rest, marks.thighs) - _middle(rest, marks.feet)))
    heights = _middle(places, marks.thighs)[:, 2] / max(leg, _SHORT)
    trunk = marks.trunk(places)[:, 2]
    return bool(np.median(trunk) > _ON_END and abs(np.median(heights) - 1.0) < _NEARLY)


def _named_landmarks(motion: SkeletonMotion, rest: FloatArray) -> _Landmarks | None:
    """Return the landmarks found by the joints' names."""
    rig = rig_of(stick_figure(motion, rest, longer_axis(rest)))
    called = {"Left": Side.LEFT, "Right": Side.RIGHT}
    words = [(name or "").split(" ")[0] for name in part_names(motion.names)]
    sides = [called.get(word, Side.MIDDLE) for word in words]
    return _Landmarks.of(joint_roles(rig), sides, rig)


def _landmarks(motion: SkeletonMotion, places: FloatArray) -> _Landmarks | None:
    """Return the landmarks of a standing pose found by the joint tree; else None."""
    figure = stick_figure(motion, places, longer_axis(places))
    anatomy = anatomy_of(figure)
    marks = _Landmarks.of(anatomy.roles, anatomy.sides, rig_of(figure))
    return marks if marks is not None and marks.stand(places) else None


def _likeness(marks: _Landmarks, places: FloatArray, up: FloatArray) -> float:
    """Return a score for a standing frame: upright, legs down, arms symmetric."""
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
    """Return (J, 3, 3) world rotations of the joints in a plain standing pose.

    Parameters
    ----------
    turns : (N, J, 3, 3) world rotations of some frames
    places : (J, 3) positions in the standing frame
    frame : its index among the frames
    upright : (3, 3) left, up and front of the plain pose, as columns
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
            usual = scipy.spatial.transform.Rotation.from_matrix(local).mean().as_matrix()
            correction = rested[parent] @ usual @ turns[frame, joint].T
        corrections[joint] = correction
        rested[joint] = correction @ turns[frame, joint]
    return rested


def _chest(motion: SkeletonMotion, marks: _Landmarks) -> int:
    """Return the last joint above both arms, -1 if it is also a parent of the thighs."""
    chest = common_ancestor(motion, marks.arms)
    above_thighs = {int(motion.parents[thigh]) for thigh in marks.thighs}
    return -1 if chest in above_thighs else chest


def common_ancestor(motion: SkeletonMotion, joints: Sequence[int]) -> int:
    """Return the last joint that is an ancestor of, or equal to, all given joints."""
    ways = [set(lineage(motion.parents, joint)) for joint in joints]
    return max(set.intersection(*ways), default=0) if ways else 0


def in_world(
    motion: SkeletonMotion, frames: npt.NDArray[np.int64] | slice = slice(None)
) -> tuple[FloatArray, FloatArray]:
    """Return world rotations (T, J, 3, 3) and positions (T, J, 3) of the joints in some frames."""
    turns, places = motion.turns[frames].copy(), motion.places[frames].copy()
    for joint, parent in enumerate(motion.parents.tolist()):
        if parent >= 0:
            moved = np.einsum("txy,ty->tx", turns[:, parent], places[:, joint])
            places[:, joint] = places[:, parent] + moved
            turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return turns, places


def rest_places(motion: SkeletonMotion) -> FloatArray:
    """Return the joint positions at rest: (J, 3)."""
    places = motion.offsets.copy()
    for joint, parent in enumerate(motion.parents.tolist()):
        if parent >= 0:
            places[joint] += places[parent]
    return places


def longer_axis(places: FloatArray) -> FloatArray:
    """Return y, or z if a skeleton is longer along it."""
    extent = np.ptp(places, axis=0)
    up: FloatArray = np.eye(3)[2 if extent[2] > extent[1] else 1]
    return up


def stick_figure(motion: SkeletonMotion, rest: FloatArray, up: FloatArray) -> Character:
    """Return a minimal character made of joints and bone ends, to recognise the joints."""
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
    topology = Topology([[0, 1, 2]], len(vertices))
    return Character.without_clips(Path(), topology, vertices, up, rig)


def least_turn(way: FloatArray, other: FloatArray) -> FloatArray:
    """Return the smallest rotation from one direction to another: see `least_turns`."""
    turn: FloatArray = least_turns(way[None], other[None])[0]
    return turn


def _middle(places: FloatArray, pair: tuple[int, int]) -> FloatArray:
    middle: FloatArray = places[..., list(pair), :].mean(axis=-2)
    return middle


def _unit(vectors: FloatArray) -> FloatArray:
    """Normalise (..., 3) vectors; vectors of no length stay."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: FloatArray = vectors / np.where(lengths > _SHORT, lengths, 1.0)
    return units
