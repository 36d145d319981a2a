""".npz archives of plain arrays, read without running code and without trusting their counts."""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.regular_files import open_regular

MAX_ITEMS = 1_000_000_000
"""The most numbers that one array may hold: 8 GB of float64."""

ZIP_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    KeyError,
    NotImplementedError,  # a compression method that zipfile lacks
    RuntimeError,  # an encrypted entry
    ValueError,  # UnicodeDecodeError too
    TypeError,  # numpy's error for an unknown type
    OverflowError,
)

_MAGIC = b"\x93NUMPY"
_MAX_HEADER_BYTES = 10_000
_DESCR = re.compile(rb"'descr': *'([<>|=]?)([a-zA-Z])([0-9]{0,9})'")
_ORDER = re.compile(rb"'fortran_order': *(True|False)")
_SHAPE = re.compile(rb"'shape': *\(([0-9, ]*)\)")
_PLAIN_KINDS = "biufSU"
_MOST_DEFLATED = 1032
"""Most bytes that one byte of a compressed entry expands to."""

_CHUNK_BYTES = 1 << 24


def read_npz(
    path: Path, wanted: Iterable[Sequence[str]]
) -> tuple[dict[str, npt.NDArray[Any]], tuple[str, ...]]:
    """Read some arrays of an .npz archive; a wanted one of Python objects is refused.

    Other arrays take no memory.

    Parameters
    ----------
    path : the archive
    wanted : for each array its names; the first one found counts

    Returns
    -------
    arrays : those that are wanted and there, by the first of their names
    names : of all arrays in the archive

    Raises
    ------
    MeshFileError : the file is missing, damaged or no archive of arrays, or a wanted array is
        larger than `MAX_ITEMS` or than the file can hold. The sentence does not name the file.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            entries = {
                info.filename.removesuffix(".npy"): info
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }
            found = {
                names[0]: next((name for name in names if name in entries), None)
                for names in wanted
            }
            arrays = {
                known: _read_array(archive, name, entries[name])
                for known, name in found.items()
                if name is not None
            }
            return arrays, tuple(entries)
    except FileNotFoundError as error:
        raise MeshFileError("there is no such file", "check the name") from error
    except OSError as error:
        raise MeshFileError(error.strerror or str(error), "check the file") from error
    except ZIP_DAMAGE as error:
        raise MeshFileError("it is damaged or no .npz archive", "export it again") from error
    except MemoryError as error:
        raise MeshFileError("it needs more memory than there is", "keep fewer poses") from error


def _read_array(archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> npt.NDArray[Any]:
    with archive.open(info) as file:
        dtype, in_fortran_order, shape = _read_header(file, name)
        # Python's integers, because a product of damaged sizes can overflow numpy's.
        n_items = math.prod(shape)
        if n_items > MAX_ITEMS:
            count = n_items if n_items < 10**15 else "over 10**15"
            raise MeshFileError(
                f"holds {count} numbers, at most {MAX_ITEMS} can be read",
                where=f"its array {name!r}",
            )
        # No memory is allocated for a size that the data do not confirm.
        if n_items * dtype.itemsize > min(info.file_size, _MOST_DEFLATED * info.compress_size):
            raise EOFError
        array = np.empty(n_items, dtype)
        _fill(file, array)
    shaped: npt.NDArray[Any] = array.reshape(shape, order="F" if in_fortran_order else "C")
    return shaped


def _read_header(file: IO[bytes], name: str) -> tuple[np.dtype[Any], bool, tuple[int, ...]]:
    """Read a header as NumPy writes it. NumPy's own reader evaluates it, and warns."""
    start = file.read(8)
    n_length_bytes = 2 if start[6:7] == b"\1" else 4
    length = int.from_bytes(file.read(n_length_bytes), "little")
    if not start.startswith(_MAGIC) or length > _MAX_HEADER_BYTES:
        raise ValueError("no array")
    header = file.read(length)
    descr, order, shape = (part.search(header) for part in (_DESCR, _ORDER, _SHAPE))
    if descr is None or order is None or shape is None:
        raise ValueError("no plain array")
    byte_order, kind, size = (part.decode() for part in descr.groups())
    if kind == "O":
        raise MeshFileError(
            "holds Python objects, which are not loaded because that can run code",
            "save plain numbers",
            where=f"its array {name!r}",
        )
    if kind not in _PLAIN_KINDS:
        raise MeshFileError(
            f"is of type {kind + size!r}", "save plain numbers", where=f"its array {name!r}"
        )
    dtype = np.dtype(f"{byte_order}{kind}{size}")
    if not dtype.itemsize:
        raise ValueError("items without a size")
    sizes = tuple(int(part) for part in shape[1].split(b",") if part.strip())
    return dtype, order[1] == b"True", sizes


def _fill(file: IO[bytes], array: npt.NDArray[Any]) -> None:
    """Read an array's bytes in chunks, so that a file that ends early takes little memory."""
    data = array.view(np.uint8)
    for start in range(0, len(data), _CHUNK_BYTES):
        part = data[start : start + _CHUNK_BYTES]
        chunk = file.read(len(part))
        if len(chunk) < len(part):
            raise EOFError
        part[:] = np.frombuffer(chunk, np.uint8)


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
