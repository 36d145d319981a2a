"""One model, and rows of it labelled without store, threads or chunks."""

from __future__ import annotations

from pathlib import Path

import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.labels import ROWS_PER_CHUNK, Labeller, LabelRows, LabelStore, label_poses
from tests.core.labelled import labeller_of

N_ROWS, SEED = 2 * ROWS_PER_CHUNK + 300, 3


@pytest.fixture(scope="session")
def labeller(tube_model: LearnedBody) -> Labeller:
    return labeller_of(tube_model)


@pytest.fixture(scope="session")
def ground_truth(labeller: Labeller) -> LabelRows:
    rows = labeller.label_rows(SEED, range(N_ROWS))
    assert 10 < rows.colliding.sum() < N_ROWS / 2
    return rows


@pytest.fixture(scope="session")
def finished(labeller: Labeller, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of these rows that no test may change."""
    path = tmp_path_factory.mktemp("finished") / "store"
    label_poses(labeller, path, N_ROWS, seed=SEED)
    assert LabelStore.open(path).n_rows == N_ROWS
    return path
