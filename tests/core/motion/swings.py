"""A body of tubes whose arm swings through its trunk and back."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody
from lcollision_core.files import Character, ClipFrames
from lcollision_core.motion import Motion
from tests.rigged_shapes import FloatArray, rigged_body, skinned, turned

CLIP, OTHER = "swing", "nod"
N_FRAMES = 48


def swinging_body(
    fps: float = 30.0,
    n_frames: int = N_FRAMES,
    n_swings: int = 1,
    begin: float = 0.0,
    travel: float = 0.0,
) -> Character:
    """Return a character with the clips `CLIP`, in which its left arm swings down, and `OTHER`.

    The arm is 60 degrees down at the start and at the end, and in the trunk in the middle.

    Parameters
    ----------
    n_swings : number of swings down and up again
    begin : the fraction of a swing at which it starts
    travel : metres that it walks to its left
    """
    body = rigged_body()
    rig = body.rig
    assert rig is not None
    arm, head = rig.joint_names.index("LeftArm"), rig.joint_names.index("Head")
    times = np.arange(n_frames) / fps

    def turns(clip: str) -> FloatArray:
        share = times / times[-1]
        phase = np.sin(np.pi * (begin + (n_swings * share) % 1.0)) ** 2
        rotations = np.tile(np.eye(3), (n_frames, len(rig.parents), 1, 1))
        if clip == CLIP:
            angle = np.radians(60.0 + 52.0 * phase)
            rotations[:, arm] = Rotation.from_rotvec(np.outer(angle, [0.0, 1.0, 0.0])).as_matrix()
        else:
            nod = 0.3 * phase
            rotations[:, head] = Rotation.from_rotvec(np.outer(nod, [1.0, 0.0, 0.0])).as_matrix()
        transforms = turned(rig, rotations)
        transforms[:, :, 0, 3] += travel * share[:, None]
        return transforms

    def sample(clip: str, fps: float | None) -> ClipFrames:  # noqa: ARG001
        transforms = turns(clip)
        return ClipFrames(
            tuple(f"{clip} {frame}" for frame in range(n_frames)),
            times,
            transforms,
            lambda: np.stack([skinned(rig, one) for one in transforms]),
        )

    clips = dict.fromkeys((CLIP, OTHER), float(times[-1]))
    return replace(body, clips=clips, sample=sample)


@cache
def swinging() -> tuple[RigBody, Motion]:
    """Return the body, posed by its rig, and its swing."""
    character = swinging_body()
    body = RigBody.of(character)
    frames = character.sample(CLIP, None)
    assert frames.transforms is not None
    return body, Motion(CLIP, frames.times, body.space.codes_of_transforms(frames.transforms))


@cache
def through_the_trunk() -> tuple[RigBody, Motion]:
    """Return the body, and a motion whose arm jumps from before to behind the trunk at frame 13."""
    body, _ = swinging()
    rig = body.character.rig
    assert rig is not None
    arm = rig.joint_names.index("LeftArm")
    down, n_frames = Rotation.from_rotvec([0.0, np.radians(105.0), 0.0]), 28
    transforms = []
    for frame in range(n_frames):
        forwards = np.radians(40.0 if frame < n_frames // 2 else -40.0)
        rotations = np.tile(np.eye(3), (len(rig.parents), 1, 1))
        rotations[arm] = (Rotation.from_rotvec([forwards, 0.0, 0.0]) * down).as_matrix()
        transforms.append(turned(rig, rotations))
    codes = body.space.codes_of_transforms(np.stack(transforms))
    return body, Motion("through", np.arange(n_frames) / 30.0, codes)
