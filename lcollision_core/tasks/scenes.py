"""Check, resolve and write scenes of several bodies, each body in its own file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import (
    Body,
    NamedPose,
    as_scene,
    name_of_file,
    open_body,
    read_model_mesh,
    write_sequence,
)
from lcollision_core.bodies.motions import (
    MotionChange,
    read_motions,
    write_clips,
    write_new_clips,
)
from lcollision_core.bodies.names import unique_names
from lcollision_core.bodies.poses import OtherModelError, read_poses
from lcollision_core.bodies.scene_body import (
    SceneBody,
    SceneFile,
    SceneMember,
    ScenePart,
    bends,
)
from lcollision_core.bodies.scene_file import (
    beside,
    body_of_scene,
    is_scene_file,
    read_scene_file,
    write_scene_file,
)
from lcollision_core.bundled import user_folder
from lcollision_core.errors import LCollisionError, PoseSetError, listed
from lcollision_core.files.formats import POSES_SUFFIX, SCENE_SUFFIXES
from lcollision_core.files.scene_files import read_scene
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.model_file import digest_of
from lcollision_core.motion.frames import Reason
from lcollision_core.motion.motion import Motion, runs
from lcollision_core.options import ExportRequest, MotionChoice, SceneOptions
from lcollision_core.tasks.exporting import (
    count_stuck,
    measure_again,
    refuse_to_replace,
    source_files,
    write_members,
    write_motions,
    written_members,
)
from lcollision_core.tasks.inputs import InputPose, read_some_poses
from lcollision_core.tasks.resolving import ResolveMotionsRequest, resolve_one, run_of_motions
from lcollision_core.tasks.verdicts import ResolvedClip
from lcollision_core.tasks.words import joined, say, say_number

_ONLY_CLIP_RATE = 30.0


def open_scene(source: str, options: SceneOptions) -> Body:
    """Open a body, with the scene around it if any; or a scene file.

    Raises
    ------
    LCollisionError : a file cannot be read, or an option names an unknown body.
    """
    if not is_scene_file(source) and not options.has_others:
        given = ("--at", options.places), ("--fixed", options.fixed), ("--play", options.played)
        for name, values in given:
            if values:
                raise LCollisionError(f"{name} is for scenes", "add --with or --ground")
        return open_body(source)
    return body_of_scene(scene_of(source, options))


def scene_of(source: str, options: SceneOptions) -> SceneFile:
    """Return the scene of a body, or of a scene file, with the options applied.

    Raises
    ------
    LCollisionError : an option is malformed, or names an unknown body.
    """
    scene = read_scene_file(source) if is_scene_file(source) else SceneFile((ScenePart(source),))
    parts = list(scene.bodies)
    for entry in options.others:
        file, at, joint = entry.rpartition("@")
        is_held = at and not Path(entry).is_file()
        parts.append(ScenePart(file, joint=joint) if is_held else ScenePart(entry))
    names = unique_names(part.name or Path(part.file).stem for part in parts)
    parts = [replace(part, name=name) for part, name in zip(parts, names, strict=True)]
    parts = [
        replace(part, held_by=names[0]) if part.joint and not part.held_by else part
        for part in parts
    ]

    def numbered(name: str, option: str) -> int:
        if name in names:
            return names.index(name)
        bodies_text = f"its bodies are {', '.join(names)}"
        raise LCollisionError(f"{option} names {name!r}, which is not in the scene", bodies_text)

    for name in options.fixed:
        number = numbered(name, "--fixed")
        parts[number] = replace(parts[number], fixed=True)
    for entry in options.places:
        name, _, numbers = entry.rpartition("=")
        try:
            x, y, z, turn = ([*map(float, numbers.split(",")), 0.0])[:4]
            values = np.array([x, y, z, turn])
        except ValueError:
            values = np.array([np.nan])
        if not np.isfinite(values).all() or numbers.count(",") > 3:
            raise LCollisionError("is not NAME=X,Y,Z or NAME=X,Y,Z,DEGREES", where=f"--at {entry}")
        number = numbered(name, "--at")
        parts[number] = replace(parts[number], at=(x, y, z), turn=turn)
    return replace(scene, bodies=tuple(parts), ground=_height(options.ground, scene.ground))


def _height(given: str | None, held: float | str | None) -> float | str | None:
    if given is None or given == "rest":
        return held if given is None else given
    try:
        height = float(given)
    except ValueError:
        height = np.nan
    if not np.isfinite(height):
        raise LCollisionError.must_be("--ground", "a height, or nothing", repr(given))
    return height


def scene_of_files(files: Sequence[Path]) -> SceneFile:
    """Return the scene of files opened together, each body beside the previous one.

    Raises
    ------
    LCollisionError : a file is missing or cannot be read.
    """
    first, *others = files
    scene = SceneFile((ScenePart(str(first.absolute())),))
    for file in others:
        scene = beside(scene, file.absolute())
    return scene


def _scene_around(body: Body, body_file: str) -> SceneFile:
    """Return the scene that a body is, or one of that body alone."""
    scene = as_scene(body)
    scene_file = None if scene is None else scene.file
    return scene_file or SceneFile((ScenePart(str(Path(body_file).absolute())),))


def with_body(body: Body, body_file: str, path: Path) -> str:
    """Return the file of a body or a scene with another body beside it.

    Raises
    ------
    LCollisionError : the file cannot be read, or the scene file cannot be written.
    """
    return str(kept_scene(beside(_scene_around(body, body_file), path.absolute())))


def without_body(scene: SceneBody, name: str) -> str:
    """Return the file of a scene without one of its bodies, or of the only one that is left.

    What the body holds stays where it is.

    Raises
    ------
    LCollisionError : the scene file cannot be written.
    """
    assert scene.file is not None
    parts = [
        replace(part, name=member.name)
        if part.held_by != name
        else replace(part, name=member.name, held_by="", joint="")
        for part, member in zip(scene.file.bodies, scene.members, strict=False)
        if member.name != name
    ]
    if len(parts) == 1 and scene.file.ground is None:
        return parts[0].file
    return str(kept_scene(replace(scene.file, bodies=tuple(parts), path="")))


def carried_pose(pose: NamedPose, before: Body, after: Body, removed: str = "") -> NamedPose | None:
    """Return a pose of a body or a scene as one of a scene with more or fewer bodies.

    Added bodies are at rest. Bodies match by name, and a body alone matches any name; None if none
    is in both.

    Parameters
    ----------
    removed : the name of the body that is no longer in the scene
    """
    if len(pose.latent) == after.latent_size:
        return pose
    old, new = as_scene(before), as_scene(after)
    own = {
        name: pose.latent if old is None else old.codes_of_member(old_name, pose.latent)
        for old_name, name in _bodies_in_both(before, after, removed)
    }
    if not own:
        return None
    latent = own[""] if new is None else new.joined_codes([own.get(m.name) for m in new.members])
    return NamedPose(pose.name, latent, pins=pose.pins)


def carried_domains(
    domains: Collection[int], before: Body, after: Body, removed: str = ""
) -> frozenset[int]:
    """Return those of some domains of a body or a scene that are left in another one.

    Bodies match as in `carried_pose`.
    """
    by_name = {name: domain for domain, name in enumerate(after.domain_names)}
    place_of = {here: by_name.get(name, -1) for here, name in enumerate(before.domain_names)}
    for old_name, name in _bodies_in_both(before, after, removed):
        own = zip(_own_domains(before, old_name), _own_domains(after, name), strict=True)
        place_of |= dict(own)
    return frozenset({place_of[domain] for domain in domains} - {-1})


def _bodies_in_both(before: Body, after: Body, removed: str) -> Iterator[tuple[str, str]]:
    """Pair the names of bodies in a body or a scene and in another; a body alone has none."""
    posed, shown = (
        [("", body)] if scene is None else [(member.name, member.body) for member in scene.standing]
        for scene, body in ((as_scene(before), before), (as_scene(after), after))
    )
    paired: set[str] = set()
    for old_name, old_body in posed:
        if removed and old_name == removed:
            continue
        for name, body in shown:
            is_same = body.fingerprint == old_body.fingerprint
            if name not in paired and is_same and (name == old_name or "" in (name, old_name)):
                paired.add(name)
                yield old_name, name
                break


def _own_domains(body: Body, name: str) -> range:
    """Return the domains of a body alone, or in a scene, there without those of what it holds."""
    scene = as_scene(body)
    if scene is None:
        return range(len(body.domain_names))
    member = scene.member(name)
    return scene.domains_of_member(name)[: len(member.body.domain_names) if member.moves else 1]


def with_ground(body: Body, body_file: str) -> str:
    """Toggle the ground of a body or a scene, and return the file of the result.

    Codes of poses do not change.

    Raises
    ------
    LCollisionError : the scene file cannot be written.
    """
    scene = _scene_around(body, body_file)
    if scene.ground is not None and len(scene.bodies) == 1:
        return scene.bodies[0].file
    return str(kept_scene(replace(scene, ground="rest" if scene.ground is None else None)))


def kept_scene(scene: SceneFile) -> Path:
    """Write a scene without a file of the user to the data folder, and return its path.

    Raises
    ------
    MeshFileError : it cannot be written.
    """
    folder = user_folder("scenes")
    folder.mkdir(parents=True, exist_ok=True)
    names = " + ".join(Path(part.file).stem for part in scene.bodies)[:80]
    path = folder / f"{names} {digest_of(repr((scene.bodies, scene.ground)), {})[:8]}.json"
    write_scene_file(path, scene)
    return path


def parts_text(body: Body, pairs: npt.NDArray[np.integer]) -> list[str]:
    """Return which parts collide, most pairs first, as in "hero: left hand - villain: chest"."""
    owner = body.space.vertex_domain[body.faces[pairs][:, :, 0]]
    domains, counts = np.unique(np.sort(owner, axis=1), axis=0, return_counts=True)
    names = body.domain_names
    order = np.argsort(-counts, kind="stable")
    return [f"{names[a]} - {names[b]}" for a, b in domains[order].tolist()]


# Poses.


def read_scene_poses(
    body: SceneBody, files: Sequence[Path], scale: float, job: Job = UNWATCHED
) -> list[InputPose]:
    """Read poses of a scene or of its bodies; each file is of the first body that it fits.

    Bodies without a file stay at rest; without files, the scene is at rest.

    Raises
    ------
    LCollisionError : a file cannot be read, or fits no body of the scene.
    """
    poses_of: dict[str, list[NamedPose]] = {}
    sources: list[str] = []
    for path in files:
        if path.suffix.lower() == POSES_SUFFIX:
            try:
                whole = read_poses(path, body)
            except OtherModelError:
                whole = ()
            if whole:
                return [InputPose(f"{path}: {pose.name}", pose) for pose in whole]
        failure: LCollisionError | None = None
        for member in body.members:
            if not member.moves or member.name in poses_of:
                continue
            try:
                if path.suffix.lower() == POSES_SUFFIX:
                    own = read_some_poses(path, member.body)
                    _note_placement(member, [pose.placement for pose in own], job)
                    poses_of[member.name] = [placed_pose(member.body, pose) for pose in own]
                else:
                    poses_of[member.name] = [_encoded(member, path, scale, job)]
            except (PoseSetError, OtherModelError) as error:
                failure = error
                continue
            sources.append(str(path))
            break
        else:
            names = ", ".join(member.name for member in body.members if member.moves)
            raise LCollisionError(
                "is a pose of no body of the scene"
                if failure is None
                else f"is a pose of no body of the scene: {failure.headline}",
                f"its bodies are {names}, and each takes one file",
                where=path,
            )
    n_poses = max(map(len, poses_of.values()), default=1)
    poses = []
    for number in range(n_poses):
        codes = [
            poses_of[member.name][min(number, len(poses_of[member.name]) - 1)].latent
            if member.name in poses_of
            else None
            for member in body.members
        ]
        name = f"scene {number + 1}" if n_poses > 1 else "scene"
        pose = NamedPose(name, body.joined_codes(codes))
        source = " + ".join(sources) or body.name
        poses.append(InputPose(f"{source}: {name}" if n_poses > 1 else source, pose))
    _note_copies(body, np.array([given.pose.latent for given in poses]), job)
    return poses


def _note_copies(body: SceneBody, codes: FloatArray, job: Job) -> None:
    """Note moving bodies that are in one place in any of (N, D) poses, as no check finds them."""
    for first, second in combinations([own for own in body.standing if own.moves], 2):
        is_same = first.body.fingerprint == second.body.fingerprint
        if not is_same or not np.array_equal(first.place.matrix, second.place.matrix):
            continue
        own, other = (body.codes_of_member(member.name, codes) for member in (first, second))
        if (own == other).all(axis=1).any():
            text = say(
                "{name}: it stands exactly where {other} does, and faces that coincide do not "
                "collide; move it with --at",
                name=second.name,
                other=first.name,
            )
            job.note(text)


def _note_placement(
    member: SceneMember, places: Sequence[RigidTransform | None] | None, job: Job
) -> None:
    if member.body.joints is None and any(place is not None for place in places or ()):
        text = say(
            "{name}: the file's placement is left out, as no code moves this body as a whole",
            name=member.name,
        )
        job.note(text)


def placed_pose(body: Body, pose: NamedPose) -> NamedPose:
    """Return a pose whose placement became codes of the whole body."""
    if pose.placement is None:
        return pose
    (latent,) = _placed_codes(body, pose.latent[None], [pose.placement])
    return replace(pose, latent=latent, placement=None)


def _encoded(member: SceneMember, path: Path, scale: float, job: Job) -> NamedPose:
    """Return the pose of a mesh; its position becomes codes of the whole body."""
    mesh = read_model_mesh(path, member.body)
    size = member.body.body_size
    latent = member.body.nearest(np.asarray(mesh.vertices) * scale / size, job)
    away = np.linalg.norm(member.body.decode(latent) / size - mesh.vertices * scale / size, axis=1)
    return NamedPose(name_of_file(path), latent, None, float(away.mean()), float(away.max()))


# Motions.


@dataclass(frozen=True, eq=False)
class PlayedMotion:
    """The motion of one body of a scene.

    Attributes
    ----------
    member : the body
    motion : at the scene's frame rate; None if it stands still
    file : source of the motion
    start : frame of the scene at which it starts
    """

    member: SceneMember
    motion: Motion | None
    file: Path | None
    start: int

    @property
    def is_own_clip(self) -> bool:
        """Whether it is a clip of a character's own file, which is rewritten with it corrected."""
        body, file = self.member.body, self.file
        return file is not None and bends(body) and body.is_of_file(file)

    def frames(self, n: int) -> npt.NDArray[np.intp]:
        """Return the motion's frame in each of n frames of the scene, clamped to its ends."""
        last = 0 if self.motion is None else len(self.motion) - 1
        return np.clip(np.arange(n) - self.start, 0, last)


def scene_motion(
    body: SceneBody, played: Sequence[str], choice: MotionChoice, job: Job = UNWATCHED
) -> tuple[Motion, list[PlayedMotion]]:
    """Read the clips of a scene's bodies as one motion.

    Parameters
    ----------
    played : see `SceneOptions`
    choice : clip name, for bodies that have it, and frame rate; by default the highest of their
        rates

    Raises
    ------
    LCollisionError : an entry names an unknown body, a clip cannot be read, or nothing moves.
    """
    asked_clips = _asked_clips(body, played, choice.clip)
    if not asked_clips:
        raise LCollisionError(
            "has no clip", "say what moves with --play NAME=FILE", where=body.name
        )
    rates = [
        read_motions(body.member(name).body, file, clip, None, job.part())[0].rate
        for name, (file, clip, _) in asked_clips.items()
        if choice.fps is None
    ]
    rate = choice.fps or max(rates, default=_ONLY_CLIP_RATE)
    motions: list[PlayedMotion] = []
    for member in body.members:
        if not member.moves:
            continue
        if member.name not in asked_clips:
            motions.append(PlayedMotion(member, None, None, 0))
            continue
        file, clip, seconds = asked_clips[member.name]
        motion = read_motions(member.body, file, clip, rate, job.part())[0]
        _note_placement(member, motion.placements, job)
        motion = _moved_by_codes(member.body, motion).at_rate(rate)
        motions.append(PlayedMotion(member, motion, file, round(seconds * rate)))
    moving = [(of_body, of_body.motion) for of_body in motions if of_body.motion is not None]
    n = max(of_body.start + len(motion) for of_body, motion in moving)
    codes_of = {of_body.member.name: motion.codes[of_body.frames(n)] for of_body, motion in moving}
    still = [None] * n
    rows = zip(*(codes_of.get(member.name, still) for member in body.members), strict=True)
    codes = np.array([body.joined_codes(row) for row in rows])
    _note_copies(body, codes, job)
    names = " + ".join(dict.fromkeys(motion.name for _, motion in moving))
    files = dict.fromkeys(of_body.file.name for of_body, _ in moving if of_body.file is not None)
    space_at = _space_at(body, moving)
    return Motion(names, np.arange(n) / rate, codes, None, space_at, " + ".join(files)), motions


def _moved_by_codes(body: Body, motion: Motion) -> Motion:
    """Return a motion whose placements, as of a point cache, are codes of the whole body."""
    if motion.placements is None:
        return motion
    return replace(
        motion, codes=_placed_codes(body, motion.codes, motion.placements), placements=None
    )


def _placed_codes(
    body: Body, codes: FloatArray, places: Sequence[RigidTransform | None]
) -> FloatArray:
    """Return (N, D) codes of poses with placements; those of a body without joints are left out."""
    joints = body.joints
    if joints is None:
        return codes
    rows = zip(places, map(joints.transforms, codes), strict=True)
    placed = [moves if place is None else _unscaled(place).matrix @ moves for place, moves in rows]
    result = joints.unwound(joints.codes_of_transforms(np.array(placed)))
    result[:, body.shape_codes] = codes[:, body.shape_codes]
    return result


def _unscaled(place: RigidTransform) -> RigidTransform:
    """Return a placement in the unit of the body that it places."""
    return replace(place, translation=place.translation / place.scale, scale=1.0)


def _space_at(
    body: SceneBody, moving: Sequence[tuple[PlayedMotion, Motion]]
) -> Callable[[float], Any] | None:
    """Return what makes the pose space of a scene at a frame; None if it is the same in all.

    Raises
    ------
    LCollisionError : a body whose shape changes holds a prop.
    """
    shaped = [(played, motion) for played, motion in moving if motion.space_at is not None]
    holders = {member.holder for member in body.members}
    for played, _ in shaped:
        if played.member.name in holders:
            raise LCollisionError(
                "scales its joints or weighs morph targets, so it can't hold a prop",
                "leave the prop out",
                where=played.member.name,
            )
    space, standing = body.space, [member.name for member in body.standing]

    def space_at(time: float) -> Any:
        spaces = [placed.space for placed in space.members]
        for played, motion in shaped:
            frame = float(np.clip(time - played.start, 0, len(motion) - 1))
            spaces[standing.index(played.member.name)] = motion.space(
                frame, played.member.body.space
            )
        return space.with_spaces(spaces)

    return space_at if shaped else None


def _asked_clips(
    body: SceneBody, played: Sequence[str], clip: str | None
) -> dict[str, tuple[Path, str | None, float]]:
    """Return the file, clip and start time in seconds of each body that moves."""
    clip_of_body: dict[str, tuple[Path, str | None, float]] = {}
    all_clips = dict.fromkeys(
        own for name in body.plays for own in body.member(name).body.own_clips
    )
    for name, (first_clip, start) in body.plays.items():
        member = body.member(name)
        assert member.body.own_file is not None
        clip_name = clip if clip in member.body.own_clips else first_clip
        clip_of_body[name] = member.body.own_file, clip_name, start
    for entry in played:
        name, equals, what = entry.partition("=")
        member = body.member(name)
        seconds = "0"
        if "@" in what and what not in member.body.own_clips and not Path(what).is_file():
            what, _, seconds = what.rpartition("@")
        try:
            start = float(seconds)
        except ValueError:
            start = -1.0
        if not equals or not 0.0 <= start < 1e6 or not member.moves:
            raise LCollisionError("is not NAME=CLIP or NAME=CLIP@SECONDS", where=f"--play {entry}")
        if what in member.body.own_clips and member.body.own_file is not None:
            clip_of_body[name] = member.body.own_file, what, start
        elif (file := Path(what)).is_file():
            of_file = list[str]()
            if clip is not None and file.suffix.lower() in SCENE_SUFFIXES:
                of_file = [own.name for own in read_scene(file).clips]
            all_clips |= dict.fromkeys(of_file)
            clip_of_body[name] = file, clip if clip in of_file else None, start
        else:
            clip_names = ", ".join(member.body.own_clips) or "none"
            raise LCollisionError(
                f"is neither a clip of {name} nor a file",
                f"its clips are {clip_names}",
                where=repr(what),
            )
    if clip is not None and clip not in all_clips:
        clip_names = listed(map(repr, all_clips)) or "none"
        raise LCollisionError(
            f"has no clip {clip!r}", f"its clips are {clip_names}", where=body.name
        )
    return clip_of_body


@dataclass(frozen=True, eq=False)
class WrittenMotions:
    """A motion of a scene in files.

    Attributes
    ----------
    files : by the name of the body
    stored : the motion, with changed clips as read back
    put_back : frames in which a clip was left unchanged, as its file can only store a worse result
    """

    files: dict[str, Path]
    stored: Motion
    put_back: list[range]


def write_member_motions(
    folder: Path,
    body: SceneBody,
    before: Motion,
    after: Motion,
    played: Sequence[PlayedMotion],
    job: Job = UNWATCHED,
) -> WrittenMotions:
    """Write a motion of a scene, each body to its own file of a folder.

    A body that plays its own clip gets its file with the changed clip; for other characters the
    motion is a new clip. Props get point caches, including held ones, which move with their holder.

    Raises
    ------
    LCollisionError : a file cannot be written.
    """
    files: dict[str, Path] = {}
    put_back: list[range] = []
    folder.mkdir(parents=True, exist_ok=True)
    check, n, codes = body.exact_check(), len(after), after.codes.copy()
    by_name = {member_motion.member.name: member_motion for member_motion in played}
    for member, file in written_members(body):
        played_motion, path = by_name.get(member.name), folder / file
        own_file = member.body.own_file
        is_character = played_motion is not None and bends(member.body)
        if not is_character or own_file is None or own_file.suffix.lower() not in SCENE_SUFFIXES:
            rows, back = body.vertices_of[member.name], member.place.inverse()
            path = path.with_suffix(".pc2")
            meshes = (back.apply(after.vertices(frame, check)[rows]) for frame in range(n))
            unused = [np.zeros(member.body.latent_size)] * n
            write_sequence(path, member.body, unused, meshes, ExportRequest(fps=after.rate))
        else:
            assert played_motion is not None
            new = body.codes_of_member(member.name, after.codes)
            motion, first = played_motion.motion, played_motion.start
            if motion is None or not played_motion.is_own_clip:
                name = before.name if motion is None else motion.name
                written = write_new_clips(path, member.body, [Motion(name, after.times, new)])
            else:
                motion = _lasting(motion, n - first, after.rate)
                changed = replace(motion, codes=np.array(new[first:]))
                spans = runs((motion.codes != changed.codes).any(axis=1))
                change = MotionChange(motion, changed, spans)
                written = write_clips(path, member.body, own_file, [change])
                (worse,) = written.put_back
                put_back += [range(span.start + first, span.stop + first) for span in worse]
                (stored,) = written.stored
                places = body.space.codes[body.standing.index(member)]
                codes[:, places] = stored.codes[replace(played_motion, motion=stored).frames(n)]
            for sentence in written.notes:
                job.note(f"{member.name}: {sentence}")
        files[member.name] = path
    return WrittenMotions(files, replace(after, codes=codes), put_back)


def _lasting(motion: Motion, n: int, rate: float) -> Motion:
    """Return a motion that stays in its last frame until it has n frames, at a rate."""
    last, space_at, hidden = len(motion) - 1, motion.space_at, motion.hidden
    if n == last + 1:
        return motion
    frames = np.minimum(np.arange(n), last)
    after = motion.times[-1] + np.arange(1, n - last) / rate
    return replace(
        motion,
        times=np.concatenate([motion.times, after]),
        codes=motion.codes[frames],
        space_at=None if space_at is None else lambda time: space_at(min(time, last)),
        hidden=None if hidden is None else lambda frame: hidden(min(frame, last)),
        contacts=None,
    )


def _as_played(body: SceneBody, after: Motion, played: Sequence[PlayedMotion], job: Job) -> Motion:
    """Return a motion as its clips play it: until its start, a body stays in its first frame."""
    start_of = {of_body.member.name: of_body.start for of_body in played if of_body.is_own_clip}
    codes = after.codes.copy()
    for member, places in zip(body.standing, body.space.codes, strict=True):
        start = start_of.get(member.name, 0)
        first = codes[start, places]
        if (codes[:start, places] != first).any():
            job.note(
                say("{name}: until its clip starts, it stays in the first frame", name=member.name)
            )
            codes[:start, places] = first
    return after if np.array_equal(codes, after.codes) else replace(after, codes=codes)


def playing(scene: SceneFile, number: int, clip: str, start: float) -> SceneFile:
    """Return a scene in which a body plays one of its clips from a start time in seconds."""
    parts = list(scene.bodies)
    parts[number] = replace(parts[number], clip=clip, start=start)
    return replace(scene, bodies=tuple(parts))


def files_of_members(
    folder: Path, body: SceneBody, mesh_format: str | None = None, *, of_motion: bool
) -> list[Path]:
    """Return the files that an export of a scene writes, one or two per body."""
    files = [folder / file for _, file in written_members(body, mesh_format)]
    return files + [file.with_suffix(".pc2") for file in files if of_motion]


def export_scene_pose(
    folder: Path, body: SceneBody, pose: NamedPose, request: ExportRequest, job: Job
) -> str:
    """Write a pose of a scene, each body to its own file; return a sentence for the status bar."""
    vertices = body.exported_vertices(pose.latent, pose.placement)
    write_members(folder, body, [pose], [vertices], request, job)
    return say("Exported each body to {folder}", folder=folder.name)


def export_scene_motion(
    folder: Path, body: SceneBody, before: Motion, after: Motion, job: Job
) -> str:
    """Write a motion of a scene as `export_scene_pose` does.

    Parameters
    ----------
    before : the motion as read from the bodies' clips
    """
    notes: list[str] = []
    noting = Job(job.report, job, note=notes.append)
    played = scene_motion(body, (), MotionChoice(), noting)[1]
    as_played = _as_played(body, after, played, noting)
    written = write_member_motions(folder, body, before, as_played, played, noting)
    n_colliding = int((~written.stored.are_free(body.exact_check())).sum())
    exported = say("Exported each body to {folder}", folder=folder.name)
    if n_colliding:
        text = say_number(n_colliding, "{n} frame collides", "{n} frames collide")
        notes.append(text)
    return joined([exported, *notes])


def resolve_scene_motion(
    body: SceneBody,
    request: ResolveMotionsRequest,
    played: Sequence[str],
    job: Job,
    *,
    in_place: bool = False,
) -> ResolvedClip:
    """Resolve the combined motion of a scene's bodies, and write each body to its own file.

    Raises
    ------
    LCollisionError : a clip cannot be read, the output cannot be written, or it is an input and
        `in_place` is not set.
    CancelledError : the job was cancelled; finished frames are kept beside the output.
    """
    for sentence in body.notes:
        job.note(sentence)
    motion, of_bodies = scene_motion(body, played, request.choice, job)
    output = request.output
    if output.form == "mesh":
        raise LCollisionError.unwritable(
            output.path, "each body of a scene has its own file", "name a folder"
        )
    outputs = [output.path]
    if output.form == "folder":
        outputs = files_of_members(output.path, body, of_motion=True)
    read = [played_motion.file for played_motion in of_bodies if played_motion.file is not None]
    refuse_to_replace(outputs, [*read, *source_files(body)], in_place=in_place)
    with run_of_motions(request, [motion], job) as run:
        change, row = resolve_one(request, motion, run, 0, job)
        if output.form == "folder":
            after = _as_played(body, change.after, of_bodies, job)
            check = body.exact_check()
            if after is not change.after:
                collides = ~after.are_free(check)
                count_stuck(row, body, collides, reason=Reason.CLIP_STARTS_LATER)
            written = write_member_motions(output.path, body, motion, after, of_bodies, job)
            count_stuck(row, body, ~written.stored.are_free(check), written.put_back)
            if written.put_back:
                measure_again(row, body, motion, written.stored)
            for name, path in written.files.items():
                job.note(say("wrote {name} to {path}", name=name, path=path))
        else:
            write_motions(output, body, Path(), [change], [row], job)
    return row
