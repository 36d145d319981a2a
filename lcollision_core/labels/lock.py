"""Who may append to a label store: one run at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lcollision_core.errors import LabelStoreError
from lcollision_core.meshes.locks import lock_open_file


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
            lock_open_file(file)
        except (BlockingIOError, PermissionError) as error:
            raise LabelStoreError(
                f"another run is labelling into {store}; wait for it to end, or name another store"
            ) from error
        yield
