"""Characters: files with meshes, a rig and clips, and posing by the rig."""

from lcollision_core.characters.character import Character, ClipFrames, Rig
from lcollision_core.characters.rig_space import RigPoseSpace
