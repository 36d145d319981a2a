"""Left and right of a rig: its joints' partners, and the mirror images of its poses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.mirror import PoseMirror
from lcollision_core.characters import RigPoseSpace
from lcollision_core.jobs import Job
from lcollision_core.meshes.joint_kinds import Role, Side

FloatArray = npt.NDArray[np.float64]

_TOLERANCE = 0.02
"""Normalised: how far a joint may lie from its partner's mirror image where no name tells."""

_NEARER = 1e-4
"""Normalised: how much farther apart than they are joints count whose roles are neighbours."""

_ALONG_AXIS = 0.99
"""Cosine from which the way from right to left lies along an axis."""

_ALIKE = np.radians(10.0)
"""Angle up to which a bone lies at rest as the mirror image of its partner does."""

_MIDDLE = {Role.SPINE, Role.NECK, Role.HEAD}
_LOOSE = {Role.OTHER, Role.FACE}

_SIDES = (
    *(("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("左", "右")),
    *(("links", "rechts"), ("gauche", "droite"), ("izquierda", "derecha")),
)
"""Words for the sides, wherever they stand in a name."""

_SHORT_SIDES = (("l", "r"), ("lf", "rt"), ("lt", "rt"), ("lft", "rgt"))
"""Others, which stand alone: "arm.L", "l_arm", "ArmL", "lArm", "Bip01 L Arm"."""


@dataclass(frozen=True, eq=False)
class JointSides:
    """Left and right of a rig. Lengths are normalised.

    Attributes
    ----------
    partner : (J,) each joint's mirror image, its own inverse; -1 of one that has none and keeps its
        turn, as that of a sword
    normal : (3,) unit vector, from one side to the other
    offset : of the plane between them along the normal
    between : (J, 3, 3) rotation from where the partner's mirror image lies at rest to where the
        joint does: 1 unless the rest pose is not symmetric, as where one arm is raised
    """

    partner: npt.NDArray[np.intp]
    normal: FloatArray
    offset: float
    between: FloatArray


def named_pairs(names: Sequence[str]) -> list[tuple[int, int]]:
    """Return the left and the right one of joints whose names differ in the side alone."""
    number = {name: joint for joint, name in enumerate(names)}
    pairs = []
    for joint, name in enumerate(names):
        found = (one for one in _on_the_right(name) if one != name and one in number)
        other = next(found, None)
        if other is not None:
            # A name is of one pair.
            pairs.append((joint, number.pop(other)))
    return pairs


def _on_the_right(name: str) -> list[str]:
    """Return what a joint on the left may be called on the right."""
    found = [name.replace(left, right) for left, right in _SIDES]
    for left, right in _SHORT_SIDES:
        for a, b in ((left, right), (left.capitalize(), right.capitalize())):
            found.append(re.sub(rf"(?<![A-Za-z]){a}(?=[A-Z][a-z]|[^A-Za-z]|$)", b, name))
        a, b = left.upper(), right.upper()
        found.append(re.sub(rf"(?<![A-Z]){a}(?![A-Za-z])", b, name))
    return found


def find_joint_sides(space: RigPoseSpace) -> JointSides | None:
    """Find each joint's partner on the other side, by its name, else by its place at rest.

    The plane between the sides is the middle one of the joints of spine, neck and head, else of
    the pairs, else of all, so that a sword or a plait does not move it.

    Returns
    -------
    sides : None where no joint has a partner, and one lies on neither side
    """
    pairs = np.array(named_pairs(space.rig.joint_names), dtype=np.intp).reshape(-1, 2)
    normal = _normal(space, pairs)
    counted = np.unique(space.joint_of_code[space.joint_of_code >= 0])
    across = space.origins @ normal
    in_middle = [joint for joint in counted if space.roles[joint] in _MIDDLE]
    in_middle = [joint for joint in in_middle if joint not in pairs] or in_middle
    of_pairs = across[pairs].mean(axis=1) if len(pairs) else across[counted]
    offset = float(np.median(across[in_middle] if in_middle else of_pairs))
    partner = np.full(space.n_joints, -1)
    partner[pairs[:, 0]], partner[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    others = counted[partner[counted] < 0]
    if len(others):
        found = _by_place(space, others, normal, offset)
        partner[others[found >= 0]] = others[found[found >= 0]]
        for left, right in _by_role(space, others[found < 0]):
            partner[left], partner[right] = right, left
    has_pairs = bool((partner != np.arange(len(partner)))[partner >= 0].any())
    carries = partner >= 0
    for joint in range(space.n_joints - 1, 0, -1):
        carries[space.rig.parents[joint]] |= carries[joint] and space.rig.parents[joint] >= 0
    alone = partner < 0
    if not has_pairs and alone[counted].any():
        return None
    # Between the sides: what both hang on.
    in_trunk = np.isin(np.arange(space.n_joints), in_middle) | carries
    partner[alone & in_trunk] = np.flatnonzero(alone & in_trunk)
    between = _between(space, partner, normal)
    return JointSides(partner, normal, offset, between)


def _normal(space: RigPoseSpace, pairs: npt.NDArray[np.intp]) -> FloatArray:
    """Return the unit vector from right to left, an axis where it nearly is one."""
    left = np.cross(space.up, space.front)
    ways = space.origins[pairs[:, 0]] - space.origins[pairs[:, 1]]
    way = ways.sum(axis=0)
    way -= (way @ space.up) * space.up
    length = float(np.linalg.norm(way))
    normal: FloatArray = way / length if length > _TOLERANCE else left
    axis = int(np.abs(normal).argmax())
    is_axis = length <= _TOLERANCE or abs(normal[axis]) > _ALONG_AXIS
    return np.eye(3)[axis] if is_axis else normal


def _by_place(
    space: RigPoseSpace, joints: npt.NDArray[np.intp], normal: FloatArray, offset: float
) -> npt.NDArray[np.intp]:
    """Return the number, among some joints, of the one at each one's mirror image; -1 for none."""
    # Of two joints in one place, as a hand and what it holds, the one of the same role is nearer.
    kinds = [list(Role).index(space.roles[joint]) for joint in joints]
    places = np.column_stack([space.origins[joints], _NEARER * np.array(kinds)])
    image = places.copy()
    image[:, :3] -= 2.0 * np.outer(space.origins[joints] @ normal - offset, normal)
    distance, nearest = cKDTree(places).query(image)
    # Joints in one place, as those of twists, are told apart by their order.
    for place in np.unique(nearest):
        same = np.flatnonzero(np.linalg.norm(places - places[place], axis=1) < 1e-6)
        at = np.flatnonzero(np.isin(nearest, same))
        if len(at) == len(same):
            nearest[at] = same
    alone = (distance > _TOLERANCE) | (nearest[nearest] != np.arange(len(joints)))
    found: npt.NDArray[np.intp] = np.where(alone, -1, nearest)
    return found


def _by_role(
    space: RigPoseSpace, joints: npt.NDArray[np.intp]
) -> list[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Return the left and the right of some joints of each role of which there are equally many."""
    sides, roles = np.array(space.sides)[joints], np.array(space.roles)[joints]
    pairs = []
    for role in dict.fromkeys(roles.tolist()):
        left, right = (
            joints[(roles == role) & (sides == side)] for side in (Side.LEFT, Side.RIGHT)
        )
        if role not in _MIDDLE | _LOOSE and len(left) == len(right):
            pairs.append((left, right))
    return pairs


def _between(space: RigPoseSpace, partner: npt.NDArray[np.intp], normal: FloatArray) -> FloatArray:
    """Return `JointSides.between`, by the bones to the joints that hang on both partners."""
    parents = space.rig.parents
    flip = np.eye(3) - 2.0 * np.outer(normal, normal)
    between = np.broadcast_to(np.eye(3), (len(partner), 3, 3)).copy()
    for joint, other in enumerate(partner.tolist()):
        if other in (joint, -1):
            continue
        ends = np.flatnonzero(parents == joint)
        ends = ends[(partner[ends] >= 0) & (parents[partner[ends]] == other)]
        own = (space.origins[ends] - space.origins[joint]).sum(axis=0)
        image = flip @ (space.origins[partner[ends]] - space.origins[other]).sum(axis=0)
        lengths = np.linalg.norm(own) * np.linalg.norm(image)
        parent = int(parents[joint])
        if lengths <= _NEARER**2:
            # The end of a limb lies as what it hangs on.
            between[joint] = between[parent] if parent >= 0 else np.eye(3)
        elif np.arccos(np.clip(own @ image / lengths, -1.0, 1.0)) > _ALIKE:
            axis = np.cross(image, own)
            sine = float(np.linalg.norm(axis))
            if sine > _NEARER * lengths:
                angle = np.arctan2(sine, image @ own)
                between[joint] = Rotation.from_rotvec(angle * axis / sine).as_matrix()
    return between


@dataclass(frozen=True, eq=False)
class RigMirror(PoseMirror):
    """Exchanges left and right of a character's poses: each joint moves as its partner's image.

    The mesh need not be symmetric.

    Attributes
    ----------
    space : of the poses
    sides : of its joints
    """

    space: RigPoseSpace
    sides: JointSides

    def _codes_of_image(
        self,
        latent: FloatArray,
        image: FloatArray,  # noqa: ARG002 - the joints tell more than the vertices
        job: Job,  # noqa: ARG002 - it is one step
    ) -> FloatArray:
        flip, sides = self.symmetry.flip, self.sides
        moved = self.space.transforms(latent) @ np.linalg.inv(self.space.rig.rest)
        mirrored = flip @ moved[sides.partner] @ flip
        mirrored[:, :3, :3] @= np.swapaxes(sides.between, 1, 2)
        codes = self.space.codes_of_transforms(mirrored @ self.space.rig.rest)
        joints = self.space.joint_of_code
        stays = (joints >= 0) & (sides.partner[joints] < 0)
        return np.where(stays, latent, codes)

    def _misfit(
        self,
        latent: FloatArray,
        mirrored: FloatArray,
        off: FloatArray,
    ) -> FloatArray:
        # By the joints, as the sides of the mesh may differ.
        places = self.space.transforms(latent)[self.sides.partner, :3, 3]
        off = self.space.transforms(mirrored)[:, :3, 3] - self.symmetry.reflect(places)
        distances: FloatArray = np.linalg.norm(off[self.sides.partner >= 0], axis=1)
        return distances / self.space.body_size

    def partner(self, domain: int) -> int | None:
        """Return the body part on the other side; None for one that has none there."""
        part_of_joint, partner = self.space.part_of_joint, self.sides.partner

        def image(of: int) -> int:
            mates = partner[np.flatnonzero(part_of_joint == of)]
            mates = mates[mates >= 0]
            return int(np.bincount(part_of_joint[mates]).argmax()) if len(mates) else of

        other = image(domain)
        return other if other != domain == image(other) else None
