"""Safe file access: valid names, regular files only, atomic writes, locks, untrusted .npz."""

from __future__ import annotations

import csv
import errno
import io
import math
import os
import re
import secrets
import shutil
import stat
import sys
import time
import unicodedata
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from mimetypes import MimeTypes
from pathlib import Path, PurePath
from tempfile import TemporaryFile
from tokenize import TokenError
from typing import IO, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import FileLockedError, MeshFileError
from lcollision_core.files.formats import FILES

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
)

_LFS_POINTER = b"version https://git-lfs"


def require_regular(path: str | os.PathLike[str]) -> int:
    """Return the size in bytes of a regular file, and refuse anything else.

    Opening a pipe waits for its writer, a device may never end, and the error for a folder is
    unclear, so none of them is opened.

    Raises
    ------
    OSError : there is no such file, or it is not a regular file; `strerror` says what it is.
    ValueError : the name contains a NUL byte.
    """
    status = Path(path).stat()
    if stat.S_ISREG(status.st_mode):
        return status.st_size
    kind = next((name for is_kind, name in _KINDS if is_kind(status.st_mode)), "a device")
    raise OSError(errno.EINVAL, f"it is {kind}, not a plain file", os.fspath(path))


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for binary reading.

    Raises
    ------
    OSError, ValueError : see `require_regular`, reading is not permitted, or it is a pointer of Git
        LFS, as clones have that were made without it.
    """
    require_regular(path)
    with ExitStack() as opened:
        file = opened.enter_context(Path(path).open("rb"))
        if file.peek(len(_LFS_POINTER)).startswith(_LFS_POINTER):
            what = "it is a pointer of Git LFS; `git lfs pull` fetches the file itself"
            raise OSError(errno.EINVAL, what, os.fspath(path))
        opened.pop_all()
    return file


def read_regular(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """Read a whole regular file.

    Raises
    ------
    OSError, ValueError : see `open_regular`, or it has more than `most_bytes` bytes.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most_bytes:
            raise OSError(
                errno.EFBIG, f"it has {size} bytes, at most {most_bytes} are read", os.fspath(path)
            )
        return file.read(size)


_LOCKED_BYTE = 1 << 30
"""Far beyond the end of the file, as Windows prevents others from reading locked bytes."""
_SECONDS_BETWEEN_TRIES = 0.05
_MAX_LOCK_NAME_BYTES = 200


@contextmanager
def locked(path: str | os.PathLike[str], wait: float = 30.0) -> Iterator[None]:
    """Lock a file against changes by other threads and processes.

    Inside the block, a file can be read, changed and written without losing another's change:
    ``with locked(path): write(change(read(path)))``. The lock is on a hidden file beside `path`,
    which is removed at the end; if the process is killed, the lock is released and the next holder
    removes the file. The lock is not re-entrant.

    Parameters
    ----------
    path : the file to change, which need not exist; its folder must
    wait : seconds to wait for another holder

    Raises
    ------
    FileLockedError : another holder has not released the lock in time.
    MeshFileError : the folder is missing, read-only or on a disk without locks.
    """
    target = Path(os.path.realpath(path))
    lock = target.with_name(f".{shortened(target.name, _MAX_LOCK_NAME_BYTES)}.lock")
    give_up = time.monotonic() + wait
    while (file := _taken(lock, path)) is None:
        if time.monotonic() >= give_up:
            raise FileLockedError(
                "is being written by another command",
                "wait for that to end, then try again",
                where=path,
            )
        time.sleep(_SECONDS_BETWEEN_TRIES)
    try:
        yield
    finally:
        if sys.platform == "win32":  # where open files cannot be removed
            file.close()
        with suppress(OSError):
            lock.unlink()
        file.close()


def _lock(file: BinaryIO) -> None:
    """Lock an open file until it is closed; raise OSError if it is locked elsewhere."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(_LOCKED_BYTE)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def shortened(name: str, n_bytes: int) -> str:
    """Cut a file name between characters to `n_bytes` bytes, which is what file systems count."""
    while len(os.fsencode(name)) > n_bytes:
        name = name[:-1]
    return name


def _taken(lock: Path, path: str | os.PathLike[str]) -> BinaryIO | None:
    """Open and lock the lock file; return None if another holder has it."""
    try:
        # Opening a pipe would wait for its reader for ever. The file may be missing.
        with suppress(FileNotFoundError):
            require_regular(lock)
        file = lock.open("ab", buffering=0)
    except OSError as error:
        raise MeshFileError.because(
            path, "cannot be changed", error, "choose another place"
        ) from error
    try:
        _lock(file)
        # Its last holder may have removed it, and a lock on a removed file excludes nobody.
        if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
            return file
    except (BlockingIOError, PermissionError, FileNotFoundError):
        pass
    except OSError as error:
        file.close()
        raise MeshFileError.because(
            path, "cannot be locked", error, "copy it to another disk"
        ) from error
    file.close()
    return None


_MAX_NAME_BYTES = 100
"""Most bytes of the target's name within a temporary name."""
_MAX_NUMBERED_BYTES = 200
"""Most bytes of the stem of an unused name, to leave space for a number."""

FileStamp = tuple[int, int, int, int]
"""Changes whenever a file is replaced or written to."""


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for writing that takes its name only once it is complete and on disk.

    The bytes go to a hidden file beside `path`, which is flushed, fsynced and renamed when the
    block ends. If the block raises, the hidden file is removed and an existing `path` is unchanged;
    only a killed process leaves the hidden file. If `path` is a symbolic link, the file that it
    points to is replaced.

    Parameters
    ----------
    path : the file to write; its folder must exist

    Yields
    ------
    the open binary file

    Raises
    ------
    MeshFileError : the folder is missing or read-only, the disk is full, or `path` is a folder
        or a device.
    """
    target = _plain_file_in_a_folder(path)
    name = f".{shortened(target.name, _MAX_NAME_BYTES)}.{secrets.token_hex(6)}.part"
    unfinished = target.with_name(name)
    try:
        with unfinished.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(target)
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = "free some space there and try again" if is_full else "choose another place"
        raise MeshFileError.unwritable(path, error, advice) from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a whole file, as `atomic_write` does.

    Raises
    ------
    MeshFileError : as in `atomic_write`.
    """
    with atomic_write(path) as file:
        file.write(data)


def write_table(
    path: str | os.PathLike[str], columns: Iterable[str], rows: Iterable[Mapping[str, object]]
) -> None:
    """Write a CSV table with a header, as `atomic_write` does; values of other names are left out.

    Raises
    ------
    MeshFileError : as in `atomic_write`.
    """
    text = io.StringIO()
    table = csv.DictWriter(text, list(columns), extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_bytes(path, text.getvalue().encode())


@contextmanager
def atomic_files(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a folder for files that move into `folder` together once all are complete.

    Files of the same names are replaced, others stay. If the block raises, no file is moved, and
    `folder` is removed if it is new.

    Parameters
    ----------
    folder : created if missing; its parent must exist

    Yields
    ------
    the folder to write into, on the same disk

    Raises
    ------
    MeshFileError : `folder` cannot be created or written to.
    """
    target = Path(folder)
    _require_parent(target, folder)
    is_new = not os.path.lexists(target)
    unfinished = target / f".{secrets.token_hex(6)}.part"
    try:
        target.mkdir(exist_ok=True)
        unfinished.mkdir()
        try:
            yield unfinished
            _move_all(unfinished, target)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
    except OSError as error:
        raise MeshFileError.because(
            f"the folder {folder}", "cannot be written to", error, "name another"
        ) from error
    except MeshFileError as error:
        raise MeshFileError.from_error(
            error, error.where.replace(str(unfinished), str(target))
        ) from error
    finally:
        if is_new:
            with suppress(OSError):  # after a success it is not empty
                target.rmdir()


def _move_all(folder: Path, target: Path) -> None:
    names = [file.name for file in folder.iterdir()]
    for name in names:
        if (target / name).is_dir():
            raise MeshFileError.unwritable(target / name, "it is a folder", "move it away")
    try:
        for name in names:
            (folder / name).replace(os.path.realpath(target / name))
    except KeyboardInterrupt:
        # Move the rest: half of the files would be neither the old content nor the new.
        _move_all(folder, target)
        raise


def file_stamp(path: str | os.PathLike[str]) -> FileStamp | None:
    """Return a stamp that changes when a file is replaced; None if there is no file.

    Compare stamps inside `locked` to find out whether the file is still the one that was read.
    """
    try:
        status = Path(path).stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def unused_name(path: Path) -> Path:
    """Return an unused name beside `path`, such as "m 2.obj"."""
    stem, number = shortened(path.stem, _MAX_NUMBERED_BYTES), 2
    while (unused := path.with_name(f"{stem} {number}{path.suffix}")).exists():
        number += 1
    return unused


def require_writable(path: str | os.PathLike[str]) -> None:
    """Refuse a path that `atomic_write` could not write, to call before long work.

    Raises
    ------
    MeshFileError : see `atomic_write`.
    """
    folder = _plain_file_in_a_folder(path).parent
    try:
        require_folder(folder)
    except MeshFileError as error:
        raise MeshFileError.unwritable(path, error) from error


def require_folder(folder: str | os.PathLike[str]) -> None:
    """Refuse a folder in which no file can be made, with a `MeshFileError`."""
    try:
        # Permissions alone do not tell, as of /proc or a full disk.
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        what = f"no file can be made in the folder {folder}"
        raise MeshFileError.because("", what, error, "choose another place") from error


def _plain_file_in_a_folder(path: str | os.PathLike[str]) -> Path:
    target = Path(os.path.realpath(path))
    try:
        # Renaming over a device such as /dev/null would replace it with a regular file.
        with suppress(FileNotFoundError, NotADirectoryError):
            require_regular(target)
    except OSError as error:
        raise MeshFileError.unwritable(path, error, "choose another name") from error
    _require_parent(target, path)
    return target


def _require_parent(target: Path, path: str | os.PathLike[str]) -> None:
    """Refuse a path, called `path` by the user, in a folder that does not exist."""
    if not target.parent.is_dir():
        raise MeshFileError.unwritable(
            path, f"there is no folder {target.parent}", "create it first"
        )


MAX_ITEMS = 1_000_000_000
"""Most numbers in one array: 8 GB of float64."""

ZIP_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    KeyError,
    NotImplementedError,  # a compression method that zipfile lacks
    RuntimeError,  # an encrypted entry
    ValueError,  # UnicodeDecodeError too
    TypeError,  # NumPy's error for an unknown type
    OverflowError,
)

_PLAIN_KINDS = "biufSU"
_MOST_DEFLATED = 1032
"""Most bytes that one byte of a compressed entry expands to."""


def read_npz(
    path: Path, wanted: Iterable[Sequence[str]]
) -> tuple[dict[str, npt.NDArray[Any]], tuple[str, ...]]:
    """Read some arrays of an .npz archive; arrays of Python objects are refused.

    Other arrays are not read.

    Parameters
    ----------
    path : the archive
    wanted : alternative names of each array; the first one present is read

    Returns
    -------
    arrays : the wanted arrays that are present, by the first of their names
    names : names of all arrays in the archive

    Raises
    ------
    MeshFileError : the file is missing, damaged or not an archive of arrays, or a wanted array has
        Python objects or is larger than `MAX_ITEMS` or than the file can hold. The message does
        not name the file.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            entries = {
                info.filename.removesuffix(".npy"): info
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }
            entry_of = {
                names[0]: next((name for name in names if name in entries), None)
                for names in wanted
            }
            arrays = {
                known: _read_array(archive, name, entries[name])
                for known, name in entry_of.items()
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
    where = f"its array {name!r}"
    with archive.open(info) as file:
        shape, _, dtype = read_header(file)
        if dtype.hasobject:
            raise MeshFileError(
                "holds Python objects, which are not loaded because that can run code",
                "save plain numbers",
                where=where,
            )
        if dtype.kind not in _PLAIN_KINDS:
            raise MeshFileError(f"is of type {dtype.str!r}", "save plain numbers", where=where)
        # Use Python integers: the product of damaged sizes could overflow NumPy's.
        n_items = math.prod(shape)
        if n_items > MAX_ITEMS:
            count = n_items if n_items < 10**15 else "over 10**15"
            raise MeshFileError(
                f"holds {count} numbers, at most {MAX_ITEMS} can be read", where=where
            )
        # Do not allocate memory for a size that the data cannot fill.
        n_bytes = n_items * dtype.itemsize
        if not dtype.itemsize or n_bytes > min(info.file_size, _MOST_DEFLATED * info.compress_size):
            raise EOFError
        file.seek(0)
        array: npt.NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the shape, order and dtype of a NumPy array, whose values follow.

    Raises
    ------
    ValueError : it is not a NumPy array.
    """
    if file.read(6) != b"\x93NUMPY":
        raise ValueError("it is no array of NumPy")
    file.seek(0)
    try:
        is_short = np.lib.format.read_magic(file) == (1, 0)
        read = np.lib.format
        return (read.read_array_header_1_0 if is_short else read.read_array_header_2_0)(file)
    except (SyntaxError, TokenError) as error:
        # NumPy parses the header as a Python dict.
        raise ValueError("its header is damaged") from error


def write_npz(file: BinaryIO, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays to an open file as a compressed .npz archive; equal arrays give equal bytes.

    Parameters
    ----------
    file : open binary file
    arrays : plain arrays by name
    """
    # Higher levels hardly compress coordinates further. Entries opened by name have no date.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(array), allow_pickle=False)


def make_unique(
    names: Iterable[str],
    key: Callable[[str], str] = str,
    joined: Callable[[str, str], str] = str.__add__,
) -> list[str]:
    """Make names unique by key: append a number such as " 2" to later ones.

    Parameters
    ----------
    names : any names
    key : maps a name to the value that must be unique, such as the name in lower case
    joined : appends an ending to a name, and may shorten the name for it
    """
    used_names: set[str] = set()
    counts: Counter[str] = Counter()
    result = []
    for name in names:
        candidate, base = name, key(name)
        while (key_of_it := key(candidate)) in used_names:
            counts[base] += 1
            candidate = joined(name, f" {counts[base] + 1}")
        used_names.add(key_of_it)
        result.append(candidate)
    return result


MAX_STEM_BYTES = 130
"""Most bytes of a name without its extension; file systems allow 143 to 255 in total."""

_OF_OTHER_PROGRAMS = re.compile(
    r"\.(3dm|3ds|3mf|7z|abc|blend|bz2|c4d|dae|docx?|dxf|gz|iges|igs|ini|jsonl|log|lwo|ma|max"
    r"|mb|md|msh|npy|od[pst]|pickle|pkl|pptx|pt|pth|rar|skp|step|stp|toml|usd[acz]?"
    r"|vrml|vtk|vtp|vtu|wrl|x3d|xlsx|xyz|xz|ya?ml|zip|zst|ztl)"
)
_MEDIA = MimeTypes()
"""Extensions known to the standard library, independent of the machine's own lists."""

_NOT_IN_NAMES = re.compile(r'[\x00-\x1f\x7f-\x9f\u2028\u2029<>:"/\\|?*]+')
_RESERVED = re.compile(r"(CON|PRN|AUX|NUL|CONIN\$|CONOUT\$|(COM|LPT)[0-9¹²³])\s*(\.|$)", re.I)
"""Device names on Windows, with any extension."""


def has_known_suffix(path: PurePath) -> bool:
    """Whether a name ends in the extension of a known format, unlike ".9" in "walk_v0.9"."""
    suffix = path.suffix.lower()
    if suffix in FILES or suffix in _MEDIA.types_map[True]:
        return True
    return bool(_OF_OTHER_PROGRAMS.fullmatch(suffix))


def file_stem(name: str) -> str:
    """Make a name valid as a file name without extension on common file systems."""
    stem = _cut(_NOT_IN_NAMES.sub("_", name), MAX_STEM_BYTES) or "pose"
    return f"_{_cut(stem, MAX_STEM_BYTES - 1)}" if _RESERVED.match(stem) else stem


def file_stems(names: Iterable[str]) -> list[str]:
    """Return each name's `file_stem`, numbered if an earlier one is the same file: "a", "A 2".

    Some file systems ignore case and the encoding of accents.
    """
    return make_unique(
        map(file_stem, names),
        _folded,
        lambda stem, ending: _cut(stem, MAX_STEM_BYTES - len(ending)) + ending,
    )


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _cut(name: str, n_bytes: int) -> str:
    return shortened(name.strip(" ."), n_bytes).strip(" .")
