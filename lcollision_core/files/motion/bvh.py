"""Read and write BVH files: a skeleton and its motion, as from motion capture."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import MeshFileError
from lcollision_core.files.mesh.text import number_rows
from lcollision_core.files.motion.skeleton import SkeletonMotion
from lcollision_core.files.safe import read_regular
from lcollision_core.meshes.topology import FloatArray

_MOST_BYTES = 1 << 30
_MOST_JOINTS = 5000
_MOST_NUMBERS = 500_000_000
_LARGEST = 1e9
"""Largest number, so that products of rotations stay finite."""

_AGAIN = "export the motion again"

_MOTION = re.compile(r"(?:^|[\r\n])[ \t]*MOTION[ \t]*(?![^\r\n])")
"""Matches MOTION only on a line of its own, as a joint may have this name too."""

_AXES = {"Xrotation": 0, "Yrotation": 1, "Zrotation": 2}
_PLACES = {"Xposition": 0, "Yposition": 1, "Zposition": 2}
_SCALES = {"Xscale": 0, "Yscale": 1, "Zscale": 2}
_CHANNELS = {name.casefold(): name for name in (*_PLACES, *_AXES, *_SCALES)}

_UNSCALED = 1e-3
"""Largest difference of a scale from 1."""


@dataclass(frozen=True, eq=False)
class Bvh:
    """A skeleton in motion; lengths are in the file's unit.

    Attributes
    ----------
    names : J names of the joints
    parents : (J,) int64 array, -1 for the root; parents come before children
    offsets : (J, 3) float64 array, rest position of each joint relative to its parent. All joints
        have the same orientation at rest.
    ends : (J, 3) float64 array, mean of a joint's end sites relative to it; NaN if it has none
    channels : names of each joint's numbers in a frame, in order, such as "Zrotation"
    frame_time : seconds per frame
    numbers : (T, C) float64 array, angles in degrees
    lines : T lines of text, the frames as in the file, with line ends
    head : text before the frames
    encoding : encoding of the text
    """

    names: tuple[str, ...]
    parents: npt.NDArray[np.int64]
    offsets: FloatArray
    ends: FloatArray
    channels: tuple[tuple[str, ...], ...]
    frame_time: float
    numbers: FloatArray
    lines: tuple[str, ...]
    head: str
    encoding: str

    def __len__(self) -> int:
        """Return T, the number of frames."""
        return len(self.numbers)

    @property
    def times(self) -> FloatArray:
        """(T,) times in seconds, from 0."""
        return np.arange(len(self), dtype=np.float64) * self.frame_time

    @property
    def motion(self) -> SkeletonMotion:
        """The skeleton and its motion, apart from the file's text."""
        return SkeletonMotion(
            name="",
            names=self.names,
            parents=self.parents,
            offsets=self.offsets,
            ends=self.ends,
            axes=None,
            times=self.times,
            up=None,
            turns=self.rotations(),
            places=self.positions(),
        )

    def rotations(self) -> FloatArray:
        """Return the (T, J, 3, 3) rotations of the joints relative to their parents."""
        turned = np.broadcast_to(np.eye(3), (len(self), len(self.names), 3, 3)).copy()
        for joint, (columns, axes) in enumerate(self._columns(_AXES)):
            if axes:
                angles = np.radians(self.numbers[:, columns])
                # SciPy takes the angles of a single axis as a 1D array.
                given = angles if len(axes) > 1 else angles[:, 0]
                turned[:, joint] = scipy.spatial.transform.Rotation.from_euler(
                    axes, given
                ).as_matrix()
        return turned

    def positions(self) -> FloatArray:
        """Return the (T, J, 3) positions of joints relative to parents; a root's is global."""
        placed = np.broadcast_to(self.offsets, (len(self), *self.offsets.shape)).copy()
        for joint, (columns, axes) in enumerate(self._columns(_PLACES)):
            for column, axis in zip(columns, axes, strict=True):
                placed[:, joint, "XYZ".index(axis)] = self.numbers[:, column]
        return placed

    def with_frames(self, frames: Sequence[int], turns: FloatArray, roots: FloatArray) -> bytes:
        """Return the file with some frames changed; the lines of all others are kept.

        Parameters
        ----------
        frames : n frame numbers, ascending
        turns : (n, J, 3, 3), see `rotations`
        roots : (n, 3) positions of the root
        """
        numbers = self.numbers[list(frames)]
        for joint, (columns, axes) in enumerate(self._columns(_AXES)):
            if axes:
                numbers[:, columns] = angles_near(turns[:, joint], axes, numbers[:, columns])
        columns, axes = next(self._columns(_PLACES))
        for column, axis in zip(columns, axes, strict=True):
            numbers[:, column] = roots[:, "XYZ".index(axis)]
        lines = list(self.lines)
        for frame, row in zip(frames, numbers, strict=True):
            end = lines[frame][len(lines[frame].rstrip()) :]
            lines[frame] = " ".join(f"{number:.6f}" for number in row) + end
        return (self.head + "".join(lines)).encode(self.encoding)

    def _columns(self, kinds: dict[str, int]) -> Iterator[tuple[list[int], str]]:
        """Yield, for each joint, the columns and axes of its channels of one kind."""
        first = 0
        for names in self.channels:
            columns = [place for place, name in enumerate(names) if name in kinds]
            yield (
                [first + place for place in columns],
                "".join(names[place][0] for place in columns),
            )
            first += len(names)


def read_bvh(path: str | os.PathLike[str]) -> Bvh:
    """Read a BVH file.

    Raises
    ------
    MeshFileError : the file is missing, too large, damaged, or not a BVH file.
    """
    try:
        return _parsed(*_decoded(read_regular(path, _MOST_BYTES)))
    except (MeshFileError, OSError, ValueError) as error:
        raise MeshFileError.unreadable(path, error, _AGAIN) from error


def _decoded(data: bytes) -> tuple[str, str]:
    """Return the text, with its byte order mark, and its encoding."""
    encoding = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be"}.get(data[:2], "utf-8")
    try:
        return data.decode(encoding), encoding
    except UnicodeDecodeError:
        return data.decode("latin-1"), "latin-1"


def _parsed(text: str, encoding: str) -> Bvh:
    motion = _MOTION.search(text)
    if not text.removeprefix("\ufeff").lstrip().startswith("HIERARCHY") or motion is None:
        raise MeshFileError("it has no HIERARCHY and MOTION sections, so it is not a BVH file")
    start = motion.start()
    names, parents, offsets, ends, channels = _hierarchy(text[:start].split())
    rows = text[start:].splitlines(keepends=True)
    lines = [place for place, row in enumerate(rows) if row.strip()]
    n_frames = _value(rows, lines, 1, "Frames:")
    frame_time = _value(rows, lines, 2, "Frame Time:")
    if not (n_frames == int(n_frames) and n_frames >= 1):
        raise MeshFileError(f"it announces {n_frames:g} frames")
    if not frame_time > 0.0:
        raise MeshFileError(f"its frame time is {frame_time:g}, it must be above 0")
    count, n_columns = int(n_frames), sum(map(len, channels))
    frames = tuple(rows[place] for place in lines[3:])
    if len(frames) < count:
        raise MeshFileError(f"it announces {count} frames and contains {len(frames)}")
    if count * n_columns > _MOST_NUMBERS:
        raise MeshFileError(f"it has {count} frames of {n_columns} numbers, which is too much")
    frames = frames[:count]
    numbers = _numbers("\n".join(map(str.strip, frames)).encode() + b"\n", n_columns)
    head = text[:start] + "".join(rows[: lines[3]])
    skeleton = names, parents, offsets, ends, channels
    bvh = Bvh(*skeleton, frame_time, numbers, frames, head, encoding)
    for name, (columns, _) in zip(names, bvh._columns(_SCALES), strict=True):
        if np.abs(numbers[:, columns] - 1.0).max(initial=0.0) > _UNSCALED:
            raise MeshFileError(
                f"it scales the joint {name[:40]!r}; only rotations and positions can be read",
                "export it without scale channels",
            )
    return bvh


def _numbers(text: bytes, n_columns: int) -> FloatArray:
    """Parse the (T, C) numbers of the frames' lines."""
    numbers, sizes = number_rows(text, "frame")
    wrong = np.flatnonzero(sizes != n_columns)
    if len(wrong):
        raise MeshFileError(
            f"frame {wrong[0]} (from 0) has {sizes[wrong[0]]} numbers, its joints have {n_columns}"
        )
    unusable = np.flatnonzero(~(np.abs(numbers) <= _LARGEST))
    if len(unusable):
        _number(text.split()[unusable[0]].decode())
    return numbers.reshape(-1, n_columns)


def _hierarchy(
    words: list[str],
) -> tuple[
    tuple[str, ...], npt.NDArray[np.int64], FloatArray, FloatArray, tuple[tuple[str, ...], ...]
]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    ends: list[list[list[float]]] = []
    channels: list[tuple[str, ...]] = []
    # The joints whose braces are open, None for an end site.
    open_: list[int | None] = []
    place, pending, is_pending = 1, 0, False

    def next_words(n: int) -> list[str]:
        nonlocal place
        if place + n > len(words):
            raise MeshFileError("its hierarchy ends too soon")
        place += n
        return words[place - n : place]

    def name() -> str:
        nonlocal place
        begin = place
        while place < len(words) and words[place] != "{":
            place += 1
        return " ".join(words[begin:place])

    while place < len(words):
        word = next_words(1)[0]
        if word in ("ROOT", "JOINT"):
            if word == "ROOT" and names:
                raise MeshFileError("it has several skeletons, and one is needed")
            if len(names) == _MOST_JOINTS:
                raise MeshFileError(f"it has more than {_MOST_JOINTS} joints")
            if word == "JOINT" and (not open_ or open_[-1] is None):
                raise MeshFileError("a joint is outside the hierarchy")
            parents.append(-1 if word == "ROOT" else open_[-1] or 0)
            names.append(name())
            offsets.append([0.0, 0.0, 0.0])
            ends.append([])
            channels.append(())
            pending, is_pending = len(names) - 1, True
        elif word == "End":
            name()
            pending, is_pending = -1, True
        elif word == "{":
            if not is_pending:
                raise MeshFileError("its braces do not match")
            open_.append(None if pending < 0 else pending)
            is_pending = False
        elif word == "}":
            if not open_:
                raise MeshFileError("its braces do not match")
            open_.pop()
        elif word == "OFFSET" and open_:
            offset = [_number(number) for number in next_words(3)]
            owner = open_[-1]
            if owner is not None:
                offsets[owner] = offset
            elif len(open_) > 1 and (above := open_[-2]) is not None:
                ends[above].append(offset)
        elif word == "CHANNELS" and open_ and open_[-1] is not None:
            count = next_words(1)[0]
            if not count.isdecimal() or int(count) > len(_CHANNELS):
                raise MeshFileError(f"a joint of it has {count} channels")
            channel_kinds = [_CHANNELS.get(name.casefold(), "") for name in next_words(int(count))]
            if "" in channel_kinds or len(set(channel_kinds)) < len(channel_kinds):
                raise MeshFileError("one of its joints has unknown or repeated channels")
            channels[open_[-1]] = tuple(channel_kinds)
        else:
            raise MeshFileError(f"its hierarchy has an unexpected {word[:40]!r}")
    if open_ or not names:
        raise MeshFileError("its braces do not match" if names else "it has no joints")
    means = np.array([np.mean(own, axis=0) if own else np.full(3, np.nan) for own in ends])
    return tuple(names), np.array(parents), np.array(offsets), means, tuple(channels)


def _value(rows: list[str], lines: list[int], number: int, name: str) -> float:
    label, colon, value = (rows[lines[number]] if number < len(lines) else "").partition(":")
    if " ".join(label.split()).casefold() + colon != name.casefold():
        raise MeshFileError(f"{name!r} is missing after MOTION")
    return _number(value.strip())


def _number(word: str) -> float:
    try:
        number = float(word)
    except ValueError:
        number = np.nan
    if not abs(number) <= _LARGEST:
        raise MeshFileError(f"{word[:40]!r} is not a number that can be used")
    return number


def angles_near(turns: FloatArray, axes: str, before: FloatArray) -> FloatArray:
    """Return the (n, A) Euler angles of (n, 3, 3) rotations nearest to `before`, in degrees.

    With fewer than three axes, the angles about the others are dropped.
    """
    order = axes + "".join(axis for axis in "XYZ" if axis not in axes)
    with warnings.catch_warnings():
        # At gimbal lock one angle is free, and any will do.
        warnings.simplefilter("ignore", UserWarning)
        first, middle, last = (
            scipy.spatial.transform.Rotation.from_matrix(turns).as_euler(order, degrees=True).T
        )
    ways = [(first, middle, last), (first + 180.0, 180.0 - middle, last + 180.0)]
    tried = np.array(ways).transpose(0, 2, 1)[:, :, : len(axes)]
    tried -= 360.0 * np.round((tried - before) / 360.0)
    is_second = np.abs(tried - before).sum(axis=2).argmin(axis=0) == 1
    angles: FloatArray = np.where(is_second[:, None], tried[1], tried[0])
    return angles


_WRITTEN_AXES = "ZXY"
"""Order of the rotations, the most common one."""

_STILL = 1e-6
"""Largest movement of a joint relative to its parent that is ignored, in skeleton extents."""

_PER_JOINT = "Xposition Yposition Zposition ", " ".join(f"{axis}rotation" for axis in _WRITTEN_AXES)


def bvh_bytes(
    names: Sequence[str],
    parents: npt.NDArray[np.int64],
    rest: FloatArray,
    ends: FloatArray,
    turns: FloatArray,
    places: FloatArray,
    frame_time: float,
) -> bytes:
    """Encode a BVH file in UTF-8.

    Joints that move relative to their parents get position channels, as the root does.

    Parameters
    ----------
    names : J names; characters that a BVH file cannot hold are replaced
    parents : (J,) -1 for the only root; parents come before children
    rest : (J, 3) global rest positions of the joints, which all have the same orientation
    ends : (J, 3) ends of the bones relative to their joints, used for joints without children
    turns : (T, J, 3, 3) rotations of the joints relative to their parents
    places : (T, J, 3) positions of the joints relative to their parents, the root's global
    frame_time : seconds per frame
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
    angles = np.zeros(rest.shape)
    for turned, placed in zip(turns, places, strict=True):
        angles = angles_near(turned, _WRITTEN_AXES, angles)
        numbers = (
            number
            for joint in order
            for row in ((placed[joint], angles[joint]) if has_place[joint] else (angles[joint],))
            for number in row.tolist()
        )
        lines.append(" ".join(f"{number:.6f}" for number in numbers))
    return ("\n".join(lines) + "\n").encode()


def depth_first(parents: npt.NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Return the joints in the depth-first order of a file, and their depths."""
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


def _name(name: str, joint: int) -> str:
    """Return a name on one line, without braces."""
    return " ".join(re.sub(r"[{}\x00-\x1f\x7f]", " ", name).split()) or f"joint {joint}"


def _row(numbers: FloatArray) -> str:
    return " ".join(f"{number:.6f}" for number in numbers)
