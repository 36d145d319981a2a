"""Open a body, poses or a mesh for editing; this module is imported before the window exists."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from lcollision_core.errors import ModelFileError, PoseSetError, WrongScaleError
from lcollision_core.files.table import SCENE_SUFFIXES
from lcollision_core.jobs import UNWATCHED, Job

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, NamedPose, OtherModelError, PoseFile
    from lcollision_core.files import Character, FileStamp
    from lcollision_core.files.scene_files import SceneDocument

    FileContent: TypeAlias = "SceneDocument | Character | AnimationAlone | OtherMesh | None"
    """The contents of a file; None for a mesh of the open body."""


@dataclass(frozen=True, eq=False)
class OpenedModel:
    """A model and the file that it was read from or written to."""

    model: Body
    file: str


def open_model(
    name_or_path: str | Path,
    job: Job = UNWATCHED,
    up: int | None = None,
    read: SceneDocument | Character | None = None,
) -> OpenedModel:
    """Read a model, a character or a scene, and remember a character's file.

    Parameters
    ----------
    up : the up axis of a character, which is remembered too
    read : content of the file, if already read

    Raises
    ------
    LCollisionError : as in `open_body` and `open_scene_file`.
    """
    from lcollision_core.bodies import find_model, open_body, remember_file, remember_up
    from lcollision_core.bodies.scene_file import is_scene_file, open_scene_file

    path = find_model(name_or_path).absolute()
    if is_scene_file(path):
        return OpenedModel(open_scene_file(path), str(path))
    model = open_body(path if read is None else read, up)
    job.check()
    try:
        remember_file(model, path)
        if up is not None:
            remember_up(model, up)
    except ModelFileError as error:
        model = model.noted(error.headline)
    return OpenedModel(model, str(path))


@dataclass(frozen=True)
class AnimationAlone:
    """A file of clips without a mesh; they are motions of the open body."""

    path: Path


@dataclass(frozen=True)
class OtherMesh:
    """A file with a mesh that does not belong to the open body."""

    path: Path


def examine(path: Path, job: Job, beside: Body | None = None) -> FileContent:
    """Read a file as far as it takes to tell how to open it.

    With a body `beside` which others may stand, a mesh with another number of vertices is a prop.
    """
    from lcollision_core.files import read_character, read_mesh
    from lcollision_core.files.scene.smpl import is_smpl_model
    from lcollision_core.files.scene_files import is_animation_alone, open_scene

    if is_smpl_model(path):
        return read_character(path)
    if path.suffix.lower() in SCENE_SUFFIXES:
        document = open_scene(path, job)
        if document.has_skin:
            return document
        if is_animation_alone(document):
            return AnimationAlone(path)
    if beside is None or read_mesh(path).topology.n_vertices == beside.n_vertices:
        return None
    return OtherMesh(path)


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
