"""A mesh in another unit: the window offers to scale it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QApplication, QMessageBox
from pytestqt.qtbot import QtBot

from app.window.main_window import MainWindow
from lcollision_core.bodies import LearnedBody
from lcollision_core.files import read_mesh, write_mesh
from tests.app.support import export_pose
from tests.app.windows import take_picture

pytestmark = pytest.mark.one_window


def answer_with(words: str, told: list[str], picture: str = "scale_and_import") -> None:
    """Click a button of the next question."""

    def click() -> None:
        box = QApplication.activeModalWidget()
        if not isinstance(box, QMessageBox):
            QTimer.singleShot(20, click)
            return
        told.extend([box.text(), box.informativeText()])
        take_picture(box, picture)
        next(button for button in box.buttons() if button.text().replace("&", "") == words).click()

    QTimer.singleShot(0, click)


@pytest.mark.parametrize("words", ["Scale and import", "Cancel"])
def test_a_mesh_in_millimetres_is_scaled_and_goes_back_to_its_size(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, words: str
) -> None:
    document = window.document
    model = document.model
    vertices = 1000.0 * (model.decode(model.known_poses[2]) + 5.0)
    write_mesh(tmp_path / "scan.obj", vertices, model.faces)
    told: list[str] = []
    answer_with(words, told)
    with qtbot.waitSignal(document.tasks.wrong_scale, timeout=20_000):
        window.files.open_path(tmp_path / "scan.obj")
    qtbot.waitUntil(lambda: len(told) == 2, timeout=20_000)
    assert told[0] == "“scan.obj” seems to be in another unit."
    assert "Scaled by 0.001 it fits" in told[1]
    if words == "Cancel":
        assert document.history.pose.placement is None
        return
    qtbot.waitUntil(lambda: document.history.pose.placement is not None, timeout=20_000)
    assert document.history.pose.name == "scan"
    export_pose(document, tmp_path / "back.obj")
    qtbot.waitUntil((tmp_path / "back.obj").exists, timeout=20_000)
    back = read_mesh(tmp_path / "back.obj").vertices
    assert np.abs(back - vertices).max() < 1000.0 * 0.02 * model.body_size


@pytest.mark.parametrize("words", ["Turn", "Cancel"])
def test_a_model_is_turned_upright_in_its_file_where_the_user_agrees(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, words: str
) -> None:
    document, upright = window.document, window.actions_by_key["upright"]
    path = tmp_path / "own.safetensors"
    document.model.save(path)
    with qtbot.waitSignal(document.model_changed, timeout=20_000):
        document.tasks.open_model(path)
    before, told = path.read_bytes(), []
    assert (document.model.up_axis, upright.isEnabled()) == (1, True)
    answer_with(words, told, "turn_upright")
    if words == "Cancel":
        upright.trigger()
        assert path.read_bytes() == before
        assert not document.tasks.incoming
        return
    with qtbot.waitSignal(document.model_changed, timeout=20_000):
        upright.trigger()
        # It runs in the other thread.
        assert document.tasks.incoming == "Turning own"
    assert "This changes the model's file" in told[1]
    assert document.model.up_axis == 2
    assert LearnedBody.load(path).up_axis == 2


def test_a_bundled_model_cannot_be_turned_and_the_tip_says_why(window: MainWindow) -> None:
    upright = window.actions_by_key["upright"]
    assert not upright.isEnabled()
    assert upright.toolTip().startswith("This model is bundled with the program: copy its file")
