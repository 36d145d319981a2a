"""Labelling runs: equal files, resuming, and progress."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from lcollision_core.embedding import ROWS_PER_BLOCK
from lcollision_core.errors import CancelledError, LabelStoreError
from lcollision_core.jobs import Job
from lcollision_core.labels import (
    ROWS_PER_CHUNK,
    Labeller,
    LabelRows,
    LabelStatus,
    LabelStore,
    label_poses,
)
from lcollision_core.labels.labelling_run import label_locally
from tests.core.labelled import as_bytes, files_of
from tests.core.labels.conftest import N_ROWS, SEED


@pytest.mark.variants(2)
@pytest.mark.parametrize("workers", [1, 2, 5])
def test_any_number_of_workers_gives_the_same_files(
    workers: int, labeller: Labeller, ground_truth: LabelRows, finished: Path, tmp_path: Path
) -> None:
    path = tmp_path / "store"
    status = label_poses(labeller, path, N_ROWS, seed=SEED, workers=workers)
    assert (status.done, status.total, status.labelled) == (N_ROWS, N_ROWS, N_ROWS)
    assert status.n_colliding == ground_truth.colliding.sum()
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(ground_truth)
    assert files_of(path) == files_of(finished)


def test_two_runs_at_once_give_the_same_files(
    labeller: Labeller, finished: Path, tmp_path: Path
) -> None:
    runs = [
        threading.Thread(
            target=label_poses, args=(labeller, tmp_path / "store", N_ROWS), kwargs={"seed": SEED}
        )
        for _ in range(2)
    ]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert files_of(tmp_path / "store") == files_of(finished)


def test_no_more_than_two_blocks_a_thread_are_begun_beyond_the_chunk_in_work(
    labeller: Labeller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill loses at most the rows of finished blocks whose chunk is not written."""
    begun: list[int] = []
    label_rows = Labeller.label_rows

    def count_and_label(self: Labeller, seed: int, rows: range) -> LabelRows:
        begun.append(rows.start)
        return label_rows(self, seed, rows)

    monkeypatch.setattr(Labeller, "label_rows", count_and_label)
    chunks = [range(first, first + ROWS_PER_CHUNK) for first in range(0, 4096, ROWS_PER_CHUNK)]
    labelled = label_locally(labeller, SEED, chunks, 4, lambda _: None, Job())
    chunk, rows = next(labelled)
    labelled.close()
    assert (chunk, len(rows)) == (range(ROWS_PER_CHUNK), ROWS_PER_CHUNK)
    first_ones = list(range(0, ROWS_PER_CHUNK + 8 * ROWS_PER_BLOCK, ROWS_PER_BLOCK))
    assert sorted(begun) == first_ones[: len(begun)]
    assert len(begun) >= ROWS_PER_CHUNK // ROWS_PER_BLOCK


def test_a_cancelled_run_keeps_its_chunks_and_goes_on(
    labeller: Labeller, ground_truth: LabelRows, tmp_path: Path
) -> None:
    path, token = tmp_path / "store", Job()

    def cancel_in_the_second_chunk(status: LabelStatus) -> None:
        if status.done > ROWS_PER_CHUNK + ROWS_PER_BLOCK:
            token.cancel()

    with pytest.raises(CancelledError):
        label_poses(labeller, path, N_ROWS, seed=SEED, job=token.part(cancel_in_the_second_chunk))
    kept = LabelStore.open(path)
    assert kept.n_rows == ROWS_PER_CHUNK
    assert as_bytes(kept.load()) == as_bytes(ground_truth.taken(slice(ROWS_PER_CHUNK)))
    statuses: list[LabelStatus] = []
    label_poses(labeller, path, N_ROWS, seed=SEED, job=Job(statuses.append))
    assert statuses[0].done == ROWS_PER_CHUNK
    assert statuses[0].n_colliding == ground_truth.colliding[:ROWS_PER_CHUNK].sum()
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(ground_truth)


def test_a_store_grows_and_never_shrinks(
    labeller: Labeller, ground_truth: LabelRows, tmp_path: Path
) -> None:
    path = tmp_path / "store"
    for wanted, kept, labelled in (
        (100, 100, 100),
        (ROWS_PER_CHUNK + 7, ROWS_PER_CHUNK + 7, ROWS_PER_CHUNK + 7),
        (20, ROWS_PER_CHUNK + 7, 0),
        (ROWS_PER_CHUNK + 40, ROWS_PER_CHUNK + 40, 40),
    ):
        status = label_poses(labeller, path, wanted, seed=SEED)
        assert (status.done, status.labelled) == (kept, labelled)
        store = LabelStore.open(path)
        assert store.n_rows == kept
        assert as_bytes(store.load()) == as_bytes(ground_truth.taken(slice(kept)))


def test_progress_tells_rate_time_left_and_share(
    labeller: Labeller, ground_truth: LabelRows, tmp_path: Path
) -> None:
    statuses: list[LabelStatus] = []
    last = label_poses(labeller, tmp_path / "store", 500, seed=SEED, job=Job(statuses.append))
    assert statuses[0] == LabelStatus(0, 500, 0)
    assert statuses[0].colliding_share is None
    assert statuses[0].rows_per_second is statuses[0].seconds_left is None
    for status in statuses[1:]:
        assert status.n_colliding == ground_truth.colliding[: status.done].sum()
        assert status.rows_per_second is not None
        assert status.seconds_left == pytest.approx((500 - status.done) / status.rows_per_second)
    assert [status.done for status in statuses[:3]] == [0, ROWS_PER_BLOCK, 2 * ROWS_PER_BLOCK]
    assert statuses[-1] == last
    assert last.done == 500
    assert last.colliding_share == pytest.approx(ground_truth.colliding[:500].mean())
    assert 0.0 < last.rows_per_second < 1e6


@pytest.mark.parametrize(("n_rows", "seed"), [(0, 0), (5, -1)])
def test_no_rows_and_negative_seeds_are_refused(
    n_rows: int, seed: int, labeller: Labeller, tmp_path: Path
) -> None:
    with pytest.raises(LabelStoreError, match="at least 1 row and a seed of 0 or more"):
        label_poses(labeller, tmp_path / "store", n_rows, seed=seed)
    assert list(tmp_path.iterdir()) == []


def test_importing_labels_loads_neither_dask_nor_torch() -> None:
    result = subprocess.run(
        [sys.executable, "-c", "import lcollision_core.labels.public, sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(result.stdout.split())
    assert "lcollision_core.labels.store" in loaded
    assert loaded & {"dask", "distributed", "torch"} == set()
