"""Check files for self-collisions: meshes, or every frame of the clips of a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import (
    Body,
    MeshBody,
    RigBody,
    character_of_mesh,
    estimated_free,
    open_body,
)
from lcollision_core.bodies.motions import (
    contact_facts,
    ground_facts,
    is_of_skeleton,
    read_motions,
)
from lcollision_core.bodies.partners import with_joint_map
from lcollision_core.bodies.scene_file import body_of_scene, is_scene_file
from lcollision_core.compiled import working_seconds
from lcollision_core.contact import DISTANCE_BOUND, CollisionDetector
from lcollision_core.errors import LCollisionError, MeshFileError, ShapeError
from lcollision_core.files import Mesh, audit_mesh, read_mesh, read_pose_set
from lcollision_core.files.formats import (
    ANIMATED_SUFFIXES,
    POSES_SUFFIX,
    SCENE_SUFFIXES,
    is_model,
)
from lcollision_core.files.motion.generated import is_generated
from lcollision_core.files.pose_set_reading import frame_rate
from lcollision_core.files.safe import write_table
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene_files import open_rigged, read_scene
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import STRICT, ContactRules, FaceGroup, Topology
from lcollision_core.meshes.contact_rules import CHARACTER_REST_EXCLUSION
from lcollision_core.motion import (
    NOMINAL_RATE,
    FrameChecks,
    Motion,
    ScreenedMotion,
    screen_frames,
    screen_motion,
)
from lcollision_core.options import NO_SCENE, MotionChoice, RuleOptions, SceneOptions
from lcollision_core.tasks.inputs import body_of_motion
from lcollision_core.tasks.scenes import parts_text, read_scene_poses, scene_motion, scene_of
from lcollision_core.tasks.verdicts import CheckedClip, CheckedFrame, CheckedMesh
from lcollision_core.tasks.words import say, say_number

_DEEPEST = 100
"""Most pairs of faces that are listed individually."""


@dataclass(frozen=True)
class CheckRequest:
    """How to check files.

    Attributes
    ----------
    rules : changes to the rules of the file, or to none
    rest : a file with the rest pose; None for the file's own
    no_rules : whether to count all pairs except by `rules`
    clearance : normalised distance below which faces count as colliding
    touch : entries "A:B" of groups that may touch regardless
    motion : which clip of a file, and which frames
    body : a character's file or a model's name, which a motion moves; None if the file has its
        own body
    error_bound : largest share of wrong verdicts, measured on samples of a learned body's latent
        box, for which the estimate may replace the check of free frames
    scene : other bodies beside the mesh or the character
    joints : a file that matches the body's joints to a motion's: see `with_joint_map`
    """

    rules: RuleOptions = field(default_factory=RuleOptions)
    rest: Path | None = None
    no_rules: bool = False
    clearance: float = 0.0
    touch: tuple[str, ...] = ()
    motion: MotionChoice = field(default_factory=MotionChoice)
    body: str | None = None
    error_bound: float = 0.0
    scene: SceneOptions = NO_SCENE
    joints: Path | None = None

    @cached_property
    def rest_mesh(self) -> Mesh | None:
        """The rest pose of meshes; None if none is given.

        Raises
        ------
        LCollisionError : it cannot be read, or is missing although the rules need it.
        """
        if self.rest is not None:
            return read_mesh(self.rest)
        if self.rules.rest_exclusion is not None:
            what = "--rest-exclusion needs a rest pose"
            raise LCollisionError(what, "give one with --rest MESH")
        return None


def check_mesh(path: Path, request: CheckRequest, job: Job = UNWATCHED) -> CheckedMesh:
    """Check one mesh, by the contact rules of its character if known, or those of a scene.

    Raises
    ------
    LCollisionError : the file cannot be read, or its faces differ from the rest pose's.
    CancelledError : the job was cancelled.
    """
    if request.scene.has_others or is_scene_file(path):
        return _check_scene(path, request, job)
    start, rest = working_seconds(), request.rest_mesh
    mesh = read_mesh(path, topology=None if rest is None else rest.topology)
    if rest is not None and rest.topology != mesh.topology:
        what = "does not have the faces of the rest pose"
        raise MeshFileError(what, "name a rest pose of this mesh", where=path)
    for remark in (*mesh.notes, *audit_mesh(mesh.topology, mesh.vertices)):
        job.note(f"{path}: {remark}")
    character = None if request.no_rules or rest is not None else _character(path, mesh, job)
    body: Body
    try:
        if character is not None:
            body, vertices = character
            for remark in body.notes:
                job.note(f"{path}: {remark}")
        else:
            vertices, groups = mesh.vertices, _groups(path, mesh.topology, request)
            reference = vertices if rest is None else rest.vertices
            body = MeshBody(vertices[None], mesh.topology, reference, groups=groups)
        is_known = character is not None or rest is not None
        checked, _ = _checked(
            str(path), _as_asked(body, request), vertices, request, start, job, is_known
        )
    except ShapeError as error:
        raise MeshFileError.because(path, "cannot be checked", error) from error
    return checked if character is None else replace(checked, rules_of=body.name)


def _check_scene(path: Path, request: CheckRequest, job: Job) -> CheckedMesh:
    """Check meshes placed in a scene, each by the rules of its own character."""
    start, scene = working_seconds(), scene_of(str(path), request.scene)
    bodies: list[Body] = []
    posed: list[npt.NDArray[np.float64]] = []
    for part in scene.bodies:
        file = Path(part.file)
        if is_model(part.file):
            model = open_body(part.file)
            bodies.append(model)
            posed.append(model.reference)
            continue
        mesh = read_mesh(file)
        body: Body | None = None
        vertices = mesh.vertices
        if not request.no_rules:
            if (character := _character(file, mesh, job)) is not None:
                body, vertices = character
            elif (document := open_rigged(file)) is not None:
                rigged = open_body(document)
                if rigged.joints is not None:
                    body, vertices = rigged, rigged.reference
        bodies.append(body or MeshBody(vertices[None], mesh.topology, vertices))
        posed.append(vertices)
    scene_body = _as_asked(body_of_scene(scene, bodies, as_posed=True), request)
    members = scene_body.members
    in_order = sorted(
        range(len(members)), key=lambda n: scene_body.vertices_of[members[n].name].start
    )
    shown_meshes = [*posed, *(member.body.reference for member in members[len(posed) :])]
    vertices = np.concatenate([members[n].place.apply(shown_meshes[n]) for n in in_order])
    files = " + ".join(part.file for part in scene.bodies)
    checked, pairs = _checked(files, scene_body, vertices, request, start, job)
    return replace(checked, parts=parts_text(scene_body, pairs))


def _checked(
    file: str,
    body: Body,
    vertices: npt.NDArray[np.float64],
    request: CheckRequest,
    start: float,
    job: Job,
    rest_is_known: bool = True,
) -> tuple[CheckedMesh, npt.NDArray[np.integer]]:
    """Check a mesh of a body; return the verdict, with the time since `start`, and the pairs."""
    detector = body.detector.with_clearance(request.clearance, rest_is_known=rest_is_known)
    nearest = None
    if request.clearance > 0.0:
        bound = max(DISTANCE_BOUND, request.clearance)
        nearest = detector.least_distance(vertices, bound, rest_is_known=rest_is_known)
    collisions = detector.summarise(vertices, n_deepest=_DEEPEST, job=job)
    if collisions.n_coincident_pairs:
        job.note(
            say_number(
                collisions.n_coincident_pairs,
                "{file}: {n} pair of faces coincides; touching is not a collision",
                "{file}: {n} pairs of faces coincide; touching is not a collision",
                file=file,
            )
        )
    topology, rules = body.detector.topology, body.detector.rules
    deepest = zip(collisions.pairs.tolist(), collisions.penetration_depth.tolist(), strict=True)
    least_at = None
    if nearest is not None:
        least_at = {"faces": nearest.faces.tolist(), "points": nearest.points.tolist()}
    return CheckedMesh(
        file=file,
        vertices=topology.n_vertices,
        faces=topology.n_faces,
        watertight=topology.is_watertight,
        pairs=collisions.n_pairs,
        near_pairs=collisions.excluded.near,
        excluded_pairs=collisions.excluded.to_json(),
        rules=rules.to_json(),
        rules_of=None,
        coincident_pairs=collisions.n_coincident_pairs,
        deepest=[{"faces": faces, "depth": depth} for faces, depth in deepest],
        clearance=request.clearance,
        least_distance=None if nearest is None else nearest.distance,
        least_at=least_at,
        energy=collisions.energy,
        colliding=collisions.colliding,
        seconds=working_seconds() - start,
        not_counted=rules.sentence(collisions.excluded),
    ), collisions.pairs


def check_clips(path: Path, request: CheckRequest, job: Job = UNWATCHED) -> list[CheckedClip]:
    """Check every frame of the clips of a file, and the poses between them.

    Raises
    ------
    LCollisionError : the file cannot be read or has no clip, or its body needs no `rest`.
    CancelledError : the job was cancelled.
    """
    first_body = request.body or str(path)
    if request.scene.has_others or is_scene_file(first_body):
        scene = _as_asked(body_of_scene(scene_of(first_body, request.scene)), request)
        for sentence in scene.notes:
            job.note(sentence)
        if request.joints is not None:
            # Refused, as a scene has several skeletons.
            with_joint_map(scene, request.joints)
        played, choice = request.scene.played, request.motion
        if request.body is not None and path.suffix.lower() == POSES_SUFFIX:
            codes = [given.pose.latent for given in read_scene_poses(scene, [path], 1.0, job)]
            times = np.arange(len(codes)) / (choice.fps or NOMINAL_RATE)
            motion = Motion(path.stem, times, np.array(codes), source=path.name)
        else:
            if request.body is not None:
                played = (*played, f"{scene.members[0].name}={path}")
            motion, _ = scene_motion(scene, played, choice, job)
        return _check_motions(scene, [motion], path, request, job)
    if request.body is not None:
        body = open_body(request.body)
        if request.joints is not None:
            body = with_joint_map(body, request.joints)
        return _check_poses(body_of_motion(body, path, job), path, request, job)
    document = open_rigged(path) if path.suffix.lower() in SCENE_SUFFIXES else None
    if document is None:
        return _check_meshes(path, request, job)
    body = open_body(document)
    for sentence in body.notes:
        job.note(f"{path}: {sentence}")
    return _check_poses(body, path, request, job)


def _check_poses(body: Body, path: Path, request: CheckRequest, job: Job) -> list[CheckedClip]:
    """Check motions of a body's poses."""
    if request.rest is not None:
        what = f"--rest is for motions of meshes, and {body.name} has a rest pose of its own"
        raise MeshFileError(what, "leave it out", where=path)
    body, choice = _as_asked(body, request), request.motion
    motions = read_motions(body, path, choice.clip, choice.fps, job.part())
    return _check_motions(body, motions, path, request, job)


def _check_motions(
    body: Body, motions: Sequence[Motion], path: Path, request: CheckRequest, job: Job
) -> list[CheckedClip]:
    """Check motions of a body by its rules."""
    check, choice = body.exact_check(clearance=request.clearance), request.motion
    verdicts = []
    for motion in motions:
        estimated = estimated_free(body, motion, request.error_bound, request.clearance)
        screened = screen_motion(
            motion,
            check,
            choice.substeps,
            None,
            job,
            continuous=choice.continuous,
            estimated_free=estimated,
            counted_only=False,
        )
        names, rules = body.domain_names, body.rules
        verdict = _verdict(
            path, motion.name, motion.times, motion.rate, screened, names, rules, request
        )
        estimates = int(estimated.sum())
        contacts, ground = contact_facts(motion, check), ground_facts(body, motion)
        verdicts.append(
            replace(verdict, estimated_frames=estimates, contacts=contacts, ground=ground)
        )
    return verdicts


def _check_meshes(path: Path, request: CheckRequest, job: Job) -> list[CheckedClip]:
    """Check a file whose frames are meshes; without a rig, parts are components."""
    suffix, choice = path.suffix.lower(), request.motion
    if is_of_skeleton(path) or is_generated(path):
        what = "is the motion of a skeleton, without a body"
        raise MeshFileError(what, "name one with --body", where=path)
    if suffix not in ANIMATED_SUFFIXES:
        one_of = f"use one of {', '.join(ANIMATED_SUFFIXES)}"
        raise MeshFileError("is not a motion file", one_of, where=path)
    clips: list[str | None] = [choice.clip]
    if suffix in SCENE_SUFFIXES and choice.clip is None:
        clips = [clip.name for clip in read_scene(path).clips] or [None]
    verdicts = []
    for clip in clips:
        rate = choice.fps or frame_rate(path, clip) or NOMINAL_RATE
        fps = rate if suffix in SCENE_SUFFIXES else choice.fps
        poses = read_pose_set(path, job.part(), clip=clip, fps=fps)
        reference = None
        if request.rest is not None:
            at_rest = read_mesh(request.rest, topology=poses.topology)
            if at_rest.topology != poses.topology:
                what = "does not have the faces of the motion"
                raise MeshFileError(what, "name its rest pose", where=request.rest)
            reference = at_rest.vertices
        body = _as_asked(MeshBody.of_poses(poses, reference), request)
        detector = body.detector.with_clearance(request.clearance)
        bound = max(DISTANCE_BOUND, request.clearance)
        parts, owner = body.parts
        times = np.arange(len(body.frames)) / rate
        checks = FrameChecks(
            body.vertices_at,
            detector.detect,
            partial(detector.least_distance, bound=bound) if request.clearance > 0.0 else None,
            detector.collide_between if choice.continuous else None,
            collide=partial(_collide, body, detector),
        )
        topology, substeps = poses.topology, choice.substeps
        screened = screen_frames(
            checks, times, owner, topology.faces, substeps, None, job, counted_only=False
        )
        name = clip or path.stem
        verdicts.append(_verdict(path, name, times, rate, screened, parts, detector.rules, request))
    return verdicts


def _collide(
    body: MeshBody, detector: CollisionDetector, frames: Sequence[int], share: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.floating]]:
    meshes = np.stack([body.vertices_at(frame, share) for frame in frames])
    return detector.are_colliding(meshes, workers=1), meshes


def _verdict(
    path: Path,
    clip: str,
    times: npt.NDArray[np.float64],
    fps: float,
    screened: ScreenedMotion,
    names: Sequence[str],
    rules: ContactRules,
    request: CheckRequest,
) -> CheckedClip:
    colliding = {collisions.frame: collisions for collisions in screened.colliding}
    excluding = {exclusions.frame: exclusions for exclusions in screened.excluded}

    def row(frame: int) -> CheckedFrame:
        counted, excluded = colliding.get(frame), excluding.get(frame)
        return CheckedFrame(
            frame,
            float(times[frame]),
            0 if counted is None else counted.n_pairs,
            0.0 if counted is None else counted.deepest,
            [[str(names[a]), str(names[b])] for a, b in (counted.domains if counted else ())],
            None if excluded is None else excluded.counts.total,
            None if excluded is None else excluded.deepest,
            None if excluded is None else excluded.counts.to_json(),
        )

    return CheckedClip(
        file=str(path),
        clip=clip,
        frames=len(times),
        fps=fps,
        colliding_frames=[row(frame) for frame in colliding],
        excluding_frames=[
            row(frame)
            for frame, excluded in excluding.items()
            if excluded.counts.total and frame not in colliding
        ],
        in_between=list(screened.in_between),
        collides_between=screened.collides_between,
        least_distance=screened.least_distance,
        least_frame=screened.least_frame,
        colliding=bool(screened.colliding or screened.in_between or screened.collides_between),
        left_out=screened.left_out.to_json(),
        not_counted=screened.left_out.sentence(rules),
        clearance=request.clearance,
        estimated_frames=0,
    )


def write_clips_table(path: Path, verdicts: Iterable[CheckedClip]) -> None:
    """Write a CSV table with a row for each frame with pairs; depths are in body sizes.

    A free frame with excluded pairs has 0 pairs.

    Raises
    ------
    MeshFileError : it cannot be written.
    """
    rows = []
    for verdict in verdicts:
        frames = (*verdict.colliding_frames, *verdict.excluding_frames)
        for frame in sorted(frames, key=lambda frame: frame.frame):
            row = {"file": verdict.file, "clip": verdict.clip, **asdict(frame)}
            row["parts"] = " ".join(f"{a}:{b}" for a, b in frame.parts)
            rules = frame.excluded_rules or {}
            row["excluded_rules"] = " ".join(f"{rule}:{n}" for rule, n in rules.items() if n)
            rows.append(row)
    write_table(path, ("file", "clip", *(column.name for column in fields(CheckedFrame))), rows)


_AnyBody = TypeVar("_AnyBody", bound="Body")


def _as_asked(body: _AnyBody, request: CheckRequest) -> _AnyBody:
    """Return a body with the contact rules of a request; a rest pose excludes its contacts."""
    body = body.with_rules(STRICT) if request.no_rules else body
    options = request.rules
    if request.rest is not None and options.rest_exclusion is None:
        options = replace(options, rest_exclusion=CHARACTER_REST_EXCLUSION)
    return body.with_options(options).with_touching(request.touch)


def _groups(path: Path, topology: Topology, request: CheckRequest) -> tuple[FaceGroup, ...]:
    """Return the meshes and materials named in a scene's file, if its faces match."""
    is_asked = request.rules.name_groups or request.touch
    if not is_asked or path.suffix.lower() not in SCENE_SUFFIXES:
        return ()
    joined = join_parts(read_scene(path))
    return joined.groups if joined.topology == topology else ()


def _character(path: Path, mesh: Mesh, job: Job) -> tuple[RigBody, npt.NDArray[np.float64]] | None:
    """Return the character of a mesh file, with its rules, and the pose; None if there is none."""
    try:
        return character_of_mesh(path, mesh)
    except LCollisionError as error:
        job.note(say("{error}; all pairs are counted", error=error))
        return None
