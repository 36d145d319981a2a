"""Match the joints of a rig to those of another skeleton.

Joints are matched by name, else by their role in the body; a user's choices override both. They
are kept in the user's data folder, one JSON file per pair of skeletons.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.anatomy import (
    Anatomy,
    joint_roles,
    limb_children,
    plain_name,
    rig_of,
    role_name,
    role_of_word,
)
from lcollision_core.bodies.body import Body
from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.bodies.standing_pose import common_ancestor
from lcollision_core.bundled import user_folder
from lcollision_core.errors import LCollisionError, MeshFileError, ModelFileError
from lcollision_core.files import Character
from lcollision_core.files.motion.skeleton import SkeletonMotion
from lcollision_core.files.safe import read_regular, write_bytes
from lcollision_core.json_values import from_json, parse_json
from lcollision_core.meshes.joint_kinds import Role, Side

ALIGNED = (Role.UPPER_ARM, Role.FOREARM, Role.THIGH, Role.SHIN)
"""Bones aligned with the other skeleton's: arms may hang at rest in one of them. Feet stand flat
in both, and hips, spines and collar bones are built differently."""

LEAST_JOINTS = 6
"""Least matches among the eight bones of arms and legs for skeletons of one kind."""

_ONE_EACH = (*ALIGNED, Role.SHOULDER, Role.HAND, Role.FOOT, Role.TOE, Role.NECK, Role.HEAD)
_NEEDED = (*ALIGNED, Role.HAND, Role.FOOT, Role.HEAD)
_FORMAT, _MAX_BYTES = "lcollision-joints", 10_000_000

JointMap = Mapping[str, str | None]
"""From each rig joint's name to the name of the skeleton joint it follows; None for none."""


@dataclass(frozen=True)
class JointMatch:
    """A joint matching that a user can see and change.

    Attributes
    ----------
    source_joints : names of the skeleton's joints
    rig_joints : J names of the rig's joints
    labels : J words for each joint's role, as "left elbow"; "" if unknown
    followed : the skeleton joint of each rig joint
    unsure : rig joints whose match is uncertain by both names and positions
    """

    source_joints: tuple[str, ...]
    rig_joints: tuple[str, ...]
    labels: tuple[str, ...]
    followed: JointMap
    unsure: frozenset[str]


@dataclass(frozen=True)
class _StoredMap:
    joints: dict[str, str | None]


def partners(
    motion: SkeletonMotion, anatomy: Anatomy, space: RigPoseSpace, chosen: JointMap
) -> npt.NDArray[np.int64]:
    """Return, for each joint of the rig, the skeleton joint that it follows, -1 for none."""
    partner = match_by_name(motion, space)
    for joint, other in enumerate(partner.tolist()):
        kinds = {space.roles[joint], anatomy.roles[other]} & set(_ONE_EACH)
        if other >= 0 and len(kinds) > 1:
            # "LeftLeg" is a shin in one skeleton and a thigh in another, such as SOMA.
            partner[joint] = -1
    if len(followed_limbs(partner, space)) < LEAST_JOINTS:
        partner[:] = -1
    taken_joints = set(partner.tolist())
    own_sides = _sides(anatomy.roles, anatomy.sides, motion.parents)
    in_limb = set(limb_children(space.rig, space.roles).values())
    for role in (*_ONE_EACH, Role.SPINE):
        for side in Side:
            theirs = _of_kind(anatomy.roles, own_sides, role, side)
            ours = _of_kind(space.roles, space.sides, role, side)
            if not theirs or not ours or (partner[ours] >= 0).any():
                continue
            if role is Role.SPINE:
                at = np.linspace(0, len(theirs) - 1, len(ours)).round().astype(int)
                partner[ours] = np.array(theirs)[at]
            elif theirs[0] not in taken_joints:
                # Not an IK target, which may have the same name.
                partner[min(ours, key=lambda joint: joint not in in_limb)] = theirs[0]
    # The first joint of a finger lies in the palm in some skeletons only.
    rig = space.rig
    fingers = finger_joints(motion.names, motion.parents, anatomy.roles, own_sides)
    for segment, joint in finger_joints(
        rig.joint_names, rig.parents, space.roles, space.sides
    ).items():
        partner[joint] = fingers.get(segment, -1)
    hips = int(space.joint_of_code[0])
    if hips >= 0 and partner[hips] < 0:
        partner[hips] = common_ancestor(motion, followed_limbs(partner, space))
    for name, follows in chosen.items():
        joint = rig.joint_names.index(name)
        partner[joint] = -1 if follows is None else motion.names.index(follows)
    return partner


def unsure_joints(
    partner: npt.NDArray[np.int64], figure: Character, anatomy: Anatomy, space: RigPoseSpace
) -> frozenset[str]:
    """Return the rig joints whose partner, or lack of one, is uncertain by names and positions.

    Parameters
    ----------
    partner : see `partners`
    figure, anatomy : of the skeleton
    """
    rig, names = space.rig, rig_of(figure).joint_names
    by_name, in_limb = joint_roles(rig_of(figure)), limb_children(rig, space.roles)
    spare = {
        role
        for joint, role in enumerate(anatomy.roles)
        if joint not in partner and not re.search("end|tip|nub|site", names[joint].lower())
    }
    unsure = set[str]()
    for joint, role in enumerate(space.roles):
        other = int(partner[joint])
        if other >= 0 and role in _ONE_EACH:
            alike = common_name(rig.joint_names[joint]) == common_name(names[other])
            # A joint named shin is a thigh if no other joint has that name.
            spare_here = {
                name
                for joint, name in enumerate(by_name)
                if joint not in partner and anatomy.sides[joint] is anatomy.sides[other]
            }
            has_word = role_of_word(names[other]) is not Role.OTHER
            is_named = has_word and role not in spare_here
            is_told = by_name[other] is role or alike or is_named
        else:
            same = _of_kind(space.roles, space.sides, role, space.sides[joint])
            is_first = role not in ALIGNED or joint in in_limb
            is_alone = is_first and not (partner[same] >= 0).any()
            is_told = role not in _NEEDED or not is_alone or not spare & {role, Role.OTHER}
        if not is_told:
            unsure.add(rig.joint_names[joint])
    return frozenset(unsure)


def match_of(
    partner: npt.NDArray[np.int64], unsure: frozenset[str], names: Sequence[str], rig_body: RigBody
) -> JointMatch:
    """Return the matching by names."""
    space = rig_body.space
    role_names = (role_name(*kind) for kind in zip(space.roles, space.sides, strict=True))
    words = [" ".join(reversed(name.split("-"))) for name in role_names]
    if space.joint_of_code[0] >= 0:
        words[int(space.joint_of_code[0])] = "hips"
    followed = [None if other < 0 else names[other] for other in partner.tolist()]
    rig_joints = space.rig.joint_names
    return JointMatch(
        tuple(names),
        tuple(rig_joints),
        tuple("" if word in ("unknown", "twist") else word for word in words),
        dict(zip(rig_joints, followed, strict=True)),
        unsure,
    )


def with_chosen_roles(figure: Character, chosen: JointMap, space: RigPoseSpace) -> Character:
    """Return a skeleton whose joints take the roles of the rig joints that follow them."""
    rig, names = rig_of(figure), space.rig.joint_names
    roles = {
        follows: role_name(space.roles[names.index(name)], space.sides[names.index(name)])
        for name, follows in reversed(list(chosen.items()))
        if follows is not None
    }
    return replace(figure, rig=replace(rig, chosen=roles)) if roles else figure


def user_joint_map(motion: SkeletonMotion, space: RigPoseSpace, path: Path) -> JointMap:
    """Return the user's choices for a skeleton: those for this task, else the remembered ones.

    Raises
    ------
    MeshFileError : a choice names an unknown joint.
    """
    chosen_partners = space.rig.followed
    if not chosen_partners:
        try:
            return read_followed(_path(motion.names, space.rig.joint_names))
        except (OSError, ModelFileError):
            return {}
    for kind, names_of_both, named in (
        ("body", space.rig.joint_names, chosen_partners),
        ("motion", motion.names, filter(None, chosen_partners.values())),
    ):
        unknown = next((name for name in named if name not in names_of_both), None)
        if unknown is not None:
            listed = ", ".join(names_of_both[:6]) + (
                " and others" if len(names_of_both) > 6 else ""
            )
            raise MeshFileError(
                f"cannot be retargeted: --joints names {unknown!r}, no joint of the {kind}",
                f"its joints are {listed}",
                where=path,
            )
    return chosen_partners


def read_followed(path: str | os.PathLike[str]) -> JointMap:
    """Read a JSON object "joints" that maps the body's joint names to the motion's.

    Raises
    ------
    FileNotFoundError : there is no such file.
    ModelFileError : it is damaged or cannot be read.
    """
    try:
        return from_json(_StoredMap, parse_json(read_regular(path, _MAX_BYTES)), "it").joints
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        advice = 'write {"joints": {"joint of the body": "joint of the motion", ...}}'
        raise ModelFileError.unreadable(path, error, advice) from error


def with_joint_map(body: Body, file: str | os.PathLike[str]) -> RigBody:
    """Return a character whose joints follow other skeletons as given in a file.

    Raises
    ------
    LCollisionError : the body has no joints.
    ModelFileError : see `read_followed`.
    """
    if not isinstance(body, RigBody):
        what = "isn't a rigged character, so --joints doesn't apply"
        raise LCollisionError(what, "name one rigged character", where=body.name)
    try:
        chosen_partners = read_followed(file)
    except FileNotFoundError as error:
        raise ModelFileError("there is no such file", "check the name", where=file) from error
    rig = replace(body.space.rig, followed=chosen_partners)
    return RigBody.of(replace(body.character, rig=rig)).with_choices_of(body)


def remember_followed(match: JointMatch, followed: JointMap) -> None:
    """Remember the matching for all motions of that skeleton on that rig.

    Raises
    ------
    ModelFileError : the file cannot be written.
    """
    path = _path(match.source_joints, match.rig_joints)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        document = {"format": _FORMAT, "format_version": 1, "joints": dict(followed)}
        write_bytes(path, json.dumps(document, indent=1, ensure_ascii=False).encode() + b"\n")
    except (OSError, LCollisionError) as error:
        what = "the joint matching"
        raise ModelFileError.because(what, "could not be saved", error, "try again") from error


def _path(source_joints: Sequence[str], rig_joints: Sequence[str]) -> Path:
    digest = hashlib.sha256(
        json.dumps([list(source_joints), list(rig_joints)]).encode()
    ).hexdigest()[:16]
    return user_folder("joints") / f"{digest}.json"


def match_by_name(motion: SkeletonMotion, space: RigPoseSpace) -> npt.NDArray[np.int64]:
    """Return, for each joint of the rig, the first skeleton joint of that name, -1 for none."""
    joint_by_name = {
        common_name(name): joint for joint, name in reversed(list(enumerate(motion.names)))
    }
    return np.array([joint_by_name.get(common_name(name), -1) for name in space.rig.joint_names])


def followed_limbs(partner: npt.NDArray[np.int64], space: RigPoseSpace) -> list[int]:
    """Return the skeleton joints that bones of the rig's arms and legs follow."""
    pairs = zip(partner.tolist(), space.roles, strict=True)
    return [joint for joint, role in pairs if joint >= 0 and role in ALIGNED]


def _sides(
    roles: Sequence[Role], sides: Sequence[Side], parents: npt.NDArray[np.integer]
) -> list[Side]:
    """Return the sides of joints; a collar bone in the middle takes the side of its arm."""
    joint_sides = list(sides)
    for joint in range(len(joint_sides) - 1, 0, -1):
        parent = int(parents[joint])
        if parent >= 0 and roles[parent] is Role.SHOULDER and joint_sides[parent] is Side.MIDDLE:
            joint_sides[parent] = joint_sides[joint]
    return joint_sides


def common_name(name: str) -> str:
    """Return a joint's name without the prefix of the program that wrote it."""
    return _PREFIX.sub("", plain_name(name))


_PREFIX = re.compile(r"^(mixamorig\d*|def|ccbase)(?=.)")
"""Prefixes that programs add to all names of a rig."""


def _of_kind(roles: Sequence[Role], sides: Sequence[Side], role: Role, side: Side) -> list[int]:
    pairs = enumerate(zip(roles, sides, strict=True))
    return [joint for joint, kind in pairs if kind == (role, side)]


FINGERS = {
    "thumb": "thumb|親指",
    "index": "index|人[指差]",
    "middle": "mid|中指",
    "ring": "ring|薬指",
    "little": "little|pink|小指",
}
"""A pattern of each finger's names, lower case without separators: English, and MMD's."""

N_SEGMENTS = 3
_TIP = re.compile(r"((end|tip|nub)(site)?\d*[lr]?|先)$")
_PALM = re.compile("carpal|palm")

Segment = tuple[Side, str, int]
"""A side, a key of `FINGERS`, and 1 to 3 from the palm on; 0 lies in the palm, 4 is a tip."""


def finger_joints(
    names: Sequence[str],
    parents: npt.NDArray[np.integer],
    roles: Sequence[Role],
    sides: Sequence[Side],
) -> dict[Segment, int]:
    """Return the joint of each finger segment; fingers with unknown names are left out.

    Parameters
    ----------
    names, parents, roles, sides : of J joints; parents come before children
    """
    chains: dict[tuple[Side, str], list[int]] = defaultdict(list)
    in_hand: list[bool] = []
    plain = [plain_name(name) for name in names]
    for joint, parent in enumerate(parents.tolist()):
        is_below = parent >= 0 and (in_hand[parent] or roles[parent] is Role.HAND)
        in_hand.append(is_below)
        finger = next(
            (finger for finger, words in FINGERS.items() if re.search(words, plain[joint])), ""
        )
        if is_below and (finger or roles[joint] is Role.THUMB):
            chains[sides[joint], finger or "thumb"].append(joint)
    above = set(parents.tolist())
    joints: dict[Segment, int] = {}
    for (side, finger), chain in chains.items():
        # Rigify's controls lie beside the bones that deform.
        deforming = [joint for joint in chain if plain[joint].startswith("def")] or chain
        bones = [joint for joint in deforming if not _TIP.search(plain[joint])]
        n_palm = sum(finger != "thumb" and bool(_PALM.search(plain[joint])) for joint in bones)
        while len(bones) > N_SEGMENTS + n_palm and bones[-1] not in above:
            bones.pop()
        n_palm = max(n_palm, len(bones) - N_SEGMENTS)
        tips = [joint for joint in deforming if joint not in bones]
        numbered = [(place + 1 - n_palm, joint) for place, joint in enumerate(bones)]
        numbered += [(N_SEGMENTS + 1, joint) for joint in tips[:1]]
        joints |= {(side, finger, number): joint for number, joint in numbered if number >= 0}
    return joints
