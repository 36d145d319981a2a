"""Run a labelling over cores or machines, shard by shard, with resuming.

Threads replace processes: decoding and the exact check release the GIL, and threads share one model
and start at once.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import Any, TypeVar

import numpy as np

from lcollision_core.devices import block_size
from lcollision_core.embedding.bilevel import ROWS_PER_BLOCK
from lcollision_core.errors import LabelStoreError, LCollisionError, MissingExtraError
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.labels.labeller import Labeller, LabelRows, StoreIdentity, blocks_of
from lcollision_core.labels.store import LabelStore, chunks_of

CountRows = Callable[[LabelRows], None]
"""Called with the rows that were labelled since the last call."""

_BLOCKS_AHEAD = 2
"""Blocks submitted per thread, so that none idles while a chunk is written."""


def label_locally(
    labeller: Labeller,
    seed: int,
    chunks: Sequence[range],
    n_threads: int,
    count: CountRows,
    job: Job,
) -> Generator[tuple[range, LabelRows], None, None]:
    """Label chunks in turn, with their blocks spread over threads.

    Parameters
    ----------
    labeller : of the model
    seed : of the samples
    chunks : the rows to label
    n_threads : >= 1
    count : called after each block
    job : polled after each block

    Yields
    ------
    each of `chunks` with its labels, in order

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    labeller.prepare()
    n_rows, n_faces = sum(map(len, chunks)), labeller.embedding.topology.n_faces
    size = block_size(n_rows, n_faces, ROWS_PER_BLOCK) // ROWS_PER_BLOCK * ROWS_PER_BLOCK
    blocks = (rows for chunk in chunks for rows in blocks_of(chunk, size))
    pending: deque[Future[LabelRows]] = deque()
    pool = ThreadPoolExecutor(n_threads, thread_name_prefix="labels")
    try:
        for chunk in chunks:
            parts: list[LabelRows] = []
            for _ in blocks_of(chunk, size):
                while len(pending) < _BLOCKS_AHEAD * n_threads and (rows := next(blocks, None)):
                    pending.append(pool.submit(labeller.label_rows, seed, rows))
                job.check()
                parts.append(pending.popleft().result())
                count(parts[-1])
            yield chunk, LabelRows.joined(parts)
    finally:
        pool.shutdown(cancel_futures=True)


_CONNECT_SECONDS = 20
_POLL_SECONDS = 0.5
_CHUNKS_AHEAD = 2
"""Chunks submitted per thread of the cluster, so that none idles while its result travels."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
FromWorker = tuple[str, str, _Result]
"""The worker's address, its version of this program, and the result."""


def label_on_cluster(
    labeller: Labeller,
    seed: int,
    chunks: Sequence[range],
    scheduler: str,
    count: CountRows,
    job: Job,
) -> Generator[tuple[range, LabelRows], None, None]:
    """Label chunks on the workers of a Dask scheduler.

    Parameters
    ----------
    labeller : of the model; it is sent to every worker once
    seed : of the samples
    chunks : the rows to label
    scheduler : its address
    count : called after each chunk
    job : polled while waiting

    Yields
    ------
    each of `chunks` with its labels, in order of completion

    Raises
    ------
    LCollisionError : as for `run_on_cluster`.
    CancelledError : the job was cancelled.
    """
    items = [(seed, rows) for rows in chunks]
    for (_, rows), labelled in run_on_cluster(label_on_worker, labeller, items, scheduler, job):
        count(labelled)
        yield rows, labelled


def run_on_cluster(
    run: Callable[[Any, _Item], FromWorker[_Result]],
    shared: Any,
    items: Sequence[_Item],
    scheduler: str,
    job: Job,
) -> Generator[tuple[_Item, _Result], None, None]:
    """Run a function on each item on the workers of a Dask scheduler.

    The workers need this program in the same version. Items of workers that leave are run by
    others, and late workers join in; every result carries the version of its worker.

    Parameters
    ----------
    run : called on a worker with `shared` and an item; returns `from_worker` of its result
    shared : sent to every worker once
    items : arguments of `run`
    scheduler : its address
    job : polled while waiting

    Yields
    ------
    each of `items` with its result, in order of completion

    Raises
    ------
    MissingExtraError : Dask is not installed.
    LCollisionError : no scheduler or worker answers, a worker lacks the program or has another
        version, or workers die.
    CancelledError : the job was cancelled.
    """
    try:
        from distributed import CancelledError as LostError
        from distributed import Client, KilledWorker, wait
    except ImportError as error:
        raise MissingExtraError(
            "work on a cluster needs Dask",
            "install it with pip install 'lcollision[cluster]'",
        ) from error
    connect = partial(Client, scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    try:
        try:
            client = connect()
        except AssertionError:
            # On a machine that stalls, Dask gives up its own thread; a second attempt works.
            client = connect()
    except (OSError, ValueError, TypeError) as error:
        raise LCollisionError(
            f"no Dask scheduler answers at {scheduler}",
            "start one with `dask scheduler`, or check the address",
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_SECONDS)
            for worker, version in client.run(program_version).items():
                _require_version(worker, version)
            sent = client.scatter(shared, broadcast=True, hash=False)
            remaining = deque(items)
            pending: dict[Any, _Item] = {}
            while remaining or pending:
                # Workers come and go; without any, an item waits for the next.
                n_threads = max(sum(client.nthreads().values()), 1)
                while remaining and len(pending) < _CHUNKS_AHEAD * n_threads:
                    item = remaining.popleft()
                    pending[client.submit(run, sent, item, pure=False)] = item
                job.check()
                with client.as_current(), suppress(TimeoutError):
                    wait(list(pending), timeout=_POLL_SECONDS, return_when="FIRST_COMPLETED")
                for future in [future for future in pending if future.done()]:
                    item = pending.pop(future)
                    worker, version, result = future.result()
                    # Check every item: workers that join late were not checked before.
                    _require_version(worker, version)
                    yield item, result
        except TimeoutError as error:
            raise LCollisionError(
                f"the scheduler at {scheduler} has no workers",
                f"start some with `dask worker {scheduler}`",
            ) from error
        except ImportError as error:
            raise LCollisionError(
                f"a worker of {scheduler} doesn't have lcollision installed ({error})",
                f"install lcollision {program_version()} there",
            ) from error
        except (KilledWorker, LostError) as error:
            raise LCollisionError(
                f"the workers of {scheduler} died",
                "give them more memory, then run the same command again to continue",
            ) from error


def program_version() -> str:
    """Return the version of this program, which workers must have too."""
    return version("lcollision")


def label_on_worker(labeller: Labeller, chunk: tuple[int, range]) -> FromWorker[LabelRows]:
    """Label one chunk, given as (seed, rows)."""
    return from_worker(labeller.label_rows(*chunk))


def from_worker(result: _Result) -> FromWorker[_Result]:
    """Return a result with the worker's address and its version of this program."""
    from distributed import get_worker

    return get_worker().address, program_version(), result


def _require_version(worker: str, installed: str) -> None:
    if installed != program_version():
        raise LCollisionError(
            f"worker {worker} runs lcollision {installed}, but this machine runs "
            f"{program_version()}",
            "install the same version there",
        )


@dataclass(frozen=True)
class LabelStatus:
    """Progress of a labelling run.

    Attributes
    ----------
    done, total : numbers of rows, including those of earlier runs
    n_colliding : number of colliding rows among those done
    labelled : number of rows labelled in this run
    seconds : time since this run began to label
    """

    done: int
    total: int
    n_colliding: int
    labelled: int = 0
    seconds: float = 0.0

    @property
    def rows_per_second(self) -> float | None:
        """The rate of this run, None before its first rows."""
        return self.labelled / max(self.seconds, 1e-9) if self.labelled else None

    @property
    def seconds_left(self) -> float | None:
        """The remaining time at that rate, None before this run's first rows."""
        rate = self.rows_per_second
        return None if rate is None else (self.total - self.done) / rate

    @property
    def colliding_share(self) -> float | None:
        """Fraction of the rows done that collide, None before the first."""
        return self.n_colliding / self.done if self.done else None


def label_poses(
    labeller: Labeller,
    path: str | os.PathLike[str],
    n_rows: int,
    *,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
    job: Job = UNWATCHED,
) -> LabelStatus:
    """Extend a store to at least `n_rows` labelled samples of a model's latent box.

    Resume where an earlier run ended, however it ended; rows that are damaged, or missing before
    later ones, are labelled again. Sample i of (model, seed) has the same labels to the last bit on
    any number of workers and on a cluster, so several runs may label into one store.

    Parameters
    ----------
    labeller : of the model
    path : the store, created if there is none
    n_rows : >= 1
    seed : of the samples, >= 0
    workers : threads, by default one per available core; unused with a scheduler
    scheduler : address of a Dask scheduler, such as "tcp://10.0.0.1:8786"
    job : reports a `LabelStatus` after every block of rows, and is polled then; finished chunks
        are kept

    Returns
    -------
    status : the final status, with all rows of the store done

    Raises
    ------
    LabelStoreError : the store belongs to another model or seed, or its manifest is damaged.
    MeshFileError : it cannot be written.
    MissingExtraError : `scheduler` without Dask installed.
    LCollisionError : no scheduler or worker answers at the address, or a worker has another
        version of the program.
    CancelledError : the job was cancelled.
    """
    if n_rows < 1 or seed < 0:
        raise LabelStoreError(
            f"a store needs at least 1 row and a seed of 0 or more, got {n_rows} and {seed}"
        )
    store = LabelStore.open_or_make(path, StoreIdentity.of(labeller, seed))
    total = max(n_rows, store.end)
    missing, done, n_colliding = [], 0, 0
    for chunk in chunks_of(total):
        job.check()
        try:
            rows = store.read(chunk)
        except LabelStoreError:
            missing.append(chunk)
        else:
            done += len(rows)
            n_colliding += int(np.count_nonzero(rows.colliding))
    status = LabelStatus(done, total, n_colliding)
    job.report(status)
    started = time.monotonic()

    def count(rows: LabelRows) -> None:
        nonlocal status
        labelled = status.labelled + len(rows)
        n_colliding = status.n_colliding + int(np.count_nonzero(rows.colliding))
        seconds = time.monotonic() - started
        status = LabelStatus(done + labelled, total, n_colliding, labelled, seconds)
        job.report(status)

    if not missing:
        return status
    if scheduler is None:
        n_threads = available_cores() if workers is None else workers
        results = label_locally(labeller, seed, missing, n_threads, count, job)
    else:
        results = label_on_cluster(labeller, seed, missing, scheduler, count, job)
    # Close the generator even if a chunk cannot be written: the workers must stop labelling.
    with closing(results):
        for chunk, rows in results:
            store.write(chunk, rows)
    return status
