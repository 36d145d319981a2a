"""Numbers as text: shortest decimals out, checked numbers in."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError

_CHUNK_BYTES = 1 << 23
_BLOCK_LINES = 1 << 18
_BLANK = re.compile(rb"\s")


def decimals(values: npt.NDArray[Any]) -> tuple[str, ...]:
    """Return each number as the shortest decimal that reads back as the same number.

    Parameters
    ----------
    values : float32 or float64 array of any shape; float32 numbers get float32's short decimals

    Returns
    -------
    one string a number, in C order
    """
    flat = values.ravel()
    return tuple(map(str, flat if flat.dtype == np.float32 else flat.tolist()))


def numbers(words: Sequence[bytes], what: str) -> npt.NDArray[np.float64]:
    """Parse decimals.

    Parameters
    ----------
    words : the decimals
    what : plural noun for the message, such as "the vertices"

    Raises
    ------
    MeshFileError : a word is no number.
    """
    try:
        return np.array(list(map(float, words)), dtype=np.float64)
    except ValueError:
        for word in words:
            try:
                float(word)
            except ValueError as error:
                raise MeshFileError(
                    f"hold {word[:30]!r}, which is no number", "export the mesh again", where=what
                ) from error
        raise


def numbers_of_text(text: bytes, what: str) -> npt.NDArray[np.float64]:
    """Parse blank-separated decimals in chunks: words take ten times their text in memory.

    Parameters
    ----------
    text : the decimals
    what : plural noun for the message

    Raises
    ------
    MeshFileError : a word is no number.
    """
    parts, start = [np.empty(0)], 0
    while start < len(text):
        # To the end of the word at hand; no number is as long as what is looked at for it.
        blank = _BLANK.search(text, start + _CHUNK_BYTES, start + 2 * _CHUNK_BYTES)
        end = blank.start() if blank else start + 2 * _CHUNK_BYTES
        chunk = text[start:end]
        plain = plain_decimals(chunk)
        parts.append(numbers(chunk.split(), what) if plain is None else plain)
        start = end
    return np.concatenate(parts)


def blocks_of_lines(lines: Iterable[bytes]) -> Iterator[list[bytes]]:
    """Group lines into blocks of bounded length, as lists of words take much memory.

    Raises
    ------
    MeshFileError : a line is longer than all that a mesh can say in one.
    """
    block: list[bytes] = []
    n_bytes = 0
    for line in lines:
        if len(line) > _CHUNK_BYTES:
            raise MeshFileError(f"it has a line of {len(line)} bytes", "export the mesh again")
        block.append(line)
        n_bytes += len(line)
        if n_bytes > _CHUNK_BYTES or len(block) >= _BLOCK_LINES:
            yield block
            block, n_bytes = [], 0
    if block:
        yield block


def plain_integers(text: bytes) -> npt.NDArray[np.int64] | None:
    """Parse blank-separated digits quickly; None where the text holds anything else.

    Numbers beyond int64 become its largest, which no index check lets through.
    """
    # With nothing but digits and blanks there is nothing that numpy's parser could trip over.
    if not text or text.isspace() or text.translate(None, b" \n0123456789"):
        return None
    return np.fromstring(text, dtype=np.int64, sep=" ")


def plain_decimals(text: bytes) -> npt.NDArray[np.float64] | None:
    """Parse blank-separated decimals quickly; None where there is anything else.

    Besides decimals the text may hold the word `nan`.
    """
    if text.translate(None, b" \t\n\r0123456789+-.eEna"):
        return None
    blank = np.frombuffer(text, dtype=np.uint8) <= ord(" ")
    n_words = int(np.count_nonzero(blank[:-1] & ~blank[1:])) + int(len(blank) > 0 and not blank[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):  # something that is no number
            return None
    # "1.2.3" is read as two.
    return values if len(values) == n_words else None


def normalised_text(data: bytes) -> bytes:
    """Return text with line ends as a lone newline and without a byte order mark."""
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data.removeprefix(b"\xef\xbb\xbf")
