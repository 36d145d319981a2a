"""Training sources of a model: its files, a summary of them, and contact rules."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import RigBody, poses_by_rig, rest_pose_set
from lcollision_core.bodies.anatomy import rig_of
from lcollision_core.bodies.remembered import with_remembered
from lcollision_core.bodies.rig_body import MOST_NEAR_PAIRS
from lcollision_core.contact import CollisionDetector, touching_patches
from lcollision_core.contact.exclusions import near_pairs_estimate
from lcollision_core.errors import LCollisionError
from lcollision_core.files import (
    Character,
    PoseSet,
    concatenated,
    read_character,
    read_pose_set,
    thinned,
)
from lcollision_core.files.formats import SCENE_SUFFIXES
from lcollision_core.files.motion.smpl import is_smpl_model
from lcollision_core.files.pose_set import disagreement
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene_files import as_file_error, open_rigged, read_scene
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import Topology, UpGuess, body_size, guess_up
from lcollision_core.meshes.contact_rules import TOUCHING_RADIUS
from lcollision_core.meshes.topology import evenly_spaced
from lcollision_core.options import NO_CHANGE, LearningRequest, RuleOptions

ENOUGH_POSES = 100
"""Number of poses up to which a rigged character is posed by its rig by default."""

_STEPS = 100
"""Progress steps of each source."""


def gather_poses(
    paths: Sequence[str | os.PathLike[str]],
    *,
    by_rig: int | None = None,
    n_wanted: int = ENOUGH_POSES,
    clip: str | None = None,
    fps: float | None = None,
    up: int | None = None,
    seed: int = 0,
    thin: bool = True,
    rules: RuleOptions = NO_CHANGE,
    job: Job = UNWATCHED,
) -> PoseSet:
    """Read the poses of one body from several sources, and let its rig make more.

    Pose 0 is the rest pose of the first rigged file, wherever it is listed, or else of the first
    source. A rigged file's contact rules are those of its posed character.

    Parameters
    ----------
    paths : files of characters, point caches, folders of meshes and pose sets, of one topology
    by_rig : number of poses by the rig, 0 for none; None for as many as are missing to
        `n_wanted`
    n_wanted : number of poses for a rigged character
    clip, fps : of animations, as in `read_pose_set`; with several files, of those that have them
    up : 0, 1 or 2 if the files are wrong about the up axis
    seed : of the poses by the rig
    rules : changes of the contact rules of a rigged file
    thin : whether to leave out near-duplicates in the files: see `thinned`
    job : reports (steps done, all steps), with equal shares for each source and for the rig's
        poses; polled between poses

    Raises
    ------
    MeshFileError, PoseSetError : as in `read_pose_set`, for one of the sources.
    PoseSetError : the topologies of the sources differ.
    LCollisionError : poses by the rig are requested, but no source has a rig.
    CancelledError : the job was cancelled.
    """
    if not paths:
        raise LCollisionError("there is nothing to read poses from", "name a file or a folder")
    files = [Path(path) for path in paths]
    characters = _characters(files, up)
    rigged = next(iter(characters), None)
    files.sort(key=lambda file: file != rigged)
    character = None if rigged is None else characters[rigged]
    if by_rig and character is not None:
        # Raise before reading anything slow.
        rig_of(character)
    body = None
    if character is not None and character.rig is not None:
        body = with_remembered(RigBody.of(character)).with_options(rules)
    # A single character without animation is not a pose set.
    with_still = len(files) > 1 or (by_rig != 0 and clip is None)
    n_steps = len(files) + (character is not None and by_rig != 0)

    def part(number: int) -> Job:
        return job.part(
            lambda done, total: job.report(
                number * _STEPS + _STEPS * done // total, n_steps * _STEPS
            )
        )

    pose_sets = _read_files(files, characters, {"clip": clip, "fps": fps}, part, with_still)
    if by_rig and rigged is None:
        raise LCollisionError(
            "has no joints to pose it by",
            "name a rigged character among the files, or leave out poses by the rig",
            where=", ".join(map(str, files)),
        )
    poses = concatenated(pose_sets)
    if thin:
        poses = thinned(poses, job=job)
    if by_rig is None:
        by_rig = 0 if body is None else max(0, n_wanted - len(poses))
    if body is not None and by_rig:
        if len(pose_sets) > 1:
            # The pose names include their files' names.
            poses = replace(poses, source=None)
        drawn_poses = poses_by_rig(body, by_rig, seed, part(len(files)))
        poses = replace(concatenated([poses, drawn_poses]), source=files[0])
    if body is not None:
        # Use the rules of the posed character, so that verdicts agree.
        notes = tuple(dict.fromkeys((*poses.notes, *body.notes)))
        poses = replace(poses, rules=body.rules, groups=body.groups, notes=notes)
    return poses if up is None else replace(poses, up_axis=up)


def _characters(files: Sequence[Path], up: int | None) -> dict[Path, Character]:
    """Read the characters among files; missing files raise later, when they are read."""
    there = [file for file in files if file.is_file()]
    opened = [(file, file if is_smpl_model(file) else open_rigged(file)) for file in there]
    return {file: read_character(document, up) for file, document in opened if document is not None}


def _read_files(
    files: Sequence[Path],
    characters: Mapping[Path, Character],
    animation: dict[str, Any],
    part: Callable[[int], Job],
    with_still: bool,
) -> list[PoseSet]:
    """Read the poses of each file, in the topology of the first.

    Parameters
    ----------
    characters : those among the files
    animation : options of `read_pose_set`; of several files, for those that have them
    part : returns the job for a file by its number
    with_still : whether a character without clips has a pose, its rest pose
    """
    pose_sets: list[PoseSet] = []
    for number, file in enumerate(files):
        character = characters.get(file)
        if with_still and character is not None and not character.clips:
            pose_sets.append(rest_pose_set(character))
            continue
        options = animation
        if len(files) > 1 and file.suffix.lower() not in SCENE_SUFFIXES:
            options = {}
        elif len(files) > 1 and character is not None and options["clip"] not in character.clips:
            options = options | {"clip": None}
        topology = pose_sets[0].topology if pose_sets else None
        pose_sets.append(read_pose_set(file, part(number), topology=topology, **options))
    return pose_sets


_NEAR_EXCLUSIONS = (0.0, 0.02, 0.05, 0.1)
"""Normalised near exclusions tried for poses without a rig, in ascending order."""

_FEW = 0.1
"""Share of poses that may still collide under a sufficient near exclusion."""

_MOST_POSES = 40
"""Number of poses, evenly spaced, that are checked."""


def with_proposed_rules(
    poses: PoseSet,
    request: LearningRequest,
    job: Job = UNWATCHED,
) -> PoseSet:
    """Apply the requested contact rules to poses, and propose those left open.

    A missing near exclusion becomes the shortest with which few poses collide, or the shortest
    that is nearly as good as any. Patches that touch in nearly every pose are excluded.

    Parameters
    ----------
    poses : with the rules of their files
    request : the requested rules
    job : reports (poses checked, all poses); polled between poses

    Raises
    ------
    LCollisionError : the request ignores pairs of unknown groups.
    CancelledError : the job was cancelled.
    """
    rules, groups = request.applied(poses.rules, poses.groups, poses.topology, poses.vertex_labels)
    if request.ignored == ():
        rules = replace(rules, ignored=())
    ruled = replace(poses, rules=rules, groups=groups)
    pose_numbers = evenly_spaced(len(poses), _MOST_POSES)
    if request.near_exclusion is None and not rules.near_exclusion:
        rules = replace(rules, near_exclusion=_near_exclusion(ruled, pose_numbers, job.part()))
        ruled = replace(ruled, rules=rules)
    if request.ignored == ():
        return ruled
    sampled_poses = poses.vertices[pose_numbers]
    touching = touching_patches(_detector(ruled), sampled_poses, TOUCHING_RADIUS, job)
    if not touching:
        return ruled
    return replace(ruled, rules=replace(rules, touching=touching, touching_radius=TOUCHING_RADIUS))


def _detector(poses: PoseSet) -> CollisionDetector:
    return CollisionDetector(poses.topology, poses.vertices[0], poses.rules, poses.groups)


def _near_exclusion(poses: PoseSet, chosen: npt.NDArray[np.intp], job: Job) -> float:
    """Return the shortest near exclusion with which few poses collide, within the pair limit."""
    shares: dict[float, float] = {}
    rest = poses.vertices[0].astype(np.float64)
    size = body_size(rest, poses.topology)
    for near in _NEAR_EXCLUSIONS:
        if near and near_pairs_estimate(poses.topology, rest, near * size) > MOST_NEAR_PAIRS:
            break
        detector = _detector(replace(poses, rules=replace(poses.rules, near_exclusion=near)))
        shares[near] = float(np.mean(detector.are_colliding(poses.vertices[chosen], job=job)))
        if shares[near] <= _FEW:
            return near
    best = min(shares.values())
    return next(near for near, share in shares.items() if share <= best + _FEW)


_MOST_LOOKED_AT = 8
"""Number of poses per source, evenly spaced, for guessing the up axis."""


@dataclass(frozen=True)
class SourceClip:
    """An animation of a file.

    Attributes
    ----------
    name : as in the file
    n_frames : number of its keys, at most 30 a second
    seconds : its duration
    """

    name: str
    n_frames: int
    seconds: float

    def frames_at(self, fps: float | None) -> int:
        """Return the number of frames at a frame rate; None for its keys."""
        return self.n_frames if fps is None else int(self.seconds * fps + 1e-6) + 1


@dataclass(frozen=True, eq=False)
class SourcesSummary:
    """Summary of the files of one body.

    Attributes
    ----------
    topology : of all of them
    rest : (V, 3) array, the rest pose or else the first pose, in the files' unit
    n_poses : number of poses, without those of clips
    clips : of the characters' files
    n_joints : number of joints that move the skin; 0 without a rig
    up : the up axis, from the file or guessed
    size : the longest side of the rest pose's bounding box
    metres : length of the files' unit; None if unknown
    notes : sentences about changes made on reading
    """

    topology: Topology
    rest: npt.NDArray[np.floating]
    n_poses: int
    clips: tuple[SourceClip, ...]
    n_joints: int
    up: UpGuess
    size: float
    metres: float | None
    notes: tuple[str, ...]

    def n_given(self, clip: str | None = None, fps: float | None = None) -> int:
        """Return the number of poses, with the frames of one clip or of all."""
        frames = (
            source_clip.frames_at(fps)
            for source_clip in self.clips
            if clip in (None, source_clip.name)
        )
        return self.n_poses + sum(frames)


def summarise_sources(paths: Sequence[Path], job: Job = UNWATCHED) -> SourcesSummary:
    """Read and summarise the files of one body.

    Parameters
    ----------
    paths : files of characters, folders of meshes, point caches and pose sets
    job : reports (poses done, all poses) of each source; polled between poses

    Raises
    ------
    LCollisionError : a file is unsuitable for learning, or the topologies differ.
    CancelledError : the job was cancelled.
    """
    summaries: list[SourcesSummary] = []
    for path in paths:
        topology, summary = summaries[0].topology if summaries else None, None
        if path.suffix.lower() in SCENE_SUFFIXES:
            summary = _of_character(path, job, topology)
        summaries.append(summary or _of_poses(path, job, topology))
        job.check()
    first = next((summary for summary in summaries if summary.n_joints), summaries[0])
    for path, of_file in zip(paths, summaries, strict=True):
        defect = disagreement(path.name, of_file.topology, first.topology)
        if defect is not None:
            raise defect
    others = [summary for summary in summaries if summary is not first]
    return replace(
        first,
        n_poses=sum(summary.n_poses for summary in summaries),
        clips=tuple(clip for summary in (first, *others) for clip in summary.clips),
        notes=tuple(dict.fromkeys(note for summary in summaries for note in summary.notes)),
    )


def _of_character(path: Path, job: Job, topology: Topology | None) -> SourcesSummary | None:
    """Summarise a scene's file; None if it has neither joints nor clips."""
    scene = read_scene(path, job)
    with as_file_error(path):
        mesh = join_parts(scene).cut_as(topology)
        if not (scene.clips or mesh.is_skinned.any()):
            return None
        poses = [mesh.posed(scene.rest)]
        for clip in scene.clips[:_MOST_LOOKED_AT]:
            times = clip.times(None)
            some = evenly_spaced(len(times), max(_MOST_LOOKED_AT // len(scene.clips), 1))
            poses.append(mesh.posed(clip.sample(times[some])))
        clips = tuple(
            SourceClip(clip.name, len(clip.times(None)), float(np.ptp(clip.key_times)))
            for clip in scene.clips
        )
    vertices = np.concatenate(poses)
    if scene.up is None:
        up = guess_up(mesh.topology, vertices)
    else:
        up = UpGuess(int(np.abs(scene.up).argmax()), True, "the file says so")
    moving = np.unique(mesh.bone_of[(mesh.weights > 0.0) & mesh.is_skinned[:, None]])
    return SourcesSummary(
        mesh.topology,
        vertices[0],
        1,
        clips,
        len(np.unique(mesh.bones[moving])),
        up,
        body_size(vertices[0], mesh.topology),
        scene.metres,
        mesh.notes,
    )


def _of_poses(path: Path, job: Job, topology: Topology | None) -> SourcesSummary:
    poses = read_pose_set(path, job, topology=topology)
    if len(poses) < 2:
        raise LCollisionError("contains only one pose", "add more", where=path)
    return SourcesSummary(
        poses.topology,
        np.asarray(poses.vertices[0]),
        len(poses),
        (),
        0,
        poses.up,
        body_size(np.asarray(poses.vertices[0]), poses.topology),
        None,
        poses.notes,
    )
