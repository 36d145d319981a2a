"""VRMA: a VRM animation, the motion of a humanoid skeleton without a body; read and written."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.read import human_bones, read_nodes
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.files.safe import read_regular
from lcollision_core.meshes.topology import FloatArray

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


_EXTENSION = "VRMC_vrm_animation"


def vrma_bytes(
    names: Sequence[str],
    parents: Sequence[int],
    offsets: FloatArray,
    turns: FloatArray,
    hips: FloatArray,
    times: FloatArray,
) -> bytes:
    """Return a VRM animation 1.0, a GLB file with one clip of linear keys.

    Parameters
    ----------
    names : B bones of VRM, as "leftUpperArm", the hips first
    parents : of the bones, -1 for the hips; parents come before children
    offsets : (B, 3) where each bone is in the T pose, seen from its parent, in metres, y up
    turns : (T, B, 3, 3) rotations of the bones from the T pose, against their parents
    hips : (T, 3) places of the hips, in metres
    times : (T,) in seconds, ascending

    Raises
    ------
    MeshFileError : the file would be too large.
    """
    asset = {"asset": {"version": "2.0", "generator": "LCollision"}}
    file = GltfDocument(json.dumps(asset).encode(), Path()).editable()
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()}
        for name, offset in zip(names, offsets, strict=True)
    ]
    for number, parent in enumerate(parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(number)
    at = file.add_array((times - times[0])[:, None], has_bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def move(node: int, path: str, values: FloatArray) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": at, "output": file.add_array(values), "interpolation": "LINEAR"})

    move(0, "translation", hips)
    for number in range(len(names)):
        turned = Rotation.from_matrix(turns[:, number]).as_quat()
        # The shorter way from key to key.
        flips = np.cumprod(np.where((turned[1:] * turned[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
        turned[1:] *= flips[:, None]
        move(number, "rotation", turned)
    bones = {name: {"node": number} for number, name in enumerate(names)}
    file.description |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "animations": [{"channels": channels, "samplers": samplers}],
        "extensionsUsed": [_EXTENSION],
        "extensions": {_EXTENSION: {"specVersion": "1.0", "humanoid": {"humanBones": bones}}},
    }
    return file.encoded()
