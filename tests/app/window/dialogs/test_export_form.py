"""The export form: its choices, remembered settings and results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QApplication, QDialog, QFileDialog, QLabel, QMessageBox
from pytestqt.qtbot import QtBot

from app.editing.settings import SETTINGS
from app.view.theme import DARK, LIGHT, apply_theme
from app.window.dialogs.forms import (
    EXPORT_NAMES,
    MESH,
    ExportDialog,
    Form,
    MotionDialog,
    _meanings,
)
from app.window.main_window import MainWindow
from lcollision_core.bodies import ExportAxes, LearnedBody, NamedPose, RigBody, export_mesh
from lcollision_core.files import read_character, read_mesh
from lcollision_core.files.motion.caches import read_point_cache
from tests.app.support import export_pose
from tests.app.windows import PATIENCE, accept_and_choose, answer, shown, take_picture
from tests.core.character_file import figure
from tests.core.gltf_builder import arm
from tests.rigged_shapes import rigged_tube

pytestmark = pytest.mark.one_window


def fields(form: Form) -> tuple[object, object]:
    return form._fields["export_axes"], form._fields["export_rescale"]


def test_every_preset_is_offered_and_a_setting() -> None:
    assert list(EXPORT_NAMES) == list(ExportAxes) == list(SETTINGS["export_axes"].choices)


def test_the_scale_follows_the_axes_and_both_are_remembered(
    qtbot: QtBot, window: MainWindow
) -> None:
    model = window.document.model
    form = ExportDialog(window.settings, window, model)
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
    again = ExportDialog(window.settings, window, model)
    qtbot.addWidget(again)
    axes, scale = fields(again)
    assert (axes.currentData(), scale.value()) == ("unreal", 2.54)
    # A body in another unit gives the same size.
    inches = model.with_card(replace(model.card, metres=0.0254))
    other = ExportDialog(window.settings, window, inches)
    qtbot.addWidget(other)
    axes, scale = fields(other)
    assert scale.value() == pytest.approx(2.54 * 0.0254, abs=1e-6)
    axes.setCurrentIndex(axes.findData("maya"))
    assert scale.value() == pytest.approx(2.54)


@pytest.mark.variants
@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_an_export_is_written_as_the_form_says(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, theme: object
) -> None:
    apply_theme(QApplication.instance(), theme)
    path = tmp_path / "pose.obj"
    told: list[str] = []
    window.document.message.connect(told.append)
    on_screen = shown(window)

    def fill(dialog: QDialog) -> None:
        assert isinstance(dialog, Form)
        axes, _ = fields(dialog)
        axes.setCurrentIndex(axes.findData("maya"))
        QApplication.processEvents()
        take_picture(dialog, f"export_{'dark' if theme is DARK else 'light'}")
        accept_and_choose(path, timers)(dialog)

    timers = [answer(fill)]
    window.actions_by_key["export"].trigger()
    qtbot.waitUntil(path.is_file, timeout=PATIENCE)
    qtbot.waitUntil(lambda: any("Exported" in sentence for sentence in told), timeout=PATIENCE)
    model = window.document.model
    read = read_mesh(path, topology=model.topology).vertices
    np.testing.assert_array_equal(read[:, 1], 100.0 * on_screen[:, model.up_axis].astype(float))
    assert window.settings["export_axes"] == "maya"
    apply_theme(QApplication.instance(), LIGHT)


@pytest.fixture
def arm_model(qtbot: QtBot, window: MainWindow, tmp_path: Path) -> RigBody:
    """Open a character whose file offers its forms."""
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        window.document.tasks.open_model(arm().write(tmp_path / "arm.glb"))
    assert isinstance(window.document.model, RigBody)
    return window.document.model


@pytest.mark.variants
@pytest.mark.parametrize("form", ["joints", "mesh", "morph"])
def test_a_character_is_given_back_in_the_form_that_is_chosen(
    qtbot: QtBot, window: MainWindow, arm_model: RigBody, tmp_path: Path, form: str
) -> None:
    document, path = window.document, tmp_path / "posed.glb"
    document.motion.blend_towards(arm_model.known_poses[2], 1.0)
    timers: list[QTimer] = []
    accept = accept_and_choose(path, timers)

    def fill(dialog: QDialog) -> None:
        assert isinstance(dialog, ExportDialog)
        keys = [dialog.form.itemData(row) for row in range(dialog.form.count())]
        assert keys == ["joints", "mesh", "morph", MESH]
        dialog.form.setCurrentIndex(keys.index(form))
        assert dialog.kinds == {"GLB": ".glb"}
        assert not dialog.axes.isEnabled()
        take_picture(dialog, f"export_{form}")
        accept(dialog)

    timers.append(answer(fill))
    with qtbot.waitSignal(document.message, timeout=PATIENCE) as told:
        window.actions_by_key["export"].trigger()
    assert "no collisions (checked)" in told.args[0]
    assert window.settings["export_form"] == form
    written = read_character(path)
    expected = arm_model.decode(document.history.latent)
    assert (written.rig is None) == (form == "mesh")
    np.testing.assert_allclose(written.rest_vertices, expected, atol=1e-5 * arm_model.body_size)


def test_a_model_keeps_the_form_of_a_file_that_is_named(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = window.document.model
    mine = tmp_path / "mine.obj"
    export_mesh(mine, model, model.reference)
    mine.write_text("# mine\n" + mine.read_text())
    form = ExportDialog(window.settings, window, model)
    qtbot.addWidget(form)
    assert not form.form.isEnabled()
    assert set(form.kinds) == {"OBJ", "PLY", "STL", "GLB"}
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (str(mine), ""))
    form.source.click()
    assert form.source.text() == "mine.obj"
    assert (form.form.currentData(), form.kinds) == ("obj", {"OBJ": ".obj"})
    assert form.axes.isEnabled()
    assert (form.export_request.like, form.export_request.form) == (mine, "obj")
    form.accept()
    export_pose(window.document, tmp_path / "out.obj", form.export_request)
    qtbot.waitUntil(lambda: not window.document.tasks.n_exports, timeout=PATIENCE)
    assert (tmp_path / "out.obj").read_text().startswith("# mine\n")


@pytest.mark.variants
@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_model_keeps_the_form_of_the_file_that_it_was_learned_from(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, suffix: str
) -> None:
    model = window.document.model
    assert isinstance(model, LearnedBody)
    mine = tmp_path / f"mine{suffix}"
    export_mesh(mine, model, model.reference)
    request = {"sources": [str(mine)], "scale": 1.0}
    provenance = {**model.card.provenance, "request": request}
    card = replace(model.card, provenance=provenance)
    learned = LearnedBody(model.name, model.embedding, card)
    form = ExportDialog(window.settings, window, learned)
    qtbot.addWidget(form)
    assert form.source.text() == mine.name
    assert form.export_request.like == mine
    assert list(form.kinds.values()) == [suffix]
    form.form.setCurrentIndex(form.form.findData(MESH))
    assert form.export_request.like is None
    assert set(form.kinds.values()) == {".obj", ".ply", ".stl", ".glb"} - {suffix}


def chooser(change: Callable[[MotionDialog], None], path: Path, timers: list[QTimer]) -> QTimer:
    """Return a timer that changes the motion export form and accepts it, with a file."""
    accept = accept_and_choose(path, timers)

    def fill(dialog: QDialog) -> None:
        assert isinstance(dialog, MotionDialog)
        change(dialog)
        take_picture(dialog, f"export_motion_{path.suffix[1:]}")
        accept(dialog)

    return answer(fill)


def test_the_motion_on_the_timeline_goes_back_into_the_character_s_file(
    qtbot: QtBot, window: MainWindow, arm_model: RigBody, tmp_path: Path
) -> None:
    path = tmp_path / "wave.glb"
    timers: list[QTimer] = []
    timeline = window.document.timeline
    qtbot.waitUntil(lambda: timeline.motion is not None)
    motion = timeline.motion
    assert motion is not None

    def look(dialog: MotionDialog) -> None:
        keys = [dialog.form.itemData(row) for row in range(dialog.form.count())]
        assert keys == ["clip", "bvh", "vrma", "pc2", "mdd"]
        assert dialog.kinds == {"GLB": ".glb"}
        assert dialog.frames == range(len(motion))
        assert (dialog.rate.isEnabled(), dialog.axes.isEnabled()) == (False, False)

    timers.append(chooser(look, path, timers))
    told: list[str] = []
    window.document.message.connect(told.append)
    window.actions_by_key["export_timeline"].trigger()
    qtbot.waitUntil(lambda: any(said.startswith("Exported wave.glb: ") for said in told))
    (clip,) = arm_model.character.clips
    before = arm_model.character.sample(clip, None)
    after = read_character(path).sample(clip, None)
    np.testing.assert_allclose(after.times, before.times, atol=1e-6)
    np.testing.assert_allclose(after.vertices, before.vertices, atol=1e-6 * arm_model.body_size)
    # The clip's own rate is not remembered as a choice.
    assert window.settings["export_rate"] == SETTINGS["export_rate"].default
    assert window.settings["motion_form"] == "clip"


def test_selected_poses_are_the_frames_of_a_point_cache(
    qtbot: QtBot, window: MainWindow, arm_model: RigBody, tmp_path: Path
) -> None:
    path = tmp_path / "wave.pc2"
    timers: list[QTimer] = []
    names = arm_model.card.pose_names
    poses = [NamedPose(*held) for held in zip(names, arm_model.known_poses, strict=True)]
    window.document.library.add_poses(poses)
    window.library.own.setChecked(True)
    window.library.list.selectAll()

    def change(dialog: MotionDialog) -> None:
        dialog.form.setCurrentIndex(dialog.form.findData("pc2"))
        assert dialog.axes.isEnabled()
        dialog.rate.setValue(25)

    timers.append(chooser(change, path, timers))
    with qtbot.waitSignal(window.document.message, timeout=PATIENCE):
        window.actions_by_key["export_motion"].trigger()
    assert len(read_point_cache(path)) == len(names)
    assert window.settings["export_rate"] == 25


@pytest.mark.variants
@pytest.mark.parametrize("words", ["Replace", "Cancel"])
def test_files_of_a_motion_that_nobody_has_named_are_asked_about(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, words: str
) -> None:
    document, timers = window.document, []
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        document.tasks.open_model(figure().write(tmp_path / "figure.glb"))
    precious = tmp_path / "run Body.pc2"
    precious.write_bytes(b"precious")
    told: list[str] = []

    def decide(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        take_picture(dialog, "replace_files")
        told.extend([dialog.text(), dialog.informativeText()])
        next(
            button for button in dialog.buttons() if button.text().replace("&", "") == words
        ).click()

    def change(dialog: MotionDialog) -> None:
        dialog.form.setCurrentIndex(dialog.form.findData("pc2"))

    window.library.list.selectAll()
    timers.append(chooser(change, tmp_path / "run.pc2", timers))
    window.actions_by_key["export_motion"].trigger()
    # The question comes after the file names are known.
    timers.append(answer(decide))
    qtbot.waitUntil(lambda: bool(told) and not document.tasks.busy, timeout=PATIENCE)
    assert told[0] == "Replace existing files?"
    assert "“run Body.pc2”" in told[1]
    assert (precious.read_bytes() == b"precious") is (words == "Cancel")
    assert (tmp_path / "run Hat.pc2").exists() is (words == "Replace")


def test_what_is_exported_is_what_was_shown_as_the_dialog_opened(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, path, timers = window.document, tmp_path / "shown.obj", []
    on_screen, other = shown(window), RigBody.of(read_character(arm().write(tmp_path / "arm.glb")))
    accept = accept_and_choose(path, timers)

    def fill(dialog: QDialog) -> None:
        document.set_model(other)
        accept(dialog)

    timers.append(answer(fill))
    with qtbot.waitSignal(document.message, timeout=PATIENCE) as told:
        window.actions_by_key["export"].trigger()
    assert told.args[0].startswith("Exported shown.obj")
    np.testing.assert_array_equal(read_mesh(path).vertices.astype(np.float32), on_screen)


def test_poses_of_no_motion_keep_the_rate_and_form_that_were_chosen(
    qtbot: QtBot, window: MainWindow
) -> None:
    window.settings["export_rate"] = 29.97
    form = MotionDialog(window.settings, window, window.document.model)
    qtbot.addWidget(form)
    assert [form.form.itemData(row) for row in range(form.form.count())] == ["pc2", "mdd"]
    assert (form.rate.value(), form.rate.text()) == (29.97, "29.97")
    assert form.export_request.fps == 29.97
    form.rate.setValue(30.0)
    assert form.rate.text() == "30"
    form.rate.setValue(23.976)
    form.show()
    take_picture(form, "export_rate")
    form.accept()
    assert window.settings["export_rate"] == 23.976
    # A model has no clips to choose, which must not affect the next character.
    assert window.settings["motion_form"] == "clip"


def test_clips_are_kept_beside_a_pose_of_joints_where_the_box_says_so(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    model = RigBody.of(read_character(figure().write(tmp_path / "figure.glb")))
    form = ExportDialog(window.settings, window, model)
    qtbot.addWidget(form)
    box = form.keep_clips
    assert box is not None
    assert not form.export_request.keep_clips
    assert "Its clips are left out: a playing clip would hide the pose." in form._about.text()
    box.setChecked(True)
    assert form.export_request.keep_clips
    assert "Its clips stay;" in form._about.text()
    form.show()
    take_picture(form, "export_keep_clips")
    form.form.setCurrentIndex(form.form.findData("mesh"))
    assert not box.isEnabled()
    assert not form.export_request.keep_clips
    form.accept()
    again = ExportDialog(window.settings, window, model)
    qtbot.addWidget(again)
    assert again.keep_clips is not None
    assert again.keep_clips.isChecked()
    # A model has no own clips.
    assert ExportDialog(window.settings, window, window.document.model).keep_clips is None


def test_a_character_whose_format_is_not_written_comes_back_as_glb_and_that_is_said(
    qtbot: QtBot, window: MainWindow, arm_model: RigBody
) -> None:
    character = replace(arm_model.character, source=Path("arm.fbx"))
    form = ExportDialog(window.settings, window, RigBody.of(character))
    qtbot.addWidget(form)
    assert form.form.currentData() == "joints"
    assert form.form.currentText() == "GLB, posed skeleton"
    labels = [label.text() for label in form.findChildren(QLabel)]
    assert "Format" in labels
    assert "Form" not in labels
    assert form.kinds == {"GLB": ".glb"}
    said = "FBX can't be written: this is a GLB with its meshes, joints,"
    assert said in form._about.text()
    assert form._meaning.text().startswith("A GLB file is always y up and in metres")
    form.show()
    take_picture(form, "export_fbx")
    form.form.setCurrentIndex(form.form.findData(MESH))
    assert said not in form._about.text()
    motion = MotionDialog(window.settings, window, RigBody.of(character))
    qtbot.addWidget(motion)
    assert motion.form.currentData() == "clip"
    assert said in motion._about.text()
    motion.form.setCurrentIndex(motion.form.findData("pc2"))
    assert said not in motion._about.text()


@pytest.mark.variants
@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_a_pose_is_printed_as_the_form_says(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, theme: object
) -> None:
    apply_theme(QApplication.instance(), theme)
    path = tmp_path / "figure.stl"
    told: list[str] = []
    window.document.message.connect(told.append)

    def fill(dialog: QDialog) -> None:
        assert isinstance(dialog, Form)
        dialog._fields["print_height"].setValue(50.0)
        dialog._fields["print_base"].setValue(2.0)
        QApplication.processEvents()
        take_picture(dialog, f"print_{'dark' if theme is DARK else 'light'}")
        accept_and_choose(path, timers)(dialog)

    timers = [answer(fill)]
    window.actions_by_key["print"].trigger()
    qtbot.waitUntil(
        lambda: any("Exported figure.stl: one closed volume" in one for one in told),
        timeout=PATIENCE,
    )
    height = float(np.ptp(read_mesh(path).vertices[:, 2]))
    assert height == pytest.approx(50.0 + 2.0 - 0.5, abs=1e-4)
    assert window.settings["print_height"] == 50.0
    apply_theme(QApplication.instance(), LIGHT)


@pytest.mark.parametrize(("sign", "axis"), [(1.0, "y"), (-1.0, "-y")])
def test_the_model_s_own_axes_are_named_also_where_up_points_down(sign: float, axis: str) -> None:
    character = rigged_tube()
    model = RigBody.of(replace(character, up=sign * character.up))
    assert _meanings(model)[ExportAxes.MODEL].startswith(f"Same as the model: {axis} is up, ")
