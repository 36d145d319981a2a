"""The form of an export: what it offers, remembers and does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PySide6.QtWidgets import QApplication, QDialog, QFileDialog, QLineEdit
from pytestqt.qtbot import QtBot

from app.editing.settings import SETTINGS
from app.view.theme import DARK, LIGHT, apply_theme
from app.window.dialogs.forms import EXPORT_NAMES, Form, export_form
from app.window.main_window import MainWindow
from lcollision_core.meshes import read_mesh
from lcollision_core.model import ExportAxes
from tests.app.windows import PATIENCE, answer, shown, take_picture


def fields(form: Form) -> tuple[object, object]:
    return form._fields["export_axes"], form._fields["export_scale"]


def test_every_preset_is_offered_and_a_setting() -> None:
    assert list(EXPORT_NAMES) == list(ExportAxes) == list(SETTINGS["export_axes"].choices)


def test_the_scale_follows_the_axes_and_both_are_remembered(
    qtbot: QtBot, window: MainWindow
) -> None:
    model = window.document.model
    form = export_form(window.settings, window, model.up_axis, model.front)
    qtbot.addWidget(form)
    axes, scale = fields(form)
    assert axes.currentData() == "model"
    assert scale.value() == 1.0
    axes.setCurrentIndex(axes.findData("maya"))
    assert scale.value() == 100.0
    axes.setCurrentIndex(axes.findData("y-up"))
    assert scale.value() == 1.0
    axes.setCurrentIndex(axes.findData("unreal"))
    scale.setValue(2.54)
    form.accept()
    again = export_form(window.settings, window, model.up_axis, model.front)
    qtbot.addWidget(again)
    axes, scale = fields(again)
    assert (axes.currentData(), scale.value()) == ("unreal", 2.54)


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_an_export_is_written_as_the_form_says(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, theme: object
) -> None:
    apply_theme(QApplication.instance(), theme)
    path = tmp_path / "pose.obj"
    told: list[str] = []
    window.document.message.connect(told.append)
    on_screen = shown(window)

    def choose(dialog: QDialog) -> None:
        assert isinstance(dialog, QFileDialog)
        name = dialog.findChild(QLineEdit, "fileNameEdit")
        assert isinstance(name, QLineEdit)
        name.setText(str(path))
        dialog.accept()

    def fill(dialog: QDialog) -> None:
        assert isinstance(dialog, Form)
        axes, _ = fields(dialog)
        axes.setCurrentIndex(axes.findData("maya"))
        QApplication.processEvents()
        take_picture(dialog, f"export_{'dark' if theme is DARK else 'light'}")
        timers.append(answer(choose))
        dialog.accept()

    timers = [answer(fill)]
    window.actions_by_key["export"].trigger()
    qtbot.waitUntil(path.is_file, timeout=PATIENCE)
    qtbot.waitUntil(lambda: any("Exported" in sentence for sentence in told), timeout=PATIENCE)
    model = window.document.model
    read = read_mesh(path, topology=model.topology).vertices
    np.testing.assert_array_equal(read[:, 1], 100.0 * on_screen[:, model.up_axis].astype(float))
    assert window.settings["export_axes"] == "maya"
    apply_theme(QApplication.instance(), LIGHT)
