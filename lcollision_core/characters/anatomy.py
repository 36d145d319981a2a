"""What the joints of a rig are: by their names, by the skeleton, and by what the user says."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.characters import joint_roles
from lcollision_core.characters.skeletons import FINGERS, TRUNK, Person, Skeleton
from lcollision_core.errors import LCollisionError
from lcollision_core.files.character import Character, Rig
from lcollision_core.meshes.joint_kinds import JOINT_KINDS, Role, Side
from lcollision_core.meshes.part_names import joint_labels, part_labels, part_names
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.meshes.units import front_direction

ROLE_NAMES: Mapping[str, tuple[Role, Side]] = {
    f"{kind.called}-{side.value}" if kind.is_paired else kind.called: (role, side)
    for role, kind in JOINT_KINDS.items()
    for side in ((Side.LEFT, Side.RIGHT) if kind.is_paired else (Side.MIDDLE,))
}
"""What a user can say that a joint is."""


def role_name(role: Role, side: Side) -> str:
    """Return which of `ROLE_NAMES` a joint is; "unknown" also of a limb's that is on no side."""
    return next(
        (
            name
            for name, (one, own) in ROLE_NAMES.items()
            if one is role and own in (side, Side.MIDDLE)
        ),
        "unknown",
    )


_LIMBS = frozenset(role for role, kind in JOINT_KINDS.items() if kind.part) - {*TRUNK, Role.FACE}
_BONES = frozenset((Role.UPPER_ARM, Role.FOREARM, Role.THIGH, Role.SHIN))
_ONE_OF_A_LIMB = _LIMBS - {Role.TOE, *FINGERS} | {Role.HEAD}

_ABOVE_THIGHS = (" shin", " leg", " hind shoulder")
"""Ends of names of parts that no joint above a thigh moves."""

_SAME_WAY = 0.9
"""Cosine to which feet point to where the body faces."""

_UNKNOWN = (
    "its joints are not recognised as a person's, so random poses turn them little; set their "
    "roles in the menus of their sliders, or with `lcollision domains --role`"
)
_FOUR_LEGS = "it stands on four legs, so random poses turn its limbs only a little"


@dataclass(frozen=True, eq=False)
class Anatomy:
    """What the J joints of a rig are, and where the body faces.

    Attributes
    ----------
    roles, sides : of each joint
    labels : J names of body parts
    front : (3,) level unit vector
    axes : (J, 3, 3): see `joint_roles.joint_axes`
    notes : sentences on what is not known
    """

    roles: tuple[Role, ...]
    sides: tuple[Side, ...]
    labels: tuple[str, ...]
    front: FloatArray
    axes: FloatArray
    notes: tuple[str, ...]


def anatomy_of(character: Character) -> Anatomy:
    """Tell what the joints of a character's rig are.

    Names and the skeleton confirm each other limb by limb: names that cannot follow each other
    along a limb do not count there, and where the skeleton is no person's, names alone do.

    Raises
    ------
    LCollisionError : the character has no rig.
    """
    rig, up = rig_of(character), character.up
    chosen = {rig.joint_names.index(name): ROLE_NAMES[role] for name, role in rig.chosen.items()}
    parts = list(part_names(rig.joint_names))
    lefts = [
        -1 if part.startswith("Right ") else int(part.startswith("Left "))
        for part in (part or "" for part in parts)
    ]
    for joint, (_, side) in chosen.items():
        lefts[joint] = {Side.LEFT: 1, Side.RIGHT: -1, Side.MIDDLE: 0}[side]
    named = list(joint_roles.joint_roles(rig))
    _rename_ends(rig, parts)
    skeleton = Skeleton(rig, named, lefts, up)
    person, notes = skeleton.person(), []
    for joint in _numbered_spine(rig.joint_names, named, person):
        named[joint] = Role.OTHER
        if person is not None and joint in person.roles:
            parts[joint] = None
    roles, by_name = _merged(named, person, skeleton)
    for joint, (role, _) in chosen.items():
        roles[joint] = role
    directions = joint_roles.bone_directions(rig, rig.rest[:, :3, 3], roles)
    front = joint_roles.front_of(roles, rig.rest[:, :3, 3], directions, up)
    if person is not None and person.front is not None:
        level = person.front - (person.front @ up) * up
        length = float(np.linalg.norm(level))
        if length > 0.5 and (front is None or front @ level < _SAME_WAY * length):
            front = level / length
    animal = skeleton.front_of_four_legs() if person is None else None
    front = animal if front is None else front
    if front is None:
        upwards = int(np.abs(up).argmax())
        front = front_direction(character.rest_vertices * up[upwards], upwards) * up[upwards]
    if animal is not None:
        roles = [
            Role.OTHER if role in _LIMBS and joint not in chosen else role
            for joint, role in enumerate(roles)
        ]
        notes.append(_FOUR_LEGS)
    if not notes and len(roles) > 1 and not _LIMBS.intersection(roles):
        notes.append(_UNKNOWN)
    own_up, own_front = (up, front)
    if person is not None and person.front is not None and person.up @ up < 0.5:
        # It lies, or another axis is up than the file says.
        own_up, own_front = person.up, person.front
    axes = joint_roles.joint_axes(
        rig, tuple(roles), rig.rest[:, :3, 3], directions, own_up, own_front
    )
    sides = joint_roles.joint_sides(rig, np.cross(own_up, own_front))
    for joint, left in enumerate(lefts):
        # Without a trunk in the middle names say more than places.
        if left and (person is None or joint in chosen):
            sides[joint] = Side.LEFT if left > 0 else Side.RIGHT
    known = [
        part if trusted and joint not in chosen else None
        for joint, (part, trusted) in enumerate(zip(parts, by_name, strict=True))
    ]
    labels = joint_labels(
        rig.joint_names,
        rig.parents,
        [part or _part(role, side) for part, role, side in zip(known, roles, sides, strict=True)],
    )
    return Anatomy(tuple(roles), tuple(sides), labels, front, axes, tuple(notes))


def _rename_ends(rig: Rig, parts: list[str | None]) -> None:
    """Call what is above a thigh no shin, and what hangs loose at the end of a shin a foot."""
    is_above = np.zeros(len(parts), dtype=np.bool_)
    for joint in range(len(parts) - 1, -1, -1):
        parent = int(rig.parents[joint])
        if parent >= 0:
            is_above[parent] |= is_above[joint] or (parts[joint] or "").endswith(" thigh")
    for joint, part in enumerate(parts):
        parent, part = int(rig.parents[joint]), part or ""
        if is_above[joint] and part.endswith(_ABOVE_THIGHS):
            name = "shoulder" if " front " in part else "haunch" if " hind " in part else "hip"
            parts[joint] = f"{part.split(' ')[0]} {name}"
        elif parent >= 0 and parent != rig.own_parents[joint] and parts[parent] == part:
            for bone, end in ((" shin", " foot"), (" forearm", " hand")):
                if part.endswith(bone):
                    parts[joint] = part.removesuffix(bone) + end


def _part(role: Role, side: Side) -> str | None:
    part = JOINT_KINDS[role].part
    return None if part is None else f"{side.value} {part}".strip().capitalize()


def _numbered_spine(
    names: Sequence[str], named: Sequence[Role], person: Person | None
) -> list[int]:
    """Return the joints from hips to head where all are one word with numbers, as Rigify's."""
    roles = {} if person is None else person.roles
    words = [re.sub(r"[\W\d_]", "", name) for name in names]
    spine = {words[joint] for joint, role in roles.items() if named[joint] is role is Role.SPINE}
    top = [joint for joint, role in roles.items() if role in (Role.NECK, Role.HEAD)]
    if {named[joint] for joint in top} & {Role.NECK, Role.HEAD}:
        return []
    spine &= {words[joint] for joint in top}
    return [joint for joint, word in enumerate(words) if word in spine]


def _merged(
    named: Sequence[Role], person: Person | None, skeleton: Skeleton
) -> tuple[list[Role], list[bool]]:
    """Return the roles of names and skeleton together, and whether each joint's name counts."""
    roles, trusted = list(named), [True] * len(named)
    if person is None:
        return roles, trusted
    branches = [(list(skeleton.below(root)), order) for root, order in person.limbs.items()]
    in_limbs = {joint for branch, _ in branches for joint in branch}
    trunk = [joint for joint in sorted(person.roles) if joint not in in_limbs]
    n_wrong = 0
    for joints, order in (*branches, (trunk, (*TRUNK, Role.FACE))):
        is_right, counted = _is_in_order(named, joints, order, person, skeleton)
        n_wrong += not is_right
        for joint in joints:
            role = person.roles.get(joint, Role.OTHER)
            if not is_right:
                roles[joint], trusted[joint] = role, named[joint] is Role.OTHER
            elif named[joint] is Role.OTHER and role is not Role.FACE:
                roles[joint] = Role.OTHER if role in counted & _ONE_OF_A_LIMB else role
    if n_wrong > len(branches) // 2:
        # What names say elsewhere is as wrong.
        for joint in set(range(len(named))) - in_limbs - set(trunk):
            roles[joint], trusted[joint] = Role.OTHER, named[joint] is Role.OTHER
    return roles, trusted


def _is_in_order(
    named: Sequence[Role],
    joints: Sequence[int],
    order: Sequence[Role],
    person: Person,
    skeleton: Skeleton,
) -> tuple[bool, set[Role]]:
    """Tell whether the names along a limb may be right, and which roles they name."""
    told = [joint for joint in joints if named[joint] not in (Role.TWIST, Role.OTHER)]
    counted = {named[joint] for joint in told}
    if not counted <= set(order):
        return False, counted
    for joint in told:
        above = next((one for one in skeleton.above(joint) if one in told), joint)
        if order.index(named[above]) > order.index(named[joint]):
            return False, counted
    # A limb both of whose bones are named may be one that the skeleton is wrong about.
    bones = _BONES.intersection(order)
    if bones and bones <= counted:
        return True, counted
    # On a neck or a head hang no arms.
    pairs = [(named[joint], person.roles[joint]) for joint in joints if joint in person.roles]
    contradicts = any(
        (name is not role and name in _ONE_OF_A_LIMB | {Role.TWIST} and role in _ONE_OF_A_LIMB)
        or (name in (Role.NECK, Role.HEAD) and role is Role.SPINE)
        for name, role in pairs
    )
    return not contradicts, counted


def joint_parts(character: Character, anatomy: Anatomy | None = None) -> npt.NDArray[np.str_]:
    """Return the name of each vertex's body part, by the largest weight.

    Parameters
    ----------
    anatomy : of the character, where that is known already

    Returns
    -------
    (V,) array, as "Left forearm"; fingers and toes belong to hands and feet, and what is not known
    is called after its joint

    Raises
    ------
    LCollisionError : the character has no rig.
    """
    known, rig = anatomy or anatomy_of(character), rig_of(character)
    return part_labels(known.labels, rig.joint_of, rig.weights)


def rig_of(character: Character) -> Rig:
    """Return a character's rig.

    Raises
    ------
    LCollisionError : it has none.
    """
    if character.rig is None:
        raise LCollisionError(character.no_rig, "choose a rigged character", where=character.source)
    return character.rig
