"""Closing the window: waiting, questions, and complete clean-up."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from PIL import Image
from PySide6.QtWidgets import QApplication, QDialog, QProgressBar
from pytestqt.qtbot import QtBot
from shiboken6 import isValid

from app.view.offscreen import VideoStyle
from app.window.dialogs.questions import FailureDialog
from app.window.main_window import MainWindow
from app.work.threads import Failure
from lcollision_core.jobs import Job
from tests.app.support import export_pose
from tests.app.windows import PATIENCE, answer, close_window, is_open, take_picture


def test_closing_waits_for_what_is_being_exported(window: MainWindow, tmp_path: Path) -> None:
    document, asked, go_on = window.document, [], threading.Event()

    def look(box: QDialog) -> None:
        take_picture(box, "closing")
        asked.append(box.text())
        go_on.set()

    document.tasks.write("Waiting", lambda *_: str(go_on.wait(PATIENCE / 1000)))
    export_pose(document, tmp_path / "no such folder" / "pose.obj")
    export_pose(document, tmp_path / "pose.obj")
    waiting = answer(look)
    # One fails, which is reported; the other is still written.
    assert not window.close()
    assert not waiting.isActive()
    assert asked == ["Finishing 3 exports…"]
    (told,) = (held for held in window.findChildren(FailureDialog) if held.isVisible())
    assert "no folder" in told.what.text()
    assert (tmp_path / "pose.obj").is_file()
    export_pose(document, tmp_path / "again.obj")
    document.history.mark_saved()
    assert window.close()
    assert (tmp_path / "again.obj").is_file()


def test_closing_waits_for_a_video_that_is_being_drawn(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    style, asked = VideoStyle(0.4, 80, 60, 10), []
    qtbot.waitUntil(lambda: window.document.motion.frame is not None, timeout=PATIENCE)
    window.viewport.pictures.film(tmp_path / "turn.gif", style)
    waiting = answer(lambda box: asked.append(box.text()))
    assert window.close()
    assert not waiting.isActive()
    assert asked == ["Finishing 1 export…"]
    with Image.open(tmp_path / "turn.gif") as video:
        assert video.n_frames == 4


@pytest.mark.parametrize("how", ["cancelled", "told to end"])
def test_an_export_runs_once_while_the_window_waits_for_it(
    qtbot: QtBot, window: MainWindow, how: str
) -> None:
    document, started, go_on, runs = window.document, [], threading.Event(), []

    def write(job: Job) -> str:
        runs.append(threading.current_thread())
        job.report(1, 4)
        go_on.wait(PATIENCE / 1000)
        return "Written"

    def give_up(box: QDialog) -> None:
        take_picture(window, f"closing_{how.replace(' ', '_')}")
        started.append(box)
        if how == "told to end":
            go_on.set()
            window.close_unasked()
        else:
            box.reject()

    document.tasks.write("Exporting slow.obj", write)
    bar = window.statusBar().findChild(QProgressBar)
    qtbot.waitUntil(lambda: (bar.value(), bar.maximum()) == (1, 4), timeout=PATIENCE)
    waiting = answer(give_up)
    assert window.close() is (how == "told to end")
    assert not waiting.isActive()
    if how == "cancelled":
        with qtbot.waitSignal(document.message, timeout=PATIENCE):
            go_on.set()
        assert window.isVisible()
        qtbot.waitUntil(lambda: not bar.isVisible(), timeout=PATIENCE)
    assert len(runs) == 1
    assert runs[0] is not threading.main_thread()


def test_an_export_is_cancelled_by_the_button_beside_it(window: MainWindow) -> None:
    document, told, go_on = window.document, [], threading.Event()

    def write(job: Job) -> str:
        go_on.wait(PATIENCE / 1000)
        job.check()
        raise AssertionError("it was not cancelled")

    button = window.statusBar().cancel
    assert not button.isVisible()
    document.message.connect(told.append)
    document.tasks.write("Exporting figure.stl", write)
    assert button.isVisible()
    button.click()
    assert told == ["Exporting figure.stl was cancelled"]
    assert document.tasks.n_exports == 0
    assert not button.isVisible()
    go_on.set()


def test_a_window_that_closes_is_gone_before_its_work_has_ended(
    window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    close, seen = window.document.close, []
    window.docks["sliders"].setFloating(True)
    window.show_failure(Failure("the disk is full", "make room", "details"))

    def look() -> bool:
        seen.extend(w for w in QApplication.topLevelWidgets() if w.isVisible())
        return close()

    monkeypatch.setattr(window.document, "close", look)
    close_window(window)
    assert seen == []


def test_told_to_end_it_closes_from_under_an_open_question(window: MainWindow) -> None:
    window.document.motion.set_code(0, 0.5)
    asked = answer(lambda _: window.close_unasked())
    assert window.close()
    assert not asked.isActive()
    assert not is_open(window)


def test_nothing_is_left_open(window: MainWindow) -> None:
    """Closing by the menu with nothing to save asks no question."""
    window.actions_by_key["quit"].trigger()
    assert not window.isVisible()
    assert window.document.close()
    assert QApplication.activeModalWidget() is None


def test_a_closed_window_is_deleted_at_once(qtbot: QtBot, window: MainWindow) -> None:
    """The garbage collector deletes widgets in any order, which crashes Qt."""
    with qtbot.waitSignal(window.destroyed, timeout=PATIENCE):
        window.actions_by_key["quit"].trigger()
    assert not isValid(window)
