"""The labelling run: which rows are missing, who labels them, its progress."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from lcollision_core.errors import LabelStoreError
from lcollision_core.jobs import CancelToken, available_cores, no_progress
from lcollision_core.labels.cluster import label_on_cluster
from lcollision_core.labels.identity import StoreIdentity
from lcollision_core.labels.labeller import Labeller, LabelRows
from lcollision_core.labels.local import label_locally
from lcollision_core.labels.store import LabelStore, chunks_of


@dataclass(frozen=True)
class LabelStatus:
    """Progress of a labelling run.

    Attributes
    ----------
    done, total : rows, those of earlier runs among them
    n_colliding : of the rows done
    labelled : rows of this run
    seconds : since it began to label
    """

    done: int
    total: int
    n_colliding: int
    labelled: int = 0
    seconds: float = 0.0

    @property
    def rows_per_second(self) -> float | None:
        """Of this run, None before its first rows."""
        return self.labelled / max(self.seconds, 1e-9) if self.labelled else None

    @property
    def seconds_left(self) -> float | None:
        """At that rate, None before this run's first rows."""
        rate = self.rows_per_second
        return None if rate is None else (self.total - self.done) / rate

    @property
    def colliding_share(self) -> float | None:
        """Fraction of the rows done that collide, None before the first."""
        return self.n_colliding / self.done if self.done else None


StatusCallback = Callable[[LabelStatus], None]


def label_poses(
    labeller: Labeller,
    path: str | os.PathLike[str],
    n_rows: int,
    *,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: StatusCallback = no_progress,
    cancel: CancelToken | None = None,
) -> LabelStatus:
    """Extend a store to at least `n_rows` labelled samples of a model's latent box.

    Goes on where an earlier run ended, however that ended; rows that are damaged, or missing before
    later ones, are labelled again. Sample i of (model, seed) has the same labels to the last bit on
    any number of workers and on a cluster, so that several runs may label into one store.

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
    status : at the end, when all rows of the store are done

    Raises
    ------
    LabelStoreError : the store belongs to another model or seed, or its manifest is damaged.
    MeshFileError : it cannot be written.
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
    store = LabelStore.open_or_make(path, StoreIdentity.of(labeller, seed))
    total = max(n_rows, store.end)
    missing, done, n_colliding = [], 0, 0
    for chunk in chunks_of(total):
        token.raise_if_cancelled()
        try:
            rows = store.read(chunk)
        except LabelStoreError:
            missing.append(chunk)
        else:
            done += len(rows)
            n_colliding += int(np.count_nonzero(rows.colliding))
    status = LabelStatus(done, total, n_colliding)
    progress(status)
    started = time.monotonic()

    def count(rows: LabelRows) -> None:
        nonlocal status
        labelled = status.labelled + len(rows)
        n_colliding = status.n_colliding + int(np.count_nonzero(rows.colliding))
        seconds = time.monotonic() - started
        status = LabelStatus(done + labelled, total, n_colliding, labelled, seconds)
        progress(status)

    if not missing:
        return status
    if scheduler is None:
        n_threads = available_cores() if workers is None else workers
        results = label_locally(labeller, seed, missing, n_threads, count, token)
    else:
        results = label_on_cluster(labeller, seed, missing, scheduler, count, token)
    # Closed even when a chunk cannot be written: the workers must stop labelling.
    with closing(results):
        for chunk, rows in results:
            store.write(chunk, rows)
    return status
