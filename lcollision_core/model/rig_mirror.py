"""Left and right of a rig: its joints' partners, and the mirror images of its poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lcollision_core.characters import RigPoseSpace
from lcollision_core.characters.joint_roles import Role
from lcollision_core.jobs import CancelToken
from lcollision_core.model.mirror import PoseMirror

FloatArray = npt.NDArray[np.float64]

_TOLERANCE = 0.02
"""Normalised: how far a joint may lie from its partner's mirror image."""

_NEARER = 1e-4
"""Normalised: how much farther apart than they are joints count whose roles are neighbours."""

_MIDDLE = {Role.SPINE, Role.NECK, Role.HEAD}
_LOOSE = {Role.OTHER, Role.FACE}


def find_joint_partners(
    space: RigPoseSpace,
) -> tuple[npt.NDArray[np.intp], int, float] | None:
    """Find each joint's partner on the other side, by the places of the rest pose.

    The plane between the sides is the middle one of the joints of spine, neck and head, else of
    all, so that a sword or a plait does not move it.

    Returns
    -------
    partner : (J,) each joint's mirror image, its own inverse; -1 of one that has none and keeps its
        turn, as that of a sword, on which nothing with a partner hangs
    axis : 0, 1 or 2, from one side to the other
    offset : of the plane along the axis, normalised
        None if a joint of a limb has no partner, or where no limb is known, any joint
    """
    axis = int(np.abs(np.cross(space.up, space.front)).argmax())
    counted = np.unique(space.joint_of_code[space.joint_of_code >= 0])
    roles = [space.roles[joint] for joint in counted]
    in_middle = np.array([role in _MIDDLE for role in roles])
    across = space.origins[counted, axis]
    offset = float(np.median(across[in_middle] if in_middle.any() else across))
    # Of two joints in one place, as a hand and what it holds, the one of the same role is nearer.
    kinds = _NEARER * np.array([list(Role).index(role) for role in roles])
    places = np.column_stack([space.origins[counted], kinds])
    image = places.copy()
    image[:, axis] = 2.0 * offset - image[:, axis]
    distance, nearest = cKDTree(places).query(image)
    # Joints in one place, as those of twists, are told apart by their order.
    for place in np.unique(nearest):
        same = np.flatnonzero(np.linalg.norm(places - places[place], axis=1) < 1e-6)
        at = np.flatnonzero(np.isin(nearest, same))
        if len(at) == len(same):
            nearest[at] = same
    alone = (distance > _TOLERANCE) | (nearest[nearest] != np.arange(len(counted)))
    limbs = [role not in _MIDDLE | _LOOSE for role in roles]
    if alone[limbs if any(limbs) else slice(None)].any():
        return None
    partner = np.arange(space.n_joints)
    partner[counted[~alone]] = counted[nearest[~alone]]
    carries = np.isin(partner, counted[~alone])
    for joint in range(space.n_joints - 1, 0, -1):
        carries[space.rig.parents[joint]] |= carries[joint] and space.rig.parents[joint] >= 0
    is_loose = np.array([role in _LOOSE for role in roles])
    partner[counted[alone & is_loose & ~carries[counted]]] = -1
    return partner, axis, offset


@dataclass(frozen=True, eq=False)
class RigMirror(PoseMirror):
    """Exchanges left and right of a character's poses: each joint moves as its partner's image.

    Attributes
    ----------
    space : of the poses
    joint_partner : (J,) each joint's partner, -1 of one that keeps its turn
    """

    space: RigPoseSpace
    joint_partner: npt.NDArray[np.intp]

    def _codes_of_image(
        self,
        latent: FloatArray,
        image: FloatArray,  # noqa: ARG002 - the joints tell more than the vertices
        cancel: CancelToken | None,  # noqa: ARG002 - it is one step
    ) -> FloatArray:
        flip = np.eye(4)
        flip[self.symmetry.axis, self.symmetry.axis] = -1.0
        flip[self.symmetry.axis, 3] = 2.0 * self.symmetry.offset
        moved = self.space.transforms(latent) @ np.linalg.inv(self.space.rig.rest)
        mirrored = flip @ moved[self.joint_partner] @ flip
        codes = self.space.codes_of_transforms(mirrored @ self.space.rig.rest)
        joints = self.space.joint_of_code
        stays = (joints >= 0) & (self.joint_partner[joints] < 0)
        return np.where(stays, latent, codes)
