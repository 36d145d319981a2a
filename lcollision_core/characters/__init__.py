"""Characters: what the joints of a rig are, and posing by the rig."""

from lcollision_core.characters.anatomy import ROLE_NAMES, joint_parts, role_name
from lcollision_core.characters.default_rules import default_rules
from lcollision_core.characters.joint_groups import joint_groups
from lcollision_core.characters.rig_space import RigPoseSpace
