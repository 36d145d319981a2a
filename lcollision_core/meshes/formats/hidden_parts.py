"""Parts of a scene that its rest pose hides by scale, as characters hide what they do not carry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.scene import (
    Part,
    Scene,
    ScenePoses,
    character_parts,
    is_mirrored,
    left_out_note,
    parents_first,
    with_parts,
)
from lcollision_core.meshes.formats.transforms import are_regular, is_regular
from lcollision_core.meshes.topology import FloatArray

_HIDDEN = 1e-3
"""Of the scale that a clip gives a node: what is scaled to less along an axis is hidden."""

_INVISIBLE = 1e-5
"""Of the size of a scene's largest part: what is smaller is not seen."""

_MOST_FRAMES = 1000


def shown_scene(scene: Scene) -> Scene:
    """Show at rest what a clip shows, and leave out scenery and what is never seen; notes say so.

    Faces of a part that is scaled to nothing have no area, so its rest pose could not be checked.
    """
    carriers = _carriers(scene)
    for node in parents_first(scene.parents):
        if node in carriers and node not in scene.revealed:
            scene = _revealed(scene, node)
    scene = with_parts(scene, character_parts(scene), "as no joint carries it")
    return with_parts(scene, _seen_parts(scene), "as its scale is zero")


def _carriers(scene: Scene) -> set[int]:
    """Return the nodes that move parts, and those above them."""
    found: set[int] = set()
    for part in scene.parts:
        for bone in part.bones.tolist():
            while bone >= 0 and bone not in found:
                found.add(bone)
                bone = int(scene.parents[bone])
    return found


def _revealed(scene: Scene, node: int) -> Scene:
    """Place a node as a clip does, with all below it, if the rest pose alone hides it by scale."""
    rest = scene.rest.transforms
    parent = int(scene.parents[node])
    above = np.eye(4) if parent < 0 else rest[0, parent]
    least = _least_scale(rest, node, parent)[0]
    if not least < _HIDDEN or not is_regular(above):
        return scene
    frames: list[tuple[float, str, FloatArray]] = []
    for clip in scene.clips:
        if node in clip.moved:
            try:
                every = len(clip.key_times) // _MOST_FRAMES + 1
                transforms = clip.sample(clip.key_times[::every]).transforms
            except MeshFileError:
                continue  # A damaged clip is refused where it is asked for.
            scales = _least_scale(transforms, node, parent).tolist()
            frames += zip(scales, [clip.name] * len(scales), transforms, strict=True)
    greatest = max((scale for scale, _, _ in frames), default=0.0)
    if not least < _HIDDEN * greatest:
        return scene
    # Not one of those in which it just grows, or beyond its size.
    shown = sorted(
        (frame for frame in frames if frame[0] >= 0.5 * greatest), key=lambda one: one[0]
    )
    _, clip_name, frame = shown[len(shown) // 2]
    below = [node]
    for other in parents_first(scene.parents):
        if scene.parents[other] in below:
            below.append(other)
    placed = rest.copy()
    placed[0, below] = above @ np.linalg.solve(_above(frame[None], parent), frame[below])
    parts = tuple(_wound(part, rest[0], placed[0], below) for part in scene.parts)
    names = [part.mesh for part in parts if not set(part.bones.tolist()).isdisjoint(below)]
    note = f"hidden at rest by its scale, shown as in the clip {clip_name!r}"
    joints = {bone for part in parts if part.is_skinned for bone in part.bones.tolist()}
    if not joints.isdisjoint(_ancestors(scene, node)):
        # What is only shown and hidden is carried by the joint that it hangs on.
        clips = tuple(replace(clip, moved=clip.moved - {node}) for clip in scene.clips)
        scene = replace(scene, clips=clips)
    return replace(
        scene,
        rest=ScenePoses(placed, scene.rest.weights),
        parts=parts,
        notes=(*scene.notes, left_out_note(note, names)),
        revealed=(*scene.revealed, *below),
    )


def _ancestors(scene: Scene, node: int) -> list[int]:
    found = []
    while (node := int(scene.parents[node])) >= 0:
        found.append(node)
    return found


def _above(transforms: FloatArray, parent: int) -> FloatArray:
    return transforms[:, parent] if parent >= 0 else np.eye(4)[None]


def _least_scale(transforms: FloatArray, node: int, parent: int) -> FloatArray:
    """Return the (N,) least scales of a node relative to its parent; 0 where that has none."""
    above = np.broadcast_to(_above(transforms, parent), (len(transforms), 4, 4))
    regular = are_regular(above)
    least = np.zeros(len(transforms))
    local = np.linalg.solve(above[regular], transforms[regular, node])
    least[regular] = np.linalg.norm(local[:, :3, :3], axis=1).min(axis=1)
    return least


def _wound(part: Part, before: FloatArray, after: FloatArray, moved: Sequence[int]) -> Part:
    """Return a part whose faces look outwards as some of its nodes are placed now."""
    if set(part.bones.tolist()).isdisjoint(moved):
        return part
    was, is_now = (
        is_mirrored(placed[part.bones] @ part.bind, part.bone_of, part.weights)
        for placed in (before, after)
    )
    return part if was == is_now else replace(part, faces=part.faces[:, [0, 2, 1]])


def _seen_parts(scene: Scene) -> list[int]:
    """Return which parts are not scaled to nothing at rest; all where none is seen.

    Beside a skinned body, what is flat and on nothing that is not could not be posed.
    """
    rest = scene.rest.transforms[0]
    sizes = np.array([_largest_size(part, rest) for part in scene.parts])
    seen = sizes >= _INVISIBLE * sizes.max()
    if any(part.is_skinned for part in scene.parts):
        for number, part in enumerate(scene.parts):
            carriers = [part.node, *_ancestors(scene, part.node)]
            seen[number] &= part.is_skinned or any(is_regular(rest[node]) for node in carriers)
    return [number for number, is_seen in enumerate(seen) if is_seen or not seen.any()]


def _largest_size(part: Part, transforms: FloatArray) -> float:
    """Return a bound of how large a part is."""
    used = np.unique(part.bone_of[part.weights > 0.0])
    turns = transforms[part.bones[used]] @ part.bind[used]
    # Too large a number is refused where the vertices are.
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.linalg.norm(np.ptp(turns @ np.append(part.points.mean(axis=0), 1.0), axis=0))
        sizes = np.linalg.norm(turns[:, :3, :3], axis=(1, 2)) * np.linalg.norm(
            np.ptp(part.points, axis=0)
        )
    return float(np.nan_to_num(spread + sizes.max(), nan=np.inf))
