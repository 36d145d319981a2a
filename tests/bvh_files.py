"""BVH files of rigs in motion, written by code independent of the reader."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from tests.rigged_shapes import FloatArray


def bvh_text(
    names: Sequence[str],
    parents: Sequence[int],
    places: FloatArray,
    turns: FloatArray,
    roots: FloatArray,
    *,
    order: str = "ZXY",
    fps: float = 30.0,
    ends: Mapping[int, Sequence[float]] | None = None,
) -> str:
    """Return a BVH file.

    Parameters
    ----------
    names, parents, places : J joints, parents first, and their (J, 3) rest positions, in the file's
        axes and unit
    turns : (T, J, 3, 3) rotations of each joint relative to its parent
    roots : (T, 3) positions of the root
    order : of the rotation channels
    ends : ends of joints' bones, relative to the joints
    """
    children: list[list[int]] = [[] for _ in names]
    for joint, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(joint)
    lines, listed = ["HIERARCHY"], []

    def joint_lines(joint: int, depth: int) -> None:
        indent, parent = "\t" * depth, parents[joint]
        offset = places[joint] - (places[parent] if parent >= 0 else 0.0)
        rotations = " ".join(f"{axis}rotation" for axis in order)
        channels = (
            f"6 Xposition Yposition Zposition {rotations}" if parent < 0 else f"3 {rotations}"
        )
        lines.append(f"{indent}{'ROOT' if parent < 0 else 'JOINT'} {names[joint]}")
        lines.append(f"{indent}{{")
        lines.append(f"{indent}\tOFFSET " + " ".join(f"{x:.6f}" for x in offset))
        lines.append(f"{indent}\tCHANNELS {channels}")
        listed.append(joint)
        for child in children[joint]:
            joint_lines(child, depth + 1)
        if not children[joint]:
            end = (ends or {}).get(joint, (0.0, 1.0, 0.0))
            lines.append(f"{indent}\tEnd Site\n{indent}\t{{")
            lines.append(f"{indent}\t\tOFFSET " + " ".join(f"{x:.6f}" for x in end))
            lines.append(f"{indent}\t}}")
        lines.append(f"{indent}}}")

    joint_lines(list(parents).index(-1), 0)
    lines += ["MOTION", f"Frames: {len(turns)}", f"Frame Time: {1.0 / fps:.7f}"]
    for frame, root in zip(turns, roots, strict=True):
        numbers = [*root]
        for joint in listed:
            numbers += Rotation.from_matrix(frame[joint]).as_euler(order, degrees=True).tolist()
        lines.append(" ".join(f"{number:.6f}" for number in numbers))
    return "\n".join(lines) + "\n"


def joint_places(text: str) -> tuple[list[str], FloatArray, FloatArray, float]:
    """Read a BVH file independently of the project's reader.

    Returns
    -------
    names : of J joints, in the file's order
    rest, places : (J, 3) rest positions, and (T, J, 3) world positions
    frame_time : seconds
    """
    head, _, tail = text.partition("MOTION")
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    open_: list[int | None] = []
    for line in map(str.strip, head.splitlines()):
        word, _, rest_of_line = line.partition(" ")
        if word in ("ROOT", "JOINT"):
            parents.append(next((at for at in reversed(open_) if at is not None), -1))
            names.append(rest_of_line)
            open_.append(len(names) - 1)
        elif word == "End":
            open_.append(None)
        elif word == "OFFSET" and open_[-1] is not None:
            offsets.append([float(number) for number in rest_of_line.split()])
        elif word == "CHANNELS":
            channels.append(rest_of_line.split()[1:])
        elif word == "}":
            open_.pop()
    assert open_ == []
    n_frames, frame_time, *rows = (line.split(":")[-1] for line in tail.strip().splitlines())
    assert len(rows) == int(n_frames)
    rest = np.array(offsets)
    for joint, parent in enumerate(parents):
        rest[joint] += rest[parent] if parent >= 0 else 0.0
    places = np.empty((len(rows), len(names), 3))
    for frame, row in enumerate(rows):
        numbers = iter(map(float, row.split()))
        turns: list[FloatArray] = []
        for joint, parent in enumerate(parents):
            place, turn = np.array(offsets[joint]), np.eye(3)
            for channel in channels[joint]:
                number, axis = next(numbers), "XYZ".index(channel[0])
                if channel.endswith("position"):
                    place[axis] = number
                else:
                    turn = (
                        turn
                        @ Rotation.from_rotvec(np.radians(number) * np.eye(3)[axis]).as_matrix()
                    )
            above = turns[parent] if parent >= 0 else np.eye(3)
            base = places[frame, parent] if parent >= 0 else 0.0
            turns.append(above @ turn)
            places[frame, joint] = base + above @ place
        assert next(numbers, None) is None
    return names, rest, places, float(frame_time)
