"""Several files of one body as one set of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes import PoseSet, concatenated, read_pose_set


def gather_poses(
    paths: Sequence[Path],
    *,
    by_rig: int | None = None,
    n_wanted: int = 100,
    clip: str | None = None,
    fps: float | None = None,
    up: int | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> PoseSet:
    """Read all poses of some files of one body."""
    del by_rig, n_wanted, seed
    poses = concatenated(
        [read_pose_set(path, progress, cancel, clip=clip, fps=fps) for path in paths]
    )
    return poses if up is None else replace(poses, up_axis=up)
