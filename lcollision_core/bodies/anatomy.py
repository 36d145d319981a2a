"""Recognise a rig's joints by names and by the skeleton's shape: roles, sides and axes."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.skeletons import FINGERS, TRUNK, Person, Skeleton
from lcollision_core.errors import LCollisionError
from lcollision_core.files.character import Character, Rig
from lcollision_core.meshes.extents import front_direction
from lcollision_core.meshes.joint_kinds import (
    JOINT_KINDS,
    Role,
    Side,
    joint_labels,
    part_labels,
    part_names,
)
from lcollision_core.meshes.topology import FloatArray

_BENT = np.radians(6.0)
"""Angle between a hinge's bones at rest above which it turns about their common normal."""

_CLEARLY_BENT = np.radians(25.0)
"""Angle above which it does so even against the body's front."""

_PARALLEL = 0.9
"""Cosine above which a bone is too parallel to a direction to bend towards it."""

_MIDDLE = 0.02
"""Distance from the middle plane, as a share of the extent, within which joints have no side."""

_SHORT = 1e-6
"""Length of a bone, relative to the rig's size, below which it has no direction."""


_BONES = {
    Role.UPPER_ARM: Role.FOREARM,
    Role.FOREARM: Role.HAND,
    Role.THIGH: Role.SHIN,
    Role.SHIN: Role.FOOT,
}
"""The role at the far end of each limb bone."""

_ENDS = {Role.SHIN: Role.FOOT, Role.FOREARM: Role.HAND}
"""The role of a loose end of a limb's last bone: see `loose_ends`."""


def joint_roles(rig: Rig) -> tuple[Role, ...]:
    """Return each joint's role by the names of the rig.

    A forearm must be below an arm, a shin below a thigh and a finger below a hand, so that a
    misleading name gets no hinge limits. A forearm's parent is the upper arm even if it is named
    shoulder, and a one-sided hip above a shin is the thigh. If a rig names both halves of a limb,
    a joint with the same role as its parent bone is a piece of it, a twist; in the same position
    it may repeat the joint, see `_repeats`.
    """
    named = [role_of_word(name) for name in rig.joint_names]
    parts = part_names(rig.joint_names)
    for joint, role in enumerate(named):
        above = _untwisted_parent(rig, joint, named)
        bone = named[above] if above >= 0 else None
        if bone is Role.SHOULDER and role is Role.FOREARM:
            named[above] = Role.UPPER_ARM
        elif bone is Role.OTHER and role is Role.SHIN and "thigh" in (parts[above] or ""):
            named[above] = Role.THIGH
    repeats = _repeats(rig, named)
    halves = {Role.FOREARM: Role.UPPER_ARM, Role.SHIN: Role.THIGH}
    halves |= {above: below for below, above in halves.items()}
    roles: list[Role] = []
    in_hand: list[bool] = []
    for joint, (role, parent) in enumerate(zip(named, rig.parents, strict=True)):
        in_hand.append(role is Role.HAND or bool(parent >= 0 and in_hand[parent]))
        above = _untwisted_parent(rig, joint, roles)
        bone = roles[above] if above >= 0 else None
        if repeats[joint]:
            role = roles[parent]
        elif parent != rig.own_parents[joint] and bone in _ENDS:
            # An IK target, whatever its name, such as "IK leg".
            role = _ENDS[bone]
        elif role in halves and role is bone and halves[role] in named:
            role = Role.TWIST
        elif role in (Role.FOREARM, Role.SHIN):
            role = role if bone is halves[role] else Role.OTHER
        elif role in (Role.PALM, Role.THUMB, Role.FINGER):
            role = role if in_hand[joint] else Role.OTHER
        elif role is bone is Role.FOOT and "ankle" in plain_name(rig.joint_names[above]):
            # As SMPL has it: what its foot turns about is the ball.
            role = Role.TOE
        elif role in (Role.OTHER, Role.TOE) and parts[joint] == "Head":
            # The "ball" of a hair strand does not belong to a foot.
            role = Role.FACE
        roles.append(role)
    return tuple(roles)


def _untwisted_parent(rig: Rig, joint: int, roles: Sequence[Role]) -> int:
    """Return a joint's nearest ancestor that is no twist, -1 for none."""
    above = int(rig.parents[joint])
    while above >= 0 and roles[above] is Role.TWIST:
        above = int(rig.parents[above])
    return above


def plain_name(name: str) -> str:
    """Return a joint's name in lower case letters and digits, without its namespace."""
    last = unicodedata.normalize("NFKC", re.split("[:|]", name)[-1])
    return re.sub(r"[\W_]", "", last.lower())


def role_of_word(name: str) -> Role:
    """Return a joint's role by its name alone."""
    plain = plain_name(name)
    return next(role for role in Role if re.search(JOINT_KINDS[role].words, plain))


def _repeats(rig: Rig, roles: Sequence[Role]) -> npt.NDArray[np.bool_]:
    """Return a (J,) mask of joints that duplicate their parents, such as exported controls.

    They have the parent's position and role, and the parent has no skin of its own. In the trunk,
    where legs may be attached to one of two such joints, their names must be equal too.
    """
    skinned = np.isin(np.arange(len(roles)), rig.joint_of[rig.weights > 0.0])
    places = rig.rest[:, :3, 3]
    near = _SHORT * float(np.ptp(places, axis=0).max())
    plain = [re.sub("^(def|org|mch)|[^a-z0-9]", "", name.lower()) for name in rig.joint_names]
    repeats = np.zeros(len(roles), dtype=np.bool_)
    for joint, parent in enumerate(rig.parents.tolist()):
        if parent < 0 or skinned[parent] or roles[parent] is not roles[joint]:
            continue
        is_shared = roles[joint] in (Role.SPINE, Role.OTHER, Role.FACE)
        repeats[joint] = bool(np.linalg.norm(places[joint] - places[parent]) <= near) and (
            not is_shared or plain[joint] == plain[parent]
        )
    return repeats


def joint_sides(rig: Rig, left: FloatArray, known: Mapping[int, Side]) -> list[Side]:
    """Return the side of each of the rig's J joints, that on which its limb leaves the trunk.

    Parameters
    ----------
    left : (3,) unit vector
    known : sides of some joints
    """
    places = rig.rest[:, :3, 3] @ left
    places = (places - np.median(places)) / float(np.ptp(rig.rest[:, :3, 3], axis=0).max() or 1.0)
    sides: list[Side] = []
    for joint, (parent, place) in enumerate(zip(rig.parents.tolist(), places, strict=True)):
        side = Side.LEFT if place > _MIDDLE else Side.RIGHT if place < -_MIDDLE else Side.MIDDLE
        above = sides[parent] if parent >= 0 else Side.MIDDLE
        side = known.get(joint, side)
        sides.append(side if above is Side.MIDDLE else above)
    return sides


def limb_children(rig: Rig, roles: Sequence[Role]) -> dict[int, int]:
    """Return the joint at the far end of each thigh, shin, upper arm and forearm."""
    next_joint: dict[int, int] = {}
    for joint, role in enumerate(roles):
        above = _untwisted_parent(rig, joint, roles)
        if above >= 0 and _BONES.get(roles[above]) is role:
            next_joint.setdefault(above, joint)
    return next_joint


def bone_directions(rig: Rig, origins: FloatArray, roles: Sequence[Role]) -> FloatArray:
    """Return the unit vectors of the joints' bones in the rest pose: (J, 3).

    They point to the limb's next joint, else to the mean of the children, else to the mean of the
    vertices that the joint moves, else as the parent's.

    Parameters
    ----------
    origins : (J, 3) of the joints
    roles : of J joints
    """
    size = float(np.ptp(origins, axis=0).max()) + float(np.ptp(rig.points, axis=(0, 1)).max())
    directions = np.zeros_like(origins)
    next_of = limb_children(rig, roles)
    for joint, parent in enumerate(rig.parents):
        following = rig.parents == joint
        if joint in next_of:
            following = np.arange(len(origins)) == next_of[joint]
        ends = origins[following] - origins[joint]
        ends = ends[np.linalg.norm(ends, axis=1) > _SHORT * size]
        led = np.flatnonzero(rig.heaviest == joint)
        if len(ends):
            way = ends.mean(axis=0)
        elif len(led):
            way = rig.points[led].mean(axis=(0, 1)) - origins[joint]
        else:
            way = np.zeros(3)
        length = float(np.linalg.norm(way))
        if length > _SHORT * size:
            directions[joint] = way / length
        else:
            directions[joint] = directions[parent] if parent >= 0 else np.eye(3)[1]
    return directions


def axes_of(up: FloatArray, front: FloatArray) -> FloatArray:
    """Return left, up and front as columns."""
    return np.stack([np.cross(up, front), up, front], axis=1)


def front_of(
    roles: Sequence[Role], origins: FloatArray, directions: FloatArray, up: FloatArray
) -> FloatArray | None:
    """Return the horizontal unit vector along which a body faces; None if undetermined.

    It is the direction of the feet or, if the trunk is more level than upright, as an animal's
    whose hooves point down, that of the spine towards the head.

    Parameters
    ----------
    roles : of J joints
    origins : (J, 3) positions at rest
    directions : (J, 3) bone directions at rest
    up : (3,) unit vector
    """

    def level(way: FloatArray) -> FloatArray:
        flat: FloatArray = way - (way @ up) * up
        return flat

    if Role.HEAD in roles and Role.SPINE in roles:
        way = origins[roles.index(Role.HEAD)] - origins[roles.index(Role.SPINE)]
        length = float(np.linalg.norm(level(way)))
        if length > abs(way @ up):
            return level(way) / length
    feet = [joint for joint, role in enumerate(roles) if role is Role.FOOT]
    way = level(directions[feet].sum(axis=0))
    length = float(np.linalg.norm(way))
    return way / length if length > 0.5 * len(feet) * (1 - _PARALLEL) and feet else None


def front_by_sides(
    lefts: Sequence[int], origins: FloatArray, up: FloatArray, front: FloatArray
) -> FloatArray:
    """Return the horizontal unit vector that has the joints named left on its left.

    Parameters
    ----------
    lefts : J numbers, 1 for left by name, -1 for right, 0 for neither
    origins : (J, 3) positions at rest
    up, front : (3,) unit vectors; `front`, by which poses are stored, stays if no name contradicts
    """
    named = np.array(lefts)
    if not ((named > 0).any() and (named < 0).any()):
        return front
    left = origins[named > 0].mean(axis=0) - origins[named < 0].mean(axis=0)
    way = np.cross(left, up)
    length = float(np.linalg.norm(way))
    is_known = length > _MIDDLE * np.ptp(origins, axis=0).max()
    return way / length if is_known and way @ front < _SAME_WAY * length else front


def joint_axes(
    rig: Rig,
    roles: tuple[Role, ...],
    origins: FloatArray,
    directions: FloatArray,
    up: FloatArray,
    front: FloatArray,
) -> FloatArray:
    """Return the joints' axes in the rest pose: (J, 3, 3), as columns.

    The first bends the bone forward (fingers towards the palm, hinges in their direction), the
    second lies along the bone, the third turns it sideways.
    """
    middle = origins.mean(axis=0)
    above = {hinge: joint for joint, hinge in limb_children(rig, roles).items()}
    axes = np.empty((len(origins), 3, 3))
    for joint, (role, bone) in enumerate(zip(roles, directions, strict=True)):
        towards = front
        if role is Role.SHIN:
            towards = -front
        elif role is Role.FINGER:
            # Palms face down in a T pose, and towards the body if the arms hang.
            towards = -up
            if abs(bone @ up) > _PARALLEL:
                towards = middle - origins[joint]
        if abs(bone @ towards) > _PARALLEL * np.linalg.norm(towards):
            towards = up if abs(bone @ up) <= _PARALLEL else front
        bend = np.cross(bone, towards)
        if role in (Role.FOREARM, Role.SHIN):
            normal = np.cross(directions[above.get(joint, rig.parents[joint])], bone)
            angle = float(np.linalg.norm(normal))
            # A nearly straight hinge may be slightly overextended or skewed.
            is_sure = angle > np.sin(_CLEARLY_BENT)
            if angle > np.sin(_BENT) and (is_sure or normal @ bend > 0.5 * angle):
                bend = normal
        bend /= np.linalg.norm(bend)
        axes[joint] = np.stack([bend, bone, np.cross(bend, bone)], axis=1)
    return axes


def joint_limits(rig: Rig, roles: tuple[Role, ...]) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the joints' rotation vectors in their axes, (J, 3) each, in radians.

    Both are 0 for joints that do not turn.
    """
    bounds = np.radians(np.array([JOINT_KINDS[role].limits for role in roles], dtype=np.float64))
    for joint, (role, parent) in enumerate(zip(roles, rig.parents, strict=True)):
        # Only the first joint of a finger turns sideways.
        if role is Role.FINGER and parent >= 0 and roles[parent] is Role.FINGER:
            bounds[joint, 2] = 0.0
    bounds[_repeats(rig, roles)] = 0.0
    return bounds[:, :, 0], bounds[:, :, 1]


ROLE_NAMES: Mapping[str, tuple[Role, Side]] = {
    f"{kind.label}-{side.value}" if kind.is_paired else kind.label: (role, side)
    for role, kind in JOINT_KINDS.items()
    for side in ((Side.LEFT, Side.RIGHT) if kind.is_paired else (Side.MIDDLE,))
}
"""Roles that a user can assign to joints."""


def role_name(role: Role, side: Side) -> str:
    """Return a joint's entry of `ROLE_NAMES`; "unknown" also for a limb joint without a side."""
    return next(
        (
            name
            for name, (entry, own) in ROLE_NAMES.items()
            if entry is role and own in (side, Side.MIDDLE)
        ),
        "unknown",
    )


_LIMBS = frozenset(role for role, kind in JOINT_KINDS.items() if kind.part) - {*TRUNK, Role.FACE}
_LIMB_BONES = frozenset((Role.UPPER_ARM, Role.FOREARM, Role.THIGH, Role.SHIN))
_ONE_OF_A_LIMB = _LIMBS - {Role.TOE, *FINGERS} | {Role.HEAD}

_ABOVE_THIGHS = (" shin", " leg", " hind shoulder")
"""Endings of part names that cannot apply above a thigh."""

_SAME_WAY = 0.9
"""Least cosine between feet and front for them to agree."""

_UNKNOWN = (
    "its joints are not recognised as a person's, so random poses turn them little; set their "
    "roles in the menus of their sliders, or with `lcollision domains --role`"
)
_FOUR_LEGS = "it stands on four legs, so random poses turn its limbs only a little"


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Roles of a rig's J joints, and the direction that the body faces.

    Attributes
    ----------
    roles, sides : of each joint
    labels : J names of body parts
    front : (3,) horizontal unit vector
    axes : (J, 3, 3): see `joint_axes`
    notes : sentences about unknown joints
    """

    roles: tuple[Role, ...]
    sides: tuple[Side, ...]
    labels: tuple[str, ...]
    front: FloatArray
    axes: FloatArray
    notes: tuple[str, ...]


def anatomy_of(character: Character) -> Anatomy:
    """Recognise the joints of a character's rig.

    Names and skeleton are compared limb by limb: names that cannot follow each other along a limb
    are ignored there. If the skeleton is not a person's, only names count.

    Raises
    ------
    LCollisionError : the character has no rig.
    """
    rig, up = rig_of(character), character.up
    chosen_roles = {
        rig.joint_names.index(name): ROLE_NAMES[role] for name, role in rig.chosen.items()
    }
    parts = list(part_names(rig.joint_names))
    lefts = [
        -1 if part.startswith("Right ") else int(part.startswith("Left "))
        for part in (part or "" for part in parts)
    ]
    for joint, (_, side) in chosen_roles.items():
        lefts[joint] = {Side.LEFT: 1, Side.RIGHT: -1, Side.MIDDLE: 0}[side]
    named = list(joint_roles(rig))
    _rename_ends(rig, parts)
    skeleton = Skeleton(rig, named, lefts, up)
    person, notes = skeleton.person(), []
    for joint in _numbered_spine(rig.joint_names, named, person):
        named[joint] = Role.OTHER
        if person is not None and joint in person.roles:
            parts[joint] = None
    roles, by_name = _merged(named, person, skeleton)
    for joint, (role, _) in chosen_roles.items():
        roles[joint] = role
    directions = bone_directions(rig, rig.rest[:, :3, 3], roles)
    front = front_of(roles, rig.rest[:, :3, 3], directions, up)
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
    if person is None:  # Like the sides below.
        front = front_by_sides(lefts, rig.rest[:, :3, 3], up, front)
    if animal is not None:
        roles = [
            Role.OTHER if role in _LIMBS and joint not in chosen_roles else role
            for joint, role in enumerate(roles)
        ]
        notes.append(_FOUR_LEGS)
    if not notes and len(roles) > 1 and not _LIMBS.intersection(roles):
        notes.append(_UNKNOWN)
    own_up, own_front = (up, front)
    if person is not None and person.front is not None and person.up @ up < 0.5:
        # It lies down, or the file is wrong about the up axis.
        own_up, own_front = person.up, person.front
    axes = joint_axes(rig, tuple(roles), rig.rest[:, :3, 3], directions, own_up, own_front)
    left = np.cross(own_up, own_front)
    sides = joint_sides(rig, left, skeleton.sides_of(person, left) if person else {})
    for joint, named_left in enumerate(lefts):
        # Without a trunk in the middle, names are more reliable than positions.
        if named_left and (person is None or joint in chosen_roles):
            sides[joint] = Side.LEFT if named_left > 0 else Side.RIGHT
    trusted_parts = [
        part if trusted and joint not in chosen_roles else None
        for joint, (part, trusted) in enumerate(zip(parts, by_name, strict=True))
    ]
    labels = joint_labels(
        rig.joint_names,
        rig.parents,
        [
            part or _part(role, side)
            for part, role, side in zip(trusted_parts, roles, sides, strict=True)
        ],
    )
    return Anatomy(tuple(roles), tuple(sides), labels, front, axes, tuple(notes))


def _rename_ends(rig: Rig, parts: list[str | None]) -> None:
    """Rename shins above a thigh, and loose ends of shins and forearms as feet and hands."""
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
    kind = JOINT_KINDS[role]
    of_side = f"{side.value} " if kind.is_paired else ""
    return None if kind.part is None else f"{of_side}{kind.part}".strip().capitalize()


def _numbered_spine(
    names: Sequence[str], named: Sequence[Role], person: Person | None
) -> list[int]:
    """Return the joints of a spine that is one numbered word up to the head, as Rigify's."""
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
    """Return merged roles of names and skeleton, and whether to trust each joint's name."""
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
        # Distrust the remaining names too.
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
    """Return whether the names along a limb may be right, and the roles that they name."""
    named_joints = [joint for joint in joints if named[joint] not in (Role.TWIST, Role.OTHER)]
    counted = {named[joint] for joint in named_joints}
    if not counted <= set(order):
        return False, counted
    for joint in named_joints:
        above = next((higher for higher in skeleton.above(joint) if higher in named_joints), joint)
        if order.index(named[above]) > order.index(named[joint]):
            return False, counted
    # If both bones of a limb are named, the skeleton may be wrong about it.
    bones = _LIMB_BONES.intersection(order)
    if bones and bones <= counted:
        return True, counted
    # A neck or a head has no arms.
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
    anatomy : of the character, if already known

    Returns
    -------
    (V,) array, as "Left forearm"; fingers and toes belong to hands and feet, and unknown parts
    are named after their joints

    Raises
    ------
    LCollisionError : the character has no rig.
    """
    joint_anatomy, rig = anatomy or anatomy_of(character), rig_of(character)
    return part_labels(joint_anatomy.labels, rig.joint_of, rig.weights)


def rig_of(character: Character) -> Rig:
    """Return a character's rig.

    Raises
    ------
    LCollisionError : it has none.
    """
    if character.rig is None:
        raise LCollisionError(character.no_rig, "choose a rigged character", where=character.source)
    return character.rig
