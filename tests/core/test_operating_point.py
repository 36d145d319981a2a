"""Where poses are called colliding: free and colliding ones are mistaken equally often."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.errors import ModelFileError
from lcollision_core.labels import is_held_out
from lcollision_core.model import PoseModel
from lcollision_core.model_file import Section
from lcollision_core.predictor import (
    CollisionPredictor,
    evaluate_predictor,
    held_out_rows,
    train_predictor,
)
from lcollision_core.predictor.operating_point import balanced_logit
from lcollision_core.predictor.row_split import split_rows
from tests.core.predictor_rows import config, made_up_rows


def _calibrated(n_rows: int, shift: float, spread: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Draw logits about a shift, and truths that collide as often as these say."""
    rng = np.random.default_rng(4)
    logit = shift + spread * rng.standard_normal(n_rows)
    return logit, rng.uniform(size=n_rows) < 1.0 / (1.0 + np.exp(-logit))


def _rates(
    logit: np.ndarray, colliding: np.ndarray, limit: float
) -> tuple[float, float, float, float]:
    called = logit > limit
    alarms, missed = called[~colliding].mean(), (~called)[colliding].mean()
    variance = alarms * (1 - alarms) / (~colliding).sum()
    variance += missed * (1 - missed) / colliding.sum()
    return alarms, missed, 2.0 * np.sqrt(variance), (called == colliding).mean()


@pytest.mark.parametrize("shift", [0.6, -0.6])
def test_both_kinds_are_mistaken_alike_where_that_costs_next_to_nothing(shift: float) -> None:
    logit, colliding = _calibrated(40_000, shift, spread=6.0)
    limit = balanced_logit(logit, colliding)
    alarms, missed, error, right = _rates(logit, colliding, 0.0)
    assert abs(alarms - missed) > error
    assert np.sign(limit) == np.sign(shift)
    balanced = _rates(logit, colliding, limit)
    assert abs(balanced[0] - balanced[1]) <= balanced[2]
    assert balanced[3] >= right - 1e-3
    # No further than needed.
    halfway = _rates(logit, colliding, 0.9 * limit)
    assert abs(halfway[0] - halfway[1]) > abs(balanced[0] - balanced[1])


def test_no_more_than_a_thousandth_of_what_is_right_is_given_up() -> None:
    logit, colliding = _calibrated(40_000, 3.0)
    alarms, missed, _, right = _rates(logit, colliding, 0.0)
    limit = balanced_logit(logit, colliding)
    balanced = _rates(logit, colliding, limit)
    assert right - 1e-3 <= balanced[3] < right
    assert missed < balanced[1] < balanced[0] < alarms
    # The next pose that would be called otherwise: past it, too much would be given up.
    further = np.sort(logit[logit > limit])[40]
    assert _rates(logit, colliding, further)[3] < right - 1e-3


def test_what_cannot_be_told_from_chance_changes_nothing() -> None:
    logit, colliding = _calibrated(40, 0.6)
    assert balanced_logit(logit, colliding) == 0.0
    assert balanced_logit(logit, np.ones(40, dtype=bool)) == 0.0
    assert balanced_logit(logit, np.zeros(40, dtype=bool)) == 0.0
    assert balanced_logit(np.empty(0), np.empty(0, dtype=bool)) == 0.0
    perfect = np.array([-2.0, -1.0, 3.0, 4.0])
    assert balanced_logit(perfect, perfect > 0.0) == 0.0


def test_rows_that_choose_neither_train_nor_measure() -> None:
    held_out = np.flatnonzero(is_held_out(np.arange(1500)))
    plain, balanced = (split_rows(1500, config(balanced=choice)) for choice in (False, True))
    assert not len(plain.validation)
    np.testing.assert_array_equal(plain.held_out, held_out)
    np.testing.assert_array_equal(balanced.training, plain.training)
    np.testing.assert_array_equal(balanced.validation, held_out[::10])
    np.testing.assert_array_equal(
        np.union1d(balanced.validation, balanced.held_out), plain.held_out
    )
    assert len(balanced.validation) + len(balanced.held_out) == len(held_out)
    # A row keeps its side when its store grows.
    grown = split_rows(2001, config(balanced=True))
    np.testing.assert_array_equal(grown.validation[: len(balanced.validation)], balanced.validation)


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_a_trained_predictor_calls_from_there(
    tube_model: PoseModel, tmp_path: Path, preset: str
) -> None:
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

    measured = held_out_rows(rows, chosen)
    assert trained.metrics == evaluate_predictor(trained, measured)
    assert trained.metrics is not None
    assert trained.metrics.samples == len(measured) == 1620
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
    loaded = PoseModel.load(path).require_predictor()
    assert loaded.facts == trained.facts
    np.testing.assert_array_equal(
        loaded.predict(measured.latent).collision_logit,
        trained.predict(measured.latent).collision_logit,
    )
    section = trained.to_section()
    facts = {**section.metadata["facts"], "logit_shift": float("nan")}
    with pytest.raises(ModelFileError, match="does not fit its latent space; train"):
        CollisionPredictor.from_section(
            Section(section.arrays, {**section.metadata, "facts": facts}), embedding
        )
