"""Humanoid skeletons in motion as VRM animations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lcollision_core.meshes.formats.gltf_document import GltfDocument
from lcollision_core.meshes.topology import FloatArray

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
