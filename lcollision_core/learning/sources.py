"""The poses that a body is learned from, of all the files that have some."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lcollision_core.bodies import RigBody, poses_by_rig, rest_pose_set
from lcollision_core.bodies.known import with_remembered
from lcollision_core.bodies.skeletons import rig_of
from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet, concatenated, read_character, read_pose_set, thinned
from lcollision_core.files.scene.smpl import is_smpl_model
from lcollision_core.files.scene_files import SCENE_SUFFIXES, open_rigged
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.options import NO_CHANGE, RuleOptions

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
    characters = {file: read_character(one, up) for file, one in opened.items() if one is not None}
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

    found: list[PoseSet] = []
    for number, file in enumerate(files):
        topology = found[0].topology if found else None
        if with_still and file in characters and not characters[file].clips:
            found.append(rest_pose_set(characters[file]))
        else:
            options = of_animation(file)
            found.append(read_pose_set(file, part(number), topology=topology, **options))
    if by_rig and rigged is None:
        raise LCollisionError(
            "has no joints to pose it by",
            "name a rigged character among the files, or leave out poses by the rig",
            where=", ".join(map(str, files)),
        )
    poses = concatenated(found)
    if thin:
        poses = thinned(poses, job=job)
    if by_rig is None:
        by_rig = 0 if body is None else max(0, n_wanted - len(poses))
    if body is not None and by_rig:
        if len(found) > 1:
            # Its names have those of their files.
            poses = replace(poses, source=None)
        made = poses_by_rig(body, by_rig, seed, part(len(files)))
        poses = replace(concatenated([poses, made]), source=files[0])
    if body is not None:
        # As of the character that is posed by its rig, so that verdicts agree.
        notes = tuple(dict.fromkeys((*poses.notes, *body.notes)))
        poses = replace(poses, rules=body.rules, groups=body.groups, notes=notes)
    return poses if up is None else replace(poses, up_axis=up)
