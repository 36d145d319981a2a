"""Labelling on a Dask cluster: workers label chunks, only this process writes them."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from typing import Any

from lcollision_core.errors import LCollisionError, MissingExtraError
from lcollision_core.jobs import CancelToken
from lcollision_core.labels.labeller import Labeller, LabelRows
from lcollision_core.labels.local import CountRows

_CONNECT_SECONDS = 20
_POLL_SECONDS = 0.5
_CHUNKS_AHEAD = 2
"""Chunks submitted for each thread of the cluster, so that none idles while its result travels."""


def label_on_cluster(
    labeller: Labeller,
    seed: int,
    chunks: Sequence[range],
    scheduler: str,
    count: CountRows,
    cancel: CancelToken,
) -> Generator[tuple[range, LabelRows], None, None]:
    """Label chunks on the workers of a Dask scheduler.

    The workers need this program in the same version. Those that leave are replaced by others,
    those that come later join in; every chunk carries the version that labelled it.

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
            "labelling on a cluster needs Dask",
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
            shared = client.scatter(labeller, broadcast=True, hash=False)
            remaining = deque(chunks)
            pending: dict[Any, range] = {}
            while remaining or pending:
                # Workers come and go; with none, a chunk waits for the next.
                n_threads = max(sum(client.nthreads().values()), 1)
                while remaining and len(pending) < _CHUNKS_AHEAD * n_threads:
                    rows = remaining.popleft()
                    pending[client.submit(label_on_worker, shared, seed, rows, pure=False)] = rows
                cancel.raise_if_cancelled()
                with client.as_current(), suppress(TimeoutError):
                    wait(list(pending), timeout=_POLL_SECONDS, return_when="FIRST_COMPLETED")
                for future in [future for future in pending if future.done()]:
                    rows = pending.pop(future)
                    worker, found, labelled = future.result()
                    # For every chunk: workers that join late are not checked before.
                    _require_version(worker, found)
                    count(labelled)
                    yield rows, labelled
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
                f"the workers of {scheduler} died while labelling",
                "give them more memory, then run the same command again to continue",
            ) from error


def program_version() -> str:
    """Return the version of this program, which the workers' must equal."""
    return version("lcollision")


def label_on_worker(labeller: Labeller, seed: int, rows: range) -> tuple[str, str, LabelRows]:
    """Label one chunk; returns the worker, its version of this program, and the labels."""
    from distributed import get_worker

    return get_worker().address, program_version(), labeller.label_rows(seed, rows)


def _require_version(worker: str, found: str) -> None:
    if found != program_version():
        raise LCollisionError(
            f"the worker {worker} has lcollision {found}, this is {program_version()}",
            "install the same version there",
        )
