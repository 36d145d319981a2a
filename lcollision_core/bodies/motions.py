"""Motions of files, for the body that they are of."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.body import Body
from lcollision_core.bodies.export import shapes_in_file, source_for
from lcollision_core.bodies.kept_contacts import contacts_of
from lcollision_core.bodies.known import open_body
from lcollision_core.bodies.poses import read_poses
from lcollision_core.bodies.retargeting import (
    Retargeting,
    carried_motions,
    rig_space_of,
    skeleton_notes,
)
from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.bodies.smpl_skeleton import axes_of_smpl
from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.files import (
    Character,
    FileStamp,
    GltfCharacter,
    as_gltf,
    file_stamp,
    read_pose_set,
)
from lcollision_core.files.animated import frame_rate
from lcollision_core.files.changed_clips import ChangedClip, changed_gltf, clip_vertices
from lcollision_core.files.character import ClipFrames
from lcollision_core.files.character_reading import character_of, character_of_smpl
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.files.motion.bvh import read_bvh
from lcollision_core.files.motion.generated import is_generated
from lcollision_core.files.motion.smpl_motion import SmplMotion, is_smpl_motion, read_smpl_motion
from lcollision_core.files.safe import atomic_write
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene_files import as_file_error, open_rigged, read_scene, scene_of
from lcollision_core.files.table import (
    ANIMATED_SUFFIXES,
    BVH_SUFFIX,
    SCENE_SUFFIXES,
    SKELETON_SUFFIXES,
)
from lcollision_core.files.written import require_written
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import RigidTransform, Topology
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.meshes.units import box_corners
from lcollision_core.motion import NOMINAL_RATE, GroundReport, Motion, is_worse, worse_spans
from lcollision_core.motion.contacts import KeptContacts
from lcollision_core.posing import ExactCheck, PoseSpace

_SAME_REST = 1e-9
"""Metres, by which the joints of equal shapes may differ."""

_NAMED = 3

_GENDERS = ("female", "male", "neutral")
"""In this order: a name with "female" has "male" in it."""

_KINDS = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Body models by their number of joints."""


def body_of_smpl(body: Body, path: Path) -> tuple[RigBody, tuple[str, ...]]:
    """Return a body in the shape that a motion says; joints that it does not turn are still.

    Parameters
    ----------
    body : a character of a body model, of any shape
    path : of the motion

    Returns
    -------
    body : with the same contact rules and names; itself where it is that already
    notes : sentences on what is not as in the file

    Raises
    ------
    MeshFileError : the body is of no body model, or see `read_smpl_motion`.
    """
    rigged, motion = _read(body, path)
    model = rigged.character.smpl
    assert model is not None
    notes = list(motion.notes)
    missing = [name for name in model.names if name not in motion.names]
    unknown = [name for name in motion.names if name not in model.names]
    n_shapes = model.shape_directions.shape[2]
    if missing:
        notes.append(f"it does not turn {_listed(missing)}, which stay as in the body model")
    if unknown:
        notes.append(f"the body model has no {_listed(unknown)}")
    if motion.betas[n_shapes:].any():
        notes.append(f"only the first {n_shapes} of its betas are in the body model")
    notes += _misfits(rigged, motion)
    shaped = _shaped(rigged, motion)
    same = rigged if shaped is None else RigBody.of(shaped).with_choices_of(rigged)
    return same, tuple(notes)


def _misfits(body: RigBody, motion: SmplMotion) -> list[str]:
    """Say where a motion was made for another body than the one that it is to move."""
    model = body.character.smpl
    assert model is not None
    name, notes = model.path.name, []
    own = next((gender for gender in _GENDERS if gender in model.path.stem.lower()), "")
    if own and motion.gender in _GENDERS and motion.gender != own:
        notes.append(f"it was made for a {motion.gender} body ('gender'), and {name} is {own}")
    kind = _KINDS[len(model.names)]
    if motion.body_model in _KINDS.values() and motion.body_model != kind:
        made_for, ours = motion.body_model.upper(), kind.upper()
        notes.append(f"it was made for {made_for} ('surface_model_type'), and {name} is {ours}")
    return notes


def motion_of_smpl(body: Body, path: Path, fps: float | None = None) -> Motion:
    """Read a motion of the SMPL family as poses of a body in its shape: see `body_of_smpl`.

    Parameters
    ----------
    fps : frames a second; None for those that the file says, else 30

    Raises
    ------
    MeshFileError : the body is of no body model, or of another shape; or see `read_smpl_motion`.
    """
    rigged, motion = _read(body, path)
    if _shaped(rigged, motion) is not None:
        raise MeshFileError(
            "is of another shape ('betas') than the body, or turns other joints",
            "open the body in the shape of the motion",
            where=path,
        )
    space, frame = rigged.space, axes_of_smpl(motion)
    turns = np.zeros((len(motion), space.n_joints, 3))
    for joint, number in _pairs(space, motion):
        turns[:, joint] = motion.turns[:, number]
    turns[:, 0] = (Rotation.from_matrix(frame) * Rotation.from_rotvec(turns[:, 0])).as_rotvec()
    pelvis = space.rig.rest[0, :3, 3]
    codes = space.codes_of_turns(turns, (pelvis + motion.places) @ frame.T - pelvis)
    times = np.arange(len(motion)) / (fps or motion.rate or NOMINAL_RATE)
    return Motion(path.stem, times, space.unwound(codes), source=path.name)


def write_smpl(
    path: str | os.PathLike[str],
    body: Body,
    file: Path,
    frames: Sequence[int],
    codes: FloatArray,
) -> None:
    """Write the file of a motion with some frames changed, whole or not at all.

    Parameters
    ----------
    file : that the motion was read from
    frames : n numbers of frames
    codes : (n, D) of them

    Raises
    ------
    MeshFileError : the file cannot be read any more, or the other cannot be written.
    """
    rigged, motion = _read(body, file)
    space, frame = rigged.space, axes_of_smpl(motion)
    turns, places = motion.turns[list(frames)], motion.places[list(frames)]
    pelvis = space.rig.rest[0, :3, 3]
    for row, pose in enumerate(codes):
        own, shift = space.turns_of(pose)
        own[0] = (Rotation.from_matrix(frame.T) * Rotation.from_rotvec(own[0])).as_rotvec()
        for joint, number in _pairs(space, motion):
            turns[row, number] = own[joint]
        places[row] = (pelvis + shift) @ frame - pelvis
    with atomic_write(path) as out:
        motion.write(out, frames, turns, places)


def _read(body: Body, path: Path) -> tuple[RigBody, SmplMotion]:
    model = None if body.character is None else body.character.smpl
    if model is None or not isinstance(body, RigBody):
        raise MeshFileError(
            "is a motion of SMPL, SMPL-H or SMPL-X, which a body without joints can't follow",
            "name the body model or another rigged character",
            where=path,
        )
    return body, read_smpl_motion(path, model.hands)


def _shaped(body: RigBody, motion: SmplMotion) -> Character | None:
    """Return a body model in the shape of a motion, None where the body is that."""
    character = body.character
    assert character.smpl is not None
    shaped, rig = character_of_smpl(character.smpl, motion.betas, motion.names), body.space.rig
    own = shaped.rig
    assert own is not None
    turns_same = np.array_equal(np.asarray(own.moving), np.asarray(rig.moving))
    if turns_same and np.abs(own.rest - rig.rest).max() <= _SAME_REST:
        return None
    chosen = replace(own, chosen=rig.chosen)
    return replace(shaped, rig=chosen, up=character.up, up_is_sure=character.up_is_sure)


def _pairs(space: RigPoseSpace, motion: SmplMotion) -> list[tuple[int, int]]:
    """Return the joints that body and motion both have: their numbers in each."""
    numbers = {name: number for number, name in enumerate(motion.names)}
    names = enumerate(space.rig.joint_names)
    return [(joint, numbers[name]) for joint, name in names if name in numbers]


def _listed(names: Sequence[str]) -> str:
    plain = [name.replace("_", " ") for name in names]
    more = f" and {len(plain) - _NAMED} more joints" if len(plain) > _NAMED else ""
    return ", ".join(plain[:_NAMED]) + more


_HIDDEN = 1e-3
"""Of its longest side at rest: with a shorter one, a face is scaled to nothing."""

_SAME = 1e-6
"""Normalised: what the codes hold of a frame to so much, they hold."""

_MOST_BYTES = 1 << 27
"""Of the shapes of a motion's frames, that are kept."""


def read_motions(
    body: Body,
    path: Path,
    clip: str | None = None,
    fps: float | None = None,
    job: Job = UNWATCHED,
) -> list[Motion]:
    """Read the motions of a file, or the one of a folder of meshes, as poses of a body.

    Parameters
    ----------
    body : whose meshes they are
    path : a character's file, whose clips are motions; a .bvh or .vrma file, or that of another
        character or of clips alone, motions of a skeleton that a character's joints follow; an
        .npz file of the SMPL family, of whose body model `body` is, in its shape: see
        `body_of_motion`; a pose set: a point cache with its mesh beside it, an .npz file, or a
        folder of meshes in the natural order of their names; or a file of poses
    clip : one of the file's clips; None for all of them
    fps : frames a second; None for the rate of the file's keys, else 30. Other files than
        characters have the frames that they have, which are taken as so many a second.
    job : reports (frames encoded, all of them); polled between frames

    Raises
    ------
    LCollisionError : a file cannot be read, is of another body, or has no motion.
    CancelledError : the job was cancelled.
    """
    suffix = path.suffix.lower()
    if suffix not in SCENE_SUFFIXES and clip is not None:
        raise MeshFileError("has no clips to choose from", "leave out the clip", where=path)
    if is_carried(body, path):
        return [
            replace(motion, contacts=_contacts(body, path, motion, retargeting, fps))
            for motion, retargeting in carried_motions(body, path, clip, fps)
        ]
    if is_smpl_motion(path):
        return [motion_of_smpl(body, path, fps)]
    if suffix == ".json":
        return [_of_poses(body, path, fps or NOMINAL_RATE)]
    if suffix not in SCENE_SUFFIXES:
        poses = read_pose_set(path, job.part(), topology=body.topology)
        body.require_topology(poses.topology, str(path))
        # The rest pose comes before the frames of a point cache.
        is_cache = suffix in ANIMATED_SUFFIXES
        frames = poses.vertices[1:] if is_cache else poses.vertices
        times = np.arange(len(frames)) / (fps or frame_rate(path, None) or NOMINAL_RATE)
        return [_encoded(body, path.stem, path.name, frames, times, job)]
    character = character_of_motion(body, path)
    names = (
        [scene_clip.name for scene_clip in read_scene(path).clips]
        if character is None
        else character.clips
    )
    if not names:
        raise MeshFileError("has no animation", "export it with its clips", where=path)
    chosen = list(names) if clip is None else [clip]
    if character is not None and body.joints is not None:
        return [_of_clip(character, body.joints, name, fps) for name in chosen]
    motions = []
    for name in chosen:
        rate = fps or frame_rate(path, name) or NOMINAL_RATE
        topology = body.topology
        poses = read_pose_set(path, job.part(), clip=name, fps=rate, topology=topology)
        body.require_topology(poses.topology, str(path))
        frames = poses.vertices[1:]
        times = np.arange(len(frames)) / rate
        motions.append(_encoded(body, name, path.name, frames, times, job))
    return motions


def _contacts(
    body: Body, path: Path, motion: Motion, retargeting: Retargeting, fps: float | None
) -> Callable[[], KeptContacts | None]:
    """Return what finds the contacts of a carried motion; None where its file has no skin."""

    @cache
    def found() -> KeptContacts | None:
        document = open_rigged(path)
        if document is None:
            return None
        try:
            source = open_body(document)
        except LCollisionError:
            # Its skeleton could be read, which is all that the motion needs.
            return None
        if source.character is None or source.joints is None:
            return None
        own = _of_clip(source.character, source.joints, motion.name, fps)
        return contacts_of(body, motion, source, own, retargeting)

    return found


def is_of_skeleton(path: Path) -> bool:
    """Whether a file is the motion of joints alone, so that it needs a body; it raises nothing."""
    return path.suffix.lower() in SKELETON_SUFFIXES or is_smpl_motion(path)


def is_carried(body: Body, path: Path) -> bool:
    """Whether a file's motions are of another skeleton, which the joints of a body follow.

    So are those of a scene that has another rig than the body, or none and other faces.

    Raises
    ------
    MeshFileError : the file is missing, or no scene at all.
    """
    if path.suffix.lower() in SKELETON_SUFFIXES or is_generated(path):
        return True
    if is_smpl_motion(path):
        # Of a body model, its own joints turn; any other character's follow them.
        character = body.character
        return body.joints is not None and character is not None and character.smpl is None
    if path.suffix.lower() not in SCENE_SUFFIXES or body.joints is None or body.is_of_file(path):
        return False
    key = body.fingerprint, path.absolute(), file_stamp(path)
    answer = _CARRIED.get(key)
    if answer is None:
        answer = _CARRIED[key] = _is_of_another(body, path)
        if len(_CARRIED) > _MOST_KNOWN:
            # Another thread may take the same one out.
            _CARRIED.pop(next(iter(_CARRIED)), None)
    return answer


_CARRIED: dict[tuple[str, Path, FileStamp | None], bool] = {}
"""What `is_carried` said, as it may take seconds and a task asks several times."""

_MOST_KNOWN = 1000


def _is_of_another(body: Body, path: Path) -> bool:
    """Whether a scene has another rig than a body, or none and other faces."""
    if character_of_motion(body, path) is not None:
        return False
    if open_rigged(path) is not None:
        return True
    try:
        joined = join_parts(read_scene(path)).cut_as(body.topology)
    except MeshFileError:
        # What is wrong with its skeleton is said when that is read; its mesh is not needed.
        return True
    return joined.topology != body.topology


def body_of_motion(body: Body, path: Path) -> tuple[Body, tuple[str, ...]]:
    """Return the body whose poses the motions of a file are, and notes on what is left out.

    That is the body itself, but for motions that say its shape: see `body_of_smpl`.

    Raises
    ------
    MeshFileError : a skeleton's file is damaged; else see `body_of_smpl`.
    """
    if is_carried(body, path):
        return body, skeleton_notes(body, path)
    return body_of_smpl(body, path) if is_smpl_motion(path) else (body, ())


def character_of_motion(body: Body, path: Path) -> Character | None:
    """Return the character of a file whose rig is the body's; None if its frames are meshes."""
    if body.character is None:
        return None
    if path.suffix.lower() not in SCENE_SUFFIXES:
        return None
    if path.resolve() == body.character.source.resolve():
        return body.character
    document = open_rigged(path)
    try:
        other = None if document is None else open_body(document)
    except MeshFileError:
        # Another's mesh may be of no form that is read here, as a compressed one.
        return None
    is_same = other is not None and other.fingerprint == body.fingerprint
    return other.character if is_same and other is not None else None


def _of_poses(body: Body, path: Path, fps: float) -> Motion:
    poses = read_poses(path, body)
    if not poses:
        raise MeshFileError("has no poses in it", "name a file that has some", where=path)
    placements = tuple(pose.placement for pose in poses)
    return Motion(
        path.stem,
        np.arange(len(poses)) / fps,
        np.array([pose.latent for pose in poses]),
        placements if any(placements) else None,
        source=path.name,
    )


def _is_bvh(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == BVH_SUFFIX


def _of_clip(character: Character, space: RigPoseSpace, clip: str, fps: float | None) -> Motion:
    """Return a clip of a character whose rig is the body's."""
    frames = character.sample(clip, fps or character.rate(clip))
    transforms = frames.transforms
    assert transforms is not None
    source = character.source.name
    return motion_of_transforms(
        *(space, clip, frames.times, transforms, frames.points),
        source=source,
        shapes=frames.shapes,
    )


def motion_of_transforms(
    space: RigPoseSpace,
    name: str,
    times: FloatArray,
    transforms: FloatArray,
    points: Mapping[int, Callable[[], FloatArray]] | None = None,
    shown: Mapping[int, Callable[[], npt.NDArray[np.floating]]] | None = None,
    source: str = "",
    shapes: FloatArray | None = None,
) -> Motion:
    """Return the motion of a rig whose joints move so, with the body as it is in each frame.

    Parameters
    ----------
    times : (T,) in seconds
    transforms : (T, J, 4, 4) global transforms of the joints
    points : of frames in which the rig has others: see `ClipFrames.points`
    shown : of frames that these do not say, what makes their (V, 3) vertices in the body's unit;
        faces that a frame scales to nothing count in no pair
    shapes : (T, S) the sliders of its morph targets; at rest if None

    Raises
    ------
    ShapeError : see `Motion` and `RigPoseSpace.codes_of_transforms`.
    """
    codes = space.unwound(space.codes_of_transforms(transforms, shapes))
    points, shown = points or {}, shown or {}
    # How far the corners of the body's box are from where the codes have them, by each joint that
    # carries vertices: the codes of the root have what joints above it do.
    carriers = np.unique(space.rig.joint_of[space.rig.weights > 0.0])
    at_rest = np.linalg.inv(space.rig.rest[carriers])
    at_rest = at_rest @ box_corners(space.rest_vertices * space.body_size)
    is_held = (
        np.abs((given - space.transforms(row))[carriers] @ at_rest).max() <= _SAME * space.body_size
        for given, row in zip(transforms, codes, strict=True)
    )
    if not points and not shown and all(is_held):
        return Motion(name, times, codes, None, None, source)
    own = space.own_joints(codes, transforms)
    n_kept = max(2, _MOST_BYTES // (24 * int(np.count_nonzero(space.rig.weights))))

    @lru_cache(n_kept)
    def shape(make: Callable[[], FloatArray]) -> FloatArray:
        return space.influence_points(make())

    @lru_cache(n_kept)
    def body(frame: int) -> RigPoseSpace:
        shaped = shape(points[frame]) if frame in points else None
        own_space = space.with_own(own.offsets[frame], own.linear[frame], shaped)
        if frame not in shown:
            return own_space
        vertices = shown[frame]().astype(np.float64)
        return own_space.shaped_as(codes[frame], vertices / space.body_size)

    def space_at(time: float) -> RigPoseSpace:
        frame, share = int(time), time % 1.0
        return body(frame).towards(body(frame + 1), share) if share else body(frame)

    @cache
    def hidden(frame: int) -> npt.NDArray[np.intp]:
        sides = _longest_sides(body(frame).decode(codes[frame][None])[0], space.topology)
        return np.flatnonzero(sides < _HIDDEN * sides_at_rest)

    sides_at_rest = _longest_sides(space.rest_vertices, space.topology)
    hides = hidden if points or shown else None
    return Motion(name, times, codes, None, space_at, source, hides)


def _longest_sides(vertices: npt.NDArray[np.floating], topology: Topology) -> FloatArray:
    corners = vertices[topology.faces]
    sides: FloatArray = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return sides


def _encoded(
    body: Body,
    name: str,
    source: str,
    frames: npt.NDArray[np.floating],
    times: FloatArray,
    job: Job,
) -> Motion:
    """Encode (T, V, 3) frames of meshes, whose detail shapes the body."""
    poses = []
    for number, frame in enumerate(frames):
        poses.append(body.encode(frame, job))
        job.report(number + 1, len(frames))
    codes = np.array([pose.latent for pose in poses])
    placements: tuple[RigidTransform | None, ...] = tuple(pose.placement for pose in poses)

    @lru_cache(max(2, _MOST_BYTES // (24 * body.n_vertices)))
    def shaped(frame: int) -> PoseSpace:
        place, vertices = placements[frame], frames[frame].astype(np.float64)
        at_home = vertices if place is None else place.inverse().apply(vertices)
        return body.space.shaped_as(codes[frame], at_home / body.body_size)

    return Motion(name, times, codes, placements, lambda time: shaped(round(time)), source)


@dataclass(frozen=True, eq=False)
class MotionChange:
    """A motion before and after its resolution.

    Attributes
    ----------
    before, after : at the same times
    spans : of frames that changed
    largest_change : of a vertex, normalised, that was asked for; None for any
    """

    before: Motion
    after: Motion
    spans: Sequence[range]
    largest_change: float | None = None


@dataclass(frozen=True, eq=False)
class WrittenClips:
    """What a file of changed clips holds.

    Attributes
    ----------
    free : of each motion (T,) which frames are free by the exact check of what is read back
    notes : sentences on what the file lacks
    put_back : of each motion the spans that are in the file as they were, because what it would
        hold of the change is worse
    """

    free: list[npt.NDArray[np.bool_]]
    notes: tuple[str, ...]
    put_back: list[list[range]]


def write_clips(
    path: str | os.PathLike[str], body: Body, file: Path, changes: Sequence[MotionChange]
) -> WrittenClips:
    """Write the character's own file with its clips changed, whole or not at all.

    A file of another format than glTF comes back as GLB, a BVH file and an .npz file of the SMPL
    family as themselves: whatever else they hold and all frames outside the spans stay as they are.

    Parameters
    ----------
    path : a .glb file, or a .vrm file for a character of one; a .bvh or .npz file for the motion of
        one
    body : the character that resolved the motions
    file : of the same rig, whose clips the motions are, or the file of the one motion
    changes : of its clips; see `changed_gltf` for what else stays

    Raises
    ------
    MeshFileError : the source cannot be written as that format, or as of `changed_gltf`.
    """
    if _is_bvh(path) or is_smpl_motion(file):
        return _write_own(path, body, file, changes)
    character, space = character_of_motion(body, file), body.space
    if character is None or not isinstance(space, RigPoseSpace):
        raise MeshFileError("has another rig", "name the file of the motion", where=file)
    require_written(path, character)
    written = _ClipsOfFile(as_gltf(character), space, body.exact_check(), file)
    put_back: list[list[range]] = [[] for _ in changes]
    data = written.changed(changes)
    was = written.changed([])
    for number, change in enumerate(changes):
        put_back[number] = written.worse_spans(change, was, data)
    if any(put_back):
        changes = [
            replace(pair, spans=[span for span in pair.spans if span not in worse])
            for pair, worse in zip(changes, put_back, strict=True)
        ]
        data = written.changed(changes)
    free = written.free(changes, data)
    with atomic_write(path) as out:
        out.write(data)
    return WrittenClips(free, written.made.notes, put_back)


def write_new_clips(
    path: str | os.PathLike[str], body: Body, motions: Sequence[Motion]
) -> WrittenClips:
    """Write the character's own file with motions of other skeletons as new clips before its own.

    Parameters
    ----------
    path : a .glb file, or a .vrm file for a character of one
    body : the character that resolved the motions

    Raises
    ------
    MeshFileError : the body has no file of its own, or it cannot be written as that format.
    """
    source = source_for(Path(path).suffix, body)
    if source is None:
        raise MeshFileError.unwritable(
            path, "the body has no file of its own", "name a .bvh, .pc2 or .mdd file, or a folder"
        )
    free, notes = source.write_motions(path, motions)
    return WrittenClips(free, notes, [[] for _ in motions])


def _joints(motion: Motion, frame: int, space: RigPoseSpace) -> FloatArray:
    """Return the (J, 4, 4) global transforms of the joints in a frame of a body's motion."""
    own = motion.space(frame, space)
    assert isinstance(own, RigPoseSpace)
    return own.transforms(motion.codes[frame])


@dataclass(frozen=True, eq=False)
class _ClipsOfFile:
    """A character's own file with changed clips, before it is written.

    Attributes
    ----------
    made : the character as glTF
    space, check : of the body
    file : that it was read from
    """

    made: GltfCharacter
    space: RigPoseSpace
    check: ExactCheck
    file: Path

    def _times(self, motion: Motion) -> FloatArray:
        return motion.times + self.made.delays.get(motion.name, 0.0)

    def changed(self, changes: Sequence[MotionChange]) -> bytes:
        """Return the file with the spans of changes."""

        def frames_of(spans: Sequence[range]) -> list[int]:
            return [frame for span in spans for frame in span]

        def shapes(change: MotionChange) -> FloatArray | None:
            frames = frames_of(change.spans)
            moved = change.after.codes[frames] - change.before.codes[frames]
            return shapes_in_file(self.space, self.made, moved)

        def transforms(motion: Motion, spans: Sequence[range]) -> FloatArray:
            frames = frames_of(spans)
            rows = (_joints(motion, frame, self.space) for frame in frames)
            return np.array([transforms[self.made.joints] for transforms in rows])

        return changed_gltf(
            self.made.character,
            [
                ChangedClip(
                    change.before.name,
                    self._times(change.before),
                    change.spans,
                    transforms(change.before, change.spans),
                    transforms(change.after, change.spans),
                    shapes(change),
                )
                for change in changes
                if change.spans
            ],
        )

    def _shown(
        self, motion: Motion, frames: range, data: bytes
    ) -> Iterator[npt.NDArray[np.float32]]:
        """Evaluate frames of a file: (V, 3) vertices in the body's frame, as readers get them."""
        times, back = self._times(motion)[frames.start : frames.stop], self.made.frame.inverse()
        for vertices in clip_vertices(data, self.file, motion.name, times):
            yield back.apply(vertices[self.made.to_read]).astype(np.float32)

    def worse_spans(self, change: MotionChange, was: bytes, data: bytes) -> list[range]:
        """Return the spans that are worse in a file than they were in another, by its vertices."""
        before, worse = change.before, []
        for span in change.spans:
            both = (self._shown(before, span, version) for version in (was, data))
            for frame, (old, new) in zip(span, zip(*both, strict=True), strict=True):
                seen = before.seen(self.check, range(frame, frame + 1))
                if is_worse(seen, old, new, change.largest_change):
                    worse.append(span)
                    break
        return worse

    def free(self, changes: Sequence[MotionChange], data: bytes) -> list[npt.NDArray[np.bool_]]:
        """Return which frames of motions are free as they are read back from a file."""
        with as_file_error(self.file):
            character = character_of(scene_of(GltfDocument(data, self.file)), self.file)
        back = self.made.frame.inverse()
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = back.scale * back.rotation, back.translation
        # What was hidden at rest may have become a joint of its own.
        made = self.made.character.rig
        assert made is not None
        assert character.rig is not None
        numbers = {node: joint for joint, node in enumerate(character.rig.nodes.tolist())}
        nodes = made.nodes[np.argsort(self.made.joints)].tolist()
        joints = [numbers[node] for node in nodes]
        free = []
        for change in changes:
            name, times = change.before.name, self._times(change.before)
            frames = character.sample(name, times)
            assert frames.transforms is not None
            # The rig that was read may have its influences, or what is hidden at rest, otherwise.
            shown = {frame: partial(self._moved_back, frames, frame) for frame in frames.points}
            motion = motion_of_transforms(
                self.space,
                name,
                change.before.times,
                place @ frames.transforms[:, joints],
                shown=shown,
                shapes=self._numbers(character, frames),
            )
            verdicts = (
                motion.check(frame, self.check).is_free(motion.codes[frame])
                for frame in range(len(motion))
            )
            free.append(np.fromiter(verdicts, np.bool_, len(motion)))
        return free

    def _numbers(self, character: Character, frames: ClipFrames) -> FloatArray | None:
        """Return the sliders of frames of the file in the order of the body's."""
        assert character.rig is not None
        read, own = character.rig.shapes, self.space.rig.shapes
        if read is None or own is None or frames.shapes is None:
            return None
        return frames.shapes[:, [read.names.index(name) for name in own.names]]

    def _moved_back(self, frames: ClipFrames, frame: int) -> FloatArray:
        return self.made.frame.inverse().apply(frames.vertices[frame][self.made.to_read])


def _write_own(
    path: str | os.PathLike[str], body: Body, file: Path, changes: Sequence[MotionChange]
) -> WrittenClips:
    """Write the one motion of a BVH file, or of the SMPL family, into a copy of it."""
    (change,) = changes
    check, put_back = body.exact_check(), []
    while True:
        frames = [frame for span in change.spans for frame in span]
        if not _is_bvh(path):
            write_smpl(path, body, file, frames, change.after.codes[frames])
        else:
            _write_bvh(path, body, file, frames, change)
        (back,) = read_motions(body, Path(path))
        worse = worse_spans(change.before, back, change.spans, check, change.largest_change)
        if not worse:
            break
        put_back += worse
        change = replace(change, spans=[span for span in change.spans if span not in worse])
    verdicts = (check.is_free(codes) for codes in back.codes)
    return WrittenClips([np.fromiter(verdicts, np.bool_, len(back))], (), [put_back])


def _write_bvh(
    path: str | os.PathLike[str],
    body: Body,
    file: Path,
    frames: Sequence[int],
    change: MotionChange,
) -> None:
    bvh, space, data = read_bvh(file), rig_space_of(body, file), file.read_bytes()
    if frames:
        before, after = (
            np.array([space.transforms(motion.codes[frame]) for frame in frames])
            for motion in (change.before, change.after)
        )
        carried = Retargeting.of(bvh, space, file).changed(frames, before, after)
        data = bvh.with_frames(frames, *carried)
    with atomic_write(path) as out:
        out.write(data)


def ground_report(body: Body, motion: Motion) -> GroundReport | None:
    """Measure how a motion stands on the ground of its scene; None without one."""
    if body.ground is None:
        return None
    return GroundReport.of(motion, body.exact_check(), body.up, *body.ground)


def ground_facts(body: Body, motion: Motion) -> dict[str, Any] | None:
    """Return what reports hold of `ground_report`."""
    report = ground_report(body, motion)
    return None if report is None else asdict(report)
