"""The decision threshold, with equal false positive and false negative rates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.errors import ModelFileError
from lcollision_core.labels import is_held_out
from lcollision_core.model_file import Section
from lcollision_core.predictor import (
    CollisionPredictor,
    held_out_index,
    score_rows,
    train_predictor,
)
from lcollision_core.predictor import config as predictor_config
from lcollision_core.predictor.config import split_rows
from lcollision_core.predictor.training import balanced_logit
from tests.core.predictor_rows import config, made_up_rows


def _calibrated(
    n_rows: int, shift: float, spread: float, seed: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Draw logits around a shift, and labels with the corresponding probabilities."""
    rng = np.random.default_rng(seed)
    logit = shift + spread * rng.standard_normal(n_rows)
    return logit, rng.uniform(size=n_rows) < 1.0 / (1.0 + np.exp(-logit))


def _scores(logit: np.ndarray, colliding: np.ndarray, limit: float) -> tuple[float, float, float]:
    """Return the false positive rate, the false negative rate and the accuracy."""
    called = logit > limit
    return (
        float(called[~colliding].mean()),
        float((~called)[colliding].mean()),
        float((called == colliding).mean()),
    )


@pytest.mark.parametrize("shift", [2.0, -2.0])
def test_both_kinds_are_mistaken_alike_where_that_costs_next_to_nothing(shift: float) -> None:
    limit = balanced_logit(*_calibrated(20_000, shift, spread=12.0))
    assert np.sign(limit) == np.sign(shift)
    others = _calibrated(1_000_000, shift, spread=12.0, seed=5)
    alarms, missed, right = _scores(*others, 0.0)
    assert abs(alarms - missed) > 0.008
    balanced = _scores(*others, limit)
    assert abs(balanced[0] - balanced[1]) < 0.4 * abs(alarms - missed)
    assert balanced[2] > right - 1e-3


def test_other_rows_too_see_half_as_many_mistakes_again() -> None:
    """The threshold must not be an accident of the rows that choose it."""
    others = _calibrated(1_000_000, 6.0, spread=4.0, seed=5)
    alarms, missed, right = _scores(*others, 0.0)
    assert alarms > 3.0 * missed
    for seed in range(10):
        limit = balanced_logit(*_calibrated(5000, 6.0, spread=4.0, seed=seed))
        balanced = _scores(*others, limit)
        assert 1.4 < (1.0 - balanced[2]) / (1.0 - right) < 1.6
        assert missed < balanced[1] < balanced[0] < alarms


def test_what_cannot_be_told_from_chance_changes_nothing() -> None:
    logit, colliding = _calibrated(40, 0.6, spread=4.0)
    assert balanced_logit(logit, colliding) == 0.0
    assert balanced_logit(logit, np.ones(40, dtype=bool)) == 0.0
    assert balanced_logit(logit, np.zeros(40, dtype=bool)) == 0.0
    assert balanced_logit(np.empty(0), np.empty(0, dtype=bool)) == 0.0
    perfect = np.concatenate([np.linspace(-5.0, -4.0, 3000), np.linspace(4.0, 5.0, 6000)])
    assert balanced_logit(perfect, perfect > 0.0) == 0.0


def test_equal_logits_are_not_divided() -> None:
    colliding = np.arange(1000) < 700
    assert balanced_logit(np.full(1000, 0.3), colliding) == 0.0
    logit = np.where(colliding | (np.arange(1000) < 900), 0.3, -2.0)
    assert balanced_logit(logit, colliding) == 0.0


def test_rows_that_choose_neither_train_nor_measure() -> None:
    n_rows, chosen = 170_000, config(balanced=True)
    held_out = np.flatnonzero(is_held_out(np.arange(n_rows)))
    plain, balanced = split_rows(n_rows, config()), split_rows(n_rows, chosen)
    assert not len(plain.validation)
    np.testing.assert_array_equal(plain.held_out, held_out)
    np.testing.assert_array_equal(balanced.training, plain.training)
    np.testing.assert_array_equal(balanced.validation, held_out[::10])
    np.testing.assert_array_equal(np.union1d(balanced.validation, balanced.held_out), held_out)
    assert len(balanced.validation) + len(balanced.held_out) == len(held_out)
    # A row stays in its split when the store grows.
    grown = split_rows(n_rows + 501, chosen)
    np.testing.assert_array_equal(grown.validation[: len(balanced.validation)], balanced.validation)
    few = split_rows(150_000, chosen)
    assert len(few.validation) == 0
    assert len(few.held_out) == 45_000


@pytest.mark.parametrize("preset", ["paper", pytest.param("default", marks=pytest.mark.slow)])
def test_a_trained_predictor_calls_from_there(
    tube_model: LearnedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str
) -> None:
    monkeypatch.setattr(predictor_config, "LEAST_BALANCING", 100)
    embedding = tube_model.embedding
    rows = made_up_rows(embedding, 6000)
    chosen = config(preset=preset, epochs=1, batch_rows=600, balanced=True)
    trained = train_predictor(rows, embedding, chosen)
    plain = train_predictor(rows, embedding, replace(chosen, balanced=False))
    shift = trained.facts.logit_shift
    chosen_by = rows.taken(split_rows(len(rows), chosen).validation)
    expected = balanced_logit(plain.scaled_outputs(chosen_by.latent)[1], chosen_by.colliding)
    assert expected != 0.0
    assert shift == -expected
    assert plain.facts.logit_shift == 0.0

    measured = rows.taken(held_out_index(len(rows), chosen, len(rows)))
    assert trained.metrics == score_rows(trained, measured).metrics()
    assert trained.metrics is not None
    assert trained.metrics.samples == len(measured) == 1620
    # The choosing rows stay separate if fewer rows are read, and if the store has grown.
    choosing = {row.tobytes() for row in chosen_by.latent}
    for n_read, n_measured in ((1000, 270), (6000, 1620)):
        read = rows.taken(held_out_index(n_read, chosen, len(rows)))
        assert len(read) == n_measured
        assert not choosing & {row.tobytes() for row in read.latent}
    assert len(held_out_index(len(rows), chosen, 4000)) == 1800 - 120
    for latent in (measured.latent[:3], measured.latent[:200]):
        logit, gradient = trained.logit_and_gradient(latent)
        plain_logit, plain_gradient = plain.logit_and_gradient(latent)
        np.testing.assert_allclose(logit, plain_logit + shift, rtol=0.0, atol=1e-9)
        np.testing.assert_array_equal(gradient, plain_gradient)
        np.testing.assert_allclose(
            trained.predict(latent).collision_logit, logit, rtol=0.0, atol=1e-3
        )

    path = tmp_path / "model.safetensors"
    tube_model.with_predictor(trained).save(path)
    loaded = LearnedBody.load(path).require_predictor()
    assert loaded.facts == trained.facts
    np.testing.assert_array_equal(
        loaded.predict(measured.latent).collision_logit,
        trained.predict(measured.latent).collision_logit,
    )
    section = trained.to_section()
    facts = {**section.metadata["facts"], "logit_shift": float("nan")}
    with pytest.raises(
        ModelFileError, match=r"latent space: predictor.facts.logit_shift must be a finite"
    ):
        CollisionPredictor.from_section(
            Section(section.arrays, {**section.metadata, "facts": facts}), embedding
        )
