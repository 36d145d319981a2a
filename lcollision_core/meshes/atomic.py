"""Writing files that people keep: whole, or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from lcollision_core.errors import MeshFileError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for writing that takes its name only once it is complete and on disk.

    The bytes go to a hidden file beside `path`, which is flushed, fsynced and renamed when the
    block ends. When the block raises, the hidden file is removed and an older `path` stays as it
    was. A symbolic link keeps pointing where it did; the file that it names is replaced.

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
    unfinished = target.with_name(f".{target.name[:100]}.{secrets.token_hex(6)}.part")
    try:
        with unfinished.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(target)
    except OSError as error:
        raise MeshFileError(
            f"{path} cannot be written: {error.strerror or error}; choose another place"
        ) from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def require_writable(path: str | os.PathLike[str]) -> None:
    """Refuse a path that `atomic_write` could not write, before long work is done for it.

    Raises
    ------
    MeshFileError : as for `atomic_write`.
    """
    folder = _plain_file_in_a_folder(path).parent
    if not os.access(folder, os.W_OK | os.X_OK):
        raise MeshFileError(
            f"{path} cannot be written: {folder} is read-only; choose another place"
        )


def _plain_file_in_a_folder(path: str | os.PathLike[str]) -> Path:
    target = Path(os.path.realpath(path))
    try:
        is_folder, is_device = target.is_dir(), target.exists() and not target.is_file()
    except OSError as error:
        raise MeshFileError(
            f"{path} cannot be written: {error.strerror or error}; choose another name"
        ) from error
    if is_folder:
        raise MeshFileError(f"{path} cannot be written: it is a folder; add a file name")
    # Renaming over a device such as /dev/null would replace it by a plain file.
    if is_device:
        raise MeshFileError(f"{path} cannot be written: it is not a plain file; choose another")
    if not target.parent.is_dir():
        raise MeshFileError(
            f"{path} cannot be written: there is no folder {target.parent}; create it first"
        )
    return target
