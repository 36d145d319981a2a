"""Open a body, poses, a mesh or motions for editing; imported before the window exists."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from lcollision_core.errors import MeshFileError, ModelFileError, PoseSetError, WrongScaleError
from lcollision_core.files.formats import SCENE_SUFFIXES, is_model
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.options import MotionChoice

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, NamedPose, OtherModelError, PoseFile
    from lcollision_core.bodies.partners import JointMatch
    from lcollision_core.files import Character, FileStamp
    from lcollision_core.files.scene_files import SceneDocument
    from lcollision_core.motion import Motion

    FileContent: TypeAlias = "SceneDocument | Character | Unposable | None"
    """The contents of a file; None for a mesh of the open body."""


def open_any(source: str | Path) -> Body:
    """Read a body, or a scene of several: see `open_body` and `open_scene_file`.

    Only the kind of body that it is gets imported.
    """
    suffix = Path(source).suffix.lower()
    if is_model(source):
        from lcollision_core.bodies.learned_body import LearnedBody

        return LearnedBody.load(source)
    if suffix == ".json":
        from lcollision_core.bodies.scene_file import is_scene_file, open_scene_file

        if is_scene_file(source):
            return open_scene_file(source)
    from lcollision_core.bodies.remembered import open_body

    return open_body(source)


@dataclass(frozen=True, eq=False)
class OpenedModel:
    """A model and the file that it was read from or written to."""

    model: Body
    file: str


def open_model(
    name_or_path: str | Path,
    job: Job = UNWATCHED,
    read: SceneDocument | Character | None = None,
) -> OpenedModel:
    """Read a model, a character or a scene, and remember a character's file.

    Parameters
    ----------
    read : content of the file, if already read

    Raises
    ------
    LCollisionError : as in `open_body` and `open_scene_file`.
    """
    from lcollision_core.bodies import find_model, open_body, remember_file
    from lcollision_core.bodies.scene_file import is_scene_file, open_scene_file

    path = find_model(name_or_path).absolute()
    if is_scene_file(path):
        return OpenedModel(open_scene_file(path), str(path))
    model = open_body(path if read is None else read)
    job.check()
    try:
        remember_file(model, path)
    except ModelFileError as error:
        model = model.noted(error.headline)
    return OpenedModel(model, str(path))


class Unposable(Enum):
    """A file without a body to pose: clips alone, which move the open body, or another mesh."""

    CLIPS = auto()
    OTHER_MESH = auto()


def examine(path: Path, job: Job, beside: Body | None = None) -> FileContent:
    """Read a file as far as it takes to tell how to open it.

    With a body `beside` which others may stand, a mesh with another number of vertices is a prop.
    """
    from lcollision_core.files import read_character, read_mesh
    from lcollision_core.files.motion.smpl import is_smpl_model
    from lcollision_core.files.scene_files import is_animation_alone, open_scene

    if is_smpl_model(path):
        return read_character(path)
    if path.suffix.lower() in SCENE_SUFFIXES:
        document = open_scene(path, job)
        if document.has_skin:
            return document
        if is_animation_alone(document):
            return Unposable.CLIPS
    if beside is None or read_mesh(path).topology.n_vertices == beside.n_vertices:
        return None
    return Unposable.OTHER_MESH


@dataclass(frozen=True, eq=False)
class ReadPoses:
    """A poses file: at least one pose.

    Attributes
    ----------
    path : of the file
    content : its poses
    stamp : of the file when read
    opened : the model that was opened for it, None for the already open one
    """

    path: Path
    content: PoseFile
    stamp: FileStamp | None
    opened: OpenedModel | None


def open_poses(
    body: Body | None, model_file: str | Path, path: Path, job: Job = UNWATCHED
) -> ReadPoses | OtherModelError:
    """Read the pose file of a body; if that is None, open the model first.

    If the file belongs to another known model, the error that names it is returned.

    Raises
    ------
    LCollisionError : the file can't be read, belongs to an unknown model, or has no poses.
    """
    from lcollision_core.bodies import OtherModelError, read_pose_file
    from lcollision_core.files import file_stamp

    opened = None
    if body is None:
        opened = open_model(model_file, job)
        body = opened.model
    stamp = file_stamp(path)
    try:
        content = read_pose_file(path, body)
    except OtherModelError as error:
        # The error is only an offer if no model was opened for the poses.
        if error.model is None or opened is not None:
            raise
        return error
    job.check()
    if not content.all_poses:
        raise ModelFileError("contains no poses", "open a file with poses", where=path)
    return ReadPoses(path, content, stamp, opened)


@dataclass(frozen=True, eq=False)
class MemberPose:
    """The pose of one of a scene's bodies, by a poses file of that body.

    Attributes
    ----------
    path : of the file
    pose : its working pose, or else its first
    members : names of the bodies of the scene that it fits
    """

    path: Path
    pose: NamedPose
    members: tuple[str, ...]


def pose_of_member(body: Body, path: Path) -> MemberPose | None:
    """Return the pose of a file that is of a body of a scene; None if it is of none of them.

    Raises
    ------
    LCollisionError : the file can't be read.
    """
    from lcollision_core.bodies import OtherModelError, as_scene, read_pose_file
    from lcollision_core.tasks.scenes import placed_pose

    scene = as_scene(body)
    members = [] if scene is None else [member for member in scene.standing if member.moves]
    for fingerprint, own in {m.body.fingerprint: m.body for m in members}.items():
        try:
            content = read_pose_file(path, own)
        except OtherModelError:
            continue
        fitting = tuple(m.name for m in members if m.body.fingerprint == fingerprint)
        pose = content.working or next(iter(content.all_poses), None)
        return None if pose is None else MemberPose(path, placed_pose(own, pose), fitting)
    return None


def import_mesh(
    body: Body, path: Path, scale: float, is_asked_as_mesh: bool, job: Job
) -> NamedPose | WrongScaleError:
    """Read a mesh with a body's topology as a pose, named after its file.

    Parameters
    ----------
    scale : factor to the body's unit; the error that names the right one is returned
    is_asked_as_mesh : whether the user chose the file as a mesh of this body; else an error
        suggests other ways to open it

    Raises
    ------
    LCollisionError : the mesh can't be read or encoded, or has another topology.
    """
    from lcollision_core.bodies import encode_mesh, read_model_mesh

    try:
        mesh = read_model_mesh(path, body)
    except PoseSetError as error:
        if is_asked_as_mesh:
            raise
        raise PoseSetError(
            "has no skeleton to pose it by, and is no mesh of the body that is open",
            "open its own body first, or learn a model from its poses; `lcollision check` checks "
            "the mesh, and with --clips its animation",
            where=path.name,
        ) from error
    job.check()
    try:
        return encode_mesh(mesh, body, scale, job)
    except WrongScaleError as error:
        return error


def read_motions(body: Body, path: Path, clip: str | None, job: Job) -> list[Motion]:
    """Read the motions of a file at their own rate: see `bodies.motions.read_motions`.

    A scene's own motion is that of all its bodies together.
    """
    from lcollision_core.bodies import as_scene
    from lcollision_core.bodies.motions import read_motions as read
    from lcollision_core.tasks.scenes import scene_motion

    scene = as_scene(body)
    if scene is not None and path == own_motions(body)[0]:
        motion = scene_motion(scene, (), MotionChoice(), job)[0]
        return [motion if clip is None else replace(motion, name=clip)]
    return read(body, path, clip, None, job)


def own_motions(body: Body) -> tuple[Path | None, tuple[str, ...]]:
    """Return the file and names of a body's own motions; a scene has one motion of all bodies."""
    from lcollision_core.bodies import as_scene

    scene = as_scene(body)
    if scene is None:
        return body.own_file, body.own_clips
    names = dict.fromkeys(clip for clip, _ in scene.plays.values())
    if not names or scene.file is None or not scene.file.path:
        return None, ()
    return Path(scene.file.path), (" + ".join(names),)


@dataclass(frozen=True, eq=False)
class OpenedMotions:
    """The contents of a motion file.

    Attributes
    ----------
    body : the open body, or that body in the shape of the motions
    motions : empty if only a user can match the joints
    joints : the joint matching, None if the motions are of the body's own joints
    """

    body: Body
    motions: list[Motion]
    joints: JointMatch | None


def open_motions(body: Body, path: Path, job: Job) -> OpenedMotions:
    """Read the motions of a file at their own rate, for a body.

    Raises
    ------
    LCollisionError : the file can't be read, or the body can't follow its motion.
    """
    from lcollision_core.bodies.motions import body_of_motion as in_shape
    from lcollision_core.bodies.motions import is_retargeted
    from lcollision_core.bodies.retargeting import joint_match

    joints = joint_match(body, path) if is_retargeted(body, path) else None
    try:
        shaped, notes = in_shape(body, path)
    except MeshFileError:
        if joints is None or not joints.unsure:
            raise
        return OpenedMotions(body, [], joints)
    if shaped is not body:
        for sentence in notes:
            shaped = shaped.noted(sentence)
    return OpenedMotions(shaped, read_motions(shaped, path, None, job), joints)
