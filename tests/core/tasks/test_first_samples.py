"""Revision of a new latent space by the first samples of its box."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.contact import CollisionDetector
from lcollision_core.embedding.bilevel import BOX_SCALE
from lcollision_core.embedding.training import train_embedding
from lcollision_core.errors import LabelStoreError, ModelFileError
from lcollision_core.files import PoseSet, write_pose_set
from lcollision_core.learning_state import RunState, Stage
from lcollision_core.options import LearningRequest, Quality
from lcollision_core.tasks import learning
from lcollision_core.tasks.learning import (
    EFFORTS,
    MostlyCollidingError,
    adapt_to_samples,
    estimated_seconds,
    first_samples,
    learn_model,
    notes_of,
)
from lcollision_core.tasks.work_folder import WorkFolder
from tests.clothed import sleeved_tube
from tests.core.tasks.test_contacts import two_tubes
from tests.core.tasks.test_run import SMALL, work_in

REQUEST = LearningRequest(("tube.npz",), Quality.QUICK)
STRICT = replace(REQUEST, ignored=(), near_exclusion=0.0)


@pytest.fixture(autouse=True)
def _small_effort(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EFFORTS, Quality.QUICK, SMALL)


def trained(poses: PoseSet) -> LearnedBody:
    return LearnedBody.from_training("tubes", train_embedding(poses, SMALL.embedding), poses)


@pytest.fixture(scope="module")
def always_touching() -> LearnedBody:
    """Return a model of a tube that penetrates another, without contact rules."""
    return trained(two_tubes())


@pytest.fixture
def touching_file(tmp_path: Path) -> str:
    write_pose_set(tmp_path / "tubes.npz", two_tubes())
    return str(tmp_path / "tubes.npz")


def test_layers_stay_on_what_they_cover_all_over_the_box() -> None:
    poses, covered = sleeved_tube()
    model = trained(replace(poses, vertices=poses.vertices[:8], names=poses.names[:8]))
    first = model.n_vertices - len(covered)
    drawn = model.decode(first_samples(model, 0)[:64]) / model.body_size
    away = np.linalg.norm(drawn[:, first:] - drawn[:, covered], axis=2)
    # The distance is 0.01 at rest; joined by only a few edges, it would change by 0.05.
    assert np.abs(away - 0.01).max() < 0.02
    assert np.abs(away - 0.01).mean() < 0.002


@pytest.mark.slow
def test_places_that_touch_in_nearly_every_sample_are_left_out(
    always_touching: LearnedBody,
) -> None:
    model, first = adapt_to_samples(always_touching, REQUEST)
    assert first.n_places == len(model.rules.touching) > 0
    vertices = model.decode(first_samples(model, 0))
    assert first.colliding_share == np.mean(model.detector.are_colliding(vertices)) < 0.8
    strict = CollisionDetector(model.topology, model.reference)
    assert strict.are_colliding(vertices).all()
    assert "touch in nearly every one of the first 1024 samples" in notes_of(first)[0]
    assert first.row_seconds > 0.0


def test_the_box_is_made_smaller_but_never_than_the_poses_and_rules_of_the_request_stay(
    always_touching: LearnedBody,
) -> None:
    model, first = adapt_to_samples(always_touching, STRICT)
    assert (first.colliding_share, first.n_places, first.box_scale) == (1.0, 0, 1.0)
    assert model.rules == always_touching.rules
    assert set(first.parts) == {"component 1", "component 2"}
    box, codes = model.embedding.box, model.known_poses
    assert (box.low <= codes.min(axis=0) + 1e-6).all()
    assert (box.high >= codes.max(axis=0) - 1e-6).all()
    given = always_touching.embedding.box
    np.testing.assert_allclose(BOX_SCALE * box.high, given.high, rtol=1e-9)
    assert "1 times the range" in notes_of(first)[0]


def test_a_run_stops_before_the_predictor_where_nearly_all_samples_collide(
    tmp_path: Path, touching_file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The last status is the newest one, not the last that was written on the way.
    monkeypatch.setattr(learning, "_SECONDS_BETWEEN_NOTES", 1e9)
    request = replace(STRICT, sources=(touching_file,))
    work = work_in(tmp_path, request)
    with pytest.raises(MostlyCollidingError, match=r"100 % of the first 1024 samples .* collide"):
        learn_model(work)
    status = work.status
    assert (status.state, status.stage) == (RunState.FAILED, Stage.LATENT_SPACE)
    assert status.mostly_collides
    assert not work.labels.exists()
    # Other options need another folder while a run is unfinished, but not after this.
    other = replace(request, left_out=("component 2",))
    work.allow_mostly_colliding()
    assert work.request.regardless
    assert work.request == WorkFolder(work.destination).request
    with pytest.raises(LabelStoreError, match="training needs colliding, free and held-out rows"):
        learn_model(work)
    assert work.labels.exists()
    assert not work.status.mostly_collides
    with pytest.raises(ModelFileError, match="other files or options"):
        work.prepare(other)


@pytest.mark.slow
def test_after_that_parts_can_be_left_out_under_the_same_name(
    tmp_path: Path, touching_file: str
) -> None:
    request = replace(STRICT, sources=(touching_file,))
    work = work_in(tmp_path, request)
    with pytest.raises(MostlyCollidingError):
        learn_model(work)
    work.prepare(replace(request, ignored=None))
    with pytest.raises(LabelStoreError, match=r"0 of .* training rows collide"):
        learn_model(work)
    assert LearnedBody.load(work.embedding).rules.touching


def test_what_a_sample_takes_corrects_the_estimate() -> None:
    before = estimated_seconds(5000, 100, Quality.QUICK, 2)
    after = estimated_seconds(5000, 100, Quality.QUICK, 2, row_seconds=0.1, colliding_share=1.0)
    # A block of 32 mixed samples checks six additional poses.
    assert after[Stage.LABELS] == pytest.approx(SMALL.n_samples * 0.1 * 38 / 32)
    assert after[Stage.PREDICTOR] > before[Stage.PREDICTOR] + 0.7 * SMALL.n_samples * 0.1
    fewer = estimated_seconds(5000, 100, Quality.QUICK, 2, row_seconds=0.1, colliding_share=0.1)
    assert before[Stage.PREDICTOR] < fewer[Stage.PREDICTOR] < after[Stage.PREDICTOR]
    assert after[Stage.LATENT_SPACE] == before[Stage.LATENT_SPACE]
