"""Characters: files with meshes, a rig and clips, and posing by the rig."""

from lcollision_core.characters.anatomy import ROLE_NAMES, joint_parts, role_name
from lcollision_core.characters.as_gltf import GltfCharacter, as_gltf, is_gltf, written_frame
from lcollision_core.characters.character import Character, ClipFrames, Rig
from lcollision_core.characters.default_rules import default_rules
from lcollision_core.characters.joint_groups import joint_groups
from lcollision_core.characters.own_files import read_own_file
from lcollision_core.characters.posed_gltf import (
    PATCHED_SUFFIXES,
    CharacterForm,
    PosedFile,
    write_character,
    write_character_clip,
)
from lcollision_core.characters.reading import as_read, read_character, turned
from lcollision_core.characters.rig_space import RigPoseSpace
