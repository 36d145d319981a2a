"""What a body is learned from: its files, what they hold together, and the rules that follow."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import RigBody, poses_by_rig, rest_pose_set
from lcollision_core.bodies.known import with_remembered
from lcollision_core.bodies.rig_body import MOST_NEAR_PAIRS
from lcollision_core.bodies.skeletons import rig_of
from lcollision_core.contact import CollisionDetector, touching_patches
from lcollision_core.contact.exclusions import near_pairs_estimate
from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet, concatenated, read_character, read_pose_set, thinned
from lcollision_core.files.pose_set import disagreement
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene.smpl import is_smpl_model
from lcollision_core.files.scene_files import as_file_error, open_rigged, read_scene
from lcollision_core.files.table import SCENE_SUFFIXES
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import Topology, UpGuess, body_size, guess_up
from lcollision_core.meshes.contact_rules import TOUCHING_RADIUS
from lcollision_core.meshes.evenly_spaced import evenly_spaced
from lcollision_core.options import NO_CHANGE, LearningRequest, RuleOptions

ENOUGH_POSES = 100
"""Poses from which on a rigged character is not posed by its rig unless that is asked for."""

_STEPS = 100
"""Of the progress of each source."""


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

    Pose 0 is the rest pose of the first rigged file, wherever it is named, else that of the first
    source. The contact rules of a rigged file are those by which its rig is posed.

    Parameters
    ----------
    paths : files of characters, point caches, folders of meshes, pose sets, all of one topology
    by_rig : how many poses the rig is to make, 0 for none; None for as many as are missing to
        `n_wanted`
    n_wanted : poses of a rigged character
    clip, fps : of animations, as for `read_pose_set`; of several files those that have them obey
    up : 0, 1 or 2 where the files are wrong about the axis that is up
    seed : of the poses by the rig
    rules : changes of the contact rules of a rigged file
    thin : leave out near-duplicates among what the files have: see `thinned`
    job : reports (steps done, all steps), as many for a source as for the rig's poses; polled
        between poses

    Raises
    ------
    MeshFileError, PoseSetError : as of `read_pose_set`, for one of the sources.
    PoseSetError : the sources are not of one topology.
    LCollisionError : poses by the rig are asked for, and no source has a rig.
    CancelledError : the job was cancelled.
    """
    if not paths:
        raise LCollisionError("there is nothing to read poses from", "name a file or a folder")
    files = [Path(path) for path in paths]
    # What is missing is refused when it is read.
    opened = {
        file: file if is_smpl_model(file) else open_rigged(file) for file in files if file.is_file()
    }
    characters = {
        file: read_character(document, up)
        for file, document in opened.items()
        if document is not None
    }
    rigged = next(iter(characters), None)
    files.sort(key=lambda file: file != rigged)
    character = None if rigged is None else characters[rigged]
    if by_rig and character is not None:
        # Refused before anything is read for long.
        rig_of(character)
    body = None
    if character is not None and character.rig is not None:
        body = with_remembered(RigBody.of(character)).with_options(rules)
    # Alone, without animation, a character is no pose set.
    with_still = len(files) > 1 or (by_rig != 0 and clip is None)
    n_steps = len(files) + (character is not None and by_rig != 0)

    def part(number: int) -> Job:
        return job.part(
            lambda done, total: job.report(
                number * _STEPS + _STEPS * done // total, n_steps * _STEPS
            )
        )

    def of_animation(file: Path) -> dict[str, Any]:
        """Return the options of a file's animation; among several files, where it has them."""
        if len(files) == 1:
            return {"clip": clip, "fps": fps}
        if file.suffix.lower() not in SCENE_SUFFIXES:
            return {}
        own = characters.get(file)
        return {"clip": clip if own is None or clip in own.clips else None, "fps": fps}

    pose_sets: list[PoseSet] = []
    for number, file in enumerate(files):
        topology = pose_sets[0].topology if pose_sets else None
        if with_still and file in characters and not characters[file].clips:
            pose_sets.append(rest_pose_set(characters[file]))
        else:
            options = of_animation(file)
            pose_sets.append(read_pose_set(file, part(number), topology=topology, **options))
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
            # Its names have those of their files.
            poses = replace(poses, source=None)
        made = poses_by_rig(body, by_rig, seed, part(len(files)))
        poses = replace(concatenated([poses, made]), source=files[0])
    if body is not None:
        # As of the character that is posed by its rig, so that verdicts agree.
        notes = tuple(dict.fromkeys((*poses.notes, *body.notes)))
        poses = replace(poses, rules=body.rules, groups=body.groups, notes=notes)
    return poses if up is None else replace(poses, up_axis=up)


_NEAR_EXCLUSIONS = (0.0, 0.02, 0.05, 0.1)
"""Normalised lengths that are tried on poses without a rig, the shortest first."""

_FEW = 0.1
"""Share of the poses that may collide where the near exclusion is long enough."""

_MOST_POSES = 40
"""Poses, evenly spaced, that are asked."""


def with_proposed_rules(
    poses: PoseSet,
    request: LearningRequest,
    job: Job = UNWATCHED,
) -> PoseSet:
    """Give poses the contact rules that a request asks for, and propose what it leaves open.

    The near exclusion of poses that say none is the shortest by which few of them collide, or the
    shortest that is about as good as any. Patches that touch in nearly every pose do not count.

    Parameters
    ----------
    poses : with the rules of their files
    request : what is asked for
    job : reports (poses looked at, poses in all); polled between poses

    Raises
    ------
    LCollisionError : the request ignores pairs of groups that the mesh does not have.
    CancelledError : the job was cancelled.
    """
    rules, groups = request.applied(poses.rules, poses.groups, poses.topology, poses.vertex_labels)
    if request.ignored == ():
        rules = replace(rules, ignored=())
    ruled = replace(poses, rules=rules, groups=groups)
    chosen = evenly_spaced(len(poses), _MOST_POSES)
    if request.near_exclusion is None and not rules.near_exclusion:
        rules = replace(rules, near_exclusion=_near_exclusion(ruled, chosen, job.part()))
        ruled = replace(ruled, rules=rules)
    if request.ignored == ():
        return ruled
    asked = poses.vertices[chosen]
    touching = touching_patches(_detector(ruled), asked, TOUCHING_RADIUS, job)
    if not touching:
        return ruled
    return replace(ruled, rules=replace(rules, touching=touching, touching_radius=TOUCHING_RADIUS))


def _detector(poses: PoseSet) -> CollisionDetector:
    return CollisionDetector(poses.topology, poses.vertices[0], poses.rules, poses.groups)


def _near_exclusion(poses: PoseSet, chosen: npt.NDArray[np.intp], job: Job) -> float:
    """Return the shortest near exclusion by which few poses collide, if it can be listed."""
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
"""Poses of each source, evenly spaced, by which the axis that is up is guessed."""


@dataclass(frozen=True)
class SourceClip:
    """An animation of a file.

    Attributes
    ----------
    name : as in the file
    n_frames : its keys, at most 30 a second
    seconds : that it lasts
    """

    name: str
    n_frames: int
    seconds: float

    def frames_at(self, fps: float | None) -> int:
        """Return how many frames it has, `fps` of them a second; None for its keys."""
        return self.n_frames if fps is None else int(self.seconds * fps + 1e-6) + 1


@dataclass(frozen=True, eq=False)
class SourcesSummary:
    """What files of one body hold.

    Attributes
    ----------
    topology : of all of them
    rest : (V, 3) array, the rest pose, else the first, in the files' unit
    n_poses : poses without those of clips
    clips : of the files of characters
    n_joints : that move the skin; 0 where nothing is rigged
    up : the axis that is up, as the file says or as it is guessed
    size : the longest side of the rest pose's bounding box
    metres : length of the files' unit; None where they do not say it
    notes : sentences on what was changed on reading
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
        """Return how many poses there are, with the frames of one clip or of all."""
        frames = (
            source_clip.frames_at(fps)
            for source_clip in self.clips
            if clip in (None, source_clip.name)
        )
        return self.n_poses + sum(frames)


def summarise_sources(paths: Sequence[Path], job: Job = UNWATCHED) -> SourcesSummary:
    """Read files of one body, and tell what they hold together.

    Parameters
    ----------
    paths : files of characters, folders of meshes, point caches and pose sets
    job : reports (poses done, poses in all) of each; polled between poses

    Raises
    ------
    LCollisionError : one of them cannot be learned from, or they are not of one topology.
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
    for path, one in zip(paths, summaries, strict=True):
        defect = disagreement(path.name, one.topology, first.topology)
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
    """Return what a scene's file holds; None where neither joints nor clips make poses of it."""
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
