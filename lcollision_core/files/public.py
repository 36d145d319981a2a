"""The public names of `lcollision_core.files`, loaded on first use."""

from lcollision_core.files.character import Character, ClipFrames, Rig
from lcollision_core.files.character_reading import (
    GltfCharacter,
    as_gltf,
    is_gltf,
    read_character,
    with_up_axis,
    without_user_choices,
    written_frame,
)
from lcollision_core.files.character_writing import (
    CharacterForm,
    PosedFile,
    read_own_file,
    write_character,
)
from lcollision_core.files.mesh_file import (
    Mesh,
    as_stored,
    audit_mesh,
    read_mesh,
    write_mesh,
)
from lcollision_core.files.pose_set import PoseSet, concatenated, thinned, write_pose_set
from lcollision_core.files.pose_set_reading import (
    PoseSetInspection,
    inspect_pose_set,
    mesh_files,
    read_pose_set,
)
from lcollision_core.files.safe import (
    FileStamp,
    atomic_files,
    atomic_write,
    file_stamp,
    file_stem,
    file_stems,
    has_known_suffix,
    locked,
    require_writable,
    unused_name,
)
from lcollision_core.meshes.precision import can_hold
