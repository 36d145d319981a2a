"""The long work of the editor, as functions of a snapshot that run in another thread.

Each becomes a `Task` by `functools.partial`: the job comes last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

from app.work import compile_ahead
from app.work.frames import FrameEvaluator, OwnSpace, keep_torch_to_one_thread
from lcollision_core.errors import MeshFileError, ModelFileError, PoseSetError, WrongScaleError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.tasks.words import mirrored_name

if TYPE_CHECKING:
    from lcollision_core.bodies import (
        Body,
        MirroredPose,
        NamedPose,
        OtherModelError,
        PoseFile,
        ProposedRules,
    )
    from lcollision_core.bodies.partners import Followed, JointMatch
    from lcollision_core.contact import ContactRules, ProposedPair, RuleCounts
    from lcollision_core.files import Character, FileStamp
    from lcollision_core.files.scene_files import SceneDocument
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.motion import Motion, MotionOptions, ResolvedMotion
    from lcollision_core.resolve import ResolveOptions, ResolveResult

    Examined: TypeAlias = "SceneDocument | Character | AnimationAlone | OtherMesh | None"
    """What a file is: a body with joints; None for a mesh of the body that is open, and else."""

Float32Array = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OpenedModel:
    """A model and the file that it was read from, or written to."""

    model: Body
    file: str


@dataclass(frozen=True, eq=False)
class ReadPoses:
    """A poses file: at least one pose.

    Attributes
    ----------
    path : that was read
    held : with a working pose or others
    stamp : of the file as it was read
    opened : the model that was opened for it, None for the one that was open
    """

    path: Path
    held: PoseFile
    stamp: FileStamp | None
    opened: OpenedModel | None


@dataclass(frozen=True)
class ContactsAtRest:
    """What the contact rules make of the rest pose.

    Attributes
    ----------
    n_counted : colliding pairs that count
    excluded : how many each rule leaves out
    """

    n_counted: int
    excluded: RuleCounts


@dataclass(frozen=True)
class PartEdits:
    """New names, colours and order of body parts.

    Attributes
    ----------
    names, colours : of those domains that change, by index from 0
    order : all domains in listing order, None if that stays
    copy_name : of the user's own model to make, None to change the model's file
    """

    names: dict[int, str]
    colours: dict[int, str]
    order: tuple[int, ...] | None = None
    copy_name: str | None = None


def open_model(
    name_or_path: str | Path,
    job: Job,
    up: int | None = None,
    read: SceneDocument | Character | None = None,
) -> OpenedModel:
    """Read a model and use it once, so that nothing is left to compile before the first frame.

    `read` is what is read already of the file.
    """
    from lcollision_core.bodies import find_model, open_body, remember_file, remember_up
    from lcollision_core.bodies.scene_file import is_scene_file, open_scene_file

    path = find_model(name_or_path).absolute()
    if is_scene_file(path):
        scene: Body = open_scene_file(path)
        warm_up(scene, job)
        return OpenedModel(scene, str(path))
    model = open_body(path if read is None else read, up)
    job.check()
    try:
        remember_file(model, path)
        if up is not None:
            remember_up(model, up)
    except ModelFileError as error:
        model = model.noted(error.headline)
    warm_up(model, job)
    if model.character is not None and model.appearance is not None:
        for note in model.appearance.notes:
            model = model.noted(note)
    return OpenedModel(model, str(path))


def warm_up(model: Body, job: Job = UNWATCHED) -> None:
    """Compute once, in another thread, what the first frames need apart from predictions."""
    evaluator = FrameEvaluator(model)
    evaluator.predicts = False
    latent = np.zeros(model.latent_size)
    latent.flags.writeable = False
    frame = evaluator.frame(latent)
    compile_ahead.AHEAD.wait_for_check(job)
    evaluator.checked(frame)
    _ = model.fingerprint, model.latent_space, model.symmetry, model.code_names
    _ = model.groups_by_kind, model.appearance, model.starter_poses


def _drag_once(model: Body) -> None:
    """Compile a drag, and compute its metric: the latter takes seconds for a large mesh."""
    from lcollision_core.posing import make_grip

    dragger = model.dragger()
    dragger.begin(np.zeros(model.latent_size), make_grip(model.space, 0))
    dragger.move(model.reference[0])


@dataclass(frozen=True)
class AnimationAlone:
    """A file of clips without a mesh, which are motions of the body that is open."""

    path: Path


@dataclass(frozen=True)
class OtherMesh:
    """A file of a mesh that is none of the body that is open."""

    path: Path


def examine(path: Path, job: Job, beside: Body | None = None) -> Examined:
    """Read a file, if it shows something that joints move, so that it opens as a body.

    `beside` is a body that others may stand beside, as which a mesh of other vertices is a prop.
    """
    from lcollision_core.files import read_character, read_mesh
    from lcollision_core.files.scene.smpl import is_smpl_model
    from lcollision_core.files.scene_files import is_animation_alone, open_scene
    from lcollision_core.files.table import SCENE_SUFFIXES

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


def prepare(model: Body, job: Job) -> Body:
    """Use once what poses at rest and drags need: compiling and importing take seconds."""
    if model.has_predictor:
        keep_torch_to_one_thread(model)
        model.predict(np.zeros(model.latent_size))
    _drag_once(model)
    compile_ahead.AHEAD.wait_for_all(job)
    compile_ahead.measure(compile_ahead.triangle())
    return model


def read_poses(
    model: Body | None,
    model_file: str | Path,
    path: Path,
    job: Job,
) -> ReadPoses | OtherModelError:
    """Read a poses file of a model, which is opened first where it is None.

    Where the file belongs to another model that is known, the error that names it comes back.
    """
    from lcollision_core.bodies import OtherModelError, read_pose_file
    from lcollision_core.files import file_stamp

    opened = None
    if model is None:
        opened = open_model(model_file, job)
        model = opened.model
    stamp = file_stamp(path)
    try:
        held = read_pose_file(path, model)
    except OtherModelError as error:
        # One that was opened for them is not the one that it was.
        if error.model is None or opened is not None:
            raise
        return error
    job.check()
    if not held.all_poses:
        raise ModelFileError("contains no poses", "open a file with poses", where=path)
    return ReadPoses(path, held, stamp, opened)


def save(
    model: Body,
    path: Path,
    poses: Sequence[NamedPose],
    working: NamedPose | None,
    _: Job,
) -> FileStamp | None:
    """Write a file of poses, and return its stamp."""
    from lcollision_core.bodies import write_poses
    from lcollision_core.files import file_stamp

    write_poses(path, model, poses, working)
    return file_stamp(path)


def encode(
    model: Body,
    path: Path,
    scale: float,
    is_asked_as_mesh: bool,
    job: Job,
) -> NamedPose | WrongScaleError:
    """Read a mesh of a model's topology as a latent pose, named after its file.

    `scale` brings it into the model's unit. Without the right one, the error that names it comes
    back. A file that was not asked for as a mesh of this model is not compared with it in words.
    """
    from lcollision_core.bodies import encode_mesh, read_model_mesh

    try:
        mesh = read_model_mesh(path, model)
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
        return encode_mesh(mesh, model, scale, job)
    except WrongScaleError as error:
        return error


def mirror_poses(
    model: Body, poses: Sequence[NamedPose], job: Job
) -> list[tuple[NamedPose, MirroredPose]]:
    """Return the mirror images of poses, and a remark on each."""
    from lcollision_core.bodies import MAX_POSE_NAME_LENGTH

    images = []
    for done, pose in enumerate(poses, 1):
        image = model.mirror(pose.latent, pose.placement, pose.mirror_of, job=job.part())
        name = mirrored_name(pose.name)[:MAX_POSE_NAME_LENGTH]
        images.append((replace(pose.mirrored(image, model.pose_mirror.symmetry), name=name), image))
        job.report(done, len(poses))
    return images


def resolve(
    model: Body,
    latent: FloatArray,
    placement: RigidTransform | None,
    options: ResolveOptions,
    job: Job,
    own: OwnSpace | None = None,
) -> tuple[ResolveResult, Float32Array]:
    """Find the nearest pose that is free where it is exported to.

    Returns
    -------
    result : what Resolve found
    ghost : (V, 3) float32 array, read-only: the mesh before, to the bit as it was drawn
    """
    from lcollision_core.compiled import seconds_compiling

    check = model.exact_check(placement, own and own(), options.clearance)
    ghost = check.drawn(check.decode(latent)[0])
    ghost.flags.writeable = False
    before = seconds_compiling()
    resolver = model.resolver if own is None else model.resolver.with_check(check)
    result = resolver.resolve(latent, options, job=job, placement=placement)
    # Compiling, at the first use, does not count as search time.
    searched = max(0.0, result.seconds - (seconds_compiling() - before))
    return replace(result, seconds=searched), ghost


def read_motions(model: Body, path: Path, clip: str | None, job: Job) -> list[Motion]:
    """Read the motions of a file at their own rate: see `bodies.motions.read_motions`.

    That of a scene is what its bodies do together.
    """
    from lcollision_core.bodies import as_scene
    from lcollision_core.bodies.motions import read_motions as read
    from lcollision_core.options import MotionChoice
    from lcollision_core.tasks.scenes import scene_motion

    scene = as_scene(model)
    if scene is not None and path == own_motions(model)[0]:
        motion = scene_motion(scene, (), MotionChoice(), job)[0]
        return [motion if clip is None else replace(motion, name=clip)]
    return read(model, path, clip, None, job)


def own_motions(model: Body) -> tuple[Path | None, tuple[str, ...]]:
    """Return the file of a body's own motions and their names: of a scene the one of all bodies."""
    from lcollision_core.bodies import as_scene

    scene = as_scene(model)
    if scene is None:
        return model.own_file, model.own_clips
    names = dict.fromkeys(clip for clip, _ in scene.plays.values())
    if not names or scene.file is None or not scene.file.path:
        return None, ()
    return Path(scene.file.path), (" + ".join(names),)


@dataclass(frozen=True, eq=False)
class OpenedMotions:
    """What a file of motions holds.

    Attributes
    ----------
    opened : the body in the shape that they say, None if that is open
    motions : empty where only a user can say which joint goes where
    joints : which joint goes where, None where the motions are of the body's own joints
    """

    opened: OpenedModel | None
    motions: list[Motion]
    joints: JointMatch | None


def open_motions(model: Body, model_file: str, path: Path, job: Job) -> OpenedMotions:
    """Read the motions of a file."""
    from lcollision_core.bodies.motions import body_of_motion, is_carried
    from lcollision_core.bodies.retargeting import joint_match

    joints = joint_match(model, path) if is_carried(model, path) else None
    try:
        body, notes = body_of_motion(model, path)
    except MeshFileError:
        if joints is None or not joints.unsure:
            raise
        return OpenedMotions(None, [], joints)
    if body is not model:
        for sentence in notes:
            body = body.noted(sentence)
        warm_up(body, job)
    opened = None if body is model else OpenedModel(body, model_file)
    return OpenedMotions(opened, read_motions(body, path, None, job), joints)


def choose_joints(match: JointMatch, followed: Followed) -> None:
    """Keep which joint follows which."""
    from lcollision_core.bodies.partners import remember_followed

    remember_followed(match, followed)


def resolve_motion(
    model: Body,
    motion: Motion,
    options: MotionOptions,
    within: range | None,
    solved: npt.NDArray[np.bool_],
    stop: Job,
    job: Job,
) -> ResolvedMotion:
    """Free a motion.

    Parameters
    ----------
    within : the frames that may change; all if None
    solved : (T,) bool array, which is set for frames as they come out free
    stop : set to end with the spans that are done
    """
    from lcollision_core.motion import resolve_motion as resolved
    from lcollision_core.tasks.verdicts import ground_report

    def keep(frame: int, found: tuple[FloatArray, bool]) -> None:
        solved[frame] = found[1]

    up = np.eye(3)[model.up_axis]
    found = resolved(
        model.resolver,
        motion,
        up,
        options,
        None,
        job,
        within=within,
        keep=keep,
        stop=stop,
    )
    return replace(found, ground=ground_report(model, found.motion))


def free_neighbours(
    model: Body,
    before: Motion,
    edited: Motion,
    clearance: float,
    job: Job,
) -> Motion | None:
    """Free what an edit of one frame has eased into itself; None where nothing has to be.

    Parts keep a clearance, normalised.

    Frames that are free, the edited one among them where it is, stay equal to the bit.
    """
    from lcollision_core.motion import MotionOptions
    from lcollision_core.motion import resolve_motion as resolved
    from lcollision_core.motion.motion import runs
    from lcollision_core.resolve import ResolveOptions

    check = model.exact_check(clearance=clearance)
    is_new = np.zeros(len(edited), dtype=np.bool_)
    for frame in np.flatnonzero((before.codes != edited.codes).any(axis=1)).tolist():
        job.check()
        collides = not edited.check(frame, check).is_free(edited.codes[frame])
        is_new[frame] = collides and before.check(frame, check).is_free(before.codes[frame])
    # Without easing the frames beside them are left alone.
    frame_options = ResolveOptions(clearance=clearance)
    options = MotionOptions(easing=0, keep_feet=False, keep_contacts=False, frame=frame_options)
    up = np.eye(3)[model.up_axis]
    eased = edited
    for within in runs(is_new):
        eased = resolved(model.resolver, eased, up, options, None, job, within=within).motion
    return None if eased is edited else eased


def path_of(
    model: Body,
    motion: Motion,
    frames: range,
    vertex: int,
    job: Job,
) -> FloatArray:
    """Return the (N, 3) places of a vertex as frames of a motion are drawn, in the data's unit."""
    chosen, places = np.array([vertex]), np.empty((len(frames), 3))
    for row, frame in enumerate(frames):
        job.check()
        space = motion.space(frame, model.space)
        places[row] = space.decode_some(motion.codes[frame][None], chosen)[0, 0] * model.body_size
        job.report(row, len(frames))
    return places


def contacts_at_rest(model: Body, _: Job) -> ContactsAtRest:
    """Count the colliding pairs of the rest pose by the rules that leave them out."""
    found = model.detector.detect(model.reference)
    return ContactsAtRest(len(found.pairs), found.excluded)


def propose_pairs(model: Body, job: Job) -> dict[str, tuple[ProposedPair, ...]]:
    """Propose groups to ignore, by kind, by some of the poses that the body came with."""
    from lcollision_core.bodies import typical_poses
    from lcollision_core.contact import propose_by_kind

    return propose_by_kind(
        model.detector,
        typical_poses(model),
        model.groups_by_kind,
        job=job,
    )


def propose_rules(model: Body, job: Job) -> tuple[ProposedRules | None, bool]:
    """Propose rules for a character most of whose poses collide: see `bodies.propose_rules`.

    Returns
    -------
    proposed : or None
    is_offered : whether the user has not declined them before
    """
    from lcollision_core.bodies import propose_rules
    from lcollision_core.bodies.known import is_offer_declined

    proposed = propose_rules(model, job)
    return proposed, proposed is not None and not is_offer_declined(model)


def decline_offer(model: Body, _: Job) -> None:
    """Keep that a character's proposed rules are not to be offered again."""
    from lcollision_core.bodies.known import remember_offer_declined

    remember_offer_declined(model)


def change_rules(model: Body, model_file: str, rules: ContactRules, _: Job) -> OpenedModel:
    """Apply other contact rules to a model, and write them into its file.

    Those of a character are remembered beside its file; of a bundled model they change in the
    window alone.
    """
    from lcollision_core.bodies import (
        LearnedBody,
        change_model,
        is_bundled,
        remember_choices,
    )

    changed = model.with_rules(rules)
    if model.is_trained and not is_bundled(model_file):

        def change(held: LearnedBody) -> LearnedBody:
            _require_same(held, model, model_file, "its contact rules")
            return held.with_rules(rules)

        change_model(model_file, change)
    remember_choices(changed)
    return OpenedModel(changed, model_file)


def say_role(
    model: Body,
    model_file: str,
    joint: str,
    role: str | None,
    job: Job,
) -> OpenedModel:
    """Keep what the user says that a character's joint is, and open the character again."""
    from lcollision_core.bodies import remember_roles

    remember_roles(model, {joint: role})
    return open_model(model_file, job, read=model.character)


def turn_upright(model: Body, model_file: str, job: Job) -> OpenedModel:
    """Turn a body so that its next axis is up; a model is changed in its file, and then read."""
    from lcollision_core.bodies import LearnedBody, change_model

    axis = (model.up_axis + 1) % 3
    if not model.is_trained:
        return open_model(model_file, job, up=axis, read=model.character)

    def change(held: LearnedBody) -> LearnedBody:
        _require_same(held, model, model_file, "its up axis")
        return held.turned_upright(axis)

    change_model(model_file, change)
    return open_model(model_file, job)


def edit_parts(model: Body, model_file: str, edits: PartEdits, _: Job) -> OpenedModel:
    """Write a model's parts into its file, as that is now, or into a copy of the user's own.

    Those of a character, whose file is not ours, are remembered beside it.
    """
    from lcollision_core.bodies import (
        LearnedBody,
        change_model,
        model_destination,
        remember_choices,
    )
    from lcollision_core.files import locked

    written = model.edit_domains(edits.names, edits.colours, edits.order)
    if not model.is_trained:
        remember_choices(written)
        return OpenedModel(written, model_file)

    def change(held: LearnedBody) -> LearnedBody:
        _require_same(held, model, model_file, "its body parts")
        return held.edit_domains(edits.names, edits.colours, edits.order)

    if edits.copy_name is None:
        written, path = change_model(model_file, change), Path(model_file)
    else:
        path = model_destination(edits.copy_name)
        with locked(path):
            if path.exists():
                raise ModelFileError(
                    f"a model {edits.copy_name!r} already exists", "choose another name"
                )
            written.save(path)
    # What the open model has loaded and compiled stays.
    return OpenedModel(model.with_card(written.card, path.stem), str(path))


def _require_same(held: Body, model: Body, model_file: str, what: str) -> None:
    if held.fingerprint != model.fingerprint:
        raise ModelFileError(
            "has been replaced by another model",
            f"open that one to change {what}",
            where=model_file,
        )
