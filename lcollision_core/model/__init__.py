"""A trained body: reads one file and offers everything that a front end needs."""

from lcollision_core.model.by_rig import poses_by_rig, rest_pose_set
from lcollision_core.model.card import ModelCard
from lcollision_core.model.encode import encode_mesh, read_model_mesh, with_detail
from lcollision_core.model.encoded_pose import EncodedPose
from lcollision_core.model.export import (
    export_frame,
    export_mesh,
    export_scale,
)
from lcollision_core.model.known_characters import (
    character_of_mesh,
    remember_choices,
    remember_file,
    remember_roles,
    remember_up,
)
from lcollision_core.model.latent_space import LatentGroup, LatentSpace
from lcollision_core.model.mirror import MirroredPose, MirrorSource, Symmetry, fingerprint_of_pose
from lcollision_core.model.model_store import (
    ListedModel,
    checkpoint_path,
    find_model,
    is_bundled,
    list_models,
    model_destination,
    user_models_folder,
)
from lcollision_core.model.naming import MAX_POSE_NAME_LENGTH, unique_names
from lcollision_core.model.open_body import open_body
from lcollision_core.model.posable_body import PosableBody
from lcollision_core.model.pose_file import (
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
from lcollision_core.model.pose_kinds import PoseKind, score_kinds
from lcollision_core.model.pose_library import (
    LibraryChange,
    LibraryWrite,
    PoseLibrary,
    user_poses_folder,
)
from lcollision_core.model.pose_model import PoseModel
from lcollision_core.model.proposed_rules import ProposedRules, propose_rules, typical_poses
from lcollision_core.model.rig_model import RigModel
from lcollision_core.model.sampling import sample_poses
from lcollision_core.model.saving import change_model, save_trained
from lcollision_core.model.source_file import (
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
from lcollision_core.model.verdicts import Verdicts, estimated_free, judge_poses
from lcollision_core.options.export import ExportAxes, ExportRequest
