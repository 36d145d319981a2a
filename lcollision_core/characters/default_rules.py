"""The contact rules that a character starts with: free at rest, with little left out."""

from __future__ import annotations

from collections.abc import Sequence

from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.contact.exclusions import near_pairs_estimate
from lcollision_core.files.character import Character
from lcollision_core.meshes.contact_rules import CHARACTER_REST_EXCLUSION
from lcollision_core.meshes.face_groups import FaceGroup

NEAR_EXCLUSIONS = (0.1, 0.05, 0.02)
"""Normalised lengths within which the skin of a rig folds at its bent joints, the first that fits.

Linear blend skinning presses the inside of an elbow into itself long before a limb meets another.
Of the mannequin's joints turned one at a time to their limits, 67 % are free with 0, 84 % with
0.02, 85 % with 0.05 and 93 % with 0.1. Shells that are not joined to each other, as the X Bot's,
have no folds, and it makes no difference to them. Of places that are farther apart at rest than
a limb is thick, as a finger's tip and the palm, none are folds: `ContactRules.near_by_limb`.
"""

MOST_NEAR_PAIRS = 100_000_000
"""Of vertices: 400 MB. The mannequin of 14 442 vertices has 7 million within 0.1."""

_MOST_TOUCHING = 50_000
"""Pairs at rest beyond which only these are left out, and not the places about them."""


def default_rules(character: Character, groups: Sequence[FaceGroup] = ()) -> ContactRules:
    """Return rules by which the rest pose of a character is free.

    Pairs that touch at rest, and places within 0.02 along the surface of them, do not count. Of the
    X Bot's joints turned half way to their limits one at a time, all collide when only the pairs
    are left out, 30 % when places within 0.01 are, and 27 % with 0.02 and with 0.03.

    Parameters
    ----------
    groups : of the character; where there are joints among them, pairs about these do not count

    Raises
    ------
    ShapeError : the rest pose has no extent.
    """
    topology, rest = character.topology, character.rest_vertices
    strict = CollisionDetector(topology, rest)
    found = strict.summarise(rest, n_deepest=0)
    few = found.n_pairs + found.n_coincident_pairs <= _MOST_TOUCHING
    near = 0.0
    if character.rig is not None:
        fitting = (
            length
            for length in NEAR_EXCLUSIONS
            if near_pairs_estimate(topology, rest, length * strict.body_size) <= MOST_NEAR_PAIRS
        )
        near = next(fitting, 0.0)
    has_joints = any(group.about_joint for group in groups)
    return ContactRules(
        near_exclusion=near,
        near_by_limb=near > 0.0 and has_joints,
        rest_exclusion=CHARACTER_REST_EXCLUSION if few else 0.0,
        joint_exclusion=has_joints,
    )
