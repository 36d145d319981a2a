"""The ranges in which a predictor is sure, and its errors there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit, ndtr
from scipy.stats import binom

from lcollision_core.bodies import LearnedBody, check_poses, scoring
from lcollision_core.options import RuleOptions
from lcollision_core.predictor.metrics import ERROR_BOUNDS, SureRange, sure_ranges


def _drawn(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return logits, and outcomes drawn with their probabilities."""
    generator = np.random.default_rng(seed)
    logit = 6.0 * generator.normal(size=n)
    return logit, generator.random(n) < expit(logit)


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    """Return the bundled model."""
    return LearnedBody.load("body")


def test_samples_never_seen_are_misjudged_no_more_often_than_said() -> None:
    found = sure_ranges(*_drawn(30_000, 0))
    assert [one.error_bound for one in found] == list(ERROR_BOUNDS)
    assert all(np.diff([one.coverage for one in found]) > 0.0)
    logit, colliding = _drawn(200_000, 1)
    for one in found:
        free, called = logit < one.free_below, logit > one.colliding_above
        wrong = int((free & colliding).sum() + (called & ~colliding).sum())
        assert np.mean(free | called) == pytest.approx(one.coverage, abs=0.02)
        assert binom.sf(wrong - 1, len(logit), one.error_bound) > 1e-6


@pytest.mark.parametrize(
    ("n_samples", "bound", "share"), [(3000, 1e-3, 0.5), (6000, 1e-2, 0.5), (2000, 3e-2, 0.8)]
)
def test_one_draw_of_twenty_at_most_breaks_its_bound(
    n_samples: int, bound: float, share: float
) -> None:
    generator, n_draws, n_broken = np.random.default_rng(3), 400, 0
    colliding = generator.random((n_draws, n_samples)) < share
    logit = np.where(colliding, 1.5, -1.5) + generator.normal(size=colliding.shape)
    for one in range(n_draws):
        (found,) = sure_ranges(logit[one], colliding[one], (bound,))
        called_free = ndtr(found.free_below - 1.5)
        called_colliding = ndtr(-1.5 - found.colliding_above)
        n_broken += share * called_free + (1.0 - share) * called_colliding > bound
    assert binom.sf(n_broken - 1, n_draws, 0.05) > 1e-3


def test_no_limit_nearer_to_the_threshold_has_as_few_errors() -> None:
    logit, colliding = _drawn(200, 2)
    (found,) = sure_ranges(logit, colliding, (0.05,))
    assert found.free_below == -found.colliding_above
    distance, wrong = np.abs(logit), (logit > 0.0) != colliding
    assert found.coverage == np.mean(distance > found.colliding_above)
    n_wrong = int(wrong[distance > found.colliding_above].sum())
    for limit in np.append(distance, 0.0):
        if wrong[distance > limit].sum() <= n_wrong:
            assert np.mean(distance > limit) <= found.coverage


def test_few_samples_confirm_no_small_bound() -> None:
    logit, colliding = np.linspace(-9.0, 9.0, 1000), np.arange(1000) >= 500
    # Without an error in 1000, 0.3 % is the least bound with 95 % confidence.
    assert [one.error_bound for one in sure_ranges(logit, colliding)] == [3e-3, 1e-2, 3e-2]
    assert sure_ranges(logit, colliding)[0].coverage == 1.0


def test_what_is_not_sure_is_checked_exactly(
    body: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    latent = body.sample(60, np.random.default_rng(0))
    truth = body.detector.are_colliding(body.decode(latent).astype(np.float32))
    predictor = body.require_predictor()
    logit = predictor.predict(latent).collision_logit
    low, high = (float(value) for value in np.quantile(logit, (0.3, 0.8)))
    assert predictor.metrics is not None
    metrics = replace(predictor.metrics, sure=(SureRange(1e-2, low, high, 0.5),))
    sure = body.with_predictor(replace(predictor, metrics=metrics))

    exact = check_poses(sure, latent)
    assert exact.exact.all()
    assert np.array_equal(exact.colliding, truth)
    assert check_poses(sure, latent, 5e-3).exact.all()  # smaller than any known bound
    hybrid = check_poses(sure, latent, 2e-2)
    assert np.array_equal(hybrid.exact, (logit >= low) & (logit <= high))
    assert np.array_equal(hybrid.colliding[hybrid.exact], truth[hybrid.exact])
    assert np.array_equal(hybrid.colliding[~hybrid.exact], logit[~hybrid.exact] > high)
    # A free pose may still violate a clearance.
    roomy = check_poses(sure, latent, 2e-2, sure.detector.with_clearance(1e-3))
    assert np.array_equal(roomy.exact, logit <= high)
    # The predictor does not know of tolerated depths.
    tolerant = sure.with_options(RuleOptions(tolerated_depth=1e-3))
    assert check_poses(tolerant, latent, 2e-2).exact.all()
    # A GPU checks a pose in less time than an estimate takes.
    monkeypatch.setattr(scoring, "uses_gpu", lambda *_: True)
    assert check_poses(sure, latent, 2e-2).exact.all()
