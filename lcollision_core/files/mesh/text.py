"""Write numbers as shortest decimals, and parse checked numbers from text."""

from __future__ import annotations

import re
import warnings
from array import array
from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError

_BLANKS = bytes.maketrans(b"\t\v\f", b"   ")


def decimals(values: npt.NDArray[Any]) -> tuple[str, ...]:
    """Return each number as the shortest decimal that reads back as the same number.

    Parameters
    ----------
    values : float32 or float64 array of any shape; float32 numbers get float32's short decimals

    Returns
    -------
    one string per number, in C order
    """
    flat = values.ravel()
    return tuple(map(str, flat if flat.dtype == np.float32 else flat.tolist()))


def plain_lines(data: bytes) -> bytes:
    """Normalise text: newlines only, without byte order mark, tabs or # comments."""
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    if any(blank in data for blank in b"\t\v\f"):
        data = data.translate(_BLANKS)
    data = data.removeprefix(b"\xef\xbb\xbf")
    return data if data.endswith(b"\n") else data + b"\n"


def number_rows(
    text: bytes, name: str, *, whole: bool = False
) -> tuple[npt.NDArray[Any], npt.NDArray[np.int64]]:
    """Parse lines of blank-separated decimals.

    Parameters
    ----------
    text : lines that end in a newline
    name : name of a line in error messages, such as "vertex"
    whole : parse text with digits only as int64, clipped to its largest number

    Returns
    -------
    values : all numbers, float64 unless `whole` applies
    sizes : how many numbers each line has

    Raises
    ------
    MeshFileError : a word is not a number.
    """
    # Mark the ends of lines by a value that does not occur elsewhere.
    values: npt.NDArray[Any]
    if whole and text and not text.translate(None, b" \n0123456789"):
        values = np.fromstring(text.replace(b"\n", b" -1 "), dtype=np.int64, sep=" ")
        is_end = values < 0
    elif (parsed := _plain_decimals(text.replace(b"\n", b" nan "))) is not None:
        values, is_end = parsed, np.isnan(parsed)
    else:
        is_end = np.empty(0, dtype=np.bool_)
    ends = np.flatnonzero(is_end)
    if len(ends) == text.count(b"\n"):
        return values[~is_end], np.diff(ends, prepend=-1) - 1
    numbers, sizes = array("d"), array("q")
    for row, line in enumerate(BytesIO(text)):
        words = line.split()
        sizes.append(len(words))
        for word in words:
            try:
                numbers.append(float(word))
            except ValueError as error:
                raise MeshFileError(
                    f"holds {word[:30].decode(errors='replace')!r}, which is not a number",
                    where=f"{name} {row} (from 0)",
                ) from error
    return np.array(numbers, dtype=np.float64), np.array(sizes, dtype=np.int64)


def points(text: bytes, name: str) -> npt.NDArray[np.float64]:
    """Parse lines that begin with three coordinates, (n, 3).

    Parameters are those of `number_rows`.

    Raises
    ------
    MeshFileError : a line has fewer numbers, or a word is not a number.
    """
    values, sizes = number_rows(text, name)
    short = np.flatnonzero(sizes < 3)
    if len(short):
        raise MeshFileError(
            f"has {sizes[short[0]]} coordinates, three are needed",
            where=f"{name} {short[0]} (from 0)",
        )
    starts = np.cumsum(sizes) - sizes
    coordinates: npt.NDArray[np.float64] = values[starts[:, None] + np.arange(3)]
    return coordinates


def vertex_numbers(
    values: npt.NDArray[Any], sizes: npt.NDArray[np.int64], name: str = "face"
) -> npt.NDArray[np.int64]:
    """Return the corners of polygons as int64.

    Parameters
    ----------
    values : (sum of sizes,) array
    sizes : (P,) number of corners of each polygon
    name : name of a polygon in error messages

    Raises
    ------
    MeshFileError : a value is not an integer, such as 1.5 or infinity, or is far too large.
    """
    bad = np.flatnonzero(~(np.abs(values) < 2**53) | (values != np.floor(values)))
    if len(bad):
        row = int(np.searchsorted(np.cumsum(sizes), bad[0], side="right"))
        raise MeshFileError(
            f"has a corner that is not a vertex number: {values[bad[0]]:g}",
            where=f"{name} {row} (from 0)",
        )
    return values.astype(np.int64)


def _plain_decimals(text: bytes) -> npt.NDArray[np.float64] | None:
    """Parse decimals and the word `nan` fast; return None if there is anything else."""
    if text.translate(None, b" \n0123456789+-.eEna"):
        return None
    blank = np.frombuffer(text, dtype=np.uint8) <= ord(" ")
    n_words = int(np.count_nonzero(blank[:-1] & ~blank[1:])) + int(len(blank) > 0 and not blank[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):  # a word is not a number
            return None
    # "1.2.3" is parsed as two numbers.
    return values if len(values) == n_words else None
