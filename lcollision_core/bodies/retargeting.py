"""Retarget motions between skeletons, and write skeletal motion files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.anatomy import Anatomy, anatomy_of, axes_of, limb_children, rig_of
from lcollision_core.bodies.body import Body
from lcollision_core.bodies.partners import (
    ALIGNED,
    LEAST_JOINTS,
    N_SEGMENTS,
    JointMatch,
    finger_joints,
    followed_limbs,
    match_by_name,
    match_of,
    partners,
    unsure_joints,
    user_joint_map,
    with_chosen_roles,
)
from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.bodies.standing_pose import (
    ReposedMotion,
    in_world,
    least_turn,
    rest_places,
    stick_figure,
    with_standing_rest,
)
from lcollision_core.errors import MeshFileError, listed
from lcollision_core.files.character import Character, Rig
from lcollision_core.files.character_reading import is_gltf
from lcollision_core.files.formats import BVH_SUFFIX, SKELETON_SUFFIXES, VRMA_SUFFIX
from lcollision_core.files.gltf.read import human_bones
from lcollision_core.files.motion.bvh import Bvh, bvh_bytes, depth_first, read_bvh
from lcollision_core.files.motion.generated import is_generated, read_generated
from lcollision_core.files.motion.skeleton import (
    SkeletonMotion,
    motions_of_scene,
    nearest_axes,
    relative_to_parents,
    rotations_of,
)
from lcollision_core.files.motion.smpl import is_smpl_motion, read_smpl_motion, skeleton_of_smpl
from lcollision_core.files.motion.vrma import read_vrma, vrma_bytes
from lcollision_core.files.safe import write_bytes
from lcollision_core.files.scene.scene import nearest_above
from lcollision_core.files.scene.transforms import from_rotation_vectors, rotation_vectors
from lcollision_core.files.scene_files import as_file_error, read_skeleton_scene
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.meshes.trees import lineage
from lcollision_core.motion import NOMINAL_RATE, Motion

_SHORT, _SHORT_BONE = 1e-9, 0.02
"""Length regarded as zero; and the share of the size below which a bone has no clear direction."""

_MOST_ALIKE, _UPRIGHT = 0.8, 0.9
"""Least share of equally aligned bones for equal rigs; and least cosine of an upright trunk."""

_NEARLY = 0.2
"""Share of the length of the legs that decides between two places on the ground."""


@dataclass(frozen=True, eq=False)
class Retargeting:
    """A mapping of a skeleton's motion to a rig.

    Each joint of the rig with a partner takes the partner's world rotation, relative to rest poses
    whose limbs are aligned; other joints follow their parents. The hips' translation is scaled by
    the length of the legs.

    Attributes
    ----------
    motion : the skeleton, with a standing rest pose
    space : of the rig
    partner : (J,) int64 array, the skeleton joint of each rig joint, -1 for none
    frame : (3, 3) rotation from the skeleton's axes to the character's
    aligned : (J, 3, 3) rotations from the rig's rest pose to one aligned with the skeleton's
    share : (J,) share of the partner's turn in each joint, as several spine joints may share one
    scale : from the skeleton's unit to the character's
    is_same_rig : whether both are the same rig, so that positions match too
    """

    motion: ReposedMotion
    space: RigPoseSpace
    partner: npt.NDArray[np.int64]
    frame: FloatArray
    aligned: FloatArray
    share: FloatArray
    scale: float
    is_same_rig: bool = False

    @classmethod
    def of(cls, stored: SkeletonMotion, space: RigPoseSpace, path: Path) -> Retargeting:
        """Match joints by name, else by role, and build the mapping.

        Parameters
        ----------
        path : of the skeleton, for messages

        Raises
        ------
        MeshFileError : they share too few limbs.
        """
        other = MeshFileError(
            "has joints that match the body's neither by name nor by place",
            "name a body with the same skeleton",
            where=path,
        )
        if len(stored.names) < LEAST_JOINTS:
            raise other
        same = _as_the_rig(stored, space)
        motion = same or with_standing_rest(stored)
        rest, rig = rest_places(motion), space.rig
        figure, anatomy, partner, _ = _matched(motion, rest, space, path)
        if len(followed_limbs(partner, space)) < LEAST_JOINTS:
            raise other
        axes = space.body_axes @ axes_of(motion.up, anatomy.front).T
        frame = nearest_axes(axes[None])
        joints = rig.rest[:, :3, 3]
        scale = _leg_length(rig, space.roles) / _leg_length(rig_of(figure), anatomy.roles)
        next_bone = limb_children(rig, space.roles)
        aligned = np.broadcast_to(np.eye(3), (len(joints), 3, 3)).copy()
        for joint, (role, parent) in enumerate(zip(space.roles, rig.parents, strict=True)):
            if parent >= 0 and role not in (Role.FOOT, Role.SHOULDER, Role.SPINE):
                aligned[joint] = aligned[parent]
            below = next_bone.get(joint, joint)
            if role in ALIGNED and min(partner[[joint, below]]) >= 0:
                way = frame @ (rest[partner[below]] - rest[partner[joint]])
                bone = aligned[joint] @ (joints[below] - joints[joint])
                aligned[joint] = least_turn(bone, way) @ aligned[joint]
        share = np.array(
            [
                np.count_nonzero(partner[: joint + 1] == own) / np.count_nonzero(partner == own)
                for joint, own in enumerate(partner)
            ]
        )
        # A VRM animation has the T pose of its own body, on the ground.
        is_same = same is not None and path.suffix.lower() != VRMA_SUFFIX
        return cls(motion, space, partner, frame, aligned, share, scale, is_same)

    @property
    def _hips(self) -> int:
        """The rig's joint that the skeleton translates, -1 if the rig has no such root."""
        return int(self.space.joint_of_code[0])

    def transforms(self) -> FloatArray:
        """Return the global transforms of the rig's joints: (T, J, 4, 4), as in `Rig.rest`."""
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
                    part = self.share[joint] * rotation_vectors(local)
                    turned = turns[:, above] @ from_rotation_vectors(part)
                moved[:, joint] = self.frame @ turned @ self.frame.T @ self.aligned[joint]
            if joint == self._hips:
                way = (places[:, partner] - self._rest_of(partner, places)) @ self.frame.T
                origins[:, joint] = rig.rest[joint, :3, 3] + self.scale * way
        transforms = np.broadcast_to(np.eye(4), (n_frames, n_joints, 4, 4)).copy()
        transforms[..., :3, :3] = moved @ rig.rest[:, :3, :3]
        transforms[..., :3, 3] = origins
        return transforms

    def changed(
        self, frames: Sequence[int], before: FloatArray, after: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Apply changes of the rig's frames to the skeleton's.

        Parameters
        ----------
        frames : indices of n frames, ascending
        before, after : (n, J, 4, 4) transforms of the rig's joints

        Returns
        -------
        turns : (n, J, 3, 3) rotations of the skeleton's joints relative to their parents
        roots : (n, 3) positions of its root
        """
        frame_numbers = list(frames)
        turns, _ = in_world(self.motion)
        old_turns, local = turns[frame_numbers], self.motion.turns[frame_numbers]
        rest = np.linalg.inv(self.space.rig.rest)
        difference = (after @ rest)[..., :3, :3] @ np.linalg.inv((before @ rest)[..., :3, :3])
        # If several joints follow one, the last carries its children.
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
        roots: FloatArray = self.motion.places[frame_numbers, 0]
        if self._hips >= 0:
            roots += (after - before)[:, self._hips, :3, 3] @ self.frame / self.scale
        return self.motion.turns_as_stored(local), roots

    def _rest_of(self, joint: int, places: FloatArray) -> FloatArray:
        """Return the position of a skeleton joint when the character is at rest.

        Parameters
        ----------
        places : (T, J, 3) positions of the joints in the frames
        """
        if self.is_same_rig:
            joint_rest: FloatArray = (
                self.space.rig.rest[self._hips, :3, 3] @ self.frame / self.scale
            )
            return joint_rest
        rest = rest_places(self.motion)
        up = self.frame.T @ self.space.up
        if self._begins_on_ground(rest @ up, float((places @ up).min())):
            ends = rest + np.nan_to_num(self.motion.ends)
            rest = rest - (ends @ up).min() * up
        place: FloatArray = rest[joint]
        return place

    def _begins_on_ground(self, heights: FloatArray, lowest: float) -> bool:
        """Whether the skeleton stands on the ground when at rest, wherever its file places it.

        The frames show which: their lowest joint is near the ground, or as low as at rest. In
        doubt, a root stored in the ground has no position of its own. In a BVH file a root may be
        stored anywhere, as the positions of the frames replace that.

        Parameters
        ----------
        heights : (J,) heights of the joints as stored at rest
        lowest : height of the lowest joint in the frames
        """
        leg = _leg_length(self.space.rig, self.space.roles) / self.scale
        nearer = abs(lowest - float(heights.min())) - abs(lowest)
        if heights[0] <= 0.0:
            return nearer > -_NEARLY * leg
        return self.motion.axes is None and nearer > _NEARLY * leg


def _matched(
    motion: ReposedMotion, rest: FloatArray, space: RigPoseSpace, path: Path
) -> tuple[Character, Anatomy, npt.NDArray[np.int64], frozenset[str]]:
    """Return a skeleton's figure, its anatomy, each rig joint's partner, and unsure joints.

    Parameters
    ----------
    rest : (J, 3) positions of its joints
    """
    chosen_partners = user_joint_map(motion, space, path)
    figure = with_chosen_roles(stick_figure(motion, rest, motion.up), chosen_partners, space)
    anatomy = _facing(anatomy_of(figure), motion.front)
    partner = partners(motion, anatomy, space, chosen_partners)
    unsure: frozenset[str] = frozenset()
    if not chosen_partners:
        unsure = unsure_joints(partner, figure, anatomy, space)
    elif len(followed_limbs(partner, space)) < LEAST_JOINTS:
        # Choices that are too few to move the limbs are asked for again.
        kinds = zip(space.rig.joint_names, space.roles, partner, strict=True)
        unsure = frozenset(name for name, role, other in kinds if role in ALIGNED and other < 0)
    return figure, anatomy, partner, unsure


def joint_match(body: Body, path: Path) -> JointMatch | None:
    """Return how a body's joints match those of a file's motions.

    None if the body has no joints, or the file's skeleton has too few.

    Raises
    ------
    MeshFileError : the file is damaged.
    """
    if not isinstance(body, RigBody):
        return None
    motion = _skeleton_motions(path, most=_MOST_LOOKED_AT)[0]
    if len(motion.names) < LEAST_JOINTS:
        return None
    rested = with_standing_rest(motion)
    *_, partner, unsure = _matched(rested, rest_places(rested), body.space, path)
    return match_of(partner, unsure, motion.names, body)


def _facing(anatomy: Anatomy, front: FloatArray | None) -> Anatomy:
    """Return an anatomy with a given front, if known."""
    if front is None:
        return anatomy
    if anatomy.front @ front > 0.0:
        return replace(anatomy, front=front)
    other = {Side.LEFT: Side.RIGHT, Side.RIGHT: Side.LEFT, Side.MIDDLE: Side.MIDDLE}
    return replace(anatomy, front=front, sides=tuple(other[side] for side in anatomy.sides))


_SAME_BONE, _ALIKE, _TWISTED = np.cos(np.radians([5.0, 30.0, 60.0]))
"""Least cosines: for bones of limbs and for other bones in the axes of equal rigs, and for the
twist of a hinge, which no pose makes."""


def _as_the_rig(motion: SkeletonMotion, space: RigPoseSpace) -> ReposedMotion | None:
    """Return a motion of a rig's own joints with the rig's rest pose; None for other joints.

    Joints are the rig's own if they have its names and their bones have the same local directions,
    whatever pose the file stores, and whatever their lengths.
    """
    rig, partner = space.rig, match_by_name(motion, space)
    if motion.axes is None or len(followed_limbs(partner, space)) < LEAST_JOINTS:
        return None
    axes, places, cosines = rotations_of(rig.rest), rig.rest[:, :3, 3], list[float]()
    in_limb, size = limb_children(rig, space.roles), float(np.ptp(rig.rest[:, :3, 3], axis=0).max())
    for joint, parent in enumerate(rig.parents.tolist()):
        other, above = int(partner[joint]), int(partner[parent])
        if parent < 0 or min(other, above) < 0 or motion.parents[other] != above:
            continue
        bone = axes[parent].T @ (places[joint] - places[parent])
        theirs = motion.axes[above].T @ motion.offsets[other]
        lengths = np.linalg.norm(bone), np.linalg.norm(theirs)
        if lengths[0] < _SHORT_BONE * size or lengths[1] < _SHORT:
            continue
        cosine = float(bone @ theirs / (lengths[0] * lengths[1]))
        if space.roles[parent] in ALIGNED and in_limb.get(parent) == joint:
            turned = axes[parent].T @ axes[joint] @ motion.axes[other].T @ motion.axes[above]
            is_hinge = space.roles[joint] in (Role.FOREARM, Role.SHIN)
            if cosine < _SAME_BONE or (is_hinge and _twist(turned, bone) < _TWISTED):
                return None
        cosines.append(cosine)
    if not cosines or np.mean(np.array(cosines) > _ALIKE) < _MOST_ALIKE:
        return None
    frame = _axes_of_rig(motion, space, partner, axes)
    rested = motion.axes.copy()
    for joint, parent in enumerate(motion.parents.tolist()):
        if joint in partner:
            rested[joint] = frame.T @ axes[int(np.flatnonzero(partner == joint)[0])]
        elif parent >= 0:
            rested[joint] = rested[parent] @ motion.axes[parent].T @ motion.axes[joint]
    turns: FloatArray = rested @ np.swapaxes(motion.axes, 1, 2)
    return ReposedMotion.of(motion, turns, space.up @ frame, space.front @ frame)


def _axes_of_rig(
    motion: SkeletonMotion,
    space: RigPoseSpace,
    partner: npt.NDArray[np.int64],
    axes: FloatArray,
) -> FloatArray:
    """Return the rotation from the axes of a rig's own motion to the rig's.

    It is the one in which the trunk is stored nearly as in the rig; if the trunk lies, it is
    restricted to those that match the file's up axis.

    Parameters
    ----------
    axes : (J, 3, 3) rotations of the rig's joints at rest
    """
    assert motion.axes is not None
    trunk = [
        joint
        for joint, role in enumerate(space.roles)
        if partner[joint] >= 0 and (role is Role.SPINE or joint == space.joint_of_code[0])
    ] or np.flatnonzero(partner >= 0).tolist()
    between = axes[trunk] @ np.swapaxes(motion.axes[partner[trunk]], 1, 2)
    frame = nearest_axes(between)
    is_near = np.einsum("ij,nij->", frame, between) > (1.0 + 2.0 * _UPRIGHT) * len(trunk)
    if is_near or motion.up is None:
        return frame
    return nearest_axes(between, motion.up, space.up)


def _twist(turn: FloatArray, axis: FloatArray) -> float:
    """Return the cosine of a rotation's twist about an axis."""
    about = least_turn(axis, turn @ axis).T @ turn
    return float(0.5 * (np.trace(about) - 1.0))


def _leg_length(rig: Rig, roles: Sequence[Role]) -> float:
    """Return the mean length of thigh plus shin; without legs, the rig's extent."""
    places, below = rig.rest[:, :3, 3], limb_children(rig, roles)
    bones = [
        float(np.linalg.norm(places[below[joint]] - places[joint]))
        for joint, role in enumerate(roles)
        if role in (Role.THIGH, Role.SHIN) and joint in below
    ]
    extent = float(np.ptp(places, axis=0).max())
    return max(2.0 * float(np.mean(bones)) if bones else extent, _SHORT)


_LIMBS = {
    Role.SHOULDER: "Shoulder",
    Role.UPPER_ARM: "UpperArm",
    Role.FOREARM: "LowerArm",
    Role.HAND: "Hand",
    Role.THIGH: "UpperLeg",
    Role.SHIN: "LowerLeg",
    Role.FOOT: "Foot",
    Role.TOE: "Toes",
}
_PHALANGES = {
    Role.THUMB: ("Metacarpal", "Proximal", "Distal"),
    Role.FINGER: ("Proximal", "Intermediate", "Distal"),
}
_SPINE = ("spine", "chest", "upperChest")

_NEEDED = (
    *("hips", "spine", "head"),
    *(
        f"{side}{_LIMBS[role]}"
        for side in ("left", "right")
        for role in _LIMBS
        if role not in (Role.SHOULDER, Role.TOE)
    ),
)
"""Bones that VRM requires of a humanoid."""


@dataclass(frozen=True, eq=False)
class _Moved:
    """A moving rig, in axes with x to its left, y up and z to its front.

    Attributes
    ----------
    rest : (J, 3) joint positions at rest
    turns : (T, J, 3, 3) world rotations of the joints from the rest pose
    places : (T, J, 3) joint positions
    """

    rest: FloatArray
    turns: FloatArray
    places: FloatArray

    @classmethod
    def of(cls, space: RigPoseSpace, transforms: FloatArray) -> _Moved:
        axes = space.to_body
        linear = transforms[..., :3, :3] @ np.linalg.inv(space.rig.rest[:, :3, :3])
        # Leave out what a skeleton cannot represent, such as scaled joints.
        left, _, right = np.linalg.svd(linear)
        return cls(
            space.rig.rest[:, :3, 3] @ axes.T,
            axes @ (left @ right) @ axes.T,
            transforms[..., :3, 3] @ axes.T,
        )


def bvh_of(space: RigPoseSpace, transforms: FloatArray, frame_time: float) -> bytes:
    """Return a BVH file of a moving rig: y up, z to its front, in its own unit.

    The rest pose is the rig's. Several roots get a common parent at the origin.

    Parameters
    ----------
    transforms : (T, J, 4, 4) global transforms of the joints, as in `Rig.rest`
    frame_time : seconds between frames
    """
    moved, parents = _Moved.of(space, transforms), _one_tree(space.rig)
    names, ends = list(space.rig.joint_names), _ends(space)
    if len(parents) > len(names):
        names = ["root", *names]
        ends = np.concatenate([np.zeros((1, 3)), ends])
        still = np.broadcast_to(np.eye(3), (len(transforms), 1, 3, 3))
        moved = _Moved(
            np.concatenate([np.zeros((1, 3)), moved.rest]),
            np.concatenate([still, moved.turns], axis=1),
            np.concatenate([np.zeros((len(transforms), 1, 3)), moved.places], axis=1),
        )
    from_parents = relative_to_parents(parents, moved.turns, moved.places)
    return bvh_bytes(names, parents, moved.rest, ends, *from_parents, frame_time)


def transforms_from_bvh(space: RigPoseSpace, bvh: Bvh) -> FloatArray:
    """Return the (T, J, 4, 4) transforms of a rig's joints from a file of `bvh_of`."""
    rig, parents, axes = space.rig, _one_tree(space.rig), space.to_body
    turns, places = in_world(bvh.motion)
    order, _ = depth_first(parents)
    rows = np.argsort(order)[len(parents) - len(rig.parents) :]
    transforms = np.tile(np.eye(4), (len(turns), len(rows), 1, 1))
    transforms[..., :3, :3] = axes.T @ turns[:, rows] @ axes @ rig.rest[:, :3, :3]
    transforms[..., :3, 3] = places[:, rows] @ axes
    return transforms


def _one_tree(rig: Rig) -> npt.NDArray[np.int64]:
    """Return the joints' parents, preceded by a common root if there are several."""
    if np.count_nonzero(rig.parents < 0) == 1:
        return rig.parents
    return np.concatenate([[-1], rig.parents + 1])


def _ends(space: RigPoseSpace) -> FloatArray:
    """Return bone ends at rest relative to their joints, in the axes of `_Moved`: (J, 3)."""
    rig, owners = space.rig, space.rig.heaviest
    points = rig.points[np.arange(len(owners)), rig.weights.argmax(axis=1)]
    ways = space.anatomy.axes[:, :, 1]
    along = np.einsum("vi,vi->v", points - rig.rest[owners, :3, 3], ways[owners])
    lengths = np.full(len(ways), 0.02 * space.body_size)
    np.maximum.at(lengths, owners, along)
    ends: FloatArray = lengths[:, None] * ways @ space.to_body.T
    return ends


def vrma_of(
    character: Character, space: RigPoseSpace, transforms: FloatArray, times: FloatArray
) -> bytes:
    """Return a VRM animation of a moving rig, in metres, with a T pose standing on y = 0.

    It holds the rotations of VRM's bones, and the translation of the hips.

    Parameters
    ----------
    character : one with the rig of `space`
    transforms : (T, J, 4, 4) global transforms of the joints, as in `Rig.rest`
    times : (T,) in seconds, ascending

    Raises
    ------
    MeshFileError : the rig lacks bones that VRM requires.
    """
    is_avatar, bones = _bones(character, space)
    joints = [bones[name] for name in bones]
    moved = _Moved.of(space, transforms)
    parents = _parents(space.rig, joints)
    aligned, stood = _t_pose(space, bones, moved.rest, parents, is_avatar)
    exported = _Moved(
        stood, moved.turns[:, joints] @ np.swapaxes(aligned, 1, 2), moved.places[:, joints]
    )
    turns, places = relative_to_parents(np.array(parents), exported.turns, exported.places)
    ground = np.array([0.0, float((character.rest_vertices @ space.up).min()), 0.0])
    metres = character.metres
    offsets = np.where(np.array(parents)[:, None] >= 0, stood - stood[parents], stood - ground)
    hips = metres * (places[:, 0] - ground)
    return vrma_bytes(tuple(bones), parents, metres * offsets, turns, hips, times)


def _bones(character: Character, space: RigPoseSpace) -> tuple[bool, dict[str, int]]:
    """Return whether the file names its VRM bones, and the joint of each bone, parents first.

    Raises
    ------
    MeshFileError : it lacks bones that VRM requires.
    """
    rig, bones = space.rig, dict[str, int]()
    if is_gltf(character) and character.file is not None:
        bones_of_file, nodes = human_bones(character.file.document), rig.nodes.tolist()
        bone_of_node = {
            node: bone for node, bone in bones_of_file.items() if not bone.endswith("Eye")
        }
        bones = {
            bone_of_node[node]: joint for joint, node in enumerate(nodes) if node in bone_of_node
        }
        # VRM 0 names the joints of a thumb one further along.
        for side in ("left", "right"):
            if f"{side}ThumbIntermediate" in bones:
                thumb = [bones.pop(f"{side}Thumb{name}", None) for name in _PHALANGES[Role.FINGER]]
                named = zip(_PHALANGES[Role.THUMB], thumb, strict=True)
                bones |= {f"{side}Thumb{name}": joint for name, joint in named if joint is not None}
    is_avatar = bool(bones)
    if not is_avatar:
        bones = _recognised(space)
    missing = [name for name in _NEEDED if name not in bones]
    if missing:
        raise MeshFileError(
            f"has no joint for bones that a VRM animation needs: {listed(missing, 4)}",
            "write a .bvh file, or say what its joints are",
            where=character.name,
        )
    return is_avatar, dict(sorted(bones.items(), key=lambda bone: bone[1]))


def _recognised(space: RigPoseSpace) -> dict[str, int]:
    """Return the joint of each VRM bone, by the joints' roles."""
    rig, roles, sides = space.rig, space.roles, space.sides
    kinds, in_limb = list(zip(roles, sides, strict=True)), set(limb_children(rig, roles).values())
    joints: dict[str, int] = {}
    for side in (Side.LEFT, Side.RIGHT):
        for role, name in _LIMBS.items():
            if (role, side) in kinds:
                matching = [joint for joint, kind in enumerate(kinds) if kind == (role, side)]
                # Not an IK target, which may have the same name.
                joints[f"{side.value}{name}"] = min(
                    matching, key=lambda joint: joint not in in_limb
                )
    fingers = finger_joints(rig.joint_names, rig.parents, roles, sides)
    for (side, finger, number), joint in fingers.items():
        if side is not Side.MIDDLE and 1 <= number <= N_SEGMENTS:
            role = Role.THUMB if finger == "thumb" else Role.FINGER
            place = _PHALANGES[role][number - 1]
            joints[f"{side.value}{finger.capitalize()}{place}"] = joint
    for role, name in ((Role.NECK, "neck"), (Role.HEAD, "head")):
        if role in roles:
            joints[name] = roles.index(role)
    legs = [joint for name, joint in joints.items() if name.endswith("UpperLeg")]
    arms = [joint for name, joint in joints.items() if name.endswith("UpperArm")]
    if legs and arms and "head" in joints:
        above = (set(lineage(rig.parents, joint)[1:]) for joint in (*legs, *arms))
        hips = max(set.intersection(*above), default=-1)
        trunk = lineage(rig.parents, joints["head"])[:0:-1]
        spine = [joint for joint in trunk if roles[joint] is Role.SPINE and joint > hips]
        if len(spine) > len(_SPINE):
            spine = [spine[0], spine[len(spine) // 2], spine[-1]]
        joints |= dict(zip(_SPINE, spine, strict=False))
        if hips >= 0:
            joints["hips"] = hips
    return joints


def _parents(rig: Rig, joints: Sequence[int]) -> list[int]:
    """Return each joint's nearest ancestor among the given joints, -1 for the first."""
    number = {joint: place for place, joint in enumerate(joints)}
    above = [nearest_above(rig.parents, joint, number) for joint in joints]
    return [number.get(joint, 0 if place else -1) for place, joint in enumerate(above)]


def _t_pose(
    space: RigPoseSpace,
    bones: dict[str, int],
    rest: FloatArray,
    parents: Sequence[int],
    is_there: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return the rotations of B bones from the rest pose to a T pose, and their positions in it.

    Arms lie along x and legs along y; feet and trunk stay as at rest.

    Parameters
    ----------
    rest : (J, 3) joint positions
    parents : of the bones
    is_there : whether the rest pose is a T pose already
    """
    joints, next_bone = list(bones.values()), limb_children(space.rig, space.roles)
    turned = np.broadcast_to(np.eye(3), (len(joints), 3, 3)).copy()
    places = rest[joints].copy()
    down, across = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    for bone, (joint, parent) in enumerate(zip(joints, parents, strict=True)):
        if parent >= 0:
            step = rest[joint] - rest[joints[parent]]
            places[bone] = places[parent] + turned[parent] @ step
        if is_there or parent < 0:
            continue
        role, side = space.roles[joint], space.sides[joint]
        if role not in (Role.FOOT, Role.SHOULDER, Role.SPINE):
            turned[bone] = turned[parent]
        if role in (Role.UPPER_ARM, Role.FOREARM, Role.THIGH, Role.SHIN) and joint in next_bone:
            bone_way = turned[bone] @ (rest[next_bone[joint]] - rest[joint])
            is_arm = role in (Role.UPPER_ARM, Role.FOREARM)
            way = (across if side is Side.LEFT else -across) if is_arm else down
            turned[bone] = least_turn(bone_way, way) @ turned[bone]
    return turned, places


_SAME = 1e-4
"""Normalised tolerance within which a skeleton represents a frame."""


def retargeted_motions(
    body: Body, path: Path, clip: str | None = None, fps: float | None = None
) -> list[tuple[Motion, Retargeting]]:
    """Read a skeleton's motions, retargeted to a character; return them with their mappings.

    Parameters
    ----------
    path : a .bvh or .vrma file, arrays of a generator, or a scene, whose clips are motions
    clip : one of the clips of a scene; None for all of them
    fps : frame rate; None for the file's. BVH files are not resampled.

    Raises
    ------
    MeshFileError : the file is damaged, or the body has no matching skeleton.
    """
    space = rig_space_of(body, path)
    motions = []
    for motion in _skeleton_motions(path, clip, fps):
        times = motion.times
        if fps is not None and (path.suffix.lower() == BVH_SUFFIX or is_generated(path)):
            times = np.arange(len(times), dtype=np.float64) / fps
        carrying = Retargeting.of(motion, space, path)
        codes = space.unwound(space.codes_of_transforms(carrying.transforms()))
        # VRM animations are named after the program that wrote them.
        is_vrma = path.suffix.lower() == VRMA_SUFFIX
        name = "" if is_vrma else motion.name
        motions.append((Motion(name or path.stem, times, codes, source=path.name), carrying))
    return motions


def skeleton_notes(body: Body, path: Path) -> tuple[str, ...]:
    """Return sentences on assumptions about a skeleton's file, and what is left out of it.

    Raises
    ------
    MeshFileError : the file is damaged, or the body has no matching skeleton.
    """
    motion = _skeleton_motions(path, most=_MOST_LOOKED_AT)[0]
    notes, rested = motion.notes, Retargeting.of(motion, rig_space_of(body, path), path).motion
    if rested.turns_y_up:
        return (*notes, f"{path.name} stands along y at rest and along z in its frames: z is up")
    if rested.up[0] or rested.up.min() < 0.0:
        axis = int(np.abs(rested.up).argmax())
        sign = "-" if rested.up[axis] < 0.0 else ""
        return (*notes, f"{path.name} stands along {sign}{'xyz'[axis]}, taken as up")
    if rested.frame is None:
        return notes
    at = f"frame {rested.frame} (from 0)"
    if path.suffix.lower() != BVH_SUFFIX:
        at = f"the frame at {motion.times[rested.frame]:.2f} s"
    measured = (
        f"the rest pose of {path.name} does not stand, so its joints are measured from {at}, "
        "which does"
    )
    return (*notes, measured)


_MOST_LOOKED_AT = 64
"""Most frames of a clip that are read to find its rest pose."""


def _skeleton_motions(
    path: Path, clip: str | None = None, fps: float | None = None, most: int | None = None
) -> list[SkeletonMotion]:
    """Read a moving skeleton; `most` limits the frames read of each clip of a scene."""
    if path.suffix.lower() == BVH_SUFFIX:
        return [read_bvh(path).motion]
    if path.suffix.lower() == VRMA_SUFFIX:
        return [read_vrma(path, fps)]
    if is_generated(path):
        return read_generated(path)
    if is_smpl_motion(path):
        return [skeleton_of_smpl(read_smpl_motion(path), NOMINAL_RATE)]
    scene = read_skeleton_scene(path)
    with as_file_error(path):
        return motions_of_scene(scene, clip, fps, most)


def rig_space_of(body: Body, path: Path) -> RigPoseSpace:
    """Return the pose space of a body's joints, which the motion of a skeleton needs.

    Raises
    ------
    MeshFileError : the body has no joints.
    """
    if body.joints is not None:
        return body.joints
    raise MeshFileError(
        "is the motion of a skeleton, and the body has no joints",
        "name a rigged character as the body",
        where=path,
    )


def require_skeleton(path: str | os.PathLike[str], body: Body) -> None:
    """Raise early if a skeletal file cannot be written for a body.

    Other files are not checked.

    Raises
    ------
    MeshFileError : the body has no joints, or lacks bones that VRM requires.
    """
    if Path(path).suffix.lower() not in SKELETON_SUFFIXES:
        return
    if body.character is None or body.joints is None:
        raise MeshFileError.unwritable(
            path, "the body has no joints", "name a .pc2 or .mdd file, or a folder"
        )
    if Path(path).suffix.lower() == VRMA_SUFFIX:
        _bones(body.character, body.joints)


def write_skeleton(
    path: str | os.PathLike[str],
    body: Body,
    latents: Sequence[npt.NDArray[Any]],
    vertices: Iterable[npt.NDArray[Any]],
    fps: float,
) -> tuple[Callable[[int], npt.NDArray[Any]], tuple[str, ...]]:
    """Write poses as the motion of the body's joints, atomically.

    Parameters
    ----------
    path : a .bvh or .vrma file
    body : a character
    latents : (D,) codes of N poses
    vertices : displayed vertices of N poses, each (V, 3)
    fps : frame rate

    Returns
    -------
    stored : returns the displayed vertices of a frame as stored in the file, (V, 3)
    notes : sentences about what the file lacks

    Raises
    ------
    MeshFileError : see `require_skeleton`, or the file cannot be written.
    """
    require_skeleton(path, body)
    assert isinstance(body, RigBody)
    transforms = np.array([body.space.transforms(row) for row in latents])
    is_bvh = Path(path).suffix.lower() == BVH_SUFFIX
    if is_bvh:
        data = bvh_of(body.space, transforms, 1.0 / fps)
    else:
        data = vrma_of(body.character, body.space, transforms, np.arange(len(latents)) / fps)
    write_bytes(path, data)
    if is_bvh:
        # Any rig can read back its own BVH file; retargeting might not match it.
        stored_transforms = transforms_from_bvh(body.space, read_bvh(path))
    else:
        ((back, _),) = retargeted_motions(body, Path(path), fps=fps)
        codes = back.codes
        stored_transforms = np.array([body.space.transforms(row) for row in codes])
    space, size = body.space, body.body_size

    def stored(frame: int) -> npt.NDArray[Any]:
        return (space.skinned(stored_transforms[frame]) * size).astype(np.float32)

    # Lazily: all frames at once may not fit in memory.
    pairs = zip(range(len(stored_transforms)), vertices, strict=True)
    off = max(float(np.abs(stored(frame) - shown).max()) for frame, shown in pairs) / size
    notes: tuple[str, ...] = ()
    if off > _SAME:
        notes = (
            f"{Path(path).name} stores joint rotations only; played back, the body deviates "
            f"from the motion by up to {100.0 * off:.2g} % of its size",
        )
    return stored, notes
