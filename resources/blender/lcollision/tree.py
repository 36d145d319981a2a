# SPDX-License-Identifier: GPL-3.0-or-later
"""The bones of an armature that move meshes, and their hierarchy.

In rigs, deforming bones often have parents that do not deform but follow other bones or
constraints. The hierarchy skips those and keeps the deforming bone that moves with them.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import bpy
import numpy as np

_SAME = 1e-4
"""Bones whose ends at rest are within this share of the longest bone coincide."""

_HOLDING = {"CHILD_OF", "COPY_TRANSFORMS", "ARMATURE"}
"""Constraints by which an object or bone follows a bone like a child."""


@dataclass(frozen=True)
class Tree:
    """The hierarchy of bones that move meshes.

    Attributes
    ----------
    bones : J names, parents first
    parents : (J,) int32 array, -1 for none
    own_parents : (J,) int32 array: the nearest ancestor in Blender among the bones, -1 for none
    is_next : whether that is the direct parent in Blender
    moves : (J,) whether the bone, or one below it, has vertices
    """

    bones: list[str]
    parents: np.ndarray
    own_parents: np.ndarray
    is_next: list[bool]
    moves: np.ndarray


def is_deformed_by(mesh: bpy.types.Object, armature: bpy.types.Object) -> bool:
    """Return whether an armature deforms a mesh, by a modifier or as its parent."""
    if mesh.parent == armature and mesh.parent_type == "ARMATURE":
        return True
    return any(one.type == "ARMATURE" and one.object == armature for one in mesh.modifiers)


def carrier_of(item: bpy.types.Object, armature: bpy.types.Object) -> str | None:
    """Return the bone that an object, or an ancestor of it, is parented to or held by."""
    while item is not None:
        for one in item.constraints:
            bone = _held_by(one, armature)
            if bone is not None and one.influence > 0.0 and not one.mute:
                return bone
        if item.parent == armature and item.parent_type == "BONE":
            name = item.parent_bone
            return name if name in armature.data.bones else None
        item = item.parent
    return None


def is_moved(mesh: bpy.types.Object, armature: bpy.types.Object) -> bool:
    """Return whether bones of an armature deform or carry a mesh."""
    return is_deformed_by(mesh, armature) or carrier_of(mesh, armature) is not None


def _held_by(constraint: bpy.types.Constraint, armature: bpy.types.Object) -> str | None:
    """Return the bone of an armature that a constraint makes its owner follow."""
    if constraint.type not in _HOLDING:
        return None
    targets = constraint.targets if constraint.type == "ARMATURE" else [constraint]
    bones = [one.subtarget for one in targets if one.target == armature]
    return next((name for name in bones if name in armature.data.bones), None)


def read_tree(
    armature: bpy.types.Object, meshes: Iterable[bpy.types.Object], carriers: set[str]
) -> Tree:
    """Find the hierarchy of the bones that deform or carry meshes.

    A bone's parent is its nearest ancestor among these bones, or the one of them that coincides
    at rest with an ancestor that is not. A root that moves something hangs on the bone nearest to
    its head, so that limbs follow the trunk.

    Parameters
    ----------
    carriers : names of bones
    """
    bones = armature.data.bones
    chosen = [one for one in bones if one.use_deform or one.name in carriers]
    chosen.sort(key=lambda bone: len(bone.parent_recursive))
    number = {bone.name: at for at, bone in enumerate(chosen)}
    near = _SAME * max((bone.length for bone in bones), default=0.0)
    heads = np.array([bone.head_local for bone in chosen]).reshape(-1, 3)
    tails = np.array([bone.tail_local for bone in chosen]).reshape(-1, 3)
    above: dict[int, int] = {}

    def hangs_on(low: int, high: int) -> bool:
        while high >= 0:
            if high == low:
                return True
            high = above.get(high, -1)
        return False

    def next_up(at: int) -> int:
        own, passed = chosen[at].parent, set()
        while own is not None and own.name not in passed:
            passed.add(own.name)
            if own.name in number:
                return number[own.name]
            apart = np.maximum(
                np.linalg.norm(heads - np.array(own.head_local), axis=1),
                np.linalg.norm(tails - np.array(own.tail_local), axis=1),
            )
            for other in np.flatnonzero(apart <= near).tolist():
                if not hangs_on(at, other):
                    return other
            held = (_held_by(one, armature) for one in armature.pose.bones[own.name].constraints)
            own = own.parent or bones.get(next(filter(None, held), ""))
        return -1

    for at in range(len(chosen)):
        above[at] = next_up(at)
    moving = _weighted(chosen, meshes) | {number[name] for name in carriers}
    _join_roots(above, moving, heads, tails)
    order: list[int] = []

    def place(at: int) -> None:
        if at >= 0 and at not in placed:
            place(above[at])
            placed.add(at)
            order.append(at)

    placed: set[int] = set()
    for at in range(len(chosen)):
        place(at)
    names = [chosen[at].name for at in order]
    to = {at: place for place, at in enumerate(order)}
    parents = np.array([to.get(above[at], -1) for at in order], dtype=np.int32)
    moves = np.array([at in moving for at in order], dtype=np.bool_)
    for at in range(len(order) - 1, -1, -1):
        if parents[at] >= 0:
            moves[parents[at]] |= moves[at]
    own = [
        next((to[number[one.name]] for one in bone.parent_recursive if one.name in number), -1)
        for bone in (chosen[at] for at in order)
    ]
    return Tree(
        names,
        parents,
        np.array(own, dtype=np.int32),
        [
            bones[name].parent is not None and at >= 0 and bones[name].parent.name == names[at]
            for name, at in zip(names, own, strict=True)
        ],
        moves,
    )


def _weighted(chosen: list[bpy.types.Bone], meshes: Iterable[bpy.types.Object]) -> set[int]:
    """Return the indices of bones that vertices are weighted to."""
    names = {bone.name: at for at, bone in enumerate(chosen)}
    groups = {name for mesh in meshes for name in _weighted_groups(mesh)}
    return {names[name] for name in groups if name in names}


_groups: dict[tuple, frozenset[str]] = {}
"""Cache of `_weighted_groups`, which the panel calls at each redraw."""


def _weighted_groups(mesh: bpy.types.Object) -> frozenset[str]:
    """Return the names of the vertex groups with weighted vertices."""
    names = tuple(one.name for one in mesh.vertex_groups)
    key = (mesh.data.session_uid, len(mesh.data.vertices), names)
    if key not in _groups:
        used = {one.group for vertex in mesh.data.vertices for one in vertex.groups if one.weight}
        _groups[key] = frozenset(name for at, name in enumerate(names) if at in used)
    return _groups[key]


def _join_roots(
    above: dict[int, int], moving: set[int], heads: np.ndarray, tails: np.ndarray
) -> None:
    """Join all trees of bones that move something to the trunk, each at the bone nearest to it.

    The trunk is the tree with the least sum of distances to the roots of all trees.
    """

    def top(at: int) -> int:
        """Return the highest ancestor of a bone, itself included, that moves something."""
        highest = at
        while at >= 0:
            highest, at = (at if at in moving else highest), above[at]
        return highest

    trees: dict[int, list[int]] = {}
    for at in sorted(moving):
        trees.setdefault(top(at), []).append(at)
    if len(trees) < 2:
        return
    roots = list(trees)
    away = [
        _distances(heads[roots], heads[own], tails[own]).min(axis=1).sum() for own in trees.values()
    ]
    trunk = roots[int(np.argmin(away))]
    joined, loose = trees.pop(trunk), list(trees)
    while loose:
        apart = _distances(heads[loose], heads[joined], tails[joined])
        nearest = int(apart.min(axis=1).argmin())
        root = loose.pop(nearest)
        above[root] = joined[int(apart[nearest].argmin())]
        joined = joined + trees[root]


def _distances(points: np.ndarray, heads: np.ndarray, tails: np.ndarray) -> np.ndarray:
    """Return the (N, M) distances of (N, 3) points from bones with (M, 3) heads and tails."""
    bones, from_heads = tails - heads, points[:, None] - heads
    squares = np.maximum((bones * bones).sum(axis=1), 1e-30)
    share = np.clip((from_heads * bones).sum(axis=2) / squares, 0.0, 1.0)
    return np.linalg.norm(from_heads - share[..., None] * bones, axis=2)
