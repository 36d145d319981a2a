"""Hostile replacements of a file's fields: other types, sizes, signs, NaN and infinities."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

MISSING, TOO_LARGE = "@missing@", "@1e999@"
VALUES: tuple[Any, ...] = (
    MISSING,
    TOO_LARGE,
    None,
    True,
    -1,
    0,
    1,
    2.0,
    0.5,
    1e308,
    -1e308,
    5e-324,
    float("nan"),
    -(10**400),
    "",
    "\ud800\n",
    "x" * 100_000,
    [],
    [[1], "a"],
    {"a" * 100_000: None},
)
"""Replacements of every JSON value of a model file."""

NUMBERS = (0.0, -1.0, 1.0, 1e-38, 1e4, 1e30, 3e38, -1e300, np.nan, np.inf, -np.inf)
WHOLE_NUMBERS = (0, -1, 1, 2**31 - 1, -(2**31))


def as_json(value: Any) -> str:
    """Write JSON with numbers that no reader should accept."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return text.replace(f'"{TOO_LARGE}"', "1e999")


def places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every JSON value; of a list, only the first and the last item."""
    if place:
        yield place
    if isinstance(value, dict):
        for key in value:
            yield from places(value[key], (*place, key))
    elif isinstance(value, list | tuple):
        for index in sorted({0, len(value) - 1}) if value else ():
            yield from places(value[index], (*place, index))


def with_value(metadata: Any, place: tuple[Any, ...], value: Any) -> Any:
    changed = deepcopy(metadata)
    holder = changed
    for key in place[:-1]:
        holder = holder[key]
    if value == MISSING:
        del holder[place[-1]]
    else:
        holder[place[-1]] = value
    return changed


def changed_arrays(array: np.ndarray) -> Iterator[tuple[str, np.ndarray | None]]:
    """Yield an array with another type, another shape, or other numbers."""
    yield "missing", None
    if array.dtype.kind == "U":
        # Code points that are not characters.
        bad = np.full(array.shape + (array.dtype.itemsize // 4,), 0xFFFFFFFF, np.uint32)
        yield "no characters", bad.view(array.dtype).reshape(array.shape)
        for text in ("", "\ud800\n", "x" * 10_000):
            yield f"all {text[:3]!r}", np.full(array.shape, text)
        yield "flat", array.reshape(-1, 1)
        return
    for dtype in (np.float64, np.float32, np.int64, np.int32, np.uint8, np.bool_):
        if dtype != array.dtype:
            yield f"as {np.dtype(dtype)}", array.astype(dtype)
    yield "as one number", np.zeros((), array.dtype)
    yield "with an axis more", array[None]
    yield "flat", array.reshape(-1) if array.ndim > 1 else array.reshape(-1, 1)
    yield "transposed", array.T if array.ndim != 1 else array[::-1].copy()
    for axis in range(array.ndim):
        yield f"without {axis}", np.take(array, [], axis=axis)
        yield f"shorter in {axis}", np.take(array, range(array.shape[axis] - 1), axis=axis)
        yield f"longer in {axis}", np.concatenate([array, np.take(array, [0], axis)], axis)
    for number in NUMBERS if array.dtype.kind == "f" else WHOLE_NUMBERS:
        with np.errstate(over="ignore"):
            cast = np.array(number).astype(array.dtype)
        yield f"all {number}", np.full_like(array, cast)
        for place in (0, array.size - 1):
            changed = array.copy()
            changed.reshape(-1)[place] = cast
            yield f"{number} at {place}", changed


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))


UNPLAIN_FILES = {
    "a folder": Path.mkdir,
    "a named pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a socket": _socket,
}
"""Functions that create something other than a regular file at a path."""


def damaged_glbs(whole: bytes, n: int, seed: int) -> Iterator[bytes]:
    """Yield a GLB file n times with some bytes changed, every fifth also truncated.

    In every second, the changes are in the JSON, not in the large binary part behind it.
    """
    generator = np.random.default_rng(seed)
    json_end = 20 + int.from_bytes(whole[12:16], "little")
    for number in range(n):
        data = bytearray(whole)
        end = json_end if number % 2 else len(data)
        for place in generator.integers(0, end, generator.integers(1, 5)):
            data[place] = generator.integers(256)
        yield bytes(data if number % 5 else data[: int(generator.integers(1, len(data)))])


def without_file(path: Path) -> Path:
    """Delete a file that is to be written again: some file systems flush one that is truncated."""
    path.unlink(missing_ok=True)
    return path
