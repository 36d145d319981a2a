"""A trained body: reads one file and offers everything that a front end needs."""

from lcollision_core.bodies.by_rig import poses_by_rig, rest_pose_set
from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.encode import encode_mesh, read_model_mesh, with_detail
from lcollision_core.bodies.encoded_pose import EncodedPose
from lcollision_core.bodies.export import (
    export_frame,
    export_mesh,
    export_scale,
)
from lcollision_core.bodies.known_characters import (
    character_of_mesh,
    remember_choices,
    remember_file,
    remember_roles,
    remember_up,
)
from lcollision_core.bodies.latent_space import LatentGroup, LatentSpace
from lcollision_core.bodies.mirror import MirroredPose, MirrorSource, Symmetry, fingerprint_of_pose
from lcollision_core.bodies.model_store import (
    ListedModel,
    checkpoint_path,
    find_model,
    is_bundled,
    list_models,
    model_destination,
    user_models_folder,
)
from lcollision_core.bodies.naming import MAX_POSE_NAME_LENGTH, unique_names
from lcollision_core.bodies.open_body import open_body
from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.pose_file import (
    MAX_PINS,
    MAX_TAGS,
    NamedPose,
    OtherModelError,
    PoseFile,
    name_of_file,
    read_pose_file,
    read_poses,
    why_no_name,
    write_poses,
)
from lcollision_core.bodies.pose_kinds import PoseKind, score_kinds
from lcollision_core.bodies.pose_library import (
    LibraryChange,
    LibraryWrite,
    PoseLibrary,
    user_poses_folder,
)
from lcollision_core.bodies.pose_model import PoseModel
from lcollision_core.bodies.proposed_rules import ProposedRules, propose_rules, typical_poses
from lcollision_core.bodies.rig_model import RigModel
from lcollision_core.bodies.sampling import sample_poses
from lcollision_core.bodies.saving import change_model, save_trained
from lcollision_core.bodies.source_file import (
    EXPORT_FORMS,
    ExportForm,
    SourceFile,
    WrittenPose,
    offered_forms,
    own_source,
    requested_form,
    sequence_files,
    source_for,
    write_pose,
    write_sequence,
)
from lcollision_core.bodies.verdicts import Verdicts, estimated_free, judge_poses
from lcollision_core.options import ExportAxes, ExportRequest
