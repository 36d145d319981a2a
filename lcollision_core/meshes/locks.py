"""One writer at a time: locks of the operating system, which end with their process."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from lcollision_core.errors import HeldElsewhereError, MeshFileError
from lcollision_core.regular_files import require_regular

_LOCKED_BYTE = 1 << 30
"""Far beyond the file's end, as Windows prevents others from reading locked bytes."""
_SECONDS_BETWEEN_TRIES = 0.05
_MAX_NAME_BYTES = 200


@contextmanager
def locked(path: str | os.PathLike[str], wait: float = 30.0) -> Iterator[None]:
    """Hold a file's lock, so that no other holder changes the file meanwhile.

    Reading, changing and writing back a file inside the block loses no other change, in this
    process or another: ``with locked(path): write(change(read(path)))``. The lock is on a hidden
    file beside `path`, which is removed at the end; after a kill it is free, and the next holder
    removes it. A thread that holds the lock must not ask for it again.

    Parameters
    ----------
    path : the file to change, which need not exist; its folder must
    wait : seconds to wait for another holder

    Raises
    ------
    HeldElsewhereError : another holds it for longer.
    MeshFileError : the folder is missing, read-only or on a disk without locks.
    """
    target = Path(os.path.realpath(path))
    lock = target.with_name(f".{shortened(target.name, _MAX_NAME_BYTES)}.lock")
    give_up = time.monotonic() + wait
    while (file := _taken(lock, path)) is None:
        if time.monotonic() >= give_up:
            raise HeldElsewhereError(
                "is being written by another command",
                "wait for that to end, then try again",
                where=path,
            )
        time.sleep(_SECONDS_BETWEEN_TRIES)
    try:
        yield
    finally:
        if sys.platform == "win32":  # where nothing that is open can be removed
            file.close()
        with suppress(OSError):
            lock.unlink()
        file.close()


def lock_open_file(file: BinaryIO) -> None:
    """Lock an open file for as long as it stays open.

    Raises
    ------
    BlockingIOError, PermissionError : another has it locked.
    OSError : its disk has no locks.
    """
    if sys.platform == "win32":
        import msvcrt

        file.seek(_LOCKED_BYTE)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        file.seek(0)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_named(file: BinaryIO, path: Path) -> bool:
    """Whether an open file is still the one of this name: another may have removed or moved it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def shortened(name: str, n_bytes: int) -> str:
    """Cut a file name to `n_bytes` bytes, which is what file systems count, between characters."""
    while len(os.fsencode(name)) > n_bytes:
        name = name[:-1]
    return name


def _taken(lock: Path, path: str | os.PathLike[str]) -> BinaryIO | None:
    """Open and lock the lock's file, or return None where another holds it."""
    try:
        # Opening a pipe would wait for its reader for ever; another holder removes the lock's file.
        with suppress(FileNotFoundError):
            require_regular(lock)
        file = lock.open("ab", buffering=0)
    except OSError as error:
        raise MeshFileError.because(
            path, "cannot be changed", error, "choose another place"
        ) from error
    try:
        lock_open_file(file)
        # Its last holder may have removed it, and a lock on a removed file excludes no one.
        if is_named(file, lock):
            return file
    except (BlockingIOError, PermissionError):
        pass
    except OSError as error:
        file.close()
        raise MeshFileError.because(
            path, "cannot be locked", error, "copy it to another disk"
        ) from error
    file.close()
    return None
