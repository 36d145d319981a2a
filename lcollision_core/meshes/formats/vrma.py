"""VRMA: a VRM animation, the motion of a humanoid skeleton without a body."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.gltf_document import GltfDocument
from lcollision_core.meshes.formats.gltf_extensions import human_bones
from lcollision_core.meshes.formats.gltf_scene import read_nodes
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.regular_files import read_regular

VRMA_SUFFIX = ".vrma"

_MOST_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class HumanoidMotion:
    """A skeleton in motion, as `retargeting.SkeletonMotion` asks for it, in metres.

    Attributes
    ----------
    names : J bones of VRM, as "leftUpperArm"
    parents : (J,) int64 array, -1 for a root; parents come before children
    offsets : (J, 3) where each bone is at rest, seen from its parent
    ends : (J, 3), NaN: the file does not say where bones end
    times : (T,) in seconds
    """

    names: tuple[str, ...]
    parents: npt.NDArray[np.int64]
    offsets: FloatArray
    ends: FloatArray
    times: FloatArray
    _turns: FloatArray
    _places: FloatArray

    def __len__(self) -> int:
        """Return T, the number of frames."""
        return len(self.times)

    def turns(self) -> FloatArray:
        """Return how each bone is turned from its rest, against its parent: (T, J, 3, 3)."""
        return self._turns.copy()

    def places(self) -> FloatArray:
        """Return where each bone is, seen from its parent: (T, J, 3); a root in the world."""
        return self._places.copy()


def read_vrma(path: str | os.PathLike[str], fps: float | None = None) -> HumanoidMotion:
    """Read the first animation of a VRMA file.

    Parameters
    ----------
    fps : frames a second; None for the rate of the file's keys

    Raises
    ------
    MeshFileError : the file is missing, damaged, or has no humanoid bones or no animation.
    """
    try:
        return _motion(GltfDocument(read_regular(path, _MOST_BYTES), Path(path)), fps)
    except (MeshFileError, OSError, ValueError) as error:
        raise MeshFileError.unreadable(path, error, "export the animation again") from error


def _motion(document: GltfDocument, fps: float | None) -> HumanoidMotion:
    nodes, bones = read_nodes(document), human_bones(document)
    order = [node for node in nodes.order if node in bones]
    if not order or not nodes.clips:
        raise MeshFileError("it has no " + ("animation" if order else "humanoid bones"))
    clip = nodes.clips[0]
    times = clip.times(fps or (clip.rate if len(clip.key_times) > 1 else None))
    moved = clip.sample(times).transforms
    number = {node: joint for joint, node in enumerate(order)}
    parents = np.full(len(order), -1, dtype=np.int64)
    for joint, node in enumerate(order):
        above = int(nodes.parents[node])
        while above >= 0 and above not in number:
            above = int(nodes.parents[above])
        parents[joint] = number.get(above, -1)
    rest, moved = nodes.rest[order], moved[:, order]
    world = moved[..., :3, :3] @ np.linalg.inv(rest[:, :3, :3])
    offsets, turns, places = rest[:, :3, 3].copy(), world.copy(), moved[..., :3, 3].copy()
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            offsets[joint] -= rest[parent, :3, 3]
            back = np.swapaxes(world[:, parent], 1, 2)
            turns[:, joint] = back @ world[:, joint]
            way = moved[:, joint, :3, 3] - moved[:, parent, :3, 3]
            places[:, joint] = np.einsum("txy,ty->tx", back, way)
    ends = np.full(offsets.shape, np.nan)
    names = tuple(bones[node] for node in order)
    return HumanoidMotion(names, parents, offsets, ends, times - times[0], turns, places)
