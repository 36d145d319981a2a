"""Motions as files of skeletons, without a mesh: BVH, and VRM animations."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.rig_model import RigModel
from lcollision_core.characters import RigPoseSpace
from lcollision_core.characters.retargeting import Retargeting
from lcollision_core.characters.skeleton_motion import (
    bvh_of,
    held_by_bvh,
    require_humanoid,
    vrma_of,
)
from lcollision_core.errors import MeshFileError
from lcollision_core.files.motion.bvh import BVH_SUFFIX, read_bvh
from lcollision_core.files.motion.vrma import VRMA_SUFFIX, read_vrma
from lcollision_core.files.safe import atomic_write
from lcollision_core.motion import Motion

SKELETON_SUFFIXES = (BVH_SUFFIX, VRMA_SUFFIX)
"""Extensions of the motions of skeletons, which need a body."""

_SAME = 1e-4
"""Normalised: what a skeleton holds of a frame to so much, it holds."""


def read_skeleton(body: PosableBody, path: Path, fps: float | None = None) -> Motion:
    """Read the motion of a skeleton, carried by the joints of a character.

    Parameters
    ----------
    path : a .bvh or .vrma file
    fps : frames a second; None for the rate of the file. A BVH file has the frames that it has.

    Raises
    ------
    MeshFileError : the file is damaged, or the body has no such skeleton.
    """
    space = rig_space_of(body, path)
    motion = read_bvh(path) if path.suffix.lower() == BVH_SUFFIX else read_vrma(path, fps)
    times = motion.times
    if fps is not None:
        times = np.arange(len(times), dtype=np.float64) / fps
    carried = Retargeting.of(motion, space, path).transforms()
    codes = space.unwound(space.codes_of_transforms(carried))
    return Motion(path.stem, times, codes, source=path.name)


def rig_space_of(body: PosableBody, path: Path) -> RigPoseSpace:
    """Return the poses of a body's joints, which the motion of a skeleton needs.

    Raises
    ------
    MeshFileError : it has none.
    """
    if isinstance(body.space, RigPoseSpace):
        return body.space
    raise MeshFileError(
        "is the motion of a skeleton, and the body has no joints",
        "name a rigged character as the body",
        where=path,
    )


def require_skeleton(path: str | os.PathLike[str], body: PosableBody) -> None:
    """Refuse a file of a skeleton for a body that has none, or not the bones that it needs.

    Other files are left alone.

    Raises
    ------
    MeshFileError : the body has no joints, or lacks bones that VRM needs.
    """
    if Path(path).suffix.lower() not in SKELETON_SUFFIXES:
        return
    if not isinstance(body, RigModel):
        raise MeshFileError.unwritable(
            path, "the body has no joints", "name a .pc2 or .mdd file, or a folder"
        )
    if Path(path).suffix.lower() == VRMA_SUFFIX:
        require_humanoid(body.character, body.space)


def write_skeleton(
    path: str | os.PathLike[str],
    body: PosableBody,
    latents: Sequence[npt.NDArray[Any]],
    vertices: Iterable[npt.NDArray[Any]],
    fps: float,
) -> tuple[list[npt.NDArray[Any]], tuple[str, ...]]:
    """Write poses as the motion of the body's joints, whole or not at all.

    Parameters
    ----------
    path : a .bvh or .vrma file
    body : a character, of the poses
    latents : N poses' (D,) codes
    vertices : of N poses, each (V, 3), what the body shows of them
    fps : frames a second

    Returns
    -------
    stored : N times (V, 3), what the body shows of the file
    notes : sentences on what the file lacks

    Raises
    ------
    MeshFileError : as of `require_skeleton`, or the file cannot be written.
    """
    require_skeleton(path, body)
    assert isinstance(body, RigModel)
    transforms = np.array([body.space.transforms(row) for row in latents])
    is_bvh = Path(path).suffix.lower() == BVH_SUFFIX
    if is_bvh:
        data = bvh_of(body.space, transforms, 1.0 / fps)
    else:
        data = vrma_of(body.character, body.space, transforms, np.arange(len(latents)) / fps)
    with atomic_write(path) as out:
        out.write(data)
    if is_bvh:
        # Of a body of any kind, which another may not be able to follow.
        held = held_by_bvh(body.space, read_bvh(path))
    else:
        codes = read_skeleton(body, Path(path), fps).codes
        held = np.array([body.space.transforms(row) for row in codes])
    skinned = (body.space.skinned(one) * body.body_size for one in held)
    stored: list[npt.NDArray[Any]] = [one.astype(np.float32) for one in skinned]
    pairs = zip(stored, vertices, strict=True)
    off = max(float(np.abs(own - shown).max()) for own, shown in pairs) / body.body_size
    notes: tuple[str, ...] = ()
    if off > _SAME:
        notes = (
            f"{Path(path).name} holds the turns of joints alone: with it, this body is up to "
            f"{100.0 * off:.2g} % of its size away from the motion",
        )
    return stored, notes
