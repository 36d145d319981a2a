"""Ends of limbs that hang beside their limb in the file, as what inverse kinematics aims at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lcollision_core.characters.character import Rig
from lcollision_core.meshes.formats.scene import parents_first
from lcollision_core.meshes.topology import FloatArray, Topology

_NEAR, _NEARLY = 0.05, 1.5
"""Normalised length: a piece of its own, as of a robot, is joined to what is nearest, if that is
nearer than this, and to what is hardly farther."""

_AT_END = 0.2
"""Normalised length: a loose joint is no farther from the skin of the limb that it ends."""

_SAME_PLACE = 0.02
"""Normalised length: of two joints that are in one place."""

_LEAST_CHAIN = 2
"""Joints that lead vertices, of a limb: a knee at least bends before its end."""


def with_ends_on_limbs(
    rig: Rig, topology: Topology, rest_vertices: FloatArray, body_size: float
) -> tuple[Rig, tuple[str, ...]]:
    """Hang each loose end of a limb on the limb, so that it follows, and pulls it by a drag.

    A paw or foot is loose where it hangs on what all hangs on, its surface goes on in another
    joint's that ends a limb, and in that of none that it hangs on. What poses say of the joints, as
    global transforms, is as before.

    Parameters
    ----------
    rig, topology, rest_vertices : of the character, in its unit
    body_size : in that unit

    Returns
    -------
    rig : its joints may be in another order; see `Rig.file_parents`
    notes : a sentence that names the ends, if there are any
    """
    parents = rig.parents.tolist()
    led_by = rig.joint_of[np.arange(len(rest_vertices)), rig.weights.argmax(axis=1)]
    carries = np.eye(len(parents), dtype=np.bool_)
    for joint in range(len(parents) - 1, -1, -1):
        if parents[joint] >= 0:
            carries[parents[joint]] |= carries[joint]
    n_led = np.bincount(led_by, minlength=len(parents))
    found: dict[int, int] = {}
    for joint in _hanging_on_nothing(rig, n_led, carries):
        inside = carries[joint][led_by]
        near = _NEAR * body_size
        joined = _joined(inside, led_by, topology, rest_vertices, len(parents), near)
        if not joined.any() or joined[carries[:, joint]].any():
            continue
        end = _end(rig, joined, joint, n_led, carries, _SAME_PLACE * body_size)
        away = np.linalg.norm(rest_vertices[led_by == end] - rig.rest[joint, :3, 3], axis=1)
        way, common = carries[:, end], carries[:, end] & carries[:, joint]
        branch = int(np.flatnonzero(common)[-1]) if common.any() else -1
        if (
            parents[joint] == branch
            and int((n_led[way & ~common] > 0).sum()) >= _LEAST_CHAIN
            and n_led[carries[end]].sum() == n_led[end]
            and away.min() <= _AT_END * body_size
        ):
            found[joint] = end
    if not found:
        return rig, ()
    hung = rig.parents.copy()
    hung[list(found)] = list(found.values())
    names = ", ".join(
        f"{rig.joint_names[joint]} with {rig.joint_names[end]}" for joint, end in found.items()
    )
    note = (
        "some joints hang beside the limb that they end, as targets of inverse kinematics; here "
        f"they move with it: {names}"
    )
    return _in_order(replace(rig, parents=hung, file_parents=rig.parents)), (note,)


def _hanging_on_nothing(
    rig: Rig, n_led: npt.NDArray[np.int64], carries: npt.NDArray[np.bool_]
) -> list[int]:
    """Return the joints that carry few of the vertices, below joints that lead none."""
    carried = carries @ n_led
    return [
        joint
        for joint, parent in enumerate(rig.parents.tolist())
        if 0 < 2 * carried[joint] < n_led.sum()
        and (parent < 0 or not n_led[carries[:, parent]].any())
    ]


def _joined(
    inside: npt.NDArray[np.bool_],
    led_by: npt.NDArray[np.int32],
    topology: Topology,
    rest_vertices: FloatArray,
    n_joints: int,
    near: float,
) -> npt.NDArray[np.int64]:
    """Count of each joint the vertices at which some vertices' surface goes on, (J,).

    Where it goes on nowhere, those that are near.
    """
    edges = topology.edges
    across = edges[inside[edges[:, 0]] != inside[edges[:, 1]]]
    beyond = np.unique(across[~inside[across]])
    if not len(beyond):
        used = topology.used_vertices
        others, own = used[~inside[used]], used[inside[used]]
        if len(own) and len(others):
            away, _ = cKDTree(rest_vertices[own]).query(rest_vertices[others])
            beyond = others[away <= min(near, _NEARLY * away.min())]
    joined: npt.NDArray[np.int64] = np.bincount(led_by[beyond], minlength=n_joints)
    return joined


def _end(
    rig: Rig,
    joined: npt.NDArray[np.int64],
    loose: int,
    n_led: npt.NDArray[np.int64],
    carries: npt.NDArray[np.bool_],
    near: float,
) -> int:
    """Return the last joint of a limb at which a loose one's surface goes on, or its place is."""
    away = np.linalg.norm(rig.rest[:, :3, 3] - rig.rest[loose, :3, 3], axis=1)
    below = carries[joined.argmax()] & (n_led > 0) & ((joined > 0) | (away <= near))
    return int(np.flatnonzero(below)[-1])


def _in_order(rig: Rig) -> Rig:
    """Return a rig whose joints come after their parents again."""
    order = np.array(parents_first(rig.parents))
    number = np.empty(len(order) + 1, dtype=np.int64)
    number[order], number[-1] = np.arange(len(order)), -1
    assert rig.file_parents is not None
    return replace(
        rig,
        joint_names=tuple(rig.joint_names[joint] for joint in order),
        parents=number[rig.parents[order]],
        file_parents=number[rig.file_parents[order]],
        rest=rig.rest[order],
        nodes=rig.nodes[order],
        joint_of=number[rig.joint_of].astype(np.int32),
        stretch=None if rig.stretch is None else rig.stretch[order],
    )
