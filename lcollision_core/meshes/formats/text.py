"""Numbers as text: shortest decimals out, checked numbers in."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError


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
                    f"{what} hold {word[:30]!r}, which is no number; export the mesh again"
                ) from error
        raise


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
