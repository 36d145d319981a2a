"""Who may append to a label store: one run at a time."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from lcollision_core.errors import LabelStoreError

_LOCKED_BYTE = 1 << 30
"""Far beyond the file's end: Windows keeps others from reading what is locked."""


@contextmanager
def only_writer(store: Path) -> Iterator[None]:
    """Keep other runs, of this process or another, from appending to a store meanwhile.

    The operating system holds the lock on the store's description, which is never written again;
    it goes with the process, however that ends.

    Raises
    ------
    LabelStoreError : another run has it.
    OSError : the description cannot be opened to write, or its disk knows no locks.
    """
    with (store / "zarr.json").open("r+b", buffering=0) as file:
        try:
            _lock(file)
        except (BlockingIOError, PermissionError) as error:
            raise LabelStoreError(
                f"another run is labelling into {store}; wait for it to end, or name another store"
            ) from error
        yield


def _lock(file: BinaryIO) -> None:
    if sys.platform == "win32":
        import msvcrt

        file.seek(_LOCKED_BYTE)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
