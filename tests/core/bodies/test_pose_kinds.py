"""Realistic kinds of poses, and a predictor's estimates for them."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, PoseKind, score_kinds
from lcollision_core.embedding.bilevel import PoseDraws
from lcollision_core.errors import CancelledError
from lcollision_core.jobs import Job

KNOWN = np.array([[0.0, 1.0, -2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [-1.0, 2.0, 1.0, -4.0]])


@pytest.fixture
def draws() -> PoseDraws:
    return PoseDraws(KNOWN, np.array([0, 1, 0, 1]), np.full(4, -8.0), np.full(4, 8.0))


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    """Return the bundled model."""
    return LearnedBody.load("body")


def test_blends_lie_in_the_triangle_of_three_known_poses(draws: PoseDraws) -> None:
    blends = draws.blends(2000, np.random.default_rng(0).random)
    # Barycentric coordinates by the three known poses.
    system = np.vstack([KNOWN.T, np.ones(3)])
    weights, residual, _, _ = np.linalg.lstsq(
        system, np.vstack([blends.T, np.ones(len(blends))]), rcond=None
    )
    assert residual.max() < 1e-18
    assert weights.min() > -1e-9
    assert weights.mean(axis=1) == pytest.approx(np.full(3, 1 / 3), abs=0.03)
    noisy = draws.noisy_blends(2000, np.random.default_rng(0).random)
    assert 0.0 < np.abs(noisy - blends).mean() < 1.6
    assert np.abs(noisy).max() <= 8.0


def test_each_part_is_of_one_known_pose(draws: PoseDraws) -> None:
    mixed = draws.mixed_parts(300, np.random.default_rng(1).random)
    for columns in ([0, 2], [1, 3]):
        same = (mixed[:, None, columns] == KNOWN[None, :, columns]).all(axis=2)
        assert same.any(axis=1).all()
        assert same.any(axis=0).all()
    whole = (mixed[:, None] == KNOWN[None]).all(axis=2).any(axis=1)
    assert 0.2 < whole.mean() < 0.5  # a third is expected


def test_frames_go_from_one_known_pose_to_another(draws: PoseDraws) -> None:
    """At t = 0, a frame equals the second of its four poses."""
    numbers = iter([np.array([[0.0, 0.4, 0.9, 0.9]]), np.array([[0.0]])])
    assert np.array_equal(draws.between(1, lambda _: next(numbers)), KNOWN[[1]])
    frames = draws.between(500, np.random.default_rng(2).random)
    assert np.abs(frames).max() <= 8.0
    assert len(np.unique(frames, axis=0)) > 400


@pytest.mark.slow
def test_every_kind_is_compared_with_the_exact_check(body: LearnedBody) -> None:
    told: list[tuple[int, int]] = []
    scores = score_kinds(body, 20, job=Job(lambda done, of: told.append((done, of))))
    assert [one.kind for one in scores] == [kind.value for kind in PoseKind]
    assert told == [(done, 7) for done in range(1, 8)]
    by_kind = {one.kind: one for one in scores}
    box = body.sample(20, np.random.default_rng(0))
    truth = body.detector.are_colliding(body.decode(box).astype(np.float32))
    called = body.predict(box).collision_logit > 0.0
    assert by_kind[PoseKind.BOX].accuracy == pytest.approx(np.mean(called == truth))
    assert by_kind[PoseKind.BOX].colliding_share == pytest.approx(truth.mean())
    resolved = by_kind[PoseKind.RESOLVED]
    assert resolved.colliding_share == 0.0
    assert resolved.false_negative_rate is None
    assert resolved.false_positive_rate == pytest.approx(1.0 - resolved.accuracy)
    assert scores == score_kinds(body, 20)


def test_it_stops_when_it_is_told_to(body: LearnedBody) -> None:
    job = Job()
    job.cancel()
    with pytest.raises(CancelledError):
        score_kinds(body, 10, job=job)
