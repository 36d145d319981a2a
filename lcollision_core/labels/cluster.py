"""Work on a Dask cluster: labelling, of which workers label chunks that this process writes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from typing import Any, TypeVar

from lcollision_core.errors import LCollisionError, MissingExtraError
from lcollision_core.jobs import CancelToken
from lcollision_core.labels.labeller import Labeller, LabelRows
from lcollision_core.labels.local import CountRows

_CONNECT_SECONDS = 20
_POLL_SECONDS = 0.5
_CHUNKS_AHEAD = 2
"""Chunks submitted for each thread of the cluster, so that none idles while its result travels."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
FromWorker = tuple[str, str, _Result]
"""The worker, its version of this program, and what it found."""


def label_on_cluster(
    labeller: Labeller,
    seed: int,
    chunks: Sequence[range],
    scheduler: str,
    count: CountRows,
    cancel: CancelToken,
) -> Generator[tuple[range, LabelRows], None, None]:
    """Label chunks on the workers of a Dask scheduler.

    Parameters
    ----------
    labeller : of the model; it is sent to every worker once
    seed : of the samples
    chunks : the rows to label
    scheduler : its address
    count : called after each chunk
    cancel : polled while waiting

    Yields
    ------
    each of `chunks` with its labels, as they come

    Raises
    ------
    LCollisionError : as of `run_on_cluster`.
    CancelledError : `cancel` was set.
    """
    items = [(seed, rows) for rows in chunks]
    for (_, rows), labelled in run_on_cluster(label_on_worker, labeller, items, scheduler, cancel):
        count(labelled)
        yield rows, labelled


def run_on_cluster(
    run: Callable[[Any, _Item], FromWorker[_Result]],
    shared: Any,
    items: Sequence[_Item],
    scheduler: str,
    cancel: CancelToken,
) -> Generator[tuple[_Item, _Result], None, None]:
    """Run something for each of some items on the workers of a Dask scheduler.

    The workers need this program in the same version. Those that leave are replaced by others,
    those that come later join in; every result carries the version that it is from.

    Parameters
    ----------
    run : called with `shared` and an item on a worker, and returns `from_worker` of what it finds
    shared : is sent to every worker once
    items : what to do
    scheduler : its address
    cancel : polled while waiting

    Yields
    ------
    each of `items` with its result, as they come

    Raises
    ------
    MissingExtraError : Dask is not installed.
    LCollisionError : no scheduler or worker answers, a worker has another version of the program
        or none, or workers die.
    CancelledError : `cancel` was set.
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
            # On a machine that stalls Dask gives its own thread up; a second one starts afresh.
            client = connect()
    except (OSError, ValueError, TypeError) as error:
        raise LCollisionError(
            f"no Dask scheduler answers at {scheduler}",
            "start one with `dask scheduler`, or check the address",
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_SECONDS)
            for worker, found in client.run(program_version).items():
                _require_version(worker, found)
            sent = client.scatter(shared, broadcast=True, hash=False)
            remaining = deque(items)
            pending: dict[Any, _Item] = {}
            while remaining or pending:
                # Workers come and go; with none, an item waits for the next.
                n_threads = max(sum(client.nthreads().values()), 1)
                while remaining and len(pending) < _CHUNKS_AHEAD * n_threads:
                    item = remaining.popleft()
                    pending[client.submit(run, sent, item, pure=False)] = item
                cancel.raise_if_cancelled()
                with client.as_current(), suppress(TimeoutError):
                    wait(list(pending), timeout=_POLL_SECONDS, return_when="FIRST_COMPLETED")
                for future in [future for future in pending if future.done()]:
                    item = pending.pop(future)
                    worker, found, result = future.result()
                    # For every item: workers that join late are not checked before.
                    _require_version(worker, found)
                    yield item, result
        except TimeoutError as error:
            raise LCollisionError(
                f"the scheduler at {scheduler} has no workers",
                f"start some with `dask worker {scheduler}`",
            ) from error
        except ImportError as error:
            raise LCollisionError(
                f"a worker of {scheduler} lacks this program ({error})",
                f"install lcollision {program_version()} there",
            ) from error
        except (KilledWorker, LostError) as error:
            raise LCollisionError(
                f"the workers of {scheduler} died",
                "give them more memory, then run the same command again to continue",
            ) from error


def program_version() -> str:
    """Return the version of this program, which the workers' must equal."""
    return version("lcollision")


def label_on_worker(labeller: Labeller, chunk: tuple[int, range]) -> FromWorker[LabelRows]:
    """Label one chunk, of a seed and rows."""
    return from_worker(labeller.label_rows(*chunk))


def from_worker(result: _Result) -> FromWorker[_Result]:
    """Say which worker found a result, and by which version of this program."""
    from distributed import get_worker

    return get_worker().address, program_version(), result


def _require_version(worker: str, found: str) -> None:
    if found != program_version():
        raise LCollisionError(
            f"the worker {worker} has lcollision {found}, this is {program_version()}",
            "install the same version there",
        )
