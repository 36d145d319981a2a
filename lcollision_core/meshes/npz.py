""".npz archives of plain arrays, read without running code and without trusting their counts."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError

MAX_ITEMS = 1_000_000_000
"""The most numbers that one array may hold: 8 GB of float64."""

_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    KeyError,
    NotImplementedError,  # a compression method that zipfile lacks
    RuntimeError,  # an encrypted entry
    ValueError,  # numpy's words for a damaged header; UnicodeDecodeError too
    OverflowError,
)


def read_npz(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Read all arrays of an .npz archive; one that holds Python objects is refused.

    Parameters
    ----------
    path : the archive

    Returns
    -------
    arrays by name

    Raises
    ------
    MeshFileError : the file is missing, damaged or no archive of arrays, or an array is larger
        than `MAX_ITEMS` or than its header says. The sentence does not name the file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {
                info.filename.removesuffix(".npy"): _read_array(archive, info)
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }
    except FileNotFoundError as error:
        raise MeshFileError("there is no such file; check the name") from error
    except OSError as error:
        raise MeshFileError(f"{error.strerror or error}; check the file") from error
    except _DAMAGE as error:
        raise MeshFileError("it is damaged or no .npz archive; export it again") from error
    except MemoryError as error:
        raise MeshFileError("it needs more memory than there is; keep fewer poses") from error


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> npt.NDArray[Any]:
    name = info.filename.removesuffix(".npy")
    with archive.open(info) as file:
        shape, dtype = _read_header(file)
        if dtype.hasobject:
            raise MeshFileError(
                f"its array {name!r} holds Python objects, which are not loaded because that can "
                f"run code; save plain numbers"
            )
        # Python's integers, because a product of damaged sizes can overflow numpy's.
        n_items = 1
        for size in shape:
            n_items *= size
        if n_items > MAX_ITEMS or info.file_size > 8 * MAX_ITEMS:
            raise MeshFileError(
                f"its array {name!r} holds {n_items} numbers, at most {MAX_ITEMS} can be read"
            )
    with archive.open(info) as file:
        # read_array reads in chunks, so that a header that lies runs out of data, not of memory.
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    reader = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = reader(file)
    return shape, dtype


def write_npz(file: BinaryIO, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays to an open file as a compressed .npz archive; equal arrays give equal bytes.

    Parameters
    ----------
    file : open binary file
    arrays : plain arrays by name
    """
    # Coordinates hardly shrink further at higher levels. Entries opened by name carry no date.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(array), allow_pickle=False)
