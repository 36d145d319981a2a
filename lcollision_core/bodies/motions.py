"""Read and write the motions of files, as poses of a body."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies.body import Body
from lcollision_core.bodies.export import shapes_in_file, source_for
from lcollision_core.bodies.kept_contacts import contacts_of
from lcollision_core.bodies.poses import read_poses
from lcollision_core.bodies.remembered import open_body
from lcollision_core.bodies.retargeting import (
    Retargeting,
    retargeted_motions,
    rig_space_of,
    skeleton_notes,
)
from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.errors import (
    LCollisionError,
    MeshFileError,
    PoseSetError,
    ShapeError,
    listed,
)
from lcollision_core.files import (
    Character,
    FileStamp,
    GltfCharacter,
    as_gltf,
    file_stamp,
    read_pose_set,
)
from lcollision_core.files.changed_clips import ChangedClip, changed_gltf
from lcollision_core.files.character import ClipFrames
from lcollision_core.files.character_reading import character_of_gltf, character_of_smpl
from lcollision_core.files.character_writing import require_written
from lcollision_core.files.formats import (
    ANIMATED_SUFFIXES,
    BVH_SUFFIX,
    MOTION_SUFFIXES,
    SCENE_SUFFIXES,
    SKELETON_SUFFIXES,
)
from lcollision_core.files.motion.bvh import read_bvh
from lcollision_core.files.motion.generated import is_generated
from lcollision_core.files.motion.smpl import (
    SmplMotion,
    axes_of_smpl,
    is_smpl_motion,
    read_smpl_motion,
)
from lcollision_core.files.pose_set_reading import frame_rate
from lcollision_core.files.safe import atomic_write, write_bytes
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene_files import open_rigged, read_scene
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.extents import box_corners
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import (
    NOMINAL_RATE,
    GroundReport,
    Motion,
    contact_report,
    is_worse,
    worse_spans,
)
from lcollision_core.motion.contacts import KeptContacts
from lcollision_core.posing import ExactCheck, PoseSpace

_AT_ONCE = 4
"""Number of frames of a written file that a thread evaluates together."""

_SAME_REST = 1e-9
"""Metres; tolerance for the joints of equal shapes."""

_NAMED = 3

_GENDERS = ("female", "male", "neutral")
"""Order matters: "female" contains "male"."""

_KINDS = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Body models by their number of joints."""


def body_of_smpl(body: Body, path: Path) -> tuple[RigBody, tuple[str, ...]]:
    """Return a body in the shape of a motion; joints that the motion lacks do not turn.

    Parameters
    ----------
    body : a character of a body model, in any shape
    path : of the motion

    Returns
    -------
    body : with the same contact rules and names; unchanged if already in that shape
    notes : sentences about differences from the file

    Raises
    ------
    MeshFileError : the body is not of a body model; also see `read_smpl_motion`.
    """
    rigged, motion = _body_and_motion_of_smpl(body, path)
    model = rigged.character.smpl
    assert model is not None
    notes = list(motion.notes)
    missing = [name for name in model.names if name not in motion.names]
    unknown = [name for name in motion.names if name not in model.names]
    n_shapes = model.shape_directions.shape[2]
    if missing:
        notes.append(f"it has no rotations for {_listed(missing)}, which keep their rest pose")
    if unknown:
        notes.append(f"the body model has no {_listed(unknown)}")
    if motion.betas[n_shapes:].any():
        notes.append(f"only the first {n_shapes} of its betas are in the body model")
    notes += _misfits(rigged, motion)
    shaped = _in_its_shape(rigged, motion)
    same = rigged if shaped is None else RigBody.of(shaped).with_choices_of(rigged)
    return same, tuple(notes)


def _misfits(body: RigBody, motion: SmplMotion) -> list[str]:
    """Describe how a motion was made for another kind of body."""
    model = body.character.smpl
    assert model is not None
    name, notes = model.path.name, []
    named_gender = next((gender for gender in _GENDERS if gender in model.path.stem.lower()), "")
    if named_gender and motion.gender in _GENDERS and motion.gender != named_gender:
        notes.append(
            f"it was made for a {motion.gender} body ('gender'), and {name} is {named_gender}"
        )
    kind = _KINDS[len(model.names)]
    if motion.body_model in _KINDS.values() and motion.body_model != kind:
        made_for, ours = motion.body_model.upper(), kind.upper()
        notes.append(f"it was made for {made_for} ('surface_model_type'), and {name} is {ours}")
    return notes


def motion_of_smpl(body: Body, path: Path, fps: float | None = None) -> Motion:
    """Read a motion of the SMPL family as poses of a body in its shape: see `body_of_smpl`.

    Parameters
    ----------
    fps : frame rate; None for the file's, else 30

    Raises
    ------
    MeshFileError : the body is not of a body model or has another shape; see `read_smpl_motion`.
    """
    rigged, motion = _body_and_motion_of_smpl(body, path)
    if _in_its_shape(rigged, motion) is not None:
        raise MeshFileError(
            "is of another shape ('betas') than the body, or turns other joints",
            "open the body in the shape of the motion",
            where=path,
        )
    space, frame = rigged.space, axes_of_smpl(motion)
    turns = np.zeros((len(motion), space.n_joints, 3))
    for joint, number in _shared_joints(space, motion):
        turns[:, joint] = motion.turns[:, number]
    turns[:, 0] = _turned_by(frame, turns[:, 0])
    pelvis = space.rig.rest[0, :3, 3]
    codes = space.codes_of_rotations(turns, (pelvis + motion.places) @ frame.T - pelvis)
    times = np.arange(len(motion)) / (fps or motion.rate or NOMINAL_RATE)
    return Motion(path.stem, times, space.unwound(codes), source=path.name)


def write_smpl(
    path: str | os.PathLike[str],
    body: Body,
    file: Path,
    frames: Sequence[int],
    codes: FloatArray,
) -> None:
    """Write a copy of a motion's file with some frames changed, atomically.

    Parameters
    ----------
    file : that the motion was read from
    frames : indices of n frames
    codes : (n, D) codes of these frames

    Raises
    ------
    MeshFileError : the motion's file cannot be read, or the output cannot be written.
    """
    rigged, motion = _body_and_motion_of_smpl(body, file)
    space, frame = rigged.space, axes_of_smpl(motion)
    turns, places = motion.turns[list(frames)], motion.places[list(frames)]
    pelvis = space.rig.rest[0, :3, 3]
    for row, pose in enumerate(codes):
        own_turns, shift = space.rotations_of(pose)
        own_turns[0] = _turned_by(frame.T, own_turns[0])
        for joint, number in _shared_joints(space, motion):
            turns[row, number] = own_turns[joint]
        places[row] = (pelvis + shift) @ frame - pelvis
    with atomic_write(path) as out:
        motion.write(out, frames, turns, places)


def _turned_by(frame: FloatArray, turns: FloatArray) -> FloatArray:
    """Return (..., 3) rotation vectors followed by the (3, 3) rotation of a frame."""
    rotation = scipy.spatial.transform.Rotation
    turned: FloatArray = (rotation.from_matrix(frame) * rotation.from_rotvec(turns)).as_rotvec()
    return turned


def _body_and_motion_of_smpl(body: Body, path: Path) -> tuple[RigBody, SmplMotion]:
    """Return a body of a body model, and the motion in a file; refuse any other body."""
    model = None if body.character is None else body.character.smpl
    if model is None or not isinstance(body, RigBody):
        raise MeshFileError(
            "is a motion of SMPL, SMPL-H or SMPL-X, which a body without joints can't follow",
            "name the body model or another rigged character",
            where=path,
        )
    return body, read_smpl_motion(path, model.hands)


def _in_its_shape(body: RigBody, motion: SmplMotion) -> Character | None:
    """Return a body model in the shape of a motion, None if the body already has it."""
    character = body.character
    assert character.smpl is not None
    shaped, rig = character_of_smpl(character.smpl, motion.betas, motion.names), body.space.rig
    rig_in_shape = shaped.rig
    assert rig_in_shape is not None
    turns_same = np.array_equal(np.asarray(rig_in_shape.moving), np.asarray(rig.moving))
    if turns_same and np.abs(rig_in_shape.rest - rig.rest).max() <= _SAME_REST:
        return None
    shaped_rig = replace(rig_in_shape, chosen=rig.chosen)
    return replace(shaped, rig=shaped_rig, up=character.up, up_is_sure=character.up_is_sure)


def _shared_joints(space: RigPoseSpace, motion: SmplMotion) -> list[tuple[int, int]]:
    """Return index pairs of the joints that body and motion share."""
    numbers = {name: number for number, name in enumerate(motion.names)}
    names = enumerate(space.rig.joint_names)
    return [(joint, numbers[name]) for joint, name in names if name in numbers]


def _listed(names: Sequence[str]) -> str:
    return listed((name.replace("_", " ") for name in names), _NAMED)


_HIDDEN = 1e-3
"""Share of a face's longest side at rest below which a frame hides it."""

_SAME = 1e-6
"""Normalised tolerance within which codes represent a frame."""

_MOST_BYTES = 1 << 27
"""Largest memory for the cached shapes of a motion's frames."""


def read_motions(
    body: Body,
    path: Path,
    clip: str | None = None,
    fps: float | None = None,
    job: Job = UNWATCHED,
) -> list[Motion]:
    """Read the motions of a file or a folder of meshes as poses of a body.

    Parameters
    ----------
    body : the body that they move
    path : a character's file, whose clips are motions; a .bvh or .vrma file, another character's
        file, or a file of clips alone, whose skeleton a character's joints follow; an .npz motion
        of the SMPL family, if `body` is its body model in its shape: see `body_of_motion`; a pose
        set: a point cache, an .npz file, or a folder of meshes in natural order; or a pose file
    clip : one of the file's clips; None for all of them
    fps : frame rate; None for that of the file's keys, else 30. Only characters are resampled;
        for other files it is the rate of their frames.
    job : reports (frames encoded, all frames); polled between frames

    Raises
    ------
    LCollisionError : a file cannot be read, belongs to another body, or has no motion.
    CancelledError : the job was cancelled.
    """
    suffix = path.suffix.lower()
    if suffix not in SCENE_SUFFIXES and clip is not None:
        raise MeshFileError("has no clips to choose from", "leave out the clip", where=path)
    if is_retargeted(body, path):
        return [
            replace(
                _with_weights(body, path, motion, fps),
                contacts=_contacts(path, motion, retargeting, fps),
            )
            for motion, retargeting in retargeted_motions(body, path, clip, fps)
        ]
    if is_smpl_motion(path):
        return [motion_of_smpl(body, path, fps)]
    if suffix == ".json":
        return [_of_poses(body, path, fps or NOMINAL_RATE)]
    if suffix not in SCENE_SUFFIXES:
        if path.is_file() and suffix not in MOTION_SUFFIXES:
            one_of = f"use one of {', '.join((*MOTION_SUFFIXES, '.npy', '.json'))}"
            raise MeshFileError("is not a motion file", one_of, where=path)
        poses = read_pose_set(path, job.part(), topology=body.topology)
        body.require_topology(poses.topology, str(path))
        # A point cache's frames follow the rest pose.
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
    clip_names = list(names) if clip is None else [clip]
    if character is not None and body.joints is not None:
        return [_of_clip(character, body.joints, name, fps) for name in clip_names]
    motions = []
    for name in clip_names:
        rate = fps or frame_rate(path, name) or NOMINAL_RATE
        topology = body.topology
        poses = read_pose_set(path, job.part(), clip=name, fps=rate, topology=topology)
        body.require_topology(poses.topology, str(path))
        frames = poses.vertices[1:]
        times = np.arange(len(frames)) / rate
        motions.append(_encoded(body, name, path.name, frames, times, job))
    return motions


def _contacts(
    path: Path, motion: Motion, retargeting: Retargeting, fps: float | None
) -> Callable[[], KeptContacts | None]:
    """Return a function that finds a retargeted motion's contacts, or None without a skin."""

    @cache
    def contacts() -> KeptContacts | None:
        source = _source_of(path)
        if source is None:
            return None
        source_motion = _of_clip(source.character, source.space, motion.name, fps)
        return contacts_of(motion, source, source_motion, retargeting)

    return contacts


def _source_of(path: Path) -> RigBody | None:
    """Return the character of a file whose clips move another; None without a readable skin."""
    document = open_rigged(path)
    if document is None:
        return None
    try:
        source = open_body(document)
    except LCollisionError:
        # The motion only needs the skeleton, which could be read.
        return None
    return source if isinstance(source, RigBody) else None


def _with_weights(body: Body, path: Path, motion: Motion, fps: float | None) -> Motion:
    """Return a retargeted motion with the weights of sliders that both bodies name alike."""
    source = _source_of(path) if body.shape_names else None
    names = [] if source is None else [n for n in body.shape_names if n in source.shape_names]
    if source is None or not names:
        return motion
    clip, codes = _of_clip(source.character, source.space, motion.name, fps), motion.codes.copy()
    for name in names:
        own, theirs = (
            shaped.shape_codes.start + shaped.shape_names.index(name) for shaped in (body, source)
        )
        since = clip.times - clip.times[0]
        codes[:, own] = np.interp(motion.times, since, clip.codes[:, theirs])
    return replace(motion, codes=codes)


def is_of_skeleton(path: Path) -> bool:
    """Whether a file holds only the motion of joints and needs a body; never raises."""
    return path.suffix.lower() in SKELETON_SUFFIXES or is_smpl_motion(path)


def is_retargeted(body: Body, path: Path) -> bool:
    """Whether a file's motions are of another skeleton, which the joints of a body follow.

    Includes scenes with another rig than the body's, or without a rig and with other faces.

    Raises
    ------
    MeshFileError : the file is missing, or is not a scene.
    """
    if path.suffix.lower() in SKELETON_SUFFIXES or is_generated(path):
        return True
    if is_smpl_motion(path):
        # A body model's own joints turn; those of other characters follow them.
        character = body.character
        return body.joints is not None and character is not None and character.smpl is None
    if path.suffix.lower() not in SCENE_SUFFIXES or body.joints is None or body.is_of_file(path):
        return False
    key = body.fingerprint, path.absolute(), file_stamp(path)
    answer = _CARRIED.get(key)
    if answer is None:
        answer = _CARRIED[key] = _is_of_another(body, path)
        if len(_CARRIED) > _MOST_KNOWN:
            # Another thread may remove the same entry.
            _CARRIED.pop(next(iter(_CARRIED)), None)
    return answer


_CARRIED: dict[tuple[str, Path, FileStamp | None], bool] = {}
"""Cached results of `is_retargeted`, which may take seconds and is called repeatedly."""

_MOST_KNOWN = 1000


def _is_of_another(body: Body, path: Path) -> bool:
    """Whether a scene has another rig than a body, or no rig and other faces."""
    if character_of_motion(body, path) is not None:
        return False
    if open_rigged(path) is not None:
        return True
    try:
        joined = join_parts(read_scene(path)).cut_as(body.topology)
    except MeshFileError:
        # Reading the skeleton reports its errors; the mesh is not needed.
        return True
    return joined.topology != body.topology


def body_of_motion(body: Body, path: Path) -> tuple[Body, tuple[str, ...]]:
    """Return the body that a file's motions move, and notes on what is left out.

    It is the given body, except for motions that determine its shape: see `body_of_smpl`.

    Raises
    ------
    MeshFileError : a skeleton's file is damaged; also see `body_of_smpl`.
    """
    if is_retargeted(body, path):
        return body, skeleton_notes(body, path)
    return body_of_smpl(body, path) if is_smpl_motion(path) else (body, ())


def character_of_motion(body: Body, path: Path) -> Character | None:
    """Return a file's character if its rig is the body's; None if its frames are meshes."""
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
        # Another character's mesh may be in an unsupported form, such as compressed.
        return None
    is_same = other is not None and other.fingerprint == body.fingerprint
    return other.character if is_same and other is not None else None


def _of_poses(body: Body, path: Path, fps: float) -> Motion:
    poses = read_poses(path, body)
    if not poses:
        raise MeshFileError("contains no poses", "name a file that has some", where=path)
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
    """Return a clip of a character with the body's rig as a motion."""
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
    """Return the motion of a rig, with the body's own shape in each frame.

    Parameters
    ----------
    times : (T,) in seconds
    transforms : (T, J, 4, 4) global transforms of the joints
    points : for frames with other points of the rig: see `ClipFrames.points`
    shown : for frames that these cannot express, functions that make their (V, 3) vertices in the
        body's unit; faces that a frame scales to nothing are ignored
    shapes : (T, S) morph target weights; at rest if None

    Raises
    ------
    ShapeError : see `Motion` and `RigPoseSpace.codes_of_transforms`.
    """
    codes = space.unwound(space.codes_of_transforms(transforms, shapes))
    points, shown = points or {}, shown or {}
    # Distances of the corners of the body's box from where the codes place them, by each joint that
    # carries vertices. The root's codes include the motions of joints above it.
    carriers = np.unique(space.rig.joint_of[space.rig.weights > 0.0])
    at_rest = np.linalg.inv(space.rig.rest[carriers])
    at_rest = at_rest @ box_corners(space.rest_vertices * space.body_size)
    is_held = (
        np.abs((given - space.transforms(row))[carriers] @ at_rest).max() <= _SAME * space.body_size
        for given, row in zip(transforms, codes, strict=True)
    )
    if not points and not shown and all(is_held):
        return Motion(name, times, codes, None, None, source)
    moved_joints = space.joint_offsets(codes, transforms)
    n_kept = max(2, _MOST_BYTES // (24 * int(np.count_nonzero(space.rig.weights))))

    @lru_cache(n_kept)
    def shape(make: Callable[[], FloatArray]) -> FloatArray:
        return space.influence_points(make())

    @lru_cache(n_kept)
    def body(frame: int) -> RigPoseSpace:
        shaped = shape(points[frame]) if frame in points else None
        own_space = space.with_joint_offsets(
            moved_joints.offsets[frame], moved_joints.linear[frame], shaped
        )
        if frame not in shown:
            return own_space
        vertices = shown[frame]().astype(np.float64)
        return own_space.shaped_as(codes[frame], vertices / space.body_size)

    def space_at(time: float) -> RigPoseSpace:
        frame, share = int(time), time % 1.0
        return body(frame).interpolated(body(frame + 1), share) if share else body(frame)

    @cache
    def hidden(frame: int) -> npt.NDArray[np.intp]:
        sides = space.topology.longest_sides(body(frame).decode(codes[frame][None])[0])
        return np.flatnonzero(sides < _HIDDEN * sides_at_rest)

    sides_at_rest = space.topology.longest_sides(space.rest_vertices)
    hides = hidden if points or shown else None
    return Motion(name, times, codes, None, space_at, source, hides)


def _encoded(
    body: Body,
    name: str,
    source: str,
    frames: npt.NDArray[np.floating],
    times: FloatArray,
    job: Job,
) -> Motion:
    """Encode (T, V, 3) frames of meshes; their detail becomes the body's shape in each frame."""
    poses = []
    for number, frame in enumerate(frames):
        try:
            poses.append(body.encode(frame, job))
        except (PoseSetError, ShapeError) as error:
            what = f"frame {number} cannot be encoded"
            raise MeshFileError.because(source, what, error) from error
        job.report(number + 1, len(frames))
    codes = np.array([pose.latent for pose in poses])
    placements: tuple[RigidTransform | None, ...] = tuple(pose.placement for pose in poses)

    @lru_cache(max(2, _MOST_BYTES // (24 * body.n_vertices)))
    def shaped(frame: int) -> PoseSpace:
        place, vertices = placements[frame], frames[frame].astype(np.float64)
        at_home = vertices if place is None else place.inverse().apply(vertices)
        return body.space.shaped_as(codes[frame], at_home / body.body_size)

    def space_at(time: float) -> PoseSpace:
        here, share = shaped(int(time)), time % 1.0
        if share and isinstance(here, RigPoseSpace):
            there = shaped(int(time) + 1)
            assert isinstance(there, RigPoseSpace)
            return here.interpolated(there, share)
        return shaped(round(time))

    return Motion(name, times, codes, placements, space_at, source)


@dataclass(frozen=True, eq=False)
class MotionChange:
    """A motion before and after Resolve.

    Attributes
    ----------
    before, after : at the same times
    spans : changed frames
    largest_change : the requested limit, normalised; None for any
    """

    before: Motion
    after: Motion
    spans: Sequence[range]
    largest_change: float | None = None


@dataclass(frozen=True, eq=False)
class WrittenClips:
    """The contents of a file of changed clips.

    Attributes
    ----------
    free : for each motion (T,) which frames are free by the exact check of the file as read back
    notes : sentences about what the file lacks
    put_back : for each motion the spans left unchanged in the file, as it could only store a worse
        result
    stored : the motions as read back, in the body's codes; none of new clips
    """

    free: list[npt.NDArray[np.bool_]]
    notes: tuple[str, ...]
    put_back: list[list[range]]
    stored: Sequence[Motion] = ()


def write_clips(
    path: str | os.PathLike[str], body: Body, file: Path, changes: Sequence[MotionChange]
) -> WrittenClips:
    """Write the character's file with changed clips, atomically.

    Files of other formats than glTF become GLB; BVH files and .npz files of the SMPL family keep
    their format, other contents and all frames outside the spans.

    Parameters
    ----------
    path : a .glb file, or a .vrm file if the source is one; a .bvh or .npz file for a motion of
        that format
    body : the character whose motions were resolved
    file : the source of the motions, of the same rig
    changes : of its clips; for what else stays see `changed_gltf`

    Raises
    ------
    MeshFileError : the source cannot be written in that format; also see `changed_gltf`.
    """
    if _is_bvh(path) or is_smpl_motion(file):
        return _write_own(path, body, file, changes)
    character, space = character_of_motion(body, file), body.joints
    if character is None or space is None:
        raise MeshFileError("has another rig", "name the file of the motion", where=file)
    require_written(path, character)
    written = _ClipsOfFile(as_gltf(character), space, body.exact_check(), file)
    data = written.changed(changes)
    as_read = character_of_gltf(data, file)
    put_back = [written.worse_spans(change, as_read) for change in changes]
    if any(put_back):
        changes = [
            replace(pair, spans=[span for span in pair.spans if span not in worse])
            for pair, worse in zip(changes, put_back, strict=True)
        ]
        data = written.changed(changes)
        as_read = character_of_gltf(data, file)
    stored = written.stored(changes, as_read)
    free = [motion.are_free(written.check) for motion in stored]
    write_bytes(path, data)
    return WrittenClips(free, written.made.notes, put_back, stored)


def write_new_clips(
    path: str | os.PathLike[str], body: Body, motions: Sequence[Motion]
) -> WrittenClips:
    """Write the character's file with retargeted motions as new clips before its own.

    Parameters
    ----------
    path : a .glb file, or a .vrm file if the character's is one
    body : the character whose motions were resolved

    Raises
    ------
    MeshFileError : the body has no file, or it cannot be written in that format.
    """
    source = source_for(Path(path).suffix, body)
    if source is None:
        raise MeshFileError.unwritable(
            path, "the body has no file of its own", "name a .bvh, .pc2 or .mdd file, or a folder"
        )
    free, notes = source.write_motions(path, motions)
    return WrittenClips(free, notes, [[] for _ in motions])


def _joints(motion: Motion, frame: int, space: RigPoseSpace) -> FloatArray:
    """Return the (J, 4, 4) global transforms of the joints in a frame of a motion."""
    frame_space = motion.space(frame, space)
    assert isinstance(frame_space, RigPoseSpace)
    return frame_space.transforms(motion.codes[frame])


@dataclass(frozen=True, eq=False)
class _ClipsOfFile:
    """A character's file with changed clips, in memory.

    Attributes
    ----------
    made : the character as glTF
    space, check : of the body
    file : its source
    """

    made: GltfCharacter
    space: RigPoseSpace
    check: ExactCheck
    file: Path

    def _times(self, motion: Motion) -> FloatArray:
        return motion.times + self.made.delays.get(motion.name, 0.0)

    def changed(self, changes: Sequence[MotionChange]) -> bytes:
        """Return the file with the changed spans."""

        def shapes(change: MotionChange) -> FloatArray | None:
            frames = list(chain.from_iterable(change.spans))
            moved = change.after.codes[frames] - change.before.codes[frames]
            return shapes_in_file(self.space, self.made, moved)

        def transforms(motion: Motion, spans: Sequence[range]) -> FloatArray:
            frames = chain.from_iterable(spans)
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

    @cached_property
    def _unchanged(self) -> Character:
        return character_of_gltf(self.changed([]), self.file)

    def _shown(
        self, motion: Motion, frames: Sequence[int], as_read: Character
    ) -> Iterator[npt.NDArray[np.float32]]:
        """Yield frames of a file as read back: (V, 3) vertices in the body's coordinates."""
        read_frames = as_read.sample(motion.name, self._times(motion)[list(frames)])
        for frame in range(len(frames)):
            yield self._moved_back(read_frames, frame).astype(np.float32)

    def worse_spans(self, change: MotionChange, as_read: Character) -> list[range]:
        """Return the spans that are worse in a file than unchanged, by their vertices."""
        motion, most = change.before, change.largest_change

        def is_worse_in(frames: range) -> bool:
            checks = {at: motion.seen(self.check, range(at, at + 1)) for at in frames}
            shown = dict(zip(frames, self._shown(motion, frames, as_read), strict=True))
            # A free frame is no worse than any other; only the rest are compared.
            left = [
                at for at in frames if most is not None or not checks[at].is_free_mesh(shown[at])
            ]
            if not left:
                return False
            unchanged = self._shown(motion, left, self._unchanged)
            return any(
                is_worse(checks[at], old, shown[at], most)
                for at, old in zip(left, unchanged, strict=True)
            )

        with ThreadPoolExecutor(available_cores(), "frames of a file") as pool:
            return [
                span
                for span in change.spans
                if any(
                    pool.map(
                        is_worse_in,
                        [span[at : at + _AT_ONCE] for at in range(0, len(span), _AT_ONCE)],
                    )
                )
            ]

    def stored(self, changes: Sequence[MotionChange], as_read: Character) -> list[Motion]:
        """Return motions as read back from a file."""
        place = self.made.frame.inverse().matrix
        # Parts hidden at rest may have become joints.
        file_rig = self.made.character.rig
        assert file_rig is not None
        assert as_read.rig is not None
        numbers = {node: joint for joint, node in enumerate(as_read.rig.nodes.tolist())}
        nodes = file_rig.nodes[np.argsort(self.made.joints)].tolist()
        joints = [numbers[node] for node in nodes]
        motions = []
        for change in changes:
            name, times = change.before.name, self._times(change.before)
            frames = as_read.sample(name, times)
            assert frames.transforms is not None
            # The rig as read may store influences, or parts hidden at rest, differently.
            vertices_of_frame = {
                frame: partial(self._moved_back, frames, frame) for frame in frames.points
            }
            motion = motion_of_transforms(
                self.space,
                name,
                change.before.times,
                place @ frames.transforms[:, joints],
                shown=vertices_of_frame,
                shapes=self._numbers(as_read, frames),
            )
            motions.append(motion)
        return motions

    def _numbers(self, character: Character, frames: ClipFrames) -> FloatArray | None:
        """Return shape codes of the file's frames in the body's order."""
        assert character.rig is not None
        read, slider_shapes = character.rig.shapes, self.space.rig.shapes
        if read is None or slider_shapes is None or frames.shapes is None:
            return None
        return frames.shapes[:, [read.names.index(name) for name in slider_shapes.names]]

    def _moved_back(self, frames: ClipFrames, frame: int) -> FloatArray:
        return self.made.frame.inverse().apply(frames.vertices[frame][self.made.to_read])


def _write_own(
    path: str | os.PathLike[str], body: Body, file: Path, changes: Sequence[MotionChange]
) -> WrittenClips:
    """Write the single motion of a BVH file or of the SMPL family into a copy of the file."""
    (change,) = changes
    check, put_back = body.exact_check(), []
    while True:
        frames = list(chain.from_iterable(change.spans))
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
    return WrittenClips([np.fromiter(verdicts, np.bool_, len(back))], (), [put_back], [back])


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
        carried = Retargeting.of(bvh.motion, space, file).changed(frames, before, after)
        data = bvh.with_frames(frames, *carried)
    write_bytes(path, data)


def contact_facts(motion: Motion, check: ExactCheck) -> dict[str, Any] | None:
    """Return the values of a motion's `ContactReport` for reports; None if it has none."""
    report = contact_report(motion, check)
    return None if report is None else report.to_json()


def ground_report(body: Body, motion: Motion) -> GroundReport | None:
    """Measure how a motion stands on its scene's ground; None if there is none."""
    if body.ground is None:
        return None
    return GroundReport.of(motion, body.exact_check(), body.up, *body.ground)


def ground_facts(body: Body, motion: Motion) -> dict[str, Any] | None:
    """Return the values of `ground_report` for reports."""
    report = ground_report(body, motion)
    return None if report is None else asdict(report)
