"""What a pose is: topology, files, pose sets and alignment."""

from lcollision_core.meshes.alignment import Alignment, RigidTransform, align_rigid, fit_rigid
from lcollision_core.meshes.animated import ANIMATED_SUFFIXES
from lcollision_core.meshes.atomic import (
    FileStamp,
    atomic_files,
    atomic_write,
    file_stamp,
    require_writable,
    unused_name,
)
from lcollision_core.meshes.audit import audit_mesh, inspect_pose_set
from lcollision_core.meshes.concatenation import concatenated
from lcollision_core.meshes.contact_rules import STRICT, ContactRules, RuleCounts
from lcollision_core.meshes.degenerate import degenerate_faces
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
from lcollision_core.meshes.file_names import file_stem, file_stems, has_known_suffix
from lcollision_core.meshes.files import (
    READABLE_SUFFIXES,
    WRITABLE_SUFFIXES,
    Mesh,
    read_mesh,
    write_mesh,
)
from lcollision_core.meshes.locks import locked
from lcollision_core.meshes.pose_set import (
    PoseSet,
    PoseSetInspection,
    mesh_files,
    read_pose_set,
    write_pose_set,
)
from lcollision_core.meshes.precision import as_stored, can_hold
from lcollision_core.meshes.thinning import thinned
from lcollision_core.meshes.topology import Topology
from lcollision_core.meshes.units import body_size, front_direction, up_axis
from lcollision_core.meshes.upright import UpGuess, guess_up
