"""What some files hold that a model is to be learned from, before anything is learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError
from lcollision_core.files import read_pose_set
from lcollision_core.files.pose_set import disagreement
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene_files import SCENE_SUFFIXES, as_file_error, read_scene
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import Topology, UpGuess, body_size, guess_up
from lcollision_core.meshes.evenly_spaced import evenly_spaced

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
        frames = (held.frames_at(fps) for held in self.clips if clip in (None, held.name))
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
    found: list[SourcesSummary] = []
    for path in paths:
        topology, summary = found[0].topology if found else None, None
        if path.suffix.lower() in SCENE_SUFFIXES:
            summary = _of_character(path, job, topology)
        found.append(summary or _of_poses(path, job, topology))
        job.check()
    first = next((one for one in found if one.n_joints), found[0])
    for path, one in zip(paths, found, strict=True):
        defect = disagreement(path.name, one.topology, first.topology)
        if defect is not None:
            raise defect
    others = [one for one in found if one is not first]
    return replace(
        first,
        n_poses=sum(one.n_poses for one in found),
        clips=tuple(clip for one in (first, *others) for clip in one.clips),
        notes=tuple(dict.fromkeys(note for one in found for note in one.notes)),
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
