"""The predictor: the paper's network, its file section, predictions and gradient."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lcollision_core.bodies import LearnedBody
from lcollision_core.errors import LabelStoreError, LCollisionError, ModelFileError, ShapeError
from lcollision_core.labels import LabelRows
from lcollision_core.model_file import Section, read_model_file, write_model_file
from lcollision_core.predictor import (
    PRESETS,
    CollisionPredictor,
    PredictorConfig,
    held_out_index,
    score_rows,
    train_predictor,
)
from lcollision_core.predictor.paper_network import PaperNetwork
from tests.core.predictor_rows import PAPER, config, made_up_rows

GROUPS = (3, 2, 4, 1)


@pytest.fixture(scope="module")
def rows(tube_model: LearnedBody) -> LabelRows:
    return made_up_rows(tube_model.embedding)


@pytest.fixture(scope="module", params=["paper", "default", "no domains"])
def predictor(
    tube_model: LearnedBody, rows: LabelRows, request: pytest.FixtureRequest
) -> CollisionPredictor:
    """Return a briefly trained predictor."""
    chosen = {
        "paper": config(epochs=1),
        "default": replace(PRESETS["default"], epochs=1, batch_rows=64),
        "no domains": config(epochs=1, by_domain=False),
    }[request.param]
    return train_predictor(rows, tube_model.embedding, chosen)


def test_the_paper_s_preset_is_the_paper_s() -> None:
    assert (
        PredictorConfig(
            preset="paper",
            depth_weight=5.0,
            rank_weight=2.0,
            entropy_weight=2.0,
            rate=1e-3,
            schedule="constant",
            batch_rows=32,
            epochs=30,
            # The paper does not state which weights it kept.
            average_passes=8.0,
        )
        == PAPER
    )
    network = PaperNetwork(GROUPS, True, 0)
    shapes = [tuple(layer.weight.shape) for layer in network.modules() if hasattr(layer, "weight")]
    assert shapes == [
        (10, 512),
        (512, 256),
        (256, 256),
        (3, 256 + 4, 512),
        (3, 512, 256),
        (3, 256, 256),
        (3, 256, 128),
        (3, 128, 1),
        (3, 64),
        (64, 1),
    ]
    undivided = PaperNetwork(GROUPS, False, 0)
    shapes = [tuple(part.weight.shape) for part in undivided.modules() if hasattr(part, "weight")]
    assert shapes[3:] == [(256, 128), (128, 1), (1, 64), (64, 1)]


def test_all_collision_predictors_at_once_are_each_on_its_own() -> None:
    network = PaperNetwork(GROUPS, True, 3).double()
    latent = torch.randn((5, sum(GROUPS)), dtype=torch.float64)
    relu = torch.relu
    state = latent
    for layer in list(network.encoder)[::2]:
        state = relu(state @ layer.weight + layer.bias)
    expected = []
    for domain, codes in enumerate(latent.split(GROUPS, dim=1)[1:]):
        values = torch.cat([state, codes], dim=1)
        for number, stacked in enumerate(network.predictors):
            # The first layer's rows beyond the domain's codes are unused.
            weight = stacked.weight[domain, : values.shape[1]]
            values = values @ weight + stacked.bias[domain]
            values = values if number == 4 else relu(values)
        expected.append(values[:, 0])
    energy = torch.stack(expected, dim=1)
    first, _, last = network.classifier
    logit = relu(energy @ first.weight + first.bias) @ last.weight + last.bias
    output = network(latent)
    assert output.domain_energy.std() > 0.0
    torch.testing.assert_close(output.domain_energy, energy)
    torch.testing.assert_close(output.logit, logit[:, 0])


def test_initial_weights_depend_on_the_seed_alone() -> None:
    torch.manual_seed(1)
    one = PaperNetwork(GROUPS, True, 5).state_dict()
    torch.manual_seed(2)
    before = torch.get_rng_state()
    same, other = (PaperNetwork(GROUPS, True, seed).state_dict() for seed in (5, 6))
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not any(torch.equal(one[name], other[name]) for name in one)


def test_predictions_are_of_the_right_form(predictor: CollisionPredictor, rows: LabelRows) -> None:
    result = predictor.predict(rows.latent[:700])
    assert result.domain_energy.shape == (700, 2)
    assert result.domain_energy.dtype == result.collision_logit.dtype == np.float64
    assert result.domain_energy.min() >= 0.0 < result.domain_energy.max()
    np.testing.assert_allclose(result.energy, result.domain_energy.sum(axis=1))
    probability = 1.0 / (1.0 + np.exp(-result.collision_logit))
    np.testing.assert_allclose(result.collision_probability, probability)
    assert not result.energy.flags.writeable
    alone = predictor.predict(rows.latent[699:700])
    np.testing.assert_allclose(alone.collision_logit, result.collision_logit[699:], rtol=1e-4)
    assert len(predictor.predict(rows.latent[:0]).energy) == 0


def test_gradient_is_the_logit_s_derivative(predictor: CollisionPredictor, rows: LabelRows) -> None:
    latent = rows.latent[:6].astype(np.float64)
    logit, gradient = predictor.logit_and_gradient(latent)
    expected = predictor.predict(latent).collision_logit
    np.testing.assert_allclose(logit, expected, rtol=1e-4, atol=1e-5)
    assert np.abs(gradient).max(axis=1).min() > 0.0
    step, scale = 1e-7, np.abs(gradient).max()
    for code in range(latent.shape[1]):
        moved = np.zeros_like(latent)
        moved[:, code] = step
        # In double precision: the default preset's own logits are single.
        ahead, _ = predictor._differentiated(latent + moved)
        behind, _ = predictor._differentiated(latent - moved)
        slope = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(gradient[:, code], slope, atol=1e-4 * scale)


def test_threads_may_share_a_predictor(predictor: CollisionPredictor, rows: LabelRows) -> None:
    parts = [rows.latent[start : start + 1 + start % 9] for start in range(0, 400, 10)]
    many = [rows.latent[start : start + 70 + start % 3] for start in range(0, 400, 10)]

    def both(part: np.ndarray) -> tuple[np.ndarray, ...]:
        return *predictor.scaled_outputs(part), *predictor.logit_and_gradient(part)

    # The rounding of torch's products depends on its number of threads.
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    expected = [both(part) for part in parts]
    expected_many = [predictor.scaled_outputs(part) for part in many]
    torch.set_num_threads(n_threads)
    with ThreadPoolExecutor(4, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        found = list(pool.map(both, parts))
        found_many = list(pool.map(predictor.scaled_outputs, many))
    for results, truth in ((found, expected), (found_many, expected_many)):
        for ours, theirs in zip(results, truth, strict=True):
            for array, known in zip(ours, theirs, strict=True):
                np.testing.assert_array_equal(array, known)


def test_a_result_stays_when_there_is_another(
    predictor: CollisionPredictor, rows: LabelRows
) -> None:
    for n_rows in (1, 100):
        first = predictor.scaled_outputs(rows.latent[:n_rows])
        kept = [array.copy() for array in first]
        predictor.scaled_outputs(rows.latent[n_rows : 2 * n_rows])
        for array, known in zip(first, kept, strict=True):
            np.testing.assert_array_equal(array, known)


def test_a_model_file_and_a_pickle_keep_all(
    predictor: CollisionPredictor, rows: LabelRows, tube_model: LearnedBody, tmp_path: Path
) -> None:
    path = tmp_path / "predictor"
    write_model_file(path, {"predictor": predictor.to_section()})
    section = read_model_file(path)["predictor"]
    expected = predictor.predict(rows.latent[:50])
    read = CollisionPredictor.from_section(section, tube_model.embedding)
    predictor.logit_and_gradient(rows.latent[:1])
    for copy in (read, pickle.loads(pickle.dumps(predictor))):
        assert (copy.config, copy.facts, copy.metrics) == (
            predictor.config,
            predictor.facts,
            predictor.metrics,
        )
        found = copy.predict(rows.latent[:50])
        np.testing.assert_array_equal(found.domain_energy, expected.domain_energy)
        np.testing.assert_array_equal(found.collision_logit, expected.collision_logit)


def test_a_section_that_does_not_fit_is_refused(
    predictor: CollisionPredictor, tube_model: LearnedBody
) -> None:
    section = predictor.to_section()
    unknown = Section(section.arrays, {**section.metadata, "preset": "oracle"})
    with pytest.raises(
        ModelFileError, match="unknown preset, expected default or large or paper, got 'oracle'"
    ):
        CollisionPredictor.from_section(unknown, tube_model.embedding)
    name = min(section.arrays)
    short = {**section.arrays, name: section.arrays[name][..., :1]}
    fewer = {key: array for key, array in section.arrays.items() if key != name}
    without_facts = {key: value for key, value in section.metadata.items() if key != "facts"}
    for broken in (
        Section(short, section.metadata),
        Section(fewer, section.metadata),
        Section(section.arrays, without_facts),
        Section(section.arrays, {**section.metadata, "config": {"epochs": 0}}),
        Section(section.arrays, {**section.metadata, "config": None}),
    ):
        with pytest.raises(ModelFileError, match=r"does not fit its latent space: .*; train"):
            CollisionPredictor.from_section(broken, tube_model.embedding)


def test_files_of_earlier_versions_are_read(
    predictor: CollisionPredictor, tube_model: LearnedBody, rows: LabelRows
) -> None:
    section = predictor.to_section()
    old = {
        what: {name: value for name, value in section.metadata[what].items() if name != newer}
        for what, newer in (("config", "balanced"), ("facts", "logit_shift"))
    }
    old["config"]["kept"] = "last"
    read = CollisionPredictor.from_section(
        Section(section.arrays, {**section.metadata, **old}), tube_model.embedding
    )
    assert not read.config.balanced
    found, expected = (one.predict(rows.latent[:20]).collision_logit for one in (read, predictor))
    np.testing.assert_array_equal(found, expected)


def test_floating_point_operations_are_those_of_skin_and_layers(
    predictor: CollisionPredictor,
) -> None:
    """Each row uses every weight; the default preset's skin weights count thrice (x, y, z)."""
    arrays = predictor.arrays
    used = sum(array.size for name, array in arrays.items() if name.endswith(".weight"))
    used += 3 * sum(array.size for name, array in arrays.items() if name == "body.points")
    assert used > 1000
    assert predictor.flops(1) >= 2 * used
    assert predictor.flops(7) == 7 * predictor.flops(1)


def test_wrong_latents_are_refused(predictor: CollisionPredictor) -> None:
    size = predictor.embedding.latent_size
    for call in (predictor.predict, predictor.logit_and_gradient):
        with pytest.raises(ShapeError, match=rf"shape \(B, {size}\), got \({size},\)"):
            call(np.zeros(size))
        with pytest.raises(ShapeError, match="NaN or infinity"):
            call(np.full((2, size), np.nan))


def test_evaluation_counts_what_it_is_given(
    predictor: CollisionPredictor, rows: LabelRows, tube_model: LearnedBody
) -> None:
    kept = rows.taken(held_out_index(len(rows), predictor.config, len(rows)))
    assert len(kept) == 450
    np.testing.assert_array_equal(kept.latent[:4], rows.latent[[7, 8, 9, 17]])
    assert score_rows(predictor, kept).metrics() == predictor.metrics
    others = made_up_rows(tube_model.embedding, 300, seed=2)
    metrics = score_rows(predictor, others).metrics()
    called = predictor.predict(others.latent).collision_probability > 0.5
    assert metrics.accuracy == (called == others.colliding).mean()
    assert sum(entry.samples for entry in metrics.calibration) == 300
    with pytest.raises(LabelStoreError, match="no rows to evaluate"):
        score_rows(predictor, rows.taken(slice(0)))


def test_values_out_of_range_are_refused() -> None:
    for changes, sentence in (
        ({"batch_rows": 3}, "batch_rows must be even, got 3"),
        ({"epochs": 0}, "epochs must be at least 1, got 0"),
        ({"rank_weight": -1.0}, "rank_weight must be at least 0"),
        ({"rate": 0.0}, "rate must be over 0"),
        ({"entropy_weight": float("nan")}, "entropy_weight must be over 0"),
    ):
        with pytest.raises(LCollisionError, match=sentence):
            config(**changes)
