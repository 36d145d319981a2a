"""A new model in the window: wizard pages, background run, several windows, Open."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QRect, QSize, Qt
from PySide6.QtGui import QScreen
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QLabel
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.theme import DARK, LIGHT, Theme, apply_theme
from app.window.dialogs.learning import LearningDialog, _figures
from app.window.dialogs.new_model import NewModelDialog
from app.window.main_window import MainWindow
from app.work import learning_runs
from lcollision_core.bodies import LearnedBody, RigBody, model_destination
from lcollision_core.errors import LCollisionError
from lcollision_core.files import locked, write_mesh, write_pose_set
from lcollision_core.learning_state import LearningStatus, RunState
from lcollision_core.options import LearningRequest, Quality
from lcollision_core.tasks.learning import EFFORTS, LearnedCard
from lcollision_core.tasks.work_folder import WorkFolder
from tests.app.window.test_words import OUR_OWN
from tests.app.windows import (
    answer,
    close_window,
    drop,
    open_window,
    rest,
    settings_in,
    take_picture,
)
from tests.app.work.test_learning_runs import PATIENCE, QUICK, process_of
from tests.bending_tube import bending_tube
from tests.core.gltf_builder import arm
from tests.rigged_shapes import rigged_body, write_gltf

LEFT = Qt.MouseButton.LeftButton
SMALL = QSize(800, 600)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning_runs, "POLL_MILLISECONDS", 50)
    monkeypatch.setattr(learning_runs, "LEARNER", QUICK)


@pytest.fixture
def tubes(tmp_path: Path) -> Path:
    """Return a folder of meshes."""
    folder, poses = tmp_path / "tubes", bending_tube()
    folder.mkdir()
    for name, vertices in zip(poses.names, poses.vertices, strict=True):
        write_mesh(folder / f"{name}.obj", vertices, poses.faces)
    return folder


@pytest.fixture
def watching(qtbot: QtBot, window: MainWindow) -> MainWindow:
    """Return a window that looks at runs."""
    watched = window.learning.runs._timer
    qtbot.waitUntil(watched.isActive, timeout=PATIENCE)
    return window


@pytest.fixture
def no_runs(qtbot: QtBot, watching: MainWindow) -> Iterator[None]:
    yield
    runs = watching.learning.runs
    for run in runs.runs:
        runs.stop(run.path, discard=True)
        qtbot.waitUntil(lambda run=run: not run.path.exists(), timeout=PATIENCE)


def wizard_of(qtbot: QtBot, window: MainWindow) -> NewModelDialog:
    def shown() -> list[NewModelDialog]:
        return [d for d in window.findChildren(NewModelDialog) if d.isVisible()]

    qtbot.waitUntil(lambda: len(shown()) == 1, timeout=PATIENCE)
    return shown()[0]


def dialog_of(window: MainWindow) -> LearningDialog:
    (dialog,) = (d for d in window.findChildren(LearningDialog) if d.isVisible())
    return dialog


@pytest.mark.slow
def test_a_dropped_folder_of_meshes_is_learned_killed_continued_and_opened(
    qtbot: QtBot, watching: MainWindow, tubes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECONDS_PER_STEP", "0.05")
    window, learning = watching, watching.learning
    drop(window, tubes)
    wizard = wizard_of(qtbot, window)
    qtbot.waitUntil(lambda: wizard.preview.has_body, timeout=PATIENCE)
    assert wizard.preview.has_body
    QTest.mouseClick(wizard.next, LEFT)
    assert wizard.page is wizard.poses
    assert not wizard.poses.number.isVisible()
    assert not wizard.poses.clip.isVisible()
    QTest.mouseClick(wizard.next, LEFT)
    assert wizard.page is wizard.contacts
    QTest.mouseClick(wizard.next, LEFT)
    assert wizard.page is wizard.quality
    assert wizard.quality.name.text() == "tubes"
    wizard.quality.choices[Quality.QUICK].click()
    assert wizard.request() == LearningRequest((str(tubes),), "quick")
    wizard.quality.name.selectAll()
    QTest.keyClicks(wizard.quality.name, "Hero")
    QTest.keyClick(wizard.quality.name, Qt.Key.Key_Return)
    assert not wizard.isVisible()
    path = learning.runs.runs[0].path
    assert path == WorkFolder(model_destination("Hero")).path

    def phase() -> RunState | None:
        run = learning.runs.run_of(path)
        return run.state if run else None

    if sys.platform == "linux":
        qtbot.waitUntil(lambda: "labels" in learning.runs.runs[0].status.seconds, timeout=PATIENCE)
        qtbot.waitUntil(lambda: phase() is RunState.RUNNING, timeout=PATIENCE)
        assert learning.indicator.text().startswith("Learning Hero: ")
        # The editor stays usable meanwhile.
        window.document.motion.set_code(0, 0.3)
        rest(qtbot, window)
        os.kill(process_of(path), signal.SIGKILL)
        monkeypatch.delenv("SECONDS_PER_STEP")
        qtbot.waitUntil(lambda: phase() is RunState.KILLED, timeout=PATIENCE)
        assert learning.indicator.property("state") == "failed"
        dialog = dialog_of(window)
        assert "stopped unexpectedly" in dialog.state.text()
        QTest.mouseClick(dialog.resume, LEFT)
        window.document.history.undo()
    qtbot.waitUntil(lambda: phase() is RunState.DONE, timeout=PATIENCE)
    dialog = dialog_of(window)
    qtbot.waitUntil(dialog.card.isVisible, timeout=PATIENCE)
    assert not dialog.card.picture.pixmap().isNull()
    window.document.history.mark_saved()
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        QTest.mouseClick(dialog.open_model, LEFT)
    assert window.document.model.name == "Hero"
    assert window.document.model.has_predictor
    assert not path.exists()
    assert not window.learning.indicator.isVisible()
    rest(qtbot, window)


@pytest.mark.slow
def test_a_run_goes_on_without_its_window_and_the_next_window_finds_it(
    qtbot: QtBot,
    watching: MainWindow,
    tmp_path: Path,
    editor_model: LearnedBody,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SECONDS_PER_STEP", "0.05")
    poses = tmp_path / "tube.npz"
    write_pose_set(poses, bending_tube())
    path = watching.learning.runs.start(LearningRequest((str(poses),), "quick"), "hero")
    work = WorkFolder.at(path)
    qtbot.waitUntil(lambda: work.status.stage == "latent space", timeout=PATIENCE)
    close_window(watching)
    assert work.is_locked
    document = PoseDocument(editor_model, library_folder=tmp_path / "library")
    later = open_window(qtbot, document, settings_in(tmp_path))
    qtbot.waitUntil(lambda: len(later.learning.runs.runs) == 1, timeout=PATIENCE)
    qtbot.waitUntil(later.learning.indicator.isVisible)
    qtbot.waitUntil(
        lambda: later.learning.runs.runs[0].state == RunState.DONE, timeout=2 * PATIENCE
    )
    dialog = dialog_of(later)
    QTest.mouseClick(dialog.dismiss, LEFT)
    assert not path.exists()
    assert not dialog.isVisible()
    assert LearnedBody.load("hero").has_predictor


def test_a_rigged_character_offers_to_be_learned(
    qtbot: QtBot, watching: MainWindow, tmp_path: Path
) -> None:
    window, action = watching, watching.actions_by_key["learn_character"]
    assert not action.isEnabled()
    assert not window.collision.prediction.learn.isVisible()
    file = arm().write(tmp_path / "arm.glb")
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        drop(window, file)
    rest(qtbot, window)
    assert isinstance(window.document.model, RigBody)
    assert action.isEnabled()
    assert window.collision.prediction.learn.isVisible()
    QTest.mouseClick(window.collision.prediction.learn, LEFT)
    wizard = wizard_of(qtbot, window)
    assert wizard.files.paths == (file,)
    qtbot.waitUntil(lambda: wizard.preview.has_body, timeout=PATIENCE)
    wizard.next.click()
    assert wizard.poses.by_rig.isVisible()
    assert wizard.poses.up_axis == 1
    wizard.poses.up.setCurrentIndex(wizard.poses.up.findData(2))
    wizard.poses.by_rig.setCurrentIndex(2)
    wizard.poses.number.setValue(40)
    wizard.next.click()
    wizard.contacts.experts.setChecked(True)
    wizard.contacts._near.own.setChecked(True)
    wizard.contacts.near.setValue(3.0)
    wizard.contacts.count_groups.setChecked(True)
    wizard.next.click()
    request = wizard.request()
    assert (request.by_rig, request.up, request.quality) == (40, 2, "good")
    assert (request.near_exclusion, request.rest_exclusion) == (0.03, None)
    assert request.ignored == ()
    said = [label.text() for label in wizard.findChildren(QLabel)]
    assert [text for text in said if OUR_OWN.search(text)] == []
    given = wizard.poses.n_poses(EFFORTS[Quality.GOOD].n_poses)
    assert f": {given} poses, " in wizard.quality._meanings[Quality.GOOD].text()
    wizard.reject()


def test_what_cannot_be_learned_from_stays_on_the_first_page(
    qtbot: QtBot, watching: MainWindow, tmp_path: Path, tubes: Path, editor_model: LearnedBody
) -> None:
    window, broken = watching, tmp_path / "broken.npz"
    broken.write_bytes(b"no poses")
    window.files.open_path(broken)
    wizard = wizard_of(qtbot, window)
    qtbot.waitUntil(lambda: "broken.npz" in wizard.files.contents.text(), timeout=PATIENCE)
    wizard.next.click()
    assert wizard.page is wizard.files
    assert wizard.refusal.text() == "Remove the file that can't be used."
    take_picture(wizard, "new_model_refused")
    assert not window.findChildren(LearningDialog)
    wizard.files.list.setCurrentRow(0)
    wizard.files.list.setFocus()
    QTest.keyClick(wizard.files.list, Qt.Key.Key_Delete)
    assert wizard.files.paths == ()
    assert wizard.refusal.text() == "Add a file or a folder first."
    # Further dropped files go to the open dialog.
    drop(wizard, tubes)
    qtbot.waitUntil(lambda: wizard.files.paths == (tubes,), timeout=PATIENCE)
    wizard.files.paths_changed.emit()
    wizard.next.click()
    assert wizard.refusal.text() == "Wait for the files to be read."
    qtbot.waitUntil(lambda: wizard.preview.has_body, timeout=PATIENCE)
    assert not wizard.files.contents.text()
    for _ in range(3):
        wizard.next.click()
    editor_model.save(model_destination("taken"))
    for name in ("taken", "", "a/b", "v1.0", "body"):
        wizard.quality.name.setText(name)
        wizard.next.click()
        assert wizard.isVisible()
        assert wizard.refusal.text()
    wizard.back.click()
    assert wizard.page is wizard.contacts
    wizard.reject()
    assert not window.learning.runs.runs


def test_several_runs_are_looked_at_and_one_is_discarded(watching: MainWindow) -> None:
    window, folders = watching, []
    for name, state in (("hero", RunState.RUNNING), ("villain", RunState.FAILED)):
        work = WorkFolder(model_destination(name))
        work.prepare(LearningRequest(("/nowhere.npz",)))
        work.write_status(
            LearningStatus(state, "labels", 0.4, 0.43, 480.0, sentence="the file is gone")
        )
        folders.append(work)
    hero, villain = folders
    with locked(hero.path / "run"):
        window.learning.runs.poll()
        text = window.learning.indicator.text()
        assert text == "Learning hero: 43 %, about 8 minutes left, checking poses (and 1 more)"
        window.actions_by_key["learning"].trigger()
        dialog = dialog_of(window)
        assert dialog.headline.text() == "Learning “hero”"
        assert dialog.stop.isVisible()
        assert dialog.which.count() == 2
        dialog.show_run(villain.path)
        assert dialog.state.text() == "The file is gone."
        assert dialog.resume.isVisible()
        asked = answer(lambda box: box.reject())
        dialog.discard.click()
        assert villain.path.exists()
        asked = answer(lambda box: QTest.mouseClick(box.buttons()[0], LEFT))
        dialog.discard.click()
        assert not asked.isActive()
        assert not villain.path.exists()
    assert not dialog.isVisible()
    hero.remove()
    window.learning.runs.poll()
    assert not window.actions_by_key["learning"].isEnabled()


def test_a_run_that_nearly_always_collides_offers_the_character_instead(
    watching: MainWindow, qtbot: QtBot, tmp_path: Path
) -> None:
    window, file = watching, write_gltf(rigged_body(), tmp_path / "figure.glb")
    work = WorkFolder(model_destination("hero"))
    work.prepare(LearningRequest((str(file),)))
    sentence = "97 % of the first 1024 samples collide"
    status = LearningStatus(RunState.FAILED, "latent space", 1.0, 0.2, sentence=sentence)
    work.write_status(replace(status, model=str(file), mostly_collides=True))
    window.learning.runs.poll()
    window.actions_by_key["learning"].trigger()
    dialog = dialog_of(window)
    assert dialog.state.text() == f"{sentence}."
    shown = [button.text().replace("&", "") for button in (dialog.resume, dialog.open_model)]
    assert shown == ["Train anyway", "Open character"]
    assert dialog.open_model.isVisible()
    QTest.mouseClick(dialog.open_model, LEFT)
    qtbot.waitUntil(lambda: isinstance(window.document.model, RigBody), timeout=PATIENCE)
    # The finished part is kept until it is discarded.
    assert work.path.exists()
    work.write_status(replace(status, sentence="the disk is full"))
    window.learning.runs.poll()
    assert dialog.resume.text().replace("&", "") == "Continue"
    assert not dialog.open_model.isVisible()
    work.remove()
    window.learning.runs.poll()


def finished(name: str, model: LearnedBody) -> WorkFolder:
    work = WorkFolder(model_destination(name))
    work.prepare(LearningRequest(("/nowhere.npz",)))
    model.save(work.destination)
    work.write_status(LearningStatus(RunState.DONE, done=1.0, model=str(work.destination)))
    return work


def test_a_card_that_is_being_read_is_given_up_with_its_dialog_and_for_another_run(
    qtbot: QtBot, watching: MainWindow, editor_model: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, asked, shown = watching.learning.runs, threading.Semaphore(0), []

    def read(model_file: str, *_: object) -> str:
        asked.acquire(timeout=120.0)
        return model_file

    monkeypatch.setattr(learning_runs, "read_card", read)
    monkeypatch.setattr(
        LearningDialog, "_on_card", lambda _, path, model: shown.append((path, model))
    )
    hero, villain = finished("hero", editor_model), finished("villain", editor_model)
    runs.poll()
    watching.actions_by_key["learning"].trigger()
    dialog = dialog_of(watching)
    dialog.show_run(hero.path)
    dialog.show_run(villain.path)
    asked.release(2)
    qtbot.waitUntil(lambda: len(shown) == 1, timeout=PATIENCE)
    assert shown == [(villain.path, str(villain.destination))]
    dialog.show_run(hero.path)
    dialog.reject()
    assert not watching.learning._work.busy
    asked.release()
    hero.remove()
    villain.remove()
    runs.poll()
    assert len(shown) == 1


def test_rates_that_no_sample_tells_are_unknown() -> None:
    card = LearnedCard("", "hero", 8, 2, 1, 0.0, 0.0, 1.0, None, None, 1.0, 10, 1.0, "", {})
    figures = dict(_figures(card))
    assert figures["False positive rate"] == "unknown: no sample was free"
    assert figures["False negative rate"] == "unknown: no sample collided"


@pytest.mark.variants
@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_the_pages_fit_800_by_600(
    qtbot: QtBot,
    watching: MainWindow,
    tubes: Path,
    monkeypatch: pytest.MonkeyPatch,
    theme: Theme,
) -> None:
    apply_theme(QApplication.instance(), theme)
    monkeypatch.setattr(QScreen, "availableGeometry", lambda _: QRect(QPoint(), SMALL))
    watching.learning.new_model((tubes,))
    wizard = wizard_of(qtbot, watching)
    qtbot.waitUntil(lambda: wizard.preview.has_body, timeout=PATIENCE)
    for page in wizard.pages:
        assert wizard.page is page
        assert wizard.width() <= SMALL.width()
        assert wizard.height() <= SMALL.height() - 40
        area = page.parentWidget()
        assert page.width() <= area.width()
        assert page is not wizard.quality or page.height() <= area.height()
        if page is not wizard.quality:
            wizard.next.click()
    take_picture(wizard, f"new_model_quality_{theme.name}")
    wizard.reject()
    apply_theme(QApplication.instance(), LIGHT)


def test_the_preview_stands_on_the_axis_that_is_up(
    qtbot: QtBot, watching: MainWindow, tubes: Path
) -> None:
    watching.learning.new_model((tubes,))
    wizard = wizard_of(qtbot, watching)
    qtbot.waitUntil(lambda: wizard.preview.has_body, timeout=PATIENCE)
    pictures = []
    for axis in range(3):
        wizard.poses.up.setCurrentIndex(wizard.poses.up.findData(axis))
        image = wizard.preview.pixmap().toImage()
        pictures.append(np.array(image.constBits()).reshape(image.height(), image.width(), 4))
    assert wizard._summary is not None
    longest = int(np.ptp(wizard._summary.rest, axis=0).argmax())
    tall = [np.ptp(np.nonzero(pixels[..., 3])[0]) for pixels in pictures]
    assert int(np.argmax(tall)) == longest
    assert tall[longest] > 2 * sorted(tall)[1]
    assert np.ptp(pictures[longest][..., :3]) > 60
    wizard.reject()


def test_a_failure_to_look_for_runs_is_told(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise LCollisionError("cannot be read", "free some memory", where="the list of runs")

    monkeypatch.setattr(learning_runs, "load_learning", fail)
    with qtbot.waitSignal(document.failed, timeout=PATIENCE) as failed:
        open_window(qtbot, document, settings_in(tmp_path))
    assert failed.args[0].headline == "the list of runs cannot be read"


def test_the_dialog_keeps_its_size_and_does_not_come_back_once_closed(
    qtbot: QtBot, watching: MainWindow, editor_model: LearnedBody
) -> None:
    runs = watching.learning.runs
    work = WorkFolder(model_destination("hero"))
    work.prepare(LearningRequest(("/nowhere.npz",)))

    def tell(stage: str, done: float) -> None:
        work.write_status(LearningStatus(RunState.RUNNING, stage, done, done, 480.0))
        runs.poll()

    with locked(work.path / "run"):
        tell("poses", 0.1)
        watching.actions_by_key["learning"].trigger()
        dialog = dialog_of(watching)
        dialog.resize(800, 780)
        for stage, done in (("latent space", 0.3), ("labels", 0.6), ("predictor", 0.9)):
            tell(stage, done)
            assert (dialog.width(), dialog.height()) == (800, 780)
        dialog.reject()
    finished("hero", editor_model)
    runs.poll()
    assert watching.learning.indicator.text() == "hero is ready"
    assert not [d for d in watching.findChildren(LearningDialog) if d.isVisible()]
    # Nor in the next window; clicking the indicator shows it again.
    watching.learning._previous_states.clear()
    runs.changed.emit()
    assert not [d for d in watching.findChildren(LearningDialog) if d.isVisible()]
    QTest.mouseClick(watching.learning.indicator, LEFT)
    dialog = dialog_of(watching)
    qtbot.waitUntil(dialog.card.isVisible, timeout=PATIENCE)
    dialog.dismiss.click()
    qtbot.waitUntil(lambda: not dialog.isVisible(), timeout=PATIENCE)
