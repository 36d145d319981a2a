"""Mirror poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lcollision_core.jobs import Job

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, MirroredPose, NamedPose


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
