"""The labelling run: which rows are missing, who labels them, how far it is."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

from lcollision_core.errors import LabelStoreError
from lcollision_core.jobs import CancelToken, available_cores
from lcollision_core.labels.cluster import label_on_cluster
from lcollision_core.labels.identity import StoreIdentity
from lcollision_core.labels.labeller import Labeller
from lcollision_core.labels.layout import ROWS_A_CHUNK
from lcollision_core.labels.local import ChunkTask, label_locally
from lcollision_core.labels.store import LabelStore


@dataclass(frozen=True)
class LabelStatus:
    """How far a labelling run is.

    Attributes
    ----------
    done, total : rows, those of earlier runs among them
    n_colliding : of the rows done
    rows_per_second : of this run, None before its first rows
    seconds_left : at that rate, None before its first rows
    """

    done: int
    total: int
    n_colliding: int
    rows_per_second: float | None
    seconds_left: float | None

    @property
    def colliding_share(self) -> float | None:
        """Share of the rows done that collide, None before the first."""
        return self.n_colliding / self.done if self.done else None


StatusCallback = Callable[[LabelStatus], None]


def no_status(status: LabelStatus) -> None:
    """Report to nobody."""


def label_poses(
    labeller: Labeller,
    path: str | os.PathLike[str],
    n_rows: int,
    *,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: StatusCallback = no_status,
    cancel: CancelToken | None = None,
) -> LabelStore:
    """Bring a store to at least `n_rows` labelled samples of a model's latent box.

    Goes on where an earlier run ended, however that ended; rows that were cut off or damaged are
    labelled again, those beyond `n_rows` too. Sample i of (model, seed) has the same labels to the
    last bit on any number of workers and on a cluster.

    Parameters
    ----------
    labeller : of the model
    path : the store, made if there is none
    n_rows : >= 1
    seed : of the samples, >= 0
    workers : threads, by default one per available core; unused with a scheduler
    scheduler : address of a Dask scheduler, such as "tcp://10.0.0.1:8786"
    progress : called with a `LabelStatus` after every block of rows
    cancel : polled between blocks; finished chunks stay

    Returns
    -------
    store : LabelStore, of at least `n_rows` rows

    Raises
    ------
    LabelStoreError : the store belongs to another model or seed, is damaged, or cannot be written,
        or another run is labelling into it.
    MissingExtraError : `scheduler` without Dask installed.
    LCollisionError : no scheduler or worker answers at the address, or a worker has another
        version of the program.
    CancelledError : `cancel` was set.
    """
    if n_rows < 1 or seed < 0:
        raise LabelStoreError(
            f"a store needs at least 1 row and a seed of 0 or more, got {n_rows} and {seed}"
        )
    token = cancel or CancelToken()
    identity = StoreIdentity.of(labeller, seed)
    with LabelStore.open_to_append(path, identity, n_rows, token) as store:
        _append(store, labeller, store.n_wanted, seed, workers, scheduler, progress, token)
    return store


def _append(
    store: LabelStore,
    labeller: Labeller,
    n_rows: int,
    seed: int,
    workers: int | None,
    scheduler: str | None,
    progress: StatusCallback,
    cancel: CancelToken,
) -> None:
    chunks = range(-(-n_rows // ROWS_A_CHUNK))
    missing, done, n_colliding = [], 0, 0
    for chunk in chunks:
        wanted = min(ROWS_A_CHUNK, n_rows - chunk * ROWS_A_CHUNK)
        if store.rows_in_chunk(chunk) < wanted:
            missing.append(ChunkTask(chunk, wanted))
        else:
            done += store.rows_in_chunk(chunk)
            n_colliding += store.colliding_in_chunk(chunk)
    total = done + sum(task.n_rows for task in missing)
    before, started = done, time.monotonic()
    progress(LabelStatus(done, total, n_colliding, None, None))

    def count(new_rows: int, new_colliding: int) -> None:
        nonlocal done, n_colliding
        done += new_rows
        n_colliding += new_colliding
        rate = (done - before) / max(time.monotonic() - started, 1e-9)
        progress(LabelStatus(done, total, n_colliding, rate, (total - done) / rate))

    if not missing:
        return
    if scheduler is None:
        n_threads = available_cores() if workers is None else workers
        results = label_locally(labeller, seed, missing, n_threads, count, cancel)
    else:
        results = label_on_cluster(labeller, seed, missing, scheduler, count, cancel)
    # Closed even when a chunk cannot be written: the workers must not label on.
    with closing(results):
        for task, rows in results:
            store.write_chunk(task.chunk, rows)
