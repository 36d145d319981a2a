"""Resolve, mirror and save poses and motions; imported before the window exists."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lcollision_core.jobs import Job
from lcollision_core.options import MotionOptions, ResolveOptions

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, MirroredPose, NamedPose
    from lcollision_core.files import FileStamp
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.motion import Motion, ResolvedMotion, Solved
    from lcollision_core.posing import PoseSpace
    from lcollision_core.resolve import ResolveResult


def resolve_pose(
    body: Body,
    latent: npt.NDArray[np.float64],
    placement: RigidTransform | None,
    options: ResolveOptions,
    job: Job,
    own: Callable[[], PoseSpace] | None = None,
) -> tuple[ResolveResult, npt.NDArray[np.float32]]:
    """Find the nearest pose that is free where it is exported.

    Parameters
    ----------
    own : makes the pose space of the body in a motion's frame: see `Motion.space_at`

    Returns
    -------
    result : the pose and how it was found
    before : (V, 3) float32 array, read-only: the mesh before, exactly as drawn
    """
    check = body.exact_check(placement, own and own(), options.clearance)
    before = check.drawn(check.decode(latent)[0])
    before.flags.writeable = False
    resolver = body.resolver if own is None else body.resolver.with_check(check)
    return resolver.resolve(latent, options, job=job, placement=placement), before


def resolve_frames(
    body: Body,
    motion: Motion,
    options: MotionOptions,
    within: range | None,
    solved: npt.NDArray[np.bool_],
    stop: Job,
    job: Job,
) -> ResolvedMotion:
    """Resolve a motion, or some of its frames.

    Parameters
    ----------
    within : the frames that may change; all if None
    solved : (T,) bool array, set as frames are resolved
    stop : when cancelled, the search ends with the finished spans
    """
    from lcollision_core.bodies.motions import ground_report
    from lcollision_core.motion import resolve_motion

    def keep(frame: int, solution: Solved) -> None:
        solved[frame] = solution[1]

    up = np.array(body.up)
    resolution = resolve_motion(
        body.resolver, motion, up, options, None, job, within=within, keep=keep, stop=stop
    )
    return replace(resolution, ground=ground_report(body, resolution.motion))


def free_neighbours(
    body: Body, before: Motion, edited: Motion, clearance: float, job: Job
) -> Motion | None:
    """Resolve frames that collide after an edit of one frame was eased in; None if none do.

    Free frames stay bit-identical, including the edited one if free.

    Parameters
    ----------
    before, edited : the motion before and after the edit
    clearance : to keep between parts, normalised
    """
    from lcollision_core.motion import resolve_motion
    from lcollision_core.motion.motion import runs

    check = body.exact_check(clearance=clearance)
    is_new = np.zeros(len(edited), dtype=np.bool_)
    for frame in np.flatnonzero((before.codes != edited.codes).any(axis=1)).tolist():
        job.check()
        collides = not edited.check(frame, check).is_free(edited.codes[frame])
        is_new[frame] = collides and before.check(frame, check).is_free(before.codes[frame])
    # No easing: leave the neighbouring frames alone.
    of_frame = ResolveOptions(clearance=clearance)
    options = MotionOptions(easing=0, keep_feet=False, keep_contacts=False, frame=of_frame)
    eased, up = edited, np.array(body.up)
    for within in runs(is_new):
        eased = resolve_motion(body.resolver, eased, up, options, None, job, within=within).motion
    return None if eased is edited else eased


def mirror_poses(
    body: Body, poses: Sequence[NamedPose], job: Job
) -> list[tuple[NamedPose, MirroredPose]]:
    """Return the mirror images of poses, each with its report.

    Raises
    ------
    LCollisionError : the body is not symmetric.
    CancelledError : the job was cancelled.
    """
    symmetry, images = body.pose_mirror.symmetry, []
    for done, pose in enumerate(poses, 1):
        image = body.mirror(pose.latent, pose.placement, pose.mirror_of, job=job.part())
        images.append((pose.mirrored(image, symmetry), image))
        job.report(done, len(poses))
    return images


def save_poses(
    path: Path, body: Body, poses: Sequence[NamedPose], working: NamedPose | None = None
) -> FileStamp | None:
    """Write a pose file with the working pose, and return its stamp."""
    from lcollision_core.bodies import write_poses
    from lcollision_core.files import file_stamp

    write_poses(path, body, poses, working)
    return file_stamp(path)
