"""Read and write point caches, PC2 and MDD: the vertices of a mesh frame by frame."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.files.formats import POINT_CACHE_SUFFIXES
from lcollision_core.files.safe import MAX_ITEMS, atomic_write, open_regular

_PC2_MAGIC = b"POINTCACHE2\0"
_PC2_HEADER = np.dtype(
    [
        ("magic", "S12"),
        ("version", "<i4"),
        ("n_points", "<i4"),
        ("start", "<f4"),
        ("step", "<f4"),
        ("n_frames", "<i4"),
    ]
)
_MDD_HEADER = np.dtype([("n_frames", ">i4"), ("n_points", ">i4")])
_LARGEST = float(np.finfo(np.float32).max)


def read_point_cache(path: str | os.PathLike[str]) -> npt.NDArray[np.float32]:
    """Read the frames of a point cache; the extension, in any case, determines the format.

    Data after the announced frames are ignored: Blender's MDD files have one more frame.

    Parameters
    ----------
    path : a .pc2 or .mdd file

    Returns
    -------
    frames : (N, V, 3) float32 array, read-only, vertices in the order of the mesh, in its unit

    Raises
    ------
    MeshFileError : the file is missing, truncated, of another format, announces more than it holds
        or more than `MAX_ITEMS` numbers, or a coordinate is not finite.
    """
    with _opened(path) as file:
        layout = _layout(file, _suffix(path))
        shape = layout.n_frames, layout.n_points, 3
        if 3 * layout.n_frames * layout.n_points > MAX_ITEMS:
            raise MeshFileError(
                f"it holds {layout.n_frames} frames of {layout.n_points} vertices, at most "
                f"{MAX_ITEMS} coordinates can be read",
                "keep fewer frames",
            )
        data = np.frombuffer(file.read(4 * math.prod(shape)), layout.dtype)
        frames = data.astype(np.float32, copy=False).reshape(shape)
    for index, frame in enumerate(frames):
        if not np.isfinite(frame).all():
            vertex = int(np.flatnonzero(~np.isfinite(frame).all(axis=1))[0])
            raise MeshFileError.unreadable(
                path,
                f"vertex {vertex} of frame {index} (from 0) is at {frame[vertex].tolist()}, which "
                "is not finite",
                "export the cache again",
            )
    frames.flags.writeable = False
    return frames


def cache_rate(path: str | os.PathLike[str]) -> float | None:
    """Return the frames per second of an .mdd file; None for other formats, which lack it.

    Raises
    ------
    MeshFileError : the file is missing, truncated, or announces more than it holds.
    """
    if Path(path).suffix.lower() != ".mdd":
        return None
    with _opened(path) as file:
        return _layout(file, ".mdd").rate


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a cache; errors name its path."""
    try:
        with open_regular(path) as file:
            yield file
    except (MeshFileError, OSError, MemoryError) as error:
        reason = error if str(error) else "it needs more memory than there is"
        raise MeshFileError.unreadable(path, reason, "export the cache again") from error


class _Layout(NamedTuple):
    """What the head of a cache says.

    Attributes
    ----------
    n_frames, n_points : above 0
    dtype : of the coordinates
    times : (N,) seconds of the frames; for PC2 the number of its first frame, and the step
    """

    n_frames: int
    n_points: int
    dtype: str
    times: npt.NDArray[np.float32]

    @property
    def rate(self) -> float | None:
        """The frames per second of an MDD file, from the median step."""
        steps = np.diff(self.times.astype(np.float64))
        rate = 1.0 / float(np.median(steps)) if len(steps) and (steps > 0.0).all() else 0.0
        return rate or None


def _layout(file: BinaryIO, suffix: str) -> _Layout:
    """Read the head of a cache, up to its first frame.

    Raises
    ------
    MeshFileError : it is of another format, or announces more than the file holds.
    """
    is_mdd, size = suffix == ".mdd", os.fstat(file.fileno()).st_size
    form = _MDD_HEADER if is_mdd else _PC2_HEADER
    if size < form.itemsize:
        raise MeshFileError(f"it has {size} bytes, too few for a point cache")
    data = file.read(form.itemsize)
    header, swapped = (np.frombuffer(data, own)[0] for own in (form, form.newbyteorder("S")))
    n_frames, n_points = int(header["n_frames"]), int(header["n_points"])
    n_bytes = 12 * n_frames * n_points
    n_swapped = 12 * int(swapped["n_frames"]) * int(swapped["n_points"])
    if not 0 < n_bytes <= size and 0 < n_swapped <= size and swapped["n_points"] > 0:
        raise MeshFileError("its numbers are in the wrong byte order")
    if not is_mdd and bytes(header["magic"]) != _PC2_MAGIC.rstrip(b"\0"):
        raise MeshFileError("it does not begin with POINTCACHE2, so it is not a PC2 file")
    if not is_mdd and header["version"] != 1:
        raise MeshFileError(f"its version is {header['version']}, only 1 is known")
    n_bytes_of_times = 4 * max(n_frames, 0) if is_mdd else 0
    n_left = size - form.itemsize - n_bytes_of_times
    if n_frames < 1 or n_points < 1 or n_bytes > n_left:
        raise MeshFileError(
            f"it is truncated or damaged: it announces {n_frames} frames of {n_points} vertices, "
            f"and holds {max(n_left, 0)} bytes for them"
        )
    times = np.frombuffer(file.read(n_bytes_of_times), ">f4")
    if not is_mdd:
        times = np.array([header["start"], header["step"]])
    return _Layout(n_frames, n_points, ">f4" if is_mdd else "<f4", times)


def write_point_cache(
    path: str | os.PathLike[str], frames: npt.ArrayLike, fps: float = 30.0
) -> None:
    """Write a point cache atomically; the extension, in any case, determines the format.

    Frame 0 is at time 0. Both formats store float32.

    Parameters
    ----------
    path : a .pc2 or .mdd file in an existing folder
    frames : (N, V, 3) array, vertices in the order of the mesh, in its unit
    fps : frames per second, which only MDD stores

    Raises
    ------
    ShapeError : the shape is wrong, float32 cannot hold a coordinate, or fps is not above 0.
    MeshFileError : the extension is unknown, or the file cannot be written.
    """
    _suffix(path)
    points = np.asarray(frames)
    if points.ndim != 3 or points.shape[2] != 3 or not points.size:
        raise ShapeError.must_be("frames", "an (N, V, 3) array, not empty", points.shape)
    with point_cache(path, len(points), points.shape[1], fps) as write:
        for frame in points:
            write(frame)


@contextmanager
def point_cache(
    path: str | os.PathLike[str],
    n_frames: int,
    n_points: int,
    fps: float = 30.0,
    times_of: Path | None = None,
) -> Iterator[Callable[[npt.NDArray[Any]], None]]:
    """Write a point cache frame by frame, atomically: see `write_point_cache`.

    Parameters
    ----------
    times_of : a point cache; if it has the same format, and as many frames a second and in all, its
        times are kept

    Yields
    ------
    write : call it with the (V, 3) vertices of each frame

    Raises
    ------
    ShapeError : float32 cannot hold a coordinate, or fps is not above 0.
    MeshFileError : see `write_point_cache`.
    """
    suffix = _suffix(path)
    if not 0.0 < fps < np.inf:
        raise ShapeError.must_be("fps", "a number above 0", fps)
    is_mdd = suffix == ".mdd"
    times = np.arange(n_frames) / fps if is_mdd else np.array([0.0, 1.0])
    if times_of is not None and times_of.suffix.lower() == suffix:
        with _opened(times_of) as source:
            own = _layout(source, suffix)
        if own.n_frames == n_frames and (not is_mdd or np.isclose(own.rate or 0.0, fps)):
            times = own.times
    if is_mdd:
        head = np.array((n_frames, n_points), _MDD_HEADER).tobytes() + times.astype(">f4").tobytes()
    else:
        head = np.array((_PC2_MAGIC, 1, n_points, *times, n_frames), _PC2_HEADER).tobytes()
    with atomic_write(path) as file:
        file.write(head)

        def write(frame: npt.NDArray[Any]) -> None:
            if not float(np.abs(frame).max()) <= _LARGEST:  # NaN too
                raise ShapeError.must_be("coordinates of frames", "finite in float32", "others")
            file.write(frame.astype(">f4" if suffix == ".mdd" else "<f4").tobytes())

        yield write


def read_frame(
    path: str | os.PathLike[str], frame: int, n_frames: int, n_points: int
) -> npt.NDArray[np.float32]:
    """Read one (V, 3) frame of a point cache that `point_cache` wrote."""
    is_mdd = _suffix(path) == ".mdd"
    head = _MDD_HEADER.itemsize + 4 * n_frames if is_mdd else _PC2_HEADER.itemsize
    with _opened(path) as file:
        file.seek(head + 12 * n_points * frame)
        data = np.frombuffer(file.read(12 * n_points), ">f4" if is_mdd else "<f4")
    return data.astype(np.float32).reshape(n_points, 3)


def _suffix(path: str | os.PathLike[str]) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in POINT_CACHE_SUFFIXES:
        raise MeshFileError(
            "is not a point cache",
            where=path,
            expected=" or ".join(POINT_CACHE_SUFFIXES),
            got=suffix or "a name without extension",
        )
    return suffix
