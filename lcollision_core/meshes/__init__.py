"""Meshes and poses: topology, groups of faces, contact rules, alignment and units."""

from lcollision_core.meshes.alignment import Alignment, RigidTransform, align_rigid, fit_rigid
from lcollision_core.meshes.contact_rules import STRICT, ContactRules, RuleCounts
from lcollision_core.meshes.extents import UpGuess, body_size, front_direction, guess_up, up_axis
from lcollision_core.meshes.face_groups import (
    GROUP_KINDS,
    FaceGroup,
    component_groups,
    groups_by_kind,
    named_group,
    named_pair,
    part_groups,
    with_named_groups,
)
from lcollision_core.meshes.topology import Topology, degenerate_faces
