"""The public names of `lcollision_core.bodies`, loaded on first use."""

from lcollision_core.bodies.body import Body, EncodedPose
from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.export import (
    EXPORT_FORMS,
    ExportForm,
    SourceFile,
    WrittenPose,
    export_frame,
    export_mesh,
    export_scale,
    offered_forms,
    own_source,
    requested_form,
    sequence_files,
    source_for,
    write_pose,
    write_sequence,
)
from lcollision_core.bodies.latent_space import LatentGroup, LatentSpace
from lcollision_core.bodies.learned_body import (
    LearnedBody,
    ListedModel,
    change_model,
    checkpoint_path,
    find_model,
    is_bundled,
    list_models,
    model_destination,
    save_trained,
    user_models_folder,
)
from lcollision_core.bodies.mesh_body import MeshBody
from lcollision_core.bodies.mirror import MirroredPose, MirrorSource, Symmetry, fingerprint_of_pose
from lcollision_core.bodies.names import MAX_POSE_NAME_LENGTH, unique_names
from lcollision_core.bodies.poses import (
    MAX_PINS,
    MAX_TAGS,
    LibraryChange,
    LibraryWrite,
    NamedPose,
    OtherModelError,
    PoseFile,
    PoseLibrary,
    encode_mesh,
    name_error,
    name_of_file,
    read_model_mesh,
    read_pose_file,
    read_poses,
    user_poses_folder,
    with_detail,
    write_poses,
)
from lcollision_core.bodies.proposed_rules import ProposedRules, propose_rules, typical_poses
from lcollision_core.bodies.remembered import (
    character_of_mesh,
    open_body,
    remember_choices,
    remember_file,
    remember_roles,
    remember_up,
)
from lcollision_core.bodies.rig_body import RigBody, poses_by_rig, rest_pose_set
from lcollision_core.bodies.scene_body import SceneBody, as_scene
from lcollision_core.bodies.scoring import (
    PoseKind,
    Verdicts,
    check_poses,
    estimated_free,
    sample_poses,
    score_kinds,
)
from lcollision_core.options import ExportAxes, ExportRequest
