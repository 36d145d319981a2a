"""Read and write VRMA (VRM animation) files: the motion of a humanoid skeleton without a body."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import scipy

from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.read import human_bones, read_nodes
from lcollision_core.files.gltf.schema import GltfDocument, extension_of, inner
from lcollision_core.files.motion.skeleton import SkeletonMotion, motion_of_nodes
from lcollision_core.files.safe import read_regular
from lcollision_core.files.scene.scene import left_out_note, parents_first
from lcollision_core.files.scene.transforms import signs_on_one_side
from lcollision_core.meshes.topology import FloatArray

_MOST_BYTES = 1 << 30


def read_vrma(path: str | os.PathLike[str], fps: float | None = None) -> SkeletonMotion:
    """Read the first animation of a VRMA file.

    Parameters
    ----------
    fps : frames per second; None for the rate of the file's keys

    Raises
    ------
    MeshFileError : the file is missing, damaged, or has no humanoid bones or no animation.
    """
    try:
        return _motion(GltfDocument(read_regular(path, _MOST_BYTES), Path(path)), fps)
    except (MeshFileError, OSError, ValueError) as error:
        raise MeshFileError.unreadable(path, error, "export the animation again") from error


def _motion(document: GltfDocument, fps: float | None) -> SkeletonMotion:
    scene, bones = read_nodes(document), human_bones(document)
    order = [node for node in parents_first(scene.parents) if node in bones]
    if not order:
        raise MeshFileError("it has no humanoid bones")
    if not scene.clips:
        raise MeshFileError("it has no animation")
    names = [bones[node] for node in order]
    motion = motion_of_nodes(scene, scene.clips[0], order, names, fps)
    return replace(motion, notes=tuple(_left_out(document, len(scene.clips))))


def _left_out(document: GltfDocument, n_clips: int) -> Iterator[str]:
    """Yield notes on the content of a VRM animation that is not read."""
    extension = extension_of(document.description, _EXTENSION)
    expressions = inner(extension, "expressions")
    named = [name for kind in ("preset", "custom") for name in inner(expressions, kind)]
    if named:
        yield left_out_note("facial expressions are left out", map(str, named))
    if extension.get("lookAt"):
        yield "the gaze (lookAt) is left out"
    if n_clips > 1:
        yield f"only the first of its {n_clips} animations is read, as VRM defines"


_EXTENSION = "VRMC_vrm_animation"


def vrma_bytes(
    names: Sequence[str],
    parents: Sequence[int],
    offsets: FloatArray,
    turns: FloatArray,
    hips: FloatArray,
    times: FloatArray,
) -> bytes:
    """Encode a VRM animation 1.0, a GLB file with one clip of linear keys.

    Parameters
    ----------
    names : names of B VRM bones, such as "leftUpperArm", the hips first
    parents : parents of the bones, -1 for the hips; parents come before children
    offsets : (B, 3) positions of the bones in the T pose relative to their parents, metres, y up
    turns : (T, B, 3, 3) rotations of the bones from the T pose, relative to their parents
    hips : (T, 3) positions of the hips, metres
    times : (T,) in seconds, ascending

    Raises
    ------
    MeshFileError : the file would be too large.
    """
    file = GltfDocument.empty(Path())
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()}
        for name, offset in zip(names, offsets, strict=True)
    ]
    for number, parent in enumerate(parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(number)
    at = file.add_array((times - times[0])[:, None], has_bounds=True)
    animation: dict[str, Any] = {"channels": [], "samplers": []}
    file.add_channel(animation, at, 0, "translation", hips)
    for number in range(len(names)):
        turned = scipy.spatial.transform.Rotation.from_matrix(turns[:, number]).as_quat()
        # Make interpolation between keys take the shorter arc.
        turned *= signs_on_one_side(turned)[:, None]
        file.add_channel(animation, at, number, "rotation", turned)
    bones = {name: {"node": number} for number, name in enumerate(names)}
    file.description |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "animations": [animation],
        "extensionsUsed": [_EXTENSION],
        "extensions": {_EXTENSION: {"specVersion": "1.0", "humanoid": {"humanBones": bones}}},
    }
    return file.encoded()
