"""Writing files that people keep: whole, or not at all."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.locks import is_named, lock_open_file, locked, shortened
from lcollision_core.regular_files import require_regular

_MAX_NAME_BYTES = 100
"""Most bytes of a temporary name without its marks."""
_MAX_STEM_BYTES = 200
"""Most bytes of an unused name, so that the number fits."""
_SECONDS_TO_RENAME = 60.0
"""Retries on Windows, where a file must be closed, and so unlocked, before it is renamed."""

FileStamp = tuple[int, int, int, int]
"""Changes whenever a file is replaced or written to."""


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for writing that takes its name only once it is complete and on disk.

    The bytes go to a hidden file beside `path`, which is flushed, fsynced and renamed when the
    block ends. When the block raises, the hidden file is removed and an older `path` stays as it
    was; what a killed process left is removed by the next one to write this name. A symbolic link
    keeps pointing where it did; the file that it names is replaced.

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
    unfinished = None
    try:
        _remove_dead_parts(target)
        unfinished, file = _new_part(target)
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if sys.platform != "win32":  # while it is locked: no other writer removes it
                unfinished.replace(target)
        if sys.platform == "win32":
            unfinished.replace(target)
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = "free some space there and try again" if is_full else "choose another place"
        raise MeshFileError.unwritable(path, error, advice) from error
    finally:
        if unfinished is not None:
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)


@contextmanager
def atomic_files(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a folder for files that move into `folder` together, once all are complete.

    Files of the same names are replaced, others stay. When the block raises, nothing comes, and a
    `folder` that was not there before is none again; what a killed process left is removed by the
    next one.

    Parameters
    ----------
    folder : made if there is none; its parent must exist

    Yields
    ------
    the folder to write into, on the same disk

    Raises
    ------
    MeshFileError : `folder` cannot be made or written to.
    """
    target = Path(folder)
    is_new = not os.path.lexists(target)
    unfinished = target / f".{secrets.token_hex(6)}.part"
    try:
        target.mkdir(exist_ok=True)
        _remove_dead_folders(target)
        with locked(unfinished):
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
        raise MeshFileError.like(
            error, error.where.replace(str(unfinished), str(target))
        ) from error
    finally:
        if is_new:
            with suppress(OSError):  # it is not empty, as it should be
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
        # Half of it would be neither the old content nor the new.
        _move_all(folder, target)
        raise


def _remove_dead_folders(target: Path) -> None:
    """Remove what killed processes were to move into a folder."""
    for unfinished in target.iterdir():
        if re.fullmatch(r"\.[0-9a-f]{12}\.part", unfinished.name) and unfinished.is_dir():
            with suppress(MeshFileError), locked(unfinished, wait=0.0):  # unless it is alive
                shutil.rmtree(unfinished)


def file_stamp(path: str | os.PathLike[str]) -> FileStamp | None:
    """Return a stamp that changes when a file is replaced; None if there is no file.

    Compared inside `locked`, it says whether the file is still the one that was read.
    """
    try:
        found = Path(path).stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def unused_name(path: Path) -> Path:
    """Return a name beside `path` that no file has: "m 2.obj"."""
    stem, number = shortened(path.stem, _MAX_STEM_BYTES), 2
    while (unused := path.with_name(f"{stem} {number}{path.suffix}")).exists():
        number += 1
    return unused


def require_writable(path: str | os.PathLike[str]) -> None:
    """Refuse a path that `atomic_write` could not write, before long work is done for it.

    Raises
    ------
    MeshFileError : as for `atomic_write`.
    """
    folder = _plain_file_in_a_folder(path).parent
    if not os.access(folder, os.W_OK | os.X_OK):
        raise MeshFileError.unwritable(path, f"{folder} is read-only", "choose another place")


def _plain_file_in_a_folder(path: str | os.PathLike[str]) -> Path:
    target = Path(os.path.realpath(path))
    try:
        # Renaming over a device such as /dev/null would replace it by a plain file.
        with suppress(FileNotFoundError, NotADirectoryError):
            require_regular(target)
    except OSError as error:
        raise MeshFileError.unwritable(path, error, "choose another name") from error
    if not target.parent.is_dir():
        raise MeshFileError.unwritable(
            path, f"there is no folder {target.parent}", "create it first"
        )
    return target


def _part_name(target: Path, token: str) -> str:
    return f".{shortened(target.name, _MAX_NAME_BYTES)}.{token}.part"


def _new_part(target: Path) -> tuple[Path, BinaryIO]:
    """Make the hidden file that becomes `target`, locked for as long as it is open."""
    while True:
        part = target.with_name(_part_name(target, secrets.token_hex(6)))
        file = part.open("xb")
        with suppress(OSError):  # a disk without locks, where no other writer removes it either
            lock_open_file(file)
        if is_named(file, part):
            return part, file
        # Another writer removed it before it was locked.
        file.close()


def _remove_dead_parts(target: Path) -> None:
    """Remove the hidden files that killed writers of `target` left."""
    head, tail = map(re.escape, _part_name(target, "/").split("/"))
    is_part = re.compile(rf"{head}[0-9a-f]{{12}}{tail}")
    with suppress(OSError):  # a folder that may be written to, but not listed
        for part in target.parent.iterdir():
            if is_part.fullmatch(part.name):
                _remove_if_dead(part)


def _remove_if_dead(part: Path) -> None:
    with suppress(OSError):
        if sys.platform == "win32":
            # What is open there cannot be removed.
            if time.time() - part.stat().st_mtime > _SECONDS_TO_RENAME:
                part.unlink()
            return
        with part.open("rb+") as file:
            lock_open_file(file)
            part.unlink()
