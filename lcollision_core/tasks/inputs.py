"""Find and read the inputs of a task: files in folders, poses, and the bodies of motions."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import (
    Body,
    NamedPose,
    encode_mesh,
    name_of_file,
    open_body,
    read_model_mesh,
    read_poses,
    unique_names,
)
from lcollision_core.bodies.motions import body_of_motion as shaped
from lcollision_core.errors import (
    LCollisionError,
    MeshFileError,
    ModelFileError,
    PoseSetError,
    WrongScaleError,
    listed,
)
from lcollision_core.files import PoseSet, mesh_files
from lcollision_core.files.formats import (
    POINT_CACHE_SUFFIXES,
    READABLE_SUFFIXES,
    SCENE_SUFFIXES,
    SKELETON_SUFFIXES,
)
from lcollision_core.files.mesh_file import KEEP_PRECISION
from lcollision_core.files.motion.generated import holds_joints, is_generated
from lcollision_core.files.motion.smpl import array_names, is_smpl_motion
from lcollision_core.files.pose_set_reading import natural_key
from lcollision_core.files.scene_files import open_rigged, read_scene
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.options import RuleOptions
from lcollision_core.tasks.exporting import Output, write_result
from lcollision_core.tasks.progress import run_of_poses
from lcollision_core.tasks.words import fit_error, say, say_number

_OF_MOTIONS = (*SKELETON_SUFFIXES, *POINT_CACHE_SUFFIXES)

PARTIAL = "motions.partial.json"
"""Name of the progress file in a folder of results."""


def holds_motion(path: Path) -> bool:
    """Whether a file holds a motion and no mesh, or a folder only such files."""
    if path.is_dir():
        return not mesh_files(path)[0] and any(map(_may_hold_motion, _visible_files(path)))
    of_kind = path.suffix.lower() in _OF_MOTIONS
    return of_kind or is_generated(path) or is_smpl_motion(path)


def mesh_files_of(inputs: Iterable[Path], job: Job = UNWATCHED) -> list[Path]:
    """Replace each folder by its mesh files, in natural order; motions are skipped with a note.

    Raises
    ------
    MeshFileError : a folder has no mesh, or cannot be listed.
    """
    files: list[Path] = []
    for path in inputs:
        if not path.is_dir():
            files.append(path)
            continue
        inside, others = mesh_files(path)
        motions = [name for name in others if Path(name).suffix.lower() in _OF_MOTIONS]
        if not inside:
            advice = f"name a folder of {', '.join(READABLE_SUFFIXES)} files"
            raise MeshFileError("contains no mesh", advice, where=path)
        if motions:
            skipped = say_number(
                len(motions),
                "{folder}: skipped {names}: no mesh in it",
                "{folder}: skipped {names}: no mesh in them",
                folder=path,
                names=listed(motions, 3),
            )
            job.note(skipped)
        files += inside
    return files


def motion_files_of(inputs: Iterable[Path], job: Job = UNWATCHED) -> list[Path]:
    """Replace each folder by its motion files.

    Raises
    ------
    LCollisionError : a folder has no motion.
    """
    files: list[Path] = []
    for path in inputs:
        inside = motion_files(path, job) if path.is_dir() else [path]
        if not inside:
            advice = "leave out --clips, or name files"
            raise LCollisionError("contains no motion", advice, where=path)
        files += inside
    return files


def motion_files(folder: Path, job: Job = UNWATCHED, besides: Path | None = None) -> list[Path]:
    """Return the motion files in a folder and its subfolders, in natural order.

    Empty if it holds only meshes. Scenes count if they have clips. Body models, and further
    files that motion generators write, are skipped with a note.

    Parameters
    ----------
    job : takes the note
    besides : a subfolder of results, which is skipped
    """
    is_input = _inside(folder, besides)
    inside = filter(is_input, _visible_files(folder))
    files: list[Path] = []
    others: list[Path] = []
    for path in sorted(inside, key=lambda path: [natural_key(Path(part)) for part in path.parts]):
        if _may_hold_motion(path):
            files.append(path)
        elif path.suffix.lower() in (".npz", ".json", ".npy"):
            others.append(path)
    places = [path for path in files if path.suffix.lower() == ".npy"]
    if len(places) < len(files):
        # Generators write joint positions beside the motion, which also has the rotations.
        files, others = [path for path in files if path not in places], places + others
    if files and others:
        names = listed((path.relative_to(folder).as_posix() for path in others), 3)
        fields = {"folder": folder, "names": names}
        left_out = say_number(
            len(others),
            "{folder}: skipped {names}: no motion in it",
            "{folder}: skipped {names}: no motion in them",
            **fields,
        )
        if any(path.suffix.lower() == ".npy" for path in others):
            left_out = say_number(
                len(others),
                "{folder}: skipped {names}: no motion in it that can be read; save arrays by name "
                "in an .npz file",
                "{folder}: skipped {names}: no motion in them that can be read; save arrays by "
                "name in an .npz file",
                **fields,
            )
        job.note(left_out)
    return files


def _visible_files(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders, except hidden ones, as macOS adds to zips."""
    for path in folder.rglob("*"):
        is_hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if not is_hidden and path.is_file():
            yield path


def _inside(folder: Path, besides: Path | None) -> Callable[[Path], bool]:
    """Return a predicate that excludes a folder's results."""
    results = None if besides is None else besides.resolve()
    if results is not None and folder.resolve() not in results.parents:
        results = None

    def is_input(path: Path) -> bool:
        return path.name != PARTIAL and (results is None or results not in path.resolve().parents)

    return is_input


def _may_hold_motion(path: Path) -> bool:
    """Whether a file may hold poses, rotations or clips; its errors are reported in its row."""
    suffix = path.suffix.lower()
    if suffix in _OF_MOTIONS:
        return True
    if suffix == ".json":
        try:
            content = json.loads(path.read_bytes())
        except (OSError, ValueError):
            return True
        return isinstance(content, dict) and "poses" in content
    if suffix == ".npy":
        return holds_joints(path)
    if suffix == ".npz":
        names = array_names(path)
        has_meshes = bool({"vertices", "V"} & set(names))
        return not names or has_meshes or is_generated(path) or is_smpl_motion(path)
    try:
        return suffix in SCENE_SUFFIXES and bool(read_scene(path).clips)
    except MeshFileError:
        return True


def body_of_motion(body: Body, path: Path, job: Job) -> Body:
    """Return the body in the shape of a motion, and note what of the motion is left out."""
    body, notes = shaped(body, path)
    for sentence in notes:
        job.note(f"{path}: {sentence}")
    return body


def with_rules(poses: PoseSet, path: Path, options: RuleOptions) -> PoseSet:
    """Return poses read from a file with the rules of its character, if any, and the options.

    Raises
    ------
    LCollisionError : an option names an unknown group.
    """
    document = open_rigged(path)
    if document is not None:
        body = open_body(document)
        poses = replace(poses, rules=body.rules, groups=body.groups)
    rules, groups = options.applied(poses.rules, poses.groups, poses.topology, poses.vertex_labels)
    return replace(poses, rules=rules, groups=groups)


@dataclass(frozen=True, eq=False)
class InputPose:
    """An input pose of a task.

    Attributes
    ----------
    source : the file, and the pose's name if the file has several
    pose : in the codes of the body
    mesh : (V, 3) mesh that it was encoded from; None for a pose given by codes
    """

    source: str
    pose: NamedPose
    mesh: npt.NDArray[np.float64] | None = None


def read_input_poses(
    body: Body, paths: Sequence[Path], scale: float, job: Job = UNWATCHED
) -> tuple[list[InputPose], bool]:
    """Read the poses of files, encoding meshes; note why other files cannot be read.

    Returns
    -------
    given : with unique names
    failed : whether any file could not be read
    """
    given: list[InputPose] = []
    failed = False
    for done, path in enumerate(paths):
        try:
            given += _given_in(body, path, scale, job)
        except LCollisionError as error:
            job.note(str(error))
            failed = True
        job.report(done + 1, len(paths))
    names = unique_names(given_pose.pose.name for given_pose in given)
    return [
        replace(given_pose, pose=replace(given_pose.pose, name=name))
        for given_pose, name in zip(given, names, strict=True)
    ], failed


def _given_in(body: Body, path: Path, scale: float, job: Job) -> Iterator[InputPose]:
    if path.suffix.lower() == ".json":
        for pose in read_some_poses(path, body):
            yield InputPose(f"{path}: {pose.name}", pose)
        return
    mesh = read_model_mesh(path, body)
    if mesh.coarseness:
        job.note(f"{path}: {mesh.coarseness}; {KEEP_PRECISION}")
    try:
        pose = encode_mesh(mesh, body, scale)
    except LCollisionError as error:
        raise cannot_encode(path, error) from error
    error_text = fit_error(pose.fit_error_mean, pose.fit_error_max)
    job.note(say("{file} is encoded with a {error}", file=path, error=error_text))
    yield InputPose(str(path), pose, mesh.vertices)


def encode_meshes(
    body: Body, files: Sequence[Path], output: Output, scale: float, job: Job
) -> list[NamedPose]:
    """Encode meshes and write them as poses; a stopped run continues when called again.

    Raises
    ------
    LCollisionError : a mesh cannot be read or encoded, or the output cannot be written.
    CancelledError : the job was cancelled; finished poses are kept beside the output.
    """
    meshes = [read_model_mesh(path, body) for path in files]
    names = unique_names(name_of_file(mesh.source) for mesh in meshes)
    inputs = {"vertices": np.stack([mesh.vertices for mesh in meshes])}
    values = {"command": "encode", "scale": scale}
    with run_of_poses(output.path, body, (inputs, values), len(meshes), job) as run:
        for index, (name, mesh) in enumerate(zip(names, meshes, strict=True)):
            if str(index) not in run.done:
                try:
                    pose = encode_mesh(mesh, body, scale, job)
                except PoseSetError as error:
                    raise cannot_encode(mesh.source, error) from error
                run.keep(str(index), (replace(pose, name=name), {}))
            job.report(index + 1, len(meshes))
        poses = [replace(run.done[str(n)][0], name=name) for n, name in enumerate(names)]
        write_result(output, body, poses, job=job)
    return poses


def read_some_poses(path: Path, body: Body) -> Sequence[NamedPose]:
    """Read a pose file that has at least one pose.

    Raises
    ------
    ModelFileError : it has none, or belongs to another body.
    """
    poses = read_poses(path, body)
    if not poses:
        raise ModelFileError("contains no poses", "name a file with poses", where=path)
    return poses


def cannot_encode(path: Path, error: LCollisionError) -> MeshFileError:
    """Return the error for a mesh that cannot be encoded, with the option for another unit."""
    next_step = error.next_step
    if isinstance(error, WrongScaleError):
        next_step = f"scale it with --scale {error.factor:.6g}"
    return MeshFileError(f"cannot be encoded: {error.headline}", next_step, where=path)
