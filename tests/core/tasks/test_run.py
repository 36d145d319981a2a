"""From a pose set to a trained model in one run that resumes however it is stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.embedding.training_run import EmbeddingConfig
from lcollision_core.errors import CancelledError, LCollisionError, MeshFileError, ModelFileError
from lcollision_core.files import PoseSet, write_pose_set
from lcollision_core.jobs import Job
from lcollision_core.labels import LabelStore
from lcollision_core.learning_state import STAGES, LearningStatus, RunState, Stage
from lcollision_core.options import LearningRequest, Quality, SampleDistribution
from lcollision_core.predictor import PRESETS
from lcollision_core.tasks.learning import EFFORTS, Effort, LearnedCard, learn_model
from lcollision_core.tasks.work_folder import WorkFolder, stamped

SMALL = Effort(
    16,
    EmbeddingConfig(
        n_domains=2, n_domain_codes=3, level1_epochs=10, level2_epochs=4, held_out_stride=0
    ),
    256,
    replace(PRESETS["default"], epochs=2),
    n_judged=40,
)


@pytest.fixture(autouse=True)
def _small_effort(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EFFORTS, Quality.QUICK, SMALL)


@pytest.fixture
def request_for_tube(tmp_path: Path, tube_poses: PoseSet) -> LearningRequest:
    file = tmp_path / "tube.npz"
    write_pose_set(file, tube_poses)
    return LearningRequest((str(file),), Quality.QUICK)


@pytest.fixture(scope="module")
def whole(
    tmp_path_factory: pytest.TempPathFactory, tube_poses: PoseSet
) -> tuple[WorkFolder, LearnedCard, list[LearningStatus]]:
    """Return an uninterrupted run: its folder, its card and its statuses."""
    folder, told = tmp_path_factory.mktemp("whole"), []
    write_pose_set(folder / "tube.npz", tube_poses)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EFFORTS, Quality.QUICK, SMALL)
        work = work_in(folder, LearningRequest((str(folder / "tube.npz"),), Quality.QUICK))
        return work, learn_model(work, Job(told.append)), told


def work_in(folder: Path, request: LearningRequest, name: str = "tube") -> WorkFolder:
    work = WorkFolder(folder / f"{name}.safetensors")
    work.prepare(request)
    return work


def numbers_of(path: str) -> tuple[str, bytes]:
    """Return values that identify a model's latent space and predictor."""
    model = LearnedBody.load(path)
    return model.fingerprint, model.predict(model.known_poses).collision_logit.tobytes()


def test_a_run_ends_with_a_model_that_resolves(
    whole: tuple[WorkFolder, LearnedCard, list[LearningStatus]],
) -> None:
    work, card, told = whole
    model = LearnedBody.load(card.model)
    assert card.model == str(work.destination)
    assert (card.vertices, card.poses, card.parts, card.samples) == (model.n_vertices, 16, 2, 256)
    assert model.domain_names == ("left thigh", "left shin")
    assert card.accuracy == model.predictor_record.metrics.accuracy
    assert 0.0 < card.error_mean < 0.2
    assert {status.stage for status in told} == set(STAGES)
    assert all(np.diff([status.done for status in told]) >= 0.0)
    assert told[0].done < 0.1
    assert told[-1].done > 0.99
    assert all(seconds > 0.0 for seconds in card.seconds.values())
    # The status is kept for windows that look later, but nothing large.
    assert work.status.state == RunState.DONE
    assert work.status.model == card.model
    assert not work.poses.exists()
    assert not work.labels.exists()
    collides = sample_poses(model, 1, 0, colliding=True)
    assert model.resolve(collides[0]).exactly_free


@pytest.mark.slow
def test_a_run_that_is_cancelled_anywhere_goes_on_to_the_same_model(
    tmp_path: Path,
    request_for_tube: LearningRequest,
    whole: tuple[WorkFolder, LearnedCard, list[LearningStatus]],
) -> None:
    _, card, _ = whole
    work = work_in(tmp_path, request_for_tube, "parts")
    stages: list[Stage] = []
    for stop in np.linspace(0.0, 0.9, 10).tolist():
        token = Job()

        def cancel(status: LearningStatus, token: Job = token, stop: float = stop) -> None:
            if status.done >= stop and not token.cancelled:
                stages.append(status.stage)
                token.cancel()

        try:
            learn_model(work, token.part(cancel))
        except CancelledError:
            assert work.status.state == RunState.STOPPED
            assert work.status.done <= stop + 0.3
        else:
            # After the last step, there is nothing left to cancel.
            assert stop > 0.7
            break
        assert not work.is_locked
    assert len(stages) >= 7
    assert {Stage.POSES, Stage.LATENT_SPACE, Stage.PREDICTOR} <= set(stages)
    parts = learn_model(work)
    assert numbers_of(parts.model) == numbers_of(card.model)
    assert parts.error_mean == card.error_mean


_KILLED = """
import sys
from pathlib import Path
from threading import Event
from tests.core.tasks.test_run import SMALL
from lcollision_core.options import Quality
from lcollision_core.tasks.learning import EFFORTS, learn_model
from lcollision_core.tasks.work_folder import WorkFolder
EFFORTS[Quality.QUICK] = SMALL
write_status = WorkFolder.write_status
def write_and_wait_for_the_end(work, status):
    write_status(work, status)
    if status.stage == sys.argv[2]:
        Event().wait()
WorkFolder.write_status = write_and_wait_for_the_end
learn_model(WorkFolder(Path(sys.argv[1])))
"""


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_to_the_same_model(
    tmp_path: Path,
    request_for_tube: LearningRequest,
    whole: tuple[WorkFolder, LearnedCard, list[LearningStatus]],
) -> None:
    work = work_in(tmp_path, request_for_tube, "killed")
    for stage in (Stage.LATENT_SPACE, Stage.PREDICTOR):
        # Sums of several threads differ, and earlier tests may have set their number.
        code = f"import torch; torch.set_num_threads({torch.get_num_threads()})\n{_KILLED}"
        process = subprocess.Popen([sys.executable, "-c", code, work.destination, stage])
        give_up = time.monotonic() + 600.0
        while work.status.stage != stage and process.poll() is None:
            assert time.monotonic() < give_up, f"{stage} has not begun"
            time.sleep(0.01)
        assert process.poll() is None, "it ended before it was killed"
        assert work.is_locked
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        # A killed process cannot report it: the status is running, but nobody holds the folder.
        assert work.status.state == RunState.RUNNING
        assert not work.is_locked
    killed = learn_model(work)
    assert numbers_of(killed.model) == numbers_of(whole[1].model)


def test_samples_are_mixed(tmp_path: Path, request_for_tube: LearningRequest) -> None:
    work = work_in(tmp_path, request_for_tube)
    token = Job()
    with pytest.raises(CancelledError):
        learn_model(
            work,
            token.part(lambda status: token.cancel() if status.stage == Stage.PREDICTOR else None),
        )
    store = LabelStore.open(work.labels)
    assert store.identity.draws == SampleDistribution.MIXED
    assert store.n_rows == SMALL.n_samples


def test_a_finished_run_is_not_done_again(
    whole: tuple[WorkFolder, LearnedCard, list[LearningStatus]],
) -> None:
    work, card, _ = whole
    stamp = Path(card.model).stat().st_mtime_ns
    work.prepare(work.request)
    assert learn_model(work) == card
    assert Path(card.model).stat().st_mtime_ns == stamp


@pytest.mark.slow
def test_what_another_request_made_or_makes_is_not_touched(
    tmp_path: Path, request_for_tube: LearningRequest
) -> None:
    other = replace(request_for_tube, seed=1)
    failing = replace(request_for_tube, sources=(str(tmp_path / "none.npz"),))
    with pytest.raises(MeshFileError):
        learn_model(work_in(tmp_path, failing))
    # A run that failed before it had poses is replaced, but not one that waits for its turn.
    work = work_in(tmp_path, request_for_tube)
    assert work.status.state == RunState.STOPPED
    with pytest.raises(ModelFileError, match=r"being learned from other files or options"):
        work_in(tmp_path, other)
    token = Job()

    def cancel_later(status: LearningStatus) -> None:
        if status.stage == Stage.LATENT_SPACE:
            token.cancel()

    with pytest.raises(CancelledError):
        learn_model(work, token.part(cancel_later))
    with pytest.raises(ModelFileError, match=r"being learned from other files or options"):
        work_in(tmp_path, other)
    os.utime(request_for_tube.sources[0], ns=(1, 1))
    with pytest.raises(ModelFileError, match="its files have changed"):
        work_in(tmp_path, request_for_tube)
    learn_model(work)
    work.remove()
    before = (tmp_path / "tube.safetensors").read_bytes()
    with pytest.raises(ModelFileError, match=r"a model 'tube' already exists"):
        work_in(tmp_path, other)
    assert (tmp_path / "tube.safetensors").read_bytes() == before


def test_two_processes_do_not_learn_the_same(
    tmp_path: Path, request_for_tube: LearningRequest
) -> None:
    work = work_in(tmp_path, request_for_tube)
    with work.lock():
        assert work.is_locked
        with (
            pytest.raises(ModelFileError, match="being learned by another process"),
            work.lock(wait=0.0),
        ):
            pass
    assert not work.is_locked


def test_what_cannot_be_learned_from_is_said_and_kept(tmp_path: Path) -> None:
    work = work_in(tmp_path, LearningRequest((str(tmp_path / "none.npz"),), Quality.QUICK))
    with pytest.raises(MeshFileError, match="does not exist"):
        learn_model(work)
    assert work.status.state == RunState.FAILED
    assert "does not exist" in work.status.sentence


def test_damaged_status_and_request(tmp_path: Path, request_for_tube: LearningRequest) -> None:
    work = work_in(tmp_path, request_for_tube)
    assert work.request == stamped(request_for_tube)
    (work.path / "status.json").write_text("{")
    assert work.status.state == RunState.STOPPED
    (work.path / "request.json").write_text('{"version": 99}')
    with pytest.raises(ModelFileError, match="format version 99"):
        _ = work.request
    with pytest.raises(LCollisionError, match="quality must be quick, good, best, got better"):
        LearningRequest(("a",), "better")
    with pytest.raises(LCollisionError, match="no files"):
        LearningRequest(())
    for wrong in ({"scale": 0.0}, {"fps": -1.0}, {"up": 7}, {"near_exclusion": 3.0}):
        with pytest.raises(LCollisionError, match="must be"):
            LearningRequest(("a",), **wrong)
