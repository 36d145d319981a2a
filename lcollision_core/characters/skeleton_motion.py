"""The joints of a rig in motion as files of skeletons hold them: BVH, and VRM animations."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.characters.joint_roles import next_in_limb
from lcollision_core.characters.retargeting import in_world, least_turn
from lcollision_core.characters.rig_space import RigPoseSpace
from lcollision_core.errors import MeshFileError
from lcollision_core.files.character import Character, Rig
from lcollision_core.files.character_reading import is_gltf
from lcollision_core.files.gltf.read import human_bones
from lcollision_core.files.motion.bvh import Bvh, bvh_bytes, depth_first
from lcollision_core.files.motion.vrma import vrma_bytes
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.topology import FloatArray

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
_FINGERS = {"index": "Index", "middle": "Middle", "ring": "Ring", "little|pink": "Little"}
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
"""Bones that a humanoid of VRM must have."""


@dataclass(frozen=True, eq=False)
class _Moved:
    """A rig in motion, in axes in which x is its left, y up, and z its front.

    Attributes
    ----------
    rest : (J, 3) where the joints are at rest
    turns : (T, J, 3, 3) rotations of the joints from the rest pose, in the world
    places : (T, J, 3) where they are
    """

    rest: FloatArray
    turns: FloatArray
    places: FloatArray

    @classmethod
    def of(cls, space: RigPoseSpace, transforms: FloatArray) -> _Moved:
        axes = np.stack([np.cross(space.up, space.front), space.up, space.front])
        linear = transforms[..., :3, :3] @ np.linalg.inv(space.rig.rest[:, :3, :3])
        # What a skeleton cannot hold, as scales of joints are, is left out.
        left, _, right = np.linalg.svd(linear)
        return cls(
            space.rig.rest[:, :3, 3] @ axes.T,
            axes @ (left @ right) @ axes.T,
            transforms[..., :3, 3] @ axes.T,
        )

    def seen_from(self, parents: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return the turns and the places of the joints as their parents see them."""
        turns, places = self.turns.copy(), self.places.copy()
        for joint, parent in enumerate(parents):
            if parent >= 0:
                back = np.swapaxes(self.turns[:, parent], 1, 2)
                turns[:, joint] = back @ turns[:, joint]
                way = self.places[:, joint] - self.places[:, parent]
                places[:, joint] = np.einsum("txy,ty->tx", back, way)
        return turns, places


def bvh_of(space: RigPoseSpace, transforms: FloatArray, frame_time: float) -> bytes:
    """Return the BVH file of a rig in motion: y up, z to its front, lengths in its own unit.

    Its rest pose is the rig's. Where the rig has several roots, they hang on one at the origin.

    Parameters
    ----------
    transforms : (T, J, 4, 4) global transforms of the joints, as `Rig.rest`
    frame_time : seconds from frame to frame
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
    seen = moved.seen_from(parents.tolist())
    return bvh_bytes(names, parents, moved.rest, ends, *seen, frame_time)


def held_by_bvh(space: RigPoseSpace, bvh: Bvh) -> FloatArray:
    """Return the (T, J, 4, 4) transforms of a rig's joints that a file of `bvh_of` holds."""
    rig, parents = space.rig, _one_tree(space.rig)
    axes = np.stack([np.cross(space.up, space.front), space.up, space.front])
    turns, places = in_world(bvh)
    order, _ = depth_first(parents)
    rows = np.argsort(order)[len(parents) - len(rig.parents) :]
    transforms = np.tile(np.eye(4), (len(turns), len(rows), 1, 1))
    transforms[..., :3, :3] = axes.T @ turns[:, rows] @ axes @ rig.rest[:, :3, :3]
    transforms[..., :3, 3] = places[:, rows] @ axes
    return transforms


def _one_tree(rig: Rig) -> npt.NDArray[np.int64]:
    """Return the joints' parents, with a root before them where they have several."""
    if np.count_nonzero(rig.parents < 0) == 1:
        return rig.parents
    return np.concatenate([[-1], rig.parents + 1])


def _ends(space: RigPoseSpace) -> FloatArray:
    """Return where bones end at rest, seen from their joints, in the axes of `_Moved`: (J, 3)."""
    rig = space.rig
    axes = np.stack([np.cross(space.up, space.front), space.up, space.front])
    heaviest, rows = rig.weights.argmax(axis=1), np.arange(len(rig.weights))
    owners, points = rig.joint_of[rows, heaviest], rig.points[rows, heaviest]
    ways = space.anatomy.axes[:, :, 1]
    along = np.einsum("vi,vi->v", points - rig.rest[owners, :3, 3], ways[owners])
    lengths = np.full(len(ways), 0.02 * space.body_size)
    np.maximum.at(lengths, owners, along)
    ends: FloatArray = lengths[:, None] * ways @ axes.T
    return ends


def vrma_of(
    character: Character, space: RigPoseSpace, transforms: FloatArray, times: FloatArray
) -> bytes:
    """Return the VRM animation of a rig in motion, in metres, from a T pose that stands on y = 0.

    It holds the turns of the bones that VRM knows, and the way of the hips.

    Parameters
    ----------
    character : with the rig of `space`
    transforms : (T, J, 4, 4) global transforms of the joints, as `Rig.rest`
    times : (T,) in seconds, ascending

    Raises
    ------
    MeshFileError : the rig lacks bones that VRM needs.
    """
    is_avatar, bones = _bones(character, space)
    joints = [bones[name] for name in bones]
    moved = _Moved.of(space, transforms)
    parents = _parents(space.rig, joints)
    aligned, stood = _t_pose(space, bones, moved.rest, parents, is_avatar)
    chosen = _Moved(
        stood, moved.turns[:, joints] @ np.swapaxes(aligned, 1, 2), moved.places[:, joints]
    )
    turns, places = chosen.seen_from(parents)
    ground = np.array([0.0, float((character.rest_vertices @ space.up).min()), 0.0])
    metres = character.metres
    offsets = np.where(np.array(parents)[:, None] >= 0, stood - stood[parents], stood - ground)
    hips = metres * (places[:, 0] - ground)
    return vrma_bytes(tuple(bones), parents, metres * offsets, turns, hips, times)


def require_humanoid(character: Character, space: RigPoseSpace) -> None:
    """Refuse a rig that a VRM animation cannot be of.

    Raises
    ------
    MeshFileError : it lacks bones that VRM needs.
    """
    _bones(character, space)


def _bones(character: Character, space: RigPoseSpace) -> tuple[bool, dict[str, int]]:
    """Return whether a file says what its bones are, and the joint of each, parents first."""
    rig, found = space.rig, dict[str, int]()
    if is_gltf(character) and character.file is not None:
        said, nodes = human_bones(character.file.document), rig.nodes.tolist()
        known = {node: bone for node, bone in said.items() if not bone.endswith("Eye")}
        found = {known[node]: joint for joint, node in enumerate(nodes) if node in known}
        # VRM 0 counts the joints of a thumb from one farther on.
        for side in ("left", "right"):
            if f"{side}ThumbIntermediate" in found:
                own = [found.pop(f"{side}Thumb{name}", None) for name in _PHALANGES[Role.FINGER]]
                named = zip(_PHALANGES[Role.THUMB], own, strict=True)
                found |= {f"{side}Thumb{name}": joint for name, joint in named if joint is not None}
    is_avatar = bool(found)
    if not is_avatar:
        found = _recognised(space)
    missing = [name for name in _NEEDED if name not in found]
    if missing:
        listed = ", ".join(missing[:4]) + (" and others" if len(missing) > 4 else "")
        raise MeshFileError(
            f"has no joint for bones that a VRM animation needs: {listed}",
            "write a .bvh file, or say what its joints are",
            where=character.name,
        )
    return is_avatar, dict(sorted(found.items(), key=lambda bone: bone[1]))


def _recognised(space: RigPoseSpace) -> dict[str, int]:
    """Return which joint is which bone of VRM, by what the joints are."""
    rig, roles, sides = space.rig, space.roles, space.sides
    kinds, in_limb = list(zip(roles, sides, strict=True)), set(next_in_limb(rig, roles).values())
    found: dict[str, int] = {}
    for side in (Side.LEFT, Side.RIGHT):
        for role, name in _LIMBS.items():
            if (role, side) in kinds:
                own = [joint for joint, kind in enumerate(kinds) if kind == (role, side)]
                # Not a target of inverse kinematics, which is called so too.
                found[f"{side.value}{name}"] = min(own, key=lambda joint: joint not in in_limb)
        for word, name in {"thumb": "Thumb", **_FINGERS}.items():
            role = Role.THUMB if name == "Thumb" else Role.FINGER
            own = [
                joint
                for joint, kind in enumerate(kinds)
                if kind == (role, side)
                and (role is Role.THUMB or re.search(word, rig.joint_names[joint].lower()))
            ]
            for place, joint in zip(_PHALANGES[role], own, strict=False):
                found[f"{side.value}{name}{place}"] = joint
    for role, name in ((Role.NECK, "neck"), (Role.HEAD, "head")):
        if role in roles:
            found[name] = roles.index(role)
    legs = [joint for name, joint in found.items() if name.endswith("UpperLeg")]
    arms = [joint for name, joint in found.items() if name.endswith("UpperArm")]
    if legs and arms and "head" in found:
        shared = set.intersection(*(set(_above(rig, joint)) for joint in (*legs, *arms)))
        hips, trunk = max(shared, default=-1), _above(rig, found["head"])
        spine = [joint for joint in trunk if roles[joint] is Role.SPINE and joint > hips]
        if len(spine) > len(_SPINE):
            spine = [spine[0], spine[len(spine) // 2], spine[-1]]
        found |= dict(zip(_SPINE, spine, strict=False))
        if hips >= 0:
            found["hips"] = hips
    return found


def _above(rig: Rig, joint: int) -> list[int]:
    """Return what a joint hangs on, from the root on."""
    way = []
    while (joint := int(rig.parents[joint])) >= 0:
        way.append(joint)
    return way[::-1]


def _parents(rig: Rig, joints: Sequence[int]) -> list[int]:
    """Return which of some joints each of them hangs on next, -1 for the first."""
    number = {joint: place for place, joint in enumerate(joints)}
    return [
        next(
            (number[above] for above in reversed(_above(rig, joint)) if above in number),
            0 if place else -1,
        )
        for place, joint in enumerate(joints)
    ]


def _t_pose(
    space: RigPoseSpace,
    bones: dict[str, int],
    rest: FloatArray,
    parents: Sequence[int],
    is_there: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return how the T pose turns each of B bones from the rest pose, and where they are in it.

    Arms lie along x and legs along y, feet and trunk are as at rest.

    Parameters
    ----------
    rest : (J, 3) places of the joints
    parents : of the bones
    is_there : whether the rest pose is a T pose
    """
    joints, next_bone = list(bones.values()), next_in_limb(space.rig, space.roles)
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
            own = turned[bone] @ (rest[next_bone[joint]] - rest[joint])
            is_arm = role in (Role.UPPER_ARM, Role.FOREARM)
            way = (across if side is Side.LEFT else -across) if is_arm else down
            turned[bone] = least_turn(own, way) @ turned[bone]
    return turned, places
