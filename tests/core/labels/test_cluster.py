"""Labelling on a Dask cluster gives the same rows as here, and fails in sentences."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

import pytest

from lcollision_core.errors import CancelledError, LCollisionError, MissingExtraError
from lcollision_core.jobs import Job
from lcollision_core.labels import (
    ROWS_PER_CHUNK,
    Labeller,
    LabelStatus,
    label_poses,
    labelling_run,
)
from tests.core.labelled import files_of

pytestmark = pytest.mark.slow

N_ROWS = 4 * ROWS_PER_CHUNK + 200


def test_a_cluster_gives_the_rows_of_this_process(
    scheduler: str, labeller: Labeller, tmp_path: Path
) -> None:
    label_poses(labeller, tmp_path / "here", N_ROWS, seed=5, workers=1)
    statuses: list[LabelStatus] = []
    label_poses(
        labeller,
        tmp_path / "there",
        N_ROWS,
        seed=5,
        scheduler=scheduler,
        job=Job(statuses.append),
    )
    assert len(files_of(tmp_path / "here")) == 6
    assert files_of(tmp_path / "here") == files_of(tmp_path / "there")
    assert statuses[-1].done == N_ROWS
    assert len(statuses) == 6


def test_a_cancelled_run_goes_on_here(scheduler: str, labeller: Labeller, tmp_path: Path) -> None:
    token = Job()
    with pytest.raises(CancelledError):
        label_poses(
            labeller,
            tmp_path / "store",
            N_ROWS,
            seed=5,
            scheduler=scheduler,
            job=token.part(lambda status: token.cancel() if status.done else None),
        )
    statuses: list[LabelStatus] = []
    label_poses(labeller, tmp_path / "store", N_ROWS, seed=5, job=Job(statuses.append))
    assert statuses[0].done > 0
    label_poses(labeller, tmp_path / "whole", N_ROWS, seed=5)
    assert files_of(tmp_path / "store") == files_of(tmp_path / "whole")


def test_the_others_do_the_work_of_a_worker_that_dies(
    scheduler: str, labeller: Labeller, tmp_path: Path
) -> None:
    from distributed import Client

    with Client(scheduler, set_as_default=False) as client:
        killed = threading.Event()

        def kill_one(status: LabelStatus) -> None:
            if status.done and not killed.is_set():
                killed.set()
                os.kill(min(client.run(os.getpid).values()), signal.SIGKILL)

        label_poses(
            labeller, tmp_path / "there", N_ROWS, seed=5, scheduler=scheduler, job=Job(kill_one)
        )
        assert killed.is_set()
    label_poses(labeller, tmp_path / "here", N_ROWS, seed=5)
    assert files_of(tmp_path / "here") == files_of(tmp_path / "there")


def test_a_worker_of_another_version_is_refused(
    scheduler: str, labeller: Labeller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(labelling_run, "version", lambda _: "9.9")
    with pytest.raises(
        LCollisionError, match=r"runs lcollision \S+, but this machine runs 9\.9; install the same"
    ):
        label_poses(labeller, tmp_path / "store", 10, scheduler=scheduler)


def test_workers_that_come_late_are_asked_for_their_version(
    scheduler: str, labeller: Labeller, tmp_path: Path
) -> None:
    """Simulated by a version that changes after the first chunk."""
    from distributed import Client

    def change(found: str) -> None:
        labelling_run.version = lambda _: found  # type: ignore[assignment]

    with Client(scheduler, set_as_default=False) as client:
        (worker, *_) = client.nthreads()

        def change_one(status: LabelStatus) -> None:
            if status.done:
                client.run(change, "0.0.7", workers=[worker])

        try:
            with pytest.raises(LCollisionError, match=f"{worker} runs lcollision 0.0.7, but"):
                label_poses(
                    labeller,
                    tmp_path / "store",
                    12 * ROWS_PER_CHUNK,
                    scheduler=scheduler,
                    job=Job(change_one),
                )
        finally:
            client.run(change, labelling_run.program_version(), workers=[worker])


def test_workers_that_come_late_get_as_much_to_do(labeller: Labeller, tmp_path: Path) -> None:
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            processes=False,
            protocol="tcp",
            host="127.0.0.1",
            dashboard_address=":0",
        ) as local,
        Client(local, set_as_default=False) as client,
    ):
        in_hand: list[int] = []

        def add_two(status: LabelStatus) -> None:
            tasks = [key for key in list(local.scheduler.tasks) if "label_on_worker" in str(key)]
            in_hand.append(len(tasks))
            if status.done and len(in_hand) == 2:
                local.scale(3)
                client.wait_for_workers(3)

        label_poses(
            labeller,
            tmp_path / "store",
            8 * ROWS_PER_CHUNK,
            scheduler=local.scheduler_address,
            job=Job(add_two),
        )
    assert in_hand[:2] == [0, 2]
    assert max(in_hand) >= 6


def test_no_scheduler_and_no_worker_are_told(
    labeller: Labeller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster

    with monkeypatch.context() as hasty:
        hasty.setattr(labelling_run, "_CONNECT_SECONDS", 1)
        for address in ("tcp://127.0.0.1:9", "nonsense://nowhere"):
            with pytest.raises(LCollisionError, match=f"no Dask scheduler answers at {address}"):
                label_poses(labeller, tmp_path / "store", 10, scheduler=address)
        # Long enough to reach the scheduler on a busy machine.
        hasty.setattr(labelling_run, "_CONNECT_SECONDS", 5)
        with (
            LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=":0") as empty,
            pytest.raises(LCollisionError, match="has no workers; start some with `dask worker"),
        ):
            label_poses(labeller, tmp_path / "store", 10, scheduler=empty.scheduler_address)


def test_without_dask_the_extra_is_named(
    labeller: Labeller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"lcollision\[cluster\]"):
        label_poses(labeller, tmp_path / "store", 10, scheduler="tcp://127.0.0.1:8786")
