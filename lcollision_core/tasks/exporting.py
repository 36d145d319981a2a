"""Write poses, meshes and motions in the form of the output, and check the written files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import (
    Body,
    NamedPose,
    SceneBody,
    SourceFile,
    WrittenPose,
    as_scene,
    export_frame,
    remember_file,
    requested_form,
    sequence_files,
    source_for,
    unique_names,
    write_pose,
    write_poses,
    write_sequence,
)
from lcollision_core.bodies.motions import (
    MotionChange,
    character_of_motion,
    is_of_skeleton,
    is_retargeted,
    write_clips,
    write_new_clips,
)
from lcollision_core.bodies.retargeting import require_skeleton
from lcollision_core.bodies.scene_body import SceneMember, bends
from lcollision_core.errors import LCollisionError, MeshFileError, listed
from lcollision_core.files import (
    FileStamp,
    as_stored,
    atomic_files,
    file_stamp,
    file_stems,
    has_known_suffix,
    locked,
    require_writable,
    unused_name,
)
from lcollision_core.files.character_writing import require_written
from lcollision_core.files.formats import (
    BVH_SUFFIX,
    OWN_SUFFIXES,
    POINT_CACHE_SUFFIXES,
    SCENE_SUFFIXES,
    SKELETON_SUFFIXES,
    WRITABLE_SUFFIXES,
)
from lcollision_core.files.safe import require_folder
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.motion import KeptSpan, Motion, MotionReport, Reason
from lcollision_core.motion.motion import runs
from lcollision_core.options import MODELS_OWN, ExportAxes, ExportRequest
from lcollision_core.posing import PoseSpace
from lcollision_core.resolve import ResolveResult
from lcollision_core.tasks.verdicts import ResolvedClip
from lcollision_core.tasks.words import counted, exported_text, say, say_number


@dataclass(frozen=True)
class Output:
    """The output of a command for poses or meshes.

    Attributes
    ----------
    path : as named by the user
    form : of the output
    before : stamp of an existing file when the command began, by `file_stamp`
    """

    path: Path
    form: Literal["poses", "mesh", "folder", "frames"]
    before: FileStamp | None


def suffix_of(output: Output, model: Body, request: ExportRequest) -> str:
    """Return the extension of the mesh files of an output."""
    if output.form != "folder":
        return output.path.suffix.lower()
    like = request.like
    # A GLB file has its own axes and unit.
    is_as_stored = request.axes == ExportAxes.MODEL and request.scale is None
    if like is None and is_as_stored:
        like = model.own_file
    is_like_glb = like is not None and like.suffix.lower() in SCENE_SUFFIXES
    return f".{request.mesh_format or ('glb' if is_like_glb else 'obj')}"


def require_output(path: Path, *suffixes: str) -> Output:
    """Raise early unless an output is one writable file with one of some extensions.

    Raises
    ------
    LCollisionError : another extension, or the file cannot be written.
    """
    if path.suffix.lower() not in suffixes:
        kinds = " or ".join(suffixes)
        raise LCollisionError.unwritable(path, f"it must be a {kinds} file", "rename it")
    require_writable(path)
    return Output(path, "poses", file_stamp(path))


def output_named(name: str, pose_form: str | None = None, *, of_motions: bool = False) -> Output:
    """Determine the form of an output, before any work for it.

    Existing folders and names that end in a slash are folders; otherwise the extension decides.
    A name without a known extension, as in "results_v0.9", is a folder to be created.

    Raises
    ------
    LCollisionError : the extension is not a supported output, or the file or folder cannot be
        written.
    """
    path = Path(name)
    suffix = path.suffix.lower()
    if os.path.isdir(name):  # noqa: PTH112 - returns False for names that are too long
        require_folder(path)
        return Output(path, "folder", None)
    must_be_folder = name.endswith(("/", os.sep))
    forms: dict[str, Literal["poses", "mesh", "frames"]] = {".json": "poses", ".vrm": "mesh"}
    if of_motions:
        forms |= dict.fromkeys((".glb", *SKELETON_SUFFIXES, *OWN_SUFFIXES), "mesh")
    else:
        forms |= dict.fromkeys(WRITABLE_SUFFIXES, "mesh")
    if pose_form == "clip":
        forms |= {".glb": "frames", ".vrm": "frames"}
    forms |= dict.fromkeys(POINT_CACHE_SUFFIXES, "frames")
    if not must_be_folder and suffix in forms:
        require_writable(path)
        return Output(path, forms[suffix], file_stamp(path))
    if not must_be_folder and has_known_suffix(path):
        raise LCollisionError.unwritable(
            path,
            f"{suffix} is not a format of motions"
            if of_motions
            else f"{suffix} is not a format of poses",
            f"use one of {', '.join(forms)} or a folder",
        )
    require_writable(path)
    if path.exists():
        raise MeshFileError(
            "cannot be created: a file has this name", "name another", where=f"the folder {path}"
        )
    return Output(path, "folder", None)


def refuse_to_replace(
    outputs: Iterable[Path], sources: Iterable[Path], *, in_place: bool = False
) -> None:
    """Raise early if an output would replace an input.

    Parameters
    ----------
    outputs : files to be written
    sources : files that the command reads
    in_place : whether the user allows it

    Raises
    ------
    LCollisionError : an output is one of the sources.
    """
    if in_place:
        return
    read = {stamp[:2] for path in sources if (stamp := file_stamp(path))}
    for path in outputs:
        stamp = file_stamp(path)
        if stamp and stamp[:2] in read:
            raise LCollisionError(
                "is an input, which the output would replace",
                "name another output, or add --in-place",
                where=path,
            )


def source_files(model: Body, request: ExportRequest | None = None) -> list[Path]:
    """Return the user's files that a body, and the form of its exports, come from."""
    files, scene = [None if request is None else request.like, model.own_file], as_scene(model)
    if scene is not None:
        files += [member.body.own_file for member in scene.members]
        files += [Path(scene.file.path)] if scene.file is not None and scene.file.path else []
    return [path for path in files if path is not None]


def files_of(
    output: Output, model: Body, poses: Sequence[NamedPose], request: ExportRequest
) -> list[Path]:
    """Return the files that `write_result` writes for some poses, except for frames."""
    if output.form != "folder":
        return [output.path]
    stems, scene = file_stems(pose.name for pose in poses), as_scene(model)
    if scene is not None:
        files = [file for _, file in written_members(scene, request.mesh_format)]
        folders = stems if len(poses) > 1 else [""]
        return [output.path / folder / file for folder in folders for file in files]
    suffix = suffix_of(output, model, request)
    return [output.path / f"{stem}{suffix}" for stem in stems]


def require_one_mesh(output: Output, n_poses: int) -> None:
    """Raise if a single mesh file is to hold another number of poses than one.

    Raises
    ------
    LCollisionError : the number is not one.
    """
    if output.form == "mesh" and n_poses != 1:
        raise LCollisionError(
            f"is one mesh file, but there are {n_poses} poses", "name a folder", where=output.path
        )


def require_request(
    output: Output, model: Body, poses: Sequence[NamedPose], request: ExportRequest
) -> SourceFile | None:
    """Raise early if a request does not suit the output or the poses.

    Returns
    -------
    the source file whose form the output keeps, or None

    Raises
    ------
    MeshFileError : the format's precision is too low at a pose's position, or the file of `like`
        cannot be read, belongs to another body or does not offer the form.
    PoseSetError : the file of `like` belongs to another body.
    LCollisionError : several poses go to one mesh file, or mesh options are given for codes.
    """
    require_one_mesh(output, len(poses))
    if output.form == "poses":
        of_meshes = replace(request, mesh_format=None, fps=MODELS_OWN.fps, times_of=None)
        if of_meshes != MODELS_OWN:
            raise LCollisionError(
                "would contain codes; --axes, --scale, --like, --form and --keep-clips apply only "
                "to meshes",
                "name a mesh or a folder",
                where=output.path,
            )
        return None
    suffix = suffix_of(output, model, request)
    source = source_for(suffix, model, request.like)
    path = f"{output.path}{suffix if output.form == 'folder' else ''}"
    requested_form(path, request, source)
    for pose in poses:
        if pose.placement is not None:
            name = f"{pose.name}{suffix}"
            file = output.path / name if output.form == "folder" else output.path
            as_stored(file, pose.placement.apply(model.reference), model.topology)
    return source


def write_result(
    output: Output,
    model: Body,
    poses: Sequence[NamedPose],
    request: ExportRequest = MODELS_OWN,
    vertices: Iterable[npt.NDArray[np.floating]] | None = None,
    source: SourceFile | None = None,
    *,
    keeps_meshes: bool = True,
    job: Job = UNWATCHED,
) -> Sequence[WrittenPose]:
    """Write poses as a .json file, meshes or frames, and note it.

    One pose is a mesh; several are meshes in a folder, written atomically. A file changed by
    another command in the meantime stays, and the result gets another name.

    Parameters
    ----------
    output : a folder is created if necessary
    model : of the poses
    poses : placed poses are written at their placement
    request : of meshes
    vertices : (V, 3) of each pose; by default the decoded poses
    source : the source file whose form is kept, by `require_request`
    keeps_meshes : whether the result includes vertices of single mesh files
    job : takes the notes

    Returns
    -------
    written : one for each pose; several may share a file

    Raises
    ------
    LCollisionError : a file or folder cannot be written.
    """
    if vertices is None:
        vertices = (model.exported_vertices(pose.latent, pose.placement) for pose in poses)
    if output.form == "folder" and (scene := as_scene(model)) is not None:
        return write_members(output.path, scene, poses, list(vertices), request, job)

    def write(files: Sequence[Path]) -> list[WrittenPose]:
        written = (
            write_pose(file, model, pose.latent, mesh, pose.placement, request, source=source)
            for file, pose, mesh in zip(files, poses, vertices, strict=True)
        )
        return [file if keeps_meshes else replace(file, vertices=None) for file in written]

    if output.form == "folder":
        path, files = output.path, files_of(output, model, poses, request)
        n_replaced = sum(file.exists() for file in files)
        with atomic_files(path) as unfinished:
            in_folder = write([unfinished / file.name for file in files])
        _note_written(path, len(poses), n_replaced, in_folder, job)
        _remember(model, output, job)
        return [replace(pose, path=path / pose.path.name) for pose in in_folder]
    with locked(output.path):
        path = _path_to_write(output, job)
        n_replaced = int(path.exists())
        meshes: Sequence[WrittenPose] = []
        if output.form == "poses":
            write_poses(path, model, poses)
            meshes = [WrittenPose(path)] * len(poses)
        elif output.form == "frames":
            targets = sequence_files(path, model, source)
            n_replaced = sum(target.exists() for target in targets)
            files, meshes = write_sequence(
                path,
                model,
                [pose.latent for pose in poses],
                vertices,
                request,
                source=source,
            )
            path = files[0]
            for file in files[1:]:
                job.note(say("wrote {file}", file=file))
        else:
            meshes = write([path])
    # Frames of one file share their notes.
    one_each = meshes[:1] if output.form == "frames" else meshes
    _note_written(path, len(poses), n_replaced, one_each, job)
    _remember(model, output, job)
    return meshes


def _path_to_write(output: Output, job: Job) -> Path:
    """Return the output's path, or a new name with a note if another command has changed it."""
    path = output.path
    if path.exists() and file_stamp(path) != output.before:
        path = unused_name(path)
        job.note(
            say(
                "{output} was changed by another command in the meantime and was left alone; "
                "the result is in {path}",
                output=output.path,
                path=path,
            )
        )
    return path


def _remember(model: Body, output: Output, job: Job) -> None:
    """Remember the file of a character whose meshes were written, so that `check` knows it."""
    if model.own_file is not None and output.form != "poses":
        try:
            remember_file(model, model.own_file)
        except LCollisionError as error:
            job.note(str(error))


def _note_written(
    output: Path, n_poses: int, n_replaced: int, meshes: Sequence[WrittenPose], job: Job
) -> None:
    for sentence in dict.fromkeys(sentence for mesh in meshes for sentence in mesh.notes):
        job.note(sentence)
    poses = counted(n_poses, "pose", "poses")
    if n_replaced:
        job.note(
            say_number(
                n_replaced,
                "wrote {poses} to {output}, replacing {n} file of the same name",
                "wrote {poses} to {output}, replacing {n} files of the same names",
                poses=poses,
                output=output,
            )
        )
    else:
        job.note(say("wrote {poses} to {output}", poses=poses, output=output))


def export(
    model: Body,
    pose: NamedPose,
    outcome: ResolveResult | None,
    path: Path,
    request: ExportRequest,
    own: Callable[[], PoseSpace] | None = None,
) -> str:
    """Write the displayed mesh of a pose, at its placement, and check the file.

    Parameters
    ----------
    outcome : the result of Resolve, whose vertices are written if the pose is still that
    own : makes the pose space of the body in a motion's frame: see `Motion.space_at`

    Returns
    -------
    sentence : for the status bar
    """
    placement = pose.placement
    if outcome is not None and np.array_equal(outcome.latent, pose.latent):
        vertices = outcome.vertices
    else:
        check = model.exact_check(placement, own and own())
        vertices = check.exported(check.decode(pose.latent)[0])
    written = write_pose(
        path,
        model,
        pose.latent,
        vertices,
        placement,
        request,
        source=source_for(path.suffix, model, request.like),
    )
    collisions = written.checked(model)
    left_out = model.rules.sentence(collisions.excluded)
    return exported_text(path.name, len(collisions.pairs), None, [left_out, *written.notes])


def frame_files(
    model: Body, path: Path, request: ExportRequest
) -> tuple[list[Path], SourceFile | None]:
    """Return the files that `export_frames` writes, one per mesh of the source file, and that."""
    source = source_for(path.suffix, model, request.like)
    return list(sequence_files(path, model, source)), source


def export_frames(
    model: Body,
    motion: Motion,
    path: Path,
    request: ExportRequest,
    job: Job,
    source: SourceFile | None = None,
) -> str:
    """Write a motion as frames to `frame_files`, each at its placement, and check each.

    By default, `source` is read from the user's file. Returns a sentence for the status bar.
    """
    check = model.exact_check()

    def frames() -> Iterator[npt.NDArray[np.floating]]:
        for number in range(len(motion)):
            job.check()
            yield motion.vertices(number, check)

    files, written = write_sequence(
        path,
        model,
        list(motion.codes),
        frames(),
        request,
        source=source or source_for(path.suffix, model, request.like),
    )
    n_colliding, notes = 0, dict[str, None]()
    for done, frame in enumerate(written, 1):
        job.check()
        n_colliding += frame.collides(model)
        notes |= dict.fromkeys(frame.notes)
        job.report(done, len(written))
    names = ", ".join(file.name for file in files)
    return exported_text(names, n_colliding, len(motion), notes)


def export_clips(
    model: Body,
    file: Path,
    changes: Sequence[tuple[Motion, Motion]],
    path: Path,
) -> str:
    """Write the character's file with changed clips, and check their frames.

    Parameters
    ----------
    file : that the motions were read from
    changes : for each changed clip, the motion as read and as it is now

    Returns
    -------
    sentence : for the status bar
    """
    written = write_clips(
        path,
        model,
        file,
        [
            MotionChange(was, now, runs((was.codes != now.codes).any(axis=1)))
            for was, now in changes
        ],
    )
    frames = np.concatenate([*written.free, np.zeros(0, dtype=np.bool_)])
    return exported_text(path.name, int((~frames).sum()), len(frames), written.notes)


# Resolved motions.


def motion_outputs(
    body: Body, files: Iterable[Path], folder: Path, root: Path | None = None
) -> dict[Path, Path]:
    """Return the output of each file's motions: its own kind of file, else a point cache.

    Parameters
    ----------
    files : of motions
    folder : of the results
    root : input folder; its subfolders are kept
    """
    by_folder: dict[Path, list[tuple[Path, str]]] = {}
    for path in files:
        suffix = path.suffix.lower()
        if suffix in SCENE_SUFFIXES and body.joints is not None:
            own_suffix = "" if body.own_file is None else body.own_file.suffix.lower()
            suffix = suffix if suffix == own_suffix == ".vrm" else ".glb"
        elif suffix not in (".json", ".mdd") and not _keeps_skeleton(body, path):
            suffix = ".pc2"
        inside = folder if root is None else folder / path.parent.relative_to(root)
        by_folder.setdefault(inside, []).append((path, suffix))
    return {
        path: inside / f"{stem}{suffix}"
        for inside, named in by_folder.items()
        for (path, suffix), stem in zip(
            named, unique_names(path.stem for path, _ in named), strict=True
        )
    }


def _keeps_skeleton(body: Body, file: Path) -> bool:
    """Whether a body's motion can be written to the skeleton format of the file it was read from.

    A retargeted SMPL motion cannot hold the body's joints.
    """
    suffix = file.suffix.lower()
    is_own = suffix in OWN_SUFFIXES and is_of_skeleton(file)
    return is_own and (suffix == BVH_SUFFIX or not is_retargeted(body, file))


def as_frames(output: Output, files: Sequence[Path]) -> Output:
    """Return the output, in the form of frames if the input is not of its skeleton format."""
    suffix = output.path.suffix.lower()
    if output.form != "mesh" or suffix not in SKELETON_SUFFIXES:
        return output
    is_own = suffix in OWN_SUFFIXES and [path.suffix.lower() for path in files] == [suffix]
    return output if is_own else replace(output, form="frames")


def require_motions(
    output: Output, body: Body, files: Sequence[Path], motions: Sequence[Motion]
) -> None:
    """Raise early if an output cannot hold the motions."""
    suffix = output.path.suffix.lower()
    if output.form == "frames":
        require_skeleton(output.path, body)
    if suffix in OWN_SUFFIXES and output.form == "mesh":
        is_own = files[0].suffix.lower() == suffix and _keeps_skeleton(body, files[0])
        if len(files) > 1 or not is_own:
            raise MeshFileError.unwritable(
                output.path,
                "the motion has no skeleton of that format",
                "name a .pc2 or .mdd file, a folder or a .json file",
            )
    elif output.form == "mesh":
        character = character_of_motion(body, files[0]) if len(files) == 1 else None
        if character is None and all(is_retargeted(body, file) for file in files):
            character = body.character
        if character is None:
            raise MeshFileError.unwritable(
                output.path,
                "clips can be written only to their own character's file",
                "name a .bvh, .vrma, .pc2 or .mdd file, a folder or a .json file",
            )
        require_written(output.path, character)
    elif output.form == "frames" and len(motions) > 1:
        names = listed(repr(motion.name) for motion in motions)
        raise LCollisionError(
            f"holds one motion, but there are {len(motions)}: {names}",
            "choose one with --clip, or name a folder",
            where=output.path,
        )


def write_motions(
    output: Output,
    body: Body,
    file: Path,
    changes: Sequence[MotionChange],
    rows: Sequence[ResolvedClip],
    job: Job,
) -> None:
    """Write motions, and update their rows by the check of the output."""
    if output.form == "mesh":
        _write_clips(output, body, file, changes, rows, job)
        return
    check = body.exact_check()
    motions = [change.after for change in changes]
    names = unique_names(f"{motion.name} {n}" for motion in motions for n in range(len(motion)))
    frames = [(motion, n) for motion in motions for n in range(len(motion))]
    poses = [
        NamedPose(name, motion.codes[n], motion.placement(n))
        for name, (motion, n) in zip(names, frames, strict=True)
    ]
    request = ExportRequest(fps=motions[0].rate, times_of=file)
    source = require_request(output, body, poses, request)
    # Lazily: all meshes at once may not fit in memory.
    meshes = (motion.vertices(n, check) for motion, n in frames)
    is_skeleton = output.path.suffix.lower() in SKELETON_SUFFIXES
    posed = write_result(
        output, body, poses, request, meshes, source, keeps_meshes=is_skeleton, job=job
    )
    # Joint rotations alone may not express a frame exactly.
    if is_skeleton:
        (row,) = rows
        collides = np.zeros(len(posed), dtype=np.bool_)

        def look(start: int, stop: int) -> None:
            collides[start:stop] = [posed[n].collides(body) for n in range(start, stop)]

        for_blocks(look, len(posed), 1, job=job.part())
        count_stuck(row, body, collides)
    elif output.form == "poses" and body.joints is not None:
        for motion, row in zip(motions, rows, strict=True):
            if motion.space_at is not None:
                count_stuck(row, body, ~check.are_free(motion.codes))
                left_out = say(
                    "{path}: pose files store rotations and weights only; other deformation in "
                    "{clip} is left out (use .glb or .pc2 to keep it)",
                    path=output.path,
                    clip=motion.name,
                )
                job.note(left_out)


def measure_again(row: ResolvedClip, body: Body, before: Motion, stored: Motion) -> None:
    """Let a row say how far a motion was moved that is not stored as it was resolved."""
    report = MotionReport.of(before, stored, body.exact_check())
    for name in ("mean_change", "largest_change", "acceleration_ratio", "largest_jump"):
        setattr(row, name, getattr(report, name))


def count_stuck(
    row: ResolvedClip,
    body: Body,
    collides: npt.NDArray[np.bool_],
    put_back: Sequence[range] = (),
    reason: Reason = Reason.AS_WRITTEN,
) -> None:
    """Add frames that collide in the output to a row, with the reason.

    Parameters
    ----------
    collides : (T,) verdicts of the output
    put_back : frames that were written unchanged
    """
    row.colliding_frames = sorted({*row.colliding_frames, *np.flatnonzero(collides).tolist()})
    row.free_after = row.frames - len(row.colliding_frames)
    named = np.zeros(row.frames, dtype=np.bool_)
    of_form = [(span, True) for span in put_back]
    ends_of_named = [span["frames"] for span in row.kept_spans]
    for first, last in (*ends_of_named, *((span.start, span.stop - 1) for span in put_back)):
        named[first : last + 1] = True
    of_form += [(run, False) for run in runs(collides & ~named)]
    for span, is_original in of_form:
        ends = span.start, span.stop - 1
        kept_span = KeptSpan(ends, reason, is_original=is_original)
        row.kept_spans.append(kept_span.to_json(body.domain_names))


def _write_clips(
    output: Output,
    body: Body,
    file: Path,
    changes: Sequence[MotionChange],
    rows: Sequence[ResolvedClip],
    job: Job,
) -> None:
    """Write the character's file with changed clips, or with retargeted motions as new ones."""
    with locked(output.path):
        path = output.path
        if file_stamp(path) != output.before:
            path = unused_name(path)
        if path.suffix.lower() in SCENE_SUFFIXES and is_retargeted(body, file):
            written = write_new_clips(path, body, [change.after for change in changes])
        else:
            written = write_clips(path, body, file, changes)
    for sentence in written.notes:
        job.note(sentence)
    job.note(
        say("wrote {clips} to {path}", clips=counted(len(changes), "clip", "clips"), path=path)
    )
    for change, row, of_file, put_back in zip(
        changes, rows, written.free, written.put_back, strict=True
    ):
        row.output = str(path)
        if put_back:
            before, codes = change.before, change.after.codes.copy()
            for span in put_back:
                codes[span] = before.codes[span]
            measure_again(row, body, before, replace(change.after, codes=codes))
        # Rounding reduces the clearance slightly; without one, the check of the file decides.
        if row.clearance == 0.0:
            row.colliding_frames = []
        count_stuck(row, body, ~of_file, put_back)


# The bodies of scenes.


def write_members(
    folder: Path,
    body: SceneBody,
    poses: Sequence[NamedPose],
    vertices: Sequence[npt.NDArray[np.floating]],
    request: ExportRequest,
    job: Job = UNWATCHED,
) -> list[WrittenPose]:
    """Write poses of a scene, each body to its own file; several poses go to a folder each.

    Static bodies are not written.

    Returns
    -------
    written : for each pose, with all bodies' vertices as stored in the files, in the scene's unit

    Raises
    ------
    MeshFileError : a file cannot be written.
    """
    stems = file_stems(pose.name for pose in poses) if len(poses) > 1 else [""]
    members, written = list(written_members(body, request.mesh_format)), []
    with atomic_files(folder) as unfinished:
        for pose, mesh, stem in zip(poses, vertices, stems, strict=True):
            target = unfinished / stem
            target.mkdir(exist_ok=True)
            stored, notes = np.array(mesh, dtype=np.float64), dict[str, None]()
            for member, file in members:
                rows, codes = body.vertices_of[member.name], np.zeros(member.body.latent_size)
                if member.moves:
                    codes = body.codes_of_member(member.name, pose.latent)
                of_member = _write_member(target / file, member, codes, mesh[rows], request)
                stored[rows] = of_member.vertices
                notes |= dict.fromkeys(f"{member.name}: {text}" for text in of_member.notes)
            written.append(WrittenPose(folder / stem, stored, 1.0, tuple(notes)))
    for sentence in dict.fromkeys(sentence for pose in written for sentence in pose.notes):
        job.note(sentence)
    job.note(
        say(
            "wrote {poses} of {bodies} to {output}",
            poses=counted(len(poses), "pose", "poses"),
            bodies=counted(len(members), "body", "bodies"),
            output=folder,
        )
    )
    return written


def _write_member(
    path: Path,
    member: SceneMember,
    codes: npt.NDArray[np.float64],
    vertices: npt.NDArray[np.floating],
    request: ExportRequest,
) -> WrittenPose:
    """Write a pose of one body of a scene; return it in the scene's unit and coordinates.

    Parameters
    ----------
    codes : (D_k,) of the body
    vertices : (V_k, 3), in the scene
    """
    body, own_vertices = member.body, member.place.inverse().apply(vertices)
    source = source_for(path.suffix, body)
    if source is not None and not bends(body):
        request = replace(request, form="obj" if path.suffix == ".obj" else "mesh")
    written = write_pose(path, body, codes, own_vertices, None, request, source=source)
    frame = export_frame(body, request.axes, path, request.scale)
    if source is not None and source.frame is not None:
        frame = source.frame
    assert written.vertices is not None
    in_scene = member.place.apply(frame.inverse().apply(written.vertices))
    return replace(written, vertices=in_scene, unit=1.0)


def written_members(
    body: SceneBody, mesh_format: str | None = None
) -> Iterator[tuple[SceneMember, str]]:
    """Iterate over the bodies that exports write, and their files' names.

    The default format is that of each body's own file.
    """
    members = [
        member
        for member in body.members
        if (member.moves or member.body.own_file is not None) and not member.is_fixed
    ]
    for member, stem in zip(members, file_stems(member.name for member in members), strict=True):
        own_file = member.body.own_file
        suffix = ".obj" if own_file is None else own_file.suffix.lower()
        if suffix in SCENE_SUFFIXES and suffix != ".vrm":
            suffix = ".glb"
        suffix = f".{mesh_format}" if mesh_format else suffix
        yield member, f"{stem}{suffix}"
