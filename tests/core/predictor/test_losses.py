"""The paper's losses and scores against values by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lcollision_core.predictor import PRESETS
from lcollision_core.predictor.metrics import (
    Counts,
    area_under_roc,
    auc_interval,
    average_precision,
    interval,
    mean_difference,
    measure,
    roc_curve,
)
from lcollision_core.predictor.network_base import NetworkOutput, Targets
from lcollision_core.predictor.paper_network import (
    PaperNetwork,
    depth_loss,
    rank_loss,
    ranked_pairs,
)


def _double(*values: object) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _require_gradient(loss: object, values: torch.Tensor) -> None:
    """Compare autograd with central differences, and require a non-zero gradient."""
    values = values.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(values).sum(), values)  # type: ignore[operator]
    assert gradient.abs().max() > 0.0
    step = 1e-6
    for place in np.ndindex(*values.shape):
        ahead, behind = values.detach().clone(), values.detach().clone()
        ahead[place] += step
        behind[place] -= step
        slope = (loss(ahead).sum() - loss(behind).sum()) / (2 * step)  # type: ignore[operator]
        assert gradient[place] == pytest.approx(float(slope), abs=1e-7)


def test_depth_loss_adds_squares_of_domains_and_the_sum_s_error() -> None:
    predicted = _double([1.0, 3.0], [0.5, 0.0])
    truth, energy = _double([2.0, 1.0], [0.0, 0.0]), _double(3.0, 0.0)
    # (1-2)^2 + (3-1)^2 + |4-3| and 0.5^2 + 0 + |0.5|.
    assert depth_loss(predicted, truth, energy).tolist() == [6.0, 0.75]
    _require_gradient(lambda values: depth_loss(values, truth, energy), predicted)


def test_depth_loss_without_domains_is_the_sum_s_error_alone() -> None:
    predicted, energy = _double([1.0], [4.0]), _double(3.0, 0.0)
    none = torch.zeros((2, 0), dtype=torch.float64)
    assert depth_loss(predicted, none, energy).tolist() == [2.0, 4.0]


def test_depth_loss_vanishes_for_the_truth_when_the_masks_conserve_energy() -> None:
    shares = np.random.default_rng(0).dirichlet(np.ones(4), 50)
    energy = np.random.default_rng(1).random(50)
    truth = torch.tensor(shares * energy[:, None])
    assert depth_loss(truth, truth, torch.tensor(energy)).max() < 1e-15


def test_rank_loss_wants_the_larger_to_lead_by_the_margin() -> None:
    energy = _double(1.0, 5.0, 5.0, 1.0, 1.0, 5.0, 2.0, 2.0, 9.0)
    predicted = _double(0.5, 0.7, 0.5, 0.7, 0.0, 4.0, 3.0, 1.0, 7.0)
    # Differences of 0.2 (margin 1), -0.2, 4, and a tie; the ninth row has no partner.
    losses = rank_loss(predicted, energy, 1.0)
    assert losses.tolist() == pytest.approx([0.8, 1.2, 0.0, 0.0])
    assert ranked_pairs(energy) == 3
    _require_gradient(lambda values: rank_loss(values, energy, 1.0), predicted)


def test_the_paper_s_hybrid_loss_weighs_the_means_of_all_three() -> None:
    paper = PRESETS["paper"]
    predicted = _double([1.0, 3.0], [0.5, 0.0], [0.0, 2.0], [1.0, 1.0], [0.0, 0.0])
    truth = _double([2.0, 1.0], [0.0, 0.0], [1.0, 1.0], [0.0, 0.0], [0.0, 0.0])
    logit, colliding = _double(*[math.log(3.0)] * 5), _double(1.0, 0.0, 1.0, 0.0, 1.0)
    no_patches = torch.zeros((5, 0))
    targets = Targets(truth, truth.sum(dim=1), colliding, no_patches)
    network = PaperNetwork((2, 1, 1), True, 0)

    def loss(start: int, stop: int, **changes: object) -> float:
        output = NetworkOutput(predicted[start:stop], logit[start:stop])
        config = replace(paper, **changes)  # type: ignore[arg-type]
        return float(network.loss(output, targets, (start, stop), config, 4.0))

    # L_PD: 6, 0.75, 2, 4 and 0 of five rows. L_rank: differences of 3.5 and 0, margin 4, of two
    # pairs; the fifth row has no partner. L_entropy: right three times, wrong twice.
    depth, rank = 12.75 / 5, (0.5 + 4.0) / 2
    entropy = -(3 * math.log(0.75) + 2 * math.log(0.25)) / 5
    assert loss(0, 5) == pytest.approx(5.0 * depth + 2.0 * rank + 2.0 * entropy)
    # The losses of processes that share a batch have the same sum.
    assert loss(0, 2) + loss(2, 5) == pytest.approx(loss(0, 5))
    assert loss(0, 5, rank_weight=0.0) == pytest.approx(5.0 * depth + 2.0 * entropy)
    assert loss(0, 5, depth_weight=0.0) == pytest.approx(2.0 * rank + 2.0 * entropy)
    # Without domains, only the sum's error remains: 1, 0.5, 0, 2 and 0.
    undivided = 5.0 * 3.5 / 5 + 2.0 * rank + 2.0 * entropy
    assert loss(0, 5, by_domain=False) == pytest.approx(undivided)


def test_scores_of_eight_poses_worked_by_hand() -> None:
    probability = np.array([0.05, 0.15, 0.55, 0.95, 0.95, 0.45, 1.0, 0.5])
    colliding = np.array([False, False, False, True, True, True, True, True])
    energy = np.array([0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    predicted = np.array([0.0, 0.5, 0.0, 1.0, 2.0, 4.0, 3.0, 5.0])
    scores = measure(probability, predicted, colliding, energy, 0.25)
    assert scores.samples == 8
    assert scores.accuracy == 5 / 8
    assert scores.false_positive_rate == 1 / 3
    # 0.5 does not count as colliding.
    assert scores.false_negative_rate == 2 / 5
    assert scores.majority_rate == 5 / 8
    assert scores.energy_mse == pytest.approx((0.25 + 1.0 + 1.0) / 8)
    # One exchange of neighbours among five: 1 - 6 (1 + 1) / (5 24).
    assert scores.spearman == pytest.approx(0.9)
    bins = {place: entry for place, entry in enumerate(scores.calibration) if entry.samples}
    assert [entry.samples for entry in bins.values()] == [1, 1, 1, 2, 3]
    assert bins[5].probability == pytest.approx(0.525)
    assert bins[5].colliding_share == 0.5
    errors = 0.05 + 0.15 + (1.0 - 0.45) + 2 * abs(0.525 - 0.5) + 3 * (1.0 - 2.9 / 3)
    assert scores.calibration_error == pytest.approx(errors / 8)
    later = measure(probability, predicted, colliding, energy, 0.25, threshold=0.6)
    assert (later.accuracy, later.false_positive_rate) == (6 / 8, 0.0)
    assert later.false_negative_rate == 2 / 5
    assert later.calibration == scores.calibration


def test_counts_and_curves_of_eight_poses_worked_by_hand() -> None:
    score = np.array([0.9, 0.8, 0.8, 0.6, 0.5, 0.4, 0.3, 0.1])
    colliding = np.array([True, True, False, True, False, False, True, False])
    counts = Counts.of(score > 0.55, colliding)
    assert counts == Counts(3, 1, 3, 1)
    assert counts.shares["precision"] == (3, 4)
    assert counts.shares["recall"] == (3, 4)
    assert counts.shares["accuracy"] == (6, 8)
    # In 16 pairs of a colliding and a free pose, the first scores higher in 11 and equal in one.
    assert area_under_roc(score, colliding) == pytest.approx(11.5 / 16)
    by, of = roc_curve(score, colliding)
    assert by.tolist() == [0.0, 0.0, 0.25, 0.25, 0.5, 0.75, 0.75, 1.0]
    assert of.tolist() == [0.0, 0.25, 0.5, 0.75, 0.75, 0.75, 1.0, 1.0]
    # A quarter of the recall each at precisions of 1, 2 / 3, 3 / 4 and 4 / 7.
    expected = 0.25 * (1.0 + 2 / 3 + 3 / 4 + 4 / 7)
    assert average_precision(score, colliding) == pytest.approx(expected)
    for same in (np.ones(8, dtype=bool), np.zeros(8, dtype=bool)):
        assert area_under_roc(score, same) is None
        assert average_precision(score, same) is None


def test_intervals_are_those_of_the_tables() -> None:
    # Clopper and Pearson's for 0, 3 and 10 of 10, and Hanley and McNeil's example of 1982.
    assert interval(0, 10) == pytest.approx((0.0, 0.3085), abs=1e-4)
    assert interval(3, 10) == pytest.approx((0.0667, 0.6525), abs=1e-4)
    assert interval(10, 10) == pytest.approx((0.6915, 1.0), abs=1e-4)
    assert interval(0, 0) is None
    low, high = auc_interval(0.893, 51, 58)
    assert (high - low) / (2 * 1.96) == pytest.approx(0.032, abs=1e-3)


def test_ranking_score_is_the_mean_shortfall_over_random_pairs() -> None:
    energy = np.arange(400.0)
    truth = np.ones(400, dtype=bool)
    right = measure(np.ones(400), energy, truth, energy, 0.5)
    assert right.ranking_margin == 0.0
    silent = measure(np.ones(400), 0.0 * energy, truth, energy, 0.5)
    assert silent.ranking_margin == 0.5
    # In reverse order, each pair's loss is its difference plus the margin.
    reverse = measure(np.ones(400), -energy, truth, energy, 0.5)
    assert reverse.ranking_margin == pytest.approx(0.5 + 400 / 3, rel=0.1)


def test_undefined_scores_are_none() -> None:
    none = np.zeros(3, dtype=bool)
    scores = measure(np.zeros(3), np.zeros(3), none, np.zeros(3), 1.0)
    assert (scores.false_negative_rate, scores.spearman, scores.ranking_margin) == (None,) * 3
    untrained = measure(np.zeros(3), np.zeros(3), none, np.zeros(3), 1.0, depth=False)
    assert untrained.energy_mse is None


def test_mean_difference_is_that_of_all_pairs() -> None:
    values = np.random.default_rng(2).exponential(size=60)
    pairs = np.abs(values[:, None] - values)[~np.eye(60, dtype=bool)]
    assert mean_difference(values) == pytest.approx(pairs.mean())
    assert mean_difference(values[:1]) == 0.0
