"""Runs in separate processes: started, followed, stopped, killed, continued, discarded."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partialmethod
from pathlib import Path

import pytest
from PySide6.QtCore import QObject
from pytestqt.qtbot import QtBot

from app.work import learner, learning_runs
from app.work.learner import STOP, WANTED
from app.work.learning_runs import LearningRun, LearningRuns
from lcollision_core.bodies import LearnedBody, model_destination
from lcollision_core.errors import LCollisionError
from lcollision_core.files import locked, write_pose_set
from lcollision_core.learning_state import LearningStatus, RunState
from lcollision_core.options import LearningRequest
from lcollision_core.tasks import learning
from lcollision_core.tasks.work_folder import WorkFolder
from tests.bending_tube import bending_tube
from tests.core.tasks.test_contacts import two_tubes

QUICK = (sys.executable, "-P", "-m", "tests.app.quick_learner")
PATIENCE = 240_000


@pytest.fixture
def tube_file(tmp_path: Path) -> Path:
    path = tmp_path / "tube poses.npz"
    write_pose_set(path, bending_tube())
    return path


@pytest.fixture
def runs(qtbot: QtBot, monkeypatch: pytest.MonkeyPatch) -> Iterator[LearningRuns]:
    monkeypatch.setattr(learning_runs, "POLL_MILLISECONDS", 50)
    monkeypatch.setattr(learning_runs, "LEARNER", QUICK)
    monkeypatch.setenv("SECONDS_PER_STEP", "0.05")
    parent = QObject()
    held = LearningRuns(parent)
    held.start_polling()
    yield held
    for run in held.runs:
        held.stop(run.path, discard=True)
    qtbot.waitUntil(lambda: not held.runs, timeout=PATIENCE)
    held.close()


def begin(qtbot: QtBot, runs: LearningRuns, file: Path, name: str = "hero") -> Path:
    path = runs.start(LearningRequest((str(file),), "quick"), name)
    wait_for(qtbot, runs, path, lambda run: run.state == RunState.RUNNING)
    return path


def wait_for(qtbot: QtBot, runs: LearningRuns, path: Path, is_so: object) -> LearningRun:
    def looks() -> bool:
        run = runs.run_of(path)
        return run is not None and callable(is_so) and bool(is_so(run))

    qtbot.waitUntil(looks, timeout=PATIENCE)
    run = runs.run_of(path)
    assert run is not None
    return run


def process_of(path: Path) -> int:
    """Return the id of the process that works on a folder."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if os.fsencode(path) in words and b"tests.app.quick_learner" in words:
            return int(entry.name)
    raise AssertionError(f"no process learns in {path}")


linux = pytest.mark.skipif(sys.platform != "linux", reason="looks for the process in /proc")


@pytest.mark.slow
@linux
def test_killed_in_the_middle_a_run_says_so_and_goes_on_to_its_end(
    qtbot: QtBot, runs: LearningRuns, tube_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = begin(qtbot, runs, tube_file)
    wait_for(qtbot, runs, path, lambda run: run.status.stage != "poses")
    number = process_of(path)
    assert os.getpriority(os.PRIO_PROCESS, number) >= 1
    assert os.getsid(number) != os.getsid(0)
    os.kill(number, signal.SIGKILL)
    killed = wait_for(qtbot, runs, path, lambda run: not run.is_active)
    assert killed.state == RunState.KILLED
    assert "stopped unexpectedly" in killed.status.sentence
    monkeypatch.delenv("SECONDS_PER_STEP")
    runs.resume(path)
    done = wait_for(qtbot, runs, path, lambda run: not run.is_active)
    assert done.state == RunState.DONE, done.work.log.read_text()
    assert Path(done.status.model) == model_destination("hero")
    assert LearnedBody.load(done.status.model).has_predictor


@pytest.mark.slow
@linux
def test_a_run_is_stopped_from_another_window_and_one_waits_for_another(
    qtbot: QtBot, runs: LearningRuns, tube_file: Path
) -> None:
    first = begin(qtbot, runs, tube_file)
    second = runs.start(LearningRequest((str(tube_file),), "good"), "villain")
    assert wait_for(qtbot, runs, second, lambda _: True).state == RunState.WAITING
    later = LearningRuns(runs)
    later.poll()
    assert [(run.name, run.state) for run in later.runs] == [
        ("hero", RunState.RUNNING),
        ("villain", RunState.WAITING),
    ]
    later.stop(first)
    stopped = wait_for(qtbot, runs, first, lambda run: not run.is_active)
    assert stopped.state == RunState.STOPPED
    wait_for(qtbot, runs, second, lambda run: run.state == RunState.RUNNING)
    os.kill(process_of(second), signal.SIGTERM)
    wait_for(qtbot, runs, second, lambda run: run.state == RunState.STOPPED)
    runs.stop(first, discard=True)
    assert not first.exists()
    runs.resume(second)
    wait_for(qtbot, runs, second, lambda run: run.state == RunState.RUNNING)
    runs.stop(second, discard=True)
    qtbot.waitUntil(lambda: not second.exists(), timeout=PATIENCE)
    qtbot.waitUntil(lambda: not runs.runs, timeout=PATIENCE)


@pytest.mark.slow
def test_what_stopped_as_nearly_all_samples_collide_goes_on_regardless_once_it_is_continued(
    qtbot: QtBot, runs: LearningRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SECONDS_PER_STEP")
    write_pose_set(tmp_path / "tubes.npz", two_tubes())
    request = LearningRequest((str(tmp_path / "tubes.npz"),), "quick", ignored=())
    path = runs.start(replace(request, near_exclusion=0.0), "hero")
    failed = wait_for(qtbot, runs, path, lambda run: run.state == RunState.FAILED)
    assert failed.status.mostly_collides
    assert "samples of the latent space collide" in failed.status.sentence
    runs.resume(path)
    assert failed.work.request.regardless
    again = wait_for(
        qtbot,
        runs,
        path,
        lambda run: run.state == RunState.FAILED and not run.status.mostly_collides,
    )
    # All samples collide, so even then there is nothing to learn.
    assert "training needs colliding, free and held-out rows" in again.status.sentence


def test_what_cannot_be_learned_from_is_said_in_one_sentence(
    qtbot: QtBot, runs: LearningRuns, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"no poses")
    path = runs.start(LearningRequest((str(broken),), "quick"), "hero")
    failed = wait_for(qtbot, runs, path, lambda run: run.state == RunState.FAILED)
    assert "broken.npz" in failed.status.sentence
    assert "\n" not in failed.status.sentence
    # The run states the reason before its process ends, which writes the log.
    qtbot.waitUntil(lambda: "Traceback" in failed.work.log.read_text(), timeout=PATIENCE)


@pytest.mark.slow
@linux
def test_a_run_that_is_stopped_while_its_process_starts_ends_at_once(
    qtbot: QtBot, runs: LearningRuns, tube_file: Path
) -> None:
    path = runs.start(LearningRequest((str(tube_file),), "quick"), "hero")
    qtbot.waitUntil(lambda: runs._is_starting(path))
    number = process_of(path)
    # Another window does not know of the process.
    LearningRuns(runs).stop(path)
    assert not (path / STOP).exists()
    qtbot.waitUntil(lambda: not Path(f"/proc/{number}").exists(), timeout=PATIENCE)
    stopped = wait_for(qtbot, runs, path, lambda run: not run.is_active)
    assert stopped.state == RunState.STOPPED
    assert not stopped.work.poses.exists()
    assert not (path / STOP).exists()


def stay_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the learner run in this process without changing its priority and signals."""
    monkeypatch.setattr(learner, "_give_way", lambda: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)


@pytest.mark.slow
def test_a_process_that_comes_second_leaves_what_the_first_is_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stay_as_it_is(monkeypatch)
    # It waits five seconds for the first to end.
    monkeypatch.setattr(WorkFolder, "lock", partialmethod(WorkFolder.lock, wait=0.2))
    work = folder_of("hero", RunState.RUNNING)
    for name in (WANTED, STOP):
        (work.path / name).touch()
    with locked(work.path / "run"):
        assert learner.main([str(work.path)]) in (2, 130)
    assert (work.path / WANTED).exists()
    assert (work.path / STOP).exists()


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.ENOSPC, "free some space"), (errno.EACCES, "check the files")]
)
def test_what_the_disk_refuses_is_advised_on(
    monkeypatch: pytest.MonkeyPatch, number: int, advice: str
) -> None:
    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    stay_as_it_is(monkeypatch)
    monkeypatch.setattr(learning, "learn_model", fail)
    work = folder_of("hero", RunState.RUNNING)
    assert learner.main([str(work.path)]) == 2
    assert advice in work.status.sentence


def test_a_failure_is_stored_once_as_the_run_may_be_discarded_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stay_as_it_is(monkeypatch)
    work, file_numbers = folder_of("hero", RunState.RUNNING), list[int]()

    def fail(work: WorkFolder, _: object) -> None:
        work.write_status(LearningStatus(RunState.FAILED, sentence="nothing to learn from"))
        file_numbers.append((work.path / "status.json").stat().st_ino)
        raise LCollisionError("nothing to learn from")

    monkeypatch.setattr(learning, "learn_model", fail)
    assert learner.main([str(work.path)]) == 2
    assert [(work.path / "status.json").stat().st_ino] == file_numbers


def test_a_state_that_is_not_known_is_one_of_a_run_that_is_stopped(runs: LearningRuns) -> None:
    work = folder_of("hero", RunState.RUNNING)
    status = work.path / "status.json"
    for state in ("paused", "waiting"):
        status.write_text(status.read_text().replace("running", state))
        runs.poll()
        assert [run.state for run in runs.runs] == [RunState.STOPPED]
        work.write_status(LearningStatus(RunState.RUNNING))


def folder_of(name: str, state: RunState) -> WorkFolder:
    work = WorkFolder(model_destination(name))
    work.prepare(LearningRequest(("/nowhere.npz",)))
    work.write_status(LearningStatus(state, "labels", 0.5, 0.6, 100.0))
    return work


def test_a_process_that_went_as_the_disk_filled_up_is_explained_by_that(
    runs: LearningRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = folder_of("hero", RunState.RUNNING)
    with locked(work.path / "run"):
        runs.poll()
        assert [run.state for run in runs.runs] == [RunState.RUNNING]
    monkeypatch.setattr(learning_runs, "_LEAST_FREE_BYTES", 1 << 62)
    runs.poll()
    (run,) = runs.runs
    assert run.state == RunState.KILLED
    assert run.status.sentence.startswith("the disk is full: ")


def test_a_program_that_never_begins_does_not_wait_for_ever(
    qtbot: QtBot, runs: LearningRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning_runs, "_SECONDS_TO_BEGIN", 0.2)
    monkeypatch.setattr(learning_runs, "LEARNER", (sys.executable, "-c", "pass"))
    path = runs.start(LearningRequest(("/nowhere.npz",)), "hero")
    run = wait_for(qtbot, runs, path, lambda run: not run.is_active)
    assert run.state == RunState.FAILED
    assert "didn't start" in run.status.sentence
    assert not (path / WANTED).exists()
    monkeypatch.setattr(learning_runs, "LEARNER", ("/nowhere/python",))
    runs.resume(path)
    assert wait_for(qtbot, runs, path, lambda run: not run.is_active).state == RunState.FAILED


def test_names_that_are_taken_are_refused(runs: LearningRuns, editor_model: LearnedBody) -> None:
    editor_model.save(model_destination("hero"))
    with pytest.raises(LCollisionError, match="a model 'hero' already exists"):
        runs.start(LearningRequest(("/nowhere.npz",)), "hero")
    folder_of("villain", RunState.STOPPED).poses.touch()
    with pytest.raises(LCollisionError, match="being learned from other files"):
        runs.start(LearningRequest(("/elsewhere.npz",)), "villain")


def test_the_learner_refuses_a_folder_without_a_request(tmp_path: Path) -> None:
    work = WorkFolder(tmp_path / "hero.safetensors")
    work.path.mkdir()
    other = tmp_path / "app"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit('a package of the folder')")
    environment = learning_runs._environment()
    names = environment.keys()
    result = subprocess.run(
        [*learning_runs.LEARNER, work.path],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={name: environment.value(name) for name in names},
    )
    assert result.returncode == 2, result.stderr
    assert work.status.state == RunState.FAILED
    # It finished no stage.
    assert not work.status.seconds
    assert "request.json" in work.status.sentence
