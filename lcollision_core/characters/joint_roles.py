"""What joints are, by their names and places: their axes, and how far they turn."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lcollision_core.files.character import Rig
from lcollision_core.meshes.joint_kinds import JOINT_KINDS, Role, Side
from lcollision_core.meshes.part_names import part_names
from lcollision_core.meshes.topology import FloatArray

_BENT = np.radians(6.0)
"""A hinge whose bones lie at this angle at rest turns about their common normal."""

_CLEARLY_BENT = np.radians(25.0)
"""At this angle they do so whatever the front of the body says."""

_PARALLEL = 0.9
"""Cosine from which a bone points too much along a direction to be bent towards it."""

_MIDDLE = 0.02
"""Of the skeleton's extent: joints this near to the middle plane are on neither side."""

_SHORT = 1e-6
"""Of the size of the rig: a bone of this length has no direction."""


_BONES = {
    Role.UPPER_ARM: Role.FOREARM,
    Role.FOREARM: Role.HAND,
    Role.THIGH: Role.SHIN,
    Role.SHIN: Role.FOOT,
}
"""What is at the far end of a limb's bone."""

_ENDS = {Role.SHIN: Role.FOOT, Role.FOREARM: Role.HAND}
"""What hangs loose at the end of a limb's last bone: see `loose_ends`."""


def joint_roles(rig: Rig) -> tuple[Role, ...]:
    """Tell what each of the rig's joints is.

    A forearm is one only below an arm, a shin below a thigh, and a finger below a hand, so that
    limits of hinges are not given to what merely sounds like one. What a forearm hangs on is the
    upper arm also where it is called a shoulder, and a hip of one side above a shin is the thigh.
    Where a rig names both halves of a limb, a joint that is called like the bone that it hangs on
    is a piece of it, and twists; in its place it may be the same joint again, see `_repeats`.
    """
    plain = [
        re.sub(r"[\W_]", "", unicodedata.normalize("NFKC", re.split("[:|]", name)[-1]).lower())
        for name in rig.joint_names
    ]
    named = [
        next(role for role in Role if re.search(JOINT_KINDS[role].words, name)) for name in plain
    ]
    parts = part_names(rig.joint_names)
    for joint, role in enumerate(named):
        above = rig.parents[joint]
        while above >= 0 and named[above] is Role.TWIST:
            above = rig.parents[above]
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
        above = parent
        while above >= 0 and roles[above] is Role.TWIST:
            above = rig.parents[above]
        bone = roles[above] if above >= 0 else None
        if repeats[joint]:
            role = roles[parent]
        elif parent != rig.own_parents[joint] and bone in _ENDS:
            # Whatever a target of inverse kinematics is called, as "IK leg".
            role = _ENDS[bone]
        elif role in halves and role is bone and halves[role] in named:
            role = Role.TWIST
        elif role in (Role.FOREARM, Role.SHIN):
            role = role if bone is halves[role] else Role.OTHER
        elif role in (Role.PALM, Role.THUMB, Role.FINGER):
            role = role if in_hand[joint] else Role.OTHER
        elif role is Role.OTHER and parts[joint] == "Head":
            role = Role.FACE
        roles.append(role)
    return tuple(roles)


def _repeats(rig: Rig, roles: Sequence[Role]) -> npt.NDArray[np.bool_]:
    """Return which of the J joints move as their parents do: controls exported with the skin's.

    They lie in the parent's place, have its role, and the parent has no skin of its own. In the
    trunk, where legs may hang on one of two such joints, their names must be the same too.
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


def joint_sides(rig: Rig, left: FloatArray) -> list[Side]:
    """Tell on which side each of the rig's J joints is: that on which its limb leaves the trunk.

    Parameters
    ----------
    left : (3,) unit vector
    """
    places = rig.rest[:, :3, 3] @ left
    places = (places - np.median(places)) / float(np.ptp(rig.rest[:, :3, 3], axis=0).max() or 1.0)
    sides: list[Side] = []
    for parent, place in zip(rig.parents.tolist(), places, strict=True):
        own = Side.LEFT if place > _MIDDLE else Side.RIGHT if place < -_MIDDLE else Side.MIDDLE
        above = sides[parent] if parent >= 0 else Side.MIDDLE
        sides.append(own if above is Side.MIDDLE else above)
    return sides


def next_in_limb(rig: Rig, roles: Sequence[Role]) -> dict[int, int]:
    """Return for thighs, shins and both halves of arms the joint at their bones' other end."""
    found: dict[int, int] = {}
    for joint, role in enumerate(roles):
        above = int(rig.parents[joint])
        while above >= 0 and roles[above] is Role.TWIST:
            above = int(rig.parents[above])
        if above >= 0 and _BONES.get(roles[above]) is role:
            found.setdefault(above, joint)
    return found


def bone_directions(rig: Rig, origins: FloatArray, roles: Sequence[Role]) -> FloatArray:
    """Return the unit vectors along which the joints' bones lie in the rest pose: (J, 3).

    Towards the joint that follows in a limb, else the children's middle, else the middle of the
    vertices that the joint moves, else on from the parent.

    Parameters
    ----------
    origins : (J, 3) of the joints
    roles : of J joints
    """
    size = float(np.ptp(origins, axis=0).max()) + float(np.ptp(rig.points, axis=(0, 1)).max())
    directions = np.zeros_like(origins)
    heaviest = rig.joint_of[np.arange(len(rig.joint_of)), rig.weights.argmax(axis=1)]
    next_of = next_in_limb(rig, roles)
    for joint, parent in enumerate(rig.parents):
        following = rig.parents == joint
        if joint in next_of:
            following = np.arange(len(origins)) == next_of[joint]
        ends = origins[following] - origins[joint]
        ends = ends[np.linalg.norm(ends, axis=1) > _SHORT * size]
        led = np.flatnonzero(heaviest == joint)
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


def front_of(
    roles: Sequence[Role], origins: FloatArray, directions: FloatArray, up: FloatArray
) -> FloatArray | None:
    """Return the horizontal unit vector along which a body faces; None if its joints do not tell.

    Where its feet point; of a body that lies more than it stands, as an animal's whose hooves point
    down, along its spine to its head.

    Parameters
    ----------
    roles : of J joints
    origins : (J, 3), where they are at rest
    directions : (J, 3), their bones' at rest
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


def joint_axes(
    rig: Rig,
    roles: tuple[Role, ...],
    origins: FloatArray,
    directions: FloatArray,
    up: FloatArray,
    front: FloatArray,
) -> FloatArray:
    """Return the axes that joints turn about in the rest pose: (J, 3, 3), an axis a column.

    The first bends the bone forward (fingers towards the palm, hinges the way they go), the second
    lies along the bone, the third turns it sideways.
    """
    middle = origins.mean(axis=0)
    above = {hinge: joint for joint, hinge in next_in_limb(rig, roles).items()}
    axes = np.empty((len(origins), 3, 3))
    for joint, (role, bone) in enumerate(zip(roles, directions, strict=True)):
        towards = front
        if role is Role.SHIN:
            towards = -front
        elif role is Role.FINGER:
            # The palms face down in a T pose, and the body where the arms hang.
            towards = -up
            if abs(bone @ up) > _PARALLEL:
                towards = middle - origins[joint]
        if abs(bone @ towards) > _PARALLEL * np.linalg.norm(towards):
            towards = up if abs(bone @ up) <= _PARALLEL else front
        bend = np.cross(bone, towards)
        if role in (Role.FOREARM, Role.SHIN):
            normal = np.cross(directions[above.get(joint, rig.parents[joint])], bone)
            angle = float(np.linalg.norm(normal))
            # A hinge that is all but straight may be a little past it, or to a side.
            is_sure = angle > np.sin(_CLEARLY_BENT)
            if angle > np.sin(_BENT) and (is_sure or normal @ bend > 0.5 * angle):
                bend = normal
        bend /= np.linalg.norm(bend)
        axes[joint] = np.stack([bend, bone, np.cross(bend, bone)], axis=1)
    return axes


def joint_limits(rig: Rig, roles: tuple[Role, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of the joints' rotation vectors in their axes, (J, 3) each, in radians.

    Both are 0 where a joint does not turn.
    """
    bounds = np.radians(np.array([JOINT_KINDS[role].limits for role in roles], dtype=np.float64))
    for joint, (role, parent) in enumerate(zip(roles, rig.parents, strict=True)):
        # Only the first joint of a finger turns sideways.
        if role is Role.FINGER and parent >= 0 and roles[parent] is Role.FINGER:
            bounds[joint, 2] = 0.0
    bounds[_repeats(rig, roles)] = 0.0
    return bounds[:, :, 0], bounds[:, :, 1]
