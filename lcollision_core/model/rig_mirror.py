"""Left and right of a rig: its joints' partners, and the mirror images of its poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lcollision_core.characters import RigPoseSpace
from lcollision_core.jobs import CancelToken
from lcollision_core.model.mirror import PoseMirror

FloatArray = npt.NDArray[np.float64]

_TOLERANCE = 0.02
"""Normalised: how far a joint may lie from its partner's mirror image."""


def find_joint_partners(
    space: RigPoseSpace,
) -> tuple[npt.NDArray[np.intp], int, float] | None:
    """Find each joint's partner on the other side, by the places of the rest pose.

    Returns
    -------
    partner : (J,) each joint's mirror image, its own inverse
    axis : 0, 1 or 2, from one side to the other
    offset : of the plane along the axis, normalised
        None if some joint that poses turn has no partner
    """
    axis = int(np.abs(np.cross(space.up, space.front)).argmax())
    counted = np.unique(space.joint_of_code[space.joint_of_code >= 0])
    places = space.origins[counted]
    offset = 0.5 * float(places[:, axis].min() + places[:, axis].max())
    image = places.copy()
    image[:, axis] = 2.0 * offset - image[:, axis]
    distance, nearest = cKDTree(places).query(image)
    # Joints in one place, as those of twists, are told apart by their order.
    for place in np.unique(nearest):
        same = np.flatnonzero(np.linalg.norm(places - places[place], axis=1) < 1e-6)
        at = np.flatnonzero(np.isin(nearest, same))
        if len(at) == len(same):
            nearest[at] = same
    if distance.max() > _TOLERANCE or (nearest[nearest] != np.arange(len(counted))).any():
        return None
    partner = np.arange(space.n_joints)
    partner[counted] = counted[nearest]
    return partner, axis, offset


@dataclass(frozen=True, eq=False)
class RigMirror(PoseMirror):
    """Exchanges left and right of a character's poses: each joint moves as its partner's image.

    Attributes
    ----------
    space : of the poses
    joint_partner : (J,) each joint's partner
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
        return self.space.codes_of_transforms(mirrored @ self.space.rig.rest)
