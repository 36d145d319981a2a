"""Skeletons in motion as BVH files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.formats.bvh import angles_near
from lcollision_core.meshes.topology import FloatArray

_AXES = "ZXY"
"""The order of the rotations, the most common one."""

_STILL = 1e-6
"""Of the skeleton's extent: a joint that moves less, seen from its parent, has a fixed place."""

_PER_JOINT = "Xposition Yposition Zposition ", " ".join(f"{axis}rotation" for axis in _AXES)


def bvh_bytes(
    names: Sequence[str],
    parents: npt.NDArray[np.int64],
    rest: FloatArray,
    ends: FloatArray,
    turns: FloatArray,
    places: FloatArray,
    frame_time: float,
) -> bytes:
    """Return a BVH file, in UTF-8.

    Joints that move against their parents have channels for that, as the root has.

    Parameters
    ----------
    names : J names; what a BVH file cannot hold of them is replaced
    parents : (J,) -1 for the one root; parents come before children
    rest : (J, 3) where the joints are at rest, all of them turned alike
    ends : (J, 3) where bones end, seen from their joints; used where nothing hangs on a joint
    turns : (T, J, 3, 3) rotations of the joints against their parents
    places : (T, J, 3) of the joints seen from their parents; the root in the world
    frame_time : seconds
    """
    order, depths = depth_first(parents)
    offsets = rest - np.where(parents[:, None] >= 0, rest[parents], 0.0)
    still = _STILL * max(float(np.ptp(rest, axis=0).max()), 1e-12)
    has_place = (np.abs(places - offsets) > still).any(axis=(0, 2)) | (parents < 0)
    lines = ["HIERARCHY"]
    for joint, depth, next_depth in zip(order, depths, [*depths[1:], 0], strict=True):
        tabs = "\t" * depth
        lines += [f"{tabs}{'JOINT' if depth else 'ROOT'} {_name(names[joint], joint)}", f"{tabs}{{"]
        lines.append(f"{tabs}\tOFFSET {_row(offsets[joint])}")
        count, place = (6, _PER_JOINT[0]) if has_place[joint] else (3, "")
        lines.append(f"{tabs}\tCHANNELS {count} {place}{_PER_JOINT[1]}")
        if next_depth <= depth:
            end = _row(ends[joint])
            lines += [f"{tabs}\tEnd Site", f"{tabs}\t{{", f"{tabs}\t\tOFFSET {end}", f"{tabs}\t}}"]
        lines += ["\t" * level + "}" for level in range(depth, next_depth - 1, -1)]
    lines += ["MOTION", f"Frames: {len(turns)}", f"Frame Time: {frame_time:.9f}"]
    for angles, placed in zip(_smooth_angles(turns), places, strict=True):
        numbers = (
            number
            for joint in order
            for row in ((placed[joint], angles[joint]) if has_place[joint] else (angles[joint],))
            for number in row.tolist()
        )
        lines.append(" ".join(f"{number:.6f}" for number in numbers))
    return ("\n".join(lines) + "\n").encode()


def depth_first(parents: npt.NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Return the joints in the order of a file, and how deep each of them hangs."""
    children: list[list[int]] = [[] for _ in parents]
    waiting: list[int] = []
    for joint, parent in enumerate(parents.tolist()):
        (children[parent] if parent >= 0 else waiting).append(joint)
    order: list[int] = []
    depths = np.zeros(len(parents), dtype=np.int64)
    while waiting:
        joint = waiting.pop()
        order.append(joint)
        depths[children[joint]] = depths[joint] + 1
        waiting += children[joint][::-1]
    return order, depths[order].tolist()


def _smooth_angles(turns: FloatArray) -> Iterator[FloatArray]:
    """Yield the (J, 3) degrees of each frame, as near to those of the frame before as they can."""
    angles = np.zeros((turns.shape[1], len(_AXES)))
    for frame in turns:
        angles = angles_near(frame, _AXES, angles)
        yield angles


def _name(name: str, joint: int) -> str:
    """Return a name as words of one line, without braces."""
    return " ".join(re.sub(r"[{}\x00-\x1f\x7f]", " ", name).split()) or f"joint {joint}"


def _row(numbers: FloatArray) -> str:
    return " ".join(f"{number:.6f}" for number in numbers)
