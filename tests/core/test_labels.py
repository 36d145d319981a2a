"""Exact labels: how samples are drawn, what is said of them, and that all runs say the same."""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.contact import domain_energy
from lcollision_core.errors import CancelledError, LabelStoreError, ShapeError
from lcollision_core.jobs import CancelToken
from lcollision_core.labels import (
    BOX_SCALE,
    ROWS_A_BLOCK,
    ROWS_A_CHUNK,
    Labeller,
    LabelRows,
    LabelStatus,
    LabelStore,
    LatentBox,
    is_held_out,
    label_poses,
)
from lcollision_core.labels.local import ChunkTask, label_locally
from lcollision_core.model import PoseModel
from tests.core.labelled import as_bytes, labeller_of

N_ROWS = ROWS_A_CHUNK + 500

PINNED_BITS = [12324809925222472078, 2472481397521176968]


@pytest.fixture(scope="module")
def labeller(tube_model: PoseModel) -> Labeller:
    return labeller_of(tube_model)


@pytest.fixture(scope="module")
def truth(labeller: Labeller) -> LabelRows:
    """Return rows labelled block after block, without store, threads or chunks."""
    blocks = range(-(-N_ROWS // ROWS_A_BLOCK))
    rows = LabelRows.joined([labeller.label_block(3, block) for block in blocks]).head(N_ROWS)
    assert 10 < rows.colliding.sum() < N_ROWS / 2
    return rows


def test_the_samples_of_a_seed_never_change() -> None:
    """A store that an older program began must go on with the same rows."""
    box = LatentBox(np.array([0.0, -2.0]), np.array([1.0, 2.0]))
    first = box.draw(7, 11)[0]
    bits = np.random.Philox(np.random.SeedSequence([7, 11])).random_raw(2)
    assert bits.tolist() == PINNED_BITS
    assert first[0] == np.float32((PINNED_BITS[0] >> 11) / 2**53)
    assert first[1] == np.float32(-2.0 + 4.0 * ((PINNED_BITS[1] >> 11) / 2**53))


def test_samples_fill_the_box_evenly() -> None:
    low, high = np.array([-1.0, 3.0, 0.5]), np.array([2.0, 3.5, 10.0])
    box = LatentBox(low, high)
    samples = np.concatenate([box.draw(0, block) for block in range(200)]).astype(np.float64)
    place = (samples - low) / (high - low)
    assert place.min() >= 0.0
    assert place.max() <= 1.0 + 1e-6
    shares = np.stack([np.histogram(column, 8, (0, 1))[0] for column in place.T]) / len(place)
    # Five standard deviations of a share of 1/8 among 6400.
    assert np.abs(shares - 0.125).max() < 5 * np.sqrt(0.125 * 0.875 / len(place))
    assert np.abs(np.corrcoef(place.T) - np.eye(3)).max() < 5 / np.sqrt(len(place))


def test_blocks_and_seeds_differ() -> None:
    box = LatentBox(np.zeros(4), np.ones(4))
    drawn = [box.draw(seed, block) for seed in range(3) for block in range(3)]
    assert len({block.tobytes() for block in drawn}) == 9
    assert np.array_equal(box.draw(1, 2), drawn[5])


def test_the_box_is_the_one_that_poses_are_sampled_from(
    labeller: Labeller, tube_model: PoseModel
) -> None:
    assert BOX_SCALE == 1.2
    assert np.array_equal(labeller.box.low, 1.2 * tube_model.latent_space.minimum)
    assert np.array_equal(labeller.box.high, 1.2 * tube_model.latent_space.maximum)


def test_labels_are_those_of_the_exact_check_of_the_exported_mesh(
    truth: LabelRows, tube_model: PoseModel
) -> None:
    chosen = np.concatenate([np.flatnonzero(truth.colliding)[:8], np.arange(8)])
    for row in chosen:
        exported = tube_model.decode(truth.latent[row]).astype(np.float32)
        found = tube_model.detector.detect(exported)
        assert truth.n_pairs[row] == len(found.pairs)
        assert truth.n_near_pairs[row] == len(found.near_pairs) == 0
        assert truth.energy[row] == pytest.approx(found.energy, rel=1e-12)
        by_domain = domain_energy(found.vertex_energy[None], tube_model.attention_mask)[0]
        assert truth.domain_energy[row] == pytest.approx(by_domain, rel=1e-12)


def test_domains_share_out_all_of_the_energy(truth: LabelRows) -> None:
    assert truth.energy[truth.colliding].min() > 0.0
    assert (truth.energy[~truth.colliding] == 0.0).all()
    assert truth.domain_energy.sum(axis=1) == pytest.approx(truth.energy, rel=1e-6)
    assert (truth.domain_energy[truth.colliding].max(axis=0) > 0.0).all()


def test_near_pairs_are_counted_apart(labeller: Labeller, truth: LabelRows) -> None:
    every = np.flatnonzero(truth.colliding)[:20]
    excluded = replace(labeller, near_exclusion=0.5).label(truth.latent[every])
    assert excluded.n_near_pairs.max() > 0
    assert np.array_equal(excluded.n_pairs + excluded.n_near_pairs, truth.n_pairs[every])
    assert (excluded.energy <= truth.energy[every] * (1.0 + 1e-12)).all()
    assert excluded.energy.sum() < truth.energy[every].sum()


def test_a_row_has_the_same_bits_alone_and_in_a_batch(labeller: Labeller, truth: LabelRows) -> None:
    alone = [labeller.label(truth.latent[row : row + 1]) for row in range(70)]
    assert as_bytes(LabelRows.joined(alone)) == as_bytes(truth.head(70))


def test_a_labeller_that_travelled_says_the_same(labeller: Labeller, truth: LabelRows) -> None:
    copy = pickle.loads(pickle.dumps(labeller))
    assert copy.fingerprint == labeller.fingerprint
    assert as_bytes(copy.label_block(3, 0)) == as_bytes(truth.head(ROWS_A_BLOCK))


def test_a_latent_of_another_size_is_refused(labeller: Labeller) -> None:
    with pytest.raises(ShapeError, match="latent must be of shape"):
        labeller.label(np.zeros((2, 5)))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_any_number_of_workers_gives_the_same_store(
    workers: int, labeller: Labeller, truth: LabelRows, tmp_path: Path
) -> None:
    path = tmp_path / "store"
    label_poses(labeller, path, N_ROWS, seed=3, workers=workers)
    store = LabelStore.open(path)
    assert store.n_rows == len(store) == N_ROWS
    assert store.n_colliding == truth.colliding.sum()
    assert as_bytes(store.load()) == as_bytes(truth)


def test_no_more_than_a_block_a_thread_is_begun_beyond_the_chunk_in_work(
    labeller: Labeller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a kill may cost: the rows of finished blocks whose chunk is not written."""
    begun: list[int] = []
    label_block = Labeller.label_block

    def count_and_label(self: Labeller, seed: int, block: int) -> LabelRows:
        begun.append(block)
        return label_block(self, seed, block)

    monkeypatch.setattr(Labeller, "label_block", count_and_label)
    tasks = [ChunkTask(chunk, ROWS_A_CHUNK) for chunk in range(4)]
    labelled = label_locally(labeller, 3, tasks, 20, lambda *_: None, CancelToken())
    next(labelled)
    expected = ROWS_A_CHUNK // ROWS_A_BLOCK + 20
    deadline = time.monotonic() + 60
    while len(begun) < expected and time.monotonic() < deadline:
        time.sleep(0.01)
    labelled.close()
    assert sorted(begun) == list(range(expected))


def test_a_cancelled_run_keeps_its_chunks_and_goes_on(
    labeller: Labeller, truth: LabelRows, tmp_path: Path
) -> None:
    path, token = tmp_path / "store", CancelToken()

    def cancel_in_the_second_chunk(status: LabelStatus) -> None:
        if status.done > ROWS_A_CHUNK + ROWS_A_BLOCK:
            token.cancel()

    with pytest.raises(CancelledError):
        label_poses(
            labeller, path, N_ROWS, seed=3, progress=cancel_in_the_second_chunk, cancel=token
        )
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth.head(ROWS_A_CHUNK))
    statuses: list[LabelStatus] = []
    label_poses(labeller, path, N_ROWS, seed=3, progress=statuses.append)
    assert statuses[0].done == ROWS_A_CHUNK
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)


def test_a_store_grows_and_never_shrinks(
    labeller: Labeller, truth: LabelRows, tmp_path: Path
) -> None:
    path = tmp_path / "store"
    for wanted, kept in ((100, 100), (ROWS_A_CHUNK + 7, ROWS_A_CHUNK + 7), (20, ROWS_A_CHUNK + 7)):
        store = label_poses(labeller, path, wanted, seed=3)
        assert as_bytes(store.load()) == as_bytes(truth.head(kept))
    label_poses(labeller, path, N_ROWS, seed=3)
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)


def test_progress_tells_rate_time_left_and_share(
    labeller: Labeller, truth: LabelRows, tmp_path: Path
) -> None:
    statuses: list[LabelStatus] = []
    label_poses(labeller, tmp_path / "store", N_ROWS, seed=3, progress=statuses.append)
    assert statuses[0] == LabelStatus(0, N_ROWS, 0, None, None)
    assert statuses[0].colliding_share is None
    for status in statuses[1:]:
        assert status.n_colliding == truth.colliding[: status.done].sum()
        assert status.rows_per_second is not None
        assert status.seconds_left == pytest.approx((N_ROWS - status.done) / status.rows_per_second)
    assert [status.done for status in statuses[:3]] == [0, ROWS_A_BLOCK, 2 * ROWS_A_BLOCK]
    assert statuses[-1].done == N_ROWS
    assert statuses[-1].colliding_share == pytest.approx(truth.colliding.mean())
    assert 0.0 < statuses[-1].rows_per_second < 1e6


@pytest.mark.parametrize(("n_rows", "seed"), [(0, 0), (5, -1)])
def test_no_rows_and_negative_seeds_are_refused(
    n_rows: int, seed: int, labeller: Labeller, tmp_path: Path
) -> None:
    with pytest.raises(LabelStoreError, match="at least 1 row and a seed of 0 or more"):
        label_poses(labeller, tmp_path / "store", n_rows, seed=seed)
    assert list(tmp_path.iterdir()) == []


def test_three_rows_in_ten_are_held_out_for_good() -> None:
    held_out = is_held_out(np.arange(100_000))
    assert held_out.mean() == 0.3
    assert np.flatnonzero(held_out[:20]).tolist() == [7, 8, 9, 17, 18, 19]


def test_importing_labels_loads_neither_zarr_nor_dask_nor_torch() -> None:
    result = subprocess.run(
        [sys.executable, "-c", "import lcollision_core.labels, sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(result.stdout.split())
    assert "lcollision_core.labels.store" in loaded
    assert loaded & {"zarr", "dask", "distributed", "torch"} == set()
