"""Rigged files in the window: opened, dropped, posed in degrees, saved, recovered, undone."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QDialog, QMessageBox
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.recovery import Autosave, find_recoverable_poses
from app.view.shading import Shading
from app.window.dialogs.questions import FailureDialog
from app.window.main_window import MainWindow
from app.window.start_up import StartUp
from lcollision_core.bodies import (
    ExportRequest,
    LearnedBody,
    NamedPose,
    RigBody,
    open_body,
    write_poses,
)
from tests.app.support import export_pose
from tests.app.windows import (
    PATIENCE,
    answer,
    drop,
    rest,
    settings_in,
    take_picture,
)
from tests.core.bodies.test_starter_poses import WITH_FINGERS
from tests.core.gltf_builder import arm
from tests.rigged_shapes import rigged_body, write_gltf
from tests.skeletons import character_from

pytestmark = pytest.mark.one_window

UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    return arm().write(tmp_path / "arm.glb")


def dropped(qtbot: QtBot, window: MainWindow, path: Path) -> RigBody:
    """Drop a character on a window and return the body that it becomes."""
    document = window.document
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, path)
    rest(qtbot, window)
    assert isinstance(document.model, RigBody)
    return document.model


def test_a_dropped_character_is_posed_by_its_joints_in_degrees(
    qtbot: QtBot, window: MainWindow, arm_file: Path
) -> None:
    model = dropped(qtbot, window, arm_file)
    document = window.document
    assert Path(document.history.model_file) == arm_file
    np.testing.assert_array_equal(document.history.latent, np.zeros(model.latent_size))
    code = int(np.flatnonzero(model.space.joint_of_code[6:] == 1)[0]) + 6
    assert model.latent_space.groups[0].code_names[:3] == ("rig:LeftArm",) * 3
    window.sliders.filter.setText("leftforearm")
    row = window.sliders.row_of(code)
    assert row.isVisible()
    row.field.setFocus()
    row.field.selectAll()
    QTest.keyClicks(row.field, "30")
    QTest.keyClick(row.field, Qt.Key.Key_Return)
    assert document.history.latent[code] == pytest.approx(np.radians(30.0))
    assert row.field.text().startswith("30.0°".replace(".", row.field.locale().decimalPoint()))
    assert "°" in row.field.toolTip()
    shift = window.sliders.row_of(0)
    shift.field.setValue(10.0)
    assert document.history.latent[0] == pytest.approx(0.1)
    document.history.undo()
    document.history.undo()
    np.testing.assert_array_equal(document.history.latent, np.zeros(model.latent_size))
    assert str(arm_file) in window.settings["recent_files"]


def test_a_character_is_turned_upright_without_changing_its_file(
    qtbot: QtBot, window: MainWindow, arm_file: Path
) -> None:
    before, content = dropped(qtbot, window, arm_file).up_axis, arm_file.read_bytes()
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        window.actions_by_key["upright"].trigger()
    assert window.document.model.up_axis == (before + 1) % 3
    assert arm_file.read_bytes() == content


def test_a_character_without_predictor_lacks_nothing(
    qtbot: QtBot, window: MainWindow, arm_file: Path
) -> None:
    model = dropped(qtbot, window, arm_file)
    panel, actions = window.collision, window.actions_by_key
    qtbot.waitUntil(lambda: not window.document.tasks.busy, timeout=PATIENCE)
    assert not panel.prediction.meter.isVisible()
    assert panel.prediction.title.text() == "Body parts"
    assert [row.lock.isVisible() for row in panel.prediction.rows] == [True] * len(
        model.domain_names
    )
    assert actions["resolve"].isEnabled()
    assert window.library.training.text() == "Rest pose"
    listed = window.library.list
    names = [listed.item(row).text() for row in range(listed.count())]
    assert names == [model.card.pose_names[0]]
    enabled = {shading: actions[shading.name.lower()].isEnabled() for shading in Shading}
    assert enabled == {shading: shading is not Shading.PREDICTED for shading in Shading}
    with qtbot.waitSignal(window.document.tasks.solve_finished, timeout=PATIENCE):
        actions["resolve"].trigger()
    rest(qtbot, window)
    assert panel.outcome.exactly_free.answer is True
    assert not panel.outcome.predicted_free.isVisible()


def test_a_file_without_rig_is_a_mesh_of_the_character(
    qtbot: QtBot, window: MainWindow, arm_file: Path, tmp_path: Path
) -> None:
    model, document = dropped(qtbot, window, arm_file), window.document
    posed = model.known_poses[2]
    document.motion.blend_towards(posed, 1.0)
    export_pose(document, tmp_path / "posed.glb", ExportRequest(form="mesh"))
    qtbot.waitUntil(lambda: not document.tasks.n_exports, timeout=PATIENCE)
    document.motion.reset_all()
    with qtbot.waitSignal(document.tasks.imported, timeout=PATIENCE):
        drop(window, tmp_path / "posed.glb")
    assert document.model is model
    error = model.exported_vertices(
        document.history.latent, document.history.pose.placement
    ) - model.decode(posed)
    assert np.abs(error).max() < 1e-3 * model.body_size


def test_damaged_characters_leave_the_body_that_is_open(
    qtbot: QtBot, window: MainWindow, arm_file: Path
) -> None:
    before, document = window.document.model, window.document
    arm_file.write_bytes(arm_file.read_bytes()[:100])
    with qtbot.waitSignal(document.failed, timeout=PATIENCE):
        drop(window, arm_file)
    (dialog,) = window.findChildren(FailureDialog)
    assert "arm.glb" in dialog.failure.headline
    assert document.model is before
    assert not document.tasks.busy
    dialog.close()


def test_unsaved_changes_are_asked_about_before_another_character_comes(
    qtbot: QtBot, window: MainWindow, arm_file: Path
) -> None:
    document = window.document
    before = document.model
    document.motion.set_code(0, 0.3)
    asked = []
    timer = answer(lambda dialog: (asked.append(dialog.windowTitle()), dialog.reject()))
    drop(window, arm_file)
    qtbot.waitUntil(lambda: bool(asked), timeout=PATIENCE)
    timer.stop()
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=PATIENCE)
    assert asked == ["Unsaved changes"]
    assert document.model is before


def test_poses_of_a_character_are_saved_and_recovered_with_it(
    qtbot: QtBot, arm_file: Path, tmp_path: Path
) -> None:
    document = PoseDocument(library_folder=tmp_path / "library")
    autosave = Autosave(document, tmp_path / "sessions", seconds=0.01)
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        document.tasks.open_model(arm_file)
    code = document.model.latent_size - 1
    document.motion.set_code(code, 0.4)
    document.library.add_pose("bent")
    document.tasks.save(tmp_path / "poses.json")
    document.tasks.wait_for_saves()
    assert '"arm"' in (tmp_path / "poses.json").read_text()
    with qtbot.waitSignal(autosave.written, timeout=PATIENCE):
        document.motion.set_code(code, 0.5)
        # Pending changes are written, too.
        qtbot.waitUntil(lambda: not document.motion.moving)
    assert autosave.close(keep=True)
    assert document.close()
    document.deleteLater()

    (lost,) = find_recoverable_poses(tmp_path / "sessions")
    after = PoseDocument(open_body(arm_file), library_folder=tmp_path / "library")
    assert [pose.name for pose in after.library.poses] == ["bent"]
    autosave = Autosave(after, tmp_path / "sessions", seconds=1000.0)
    with qtbot.waitSignal(autosave.recovered, timeout=PATIENCE):
        autosave.recover(lost)
    assert after.history.latent[code] == pytest.approx(0.5)
    assert Path(after.history.model_file) == arm_file
    assert autosave.close()
    assert after.close()
    after.deleteLater()


@pytest.mark.parametrize("is_whole", [True, False])
def test_the_editor_starts_with_a_character_or_without_a_damaged_one(
    qtbot: QtBot,
    tmp_path: Path,
    arm_file: Path,
    is_whole: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if not is_whole:
        arm_file.write_bytes(b"no character")
    document = PoseDocument(library_folder=tmp_path / "library")
    window = MainWindow(document, settings_in(tmp_path))
    window.show()
    with qtbot.waitSignal(window.ready, timeout=2 * PATIENCE):
        start = StartUp(window, arm_file, None)
        start.begin()
    assert isinstance(document.model, RigBody) == is_whole
    assert bool(window.findChildren(FailureDialog)) != is_whole
    for dialog in window.findChildren(FailureDialog):
        dialog.close()
    start.setParent(None)
    start.deleteLater()
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_what_was_changed_on_reading_is_told_once(
    qtbot: QtBot, window: MainWindow, arm_file: Path
) -> None:
    told: list[str] = []
    window.document.message.connect(told.append)
    model = dropped(qtbot, window, arm_file)
    assert told == ["; ".join(["Opened arm", *model.notes])]


def test_poses_of_a_character_bring_it_back_over_another_body(
    qtbot: QtBot, window: MainWindow, arm_file: Path, tmp_path: Path, editor_model: LearnedBody
) -> None:
    model, document = dropped(qtbot, window, arm_file), window.document
    poses = tmp_path / "poses.json"
    write_poses(poses, model, [NamedPose("bent", model.known_poses[2])])
    document.set_model(editor_model)
    asked: list[str] = []

    def accept(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        asked.append(dialog.text())
        next(b for b in dialog.buttons() if b.text().replace("&", "").startswith("Open")).click()

    timer = answer(accept)
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, poses)
    timer.stop()
    assert asked == ["poses.json contains poses of the model “arm”."]
    assert document.model.fingerprint == model.fingerprint
    assert Path(document.history.model_file) == arm_file
    np.testing.assert_allclose(document.history.latent, model.known_poses[2])


def test_poses_of_a_character_whose_file_is_another_s_by_now_are_refused(
    qtbot: QtBot, window: MainWindow, arm_file: Path, tmp_path: Path, editor_model: LearnedBody
) -> None:
    model, document = dropped(qtbot, window, arm_file), window.document
    poses = tmp_path / "poses.json"
    write_poses(poses, model, [NamedPose("rest", model.known_poses[0])])
    document.set_model(editor_model)
    write_gltf(rigged_body(), arm_file)
    with qtbot.waitSignal(document.failed, timeout=PATIENCE):
        document.tasks.open_poses(poses, arm_file)
    assert document.model is editor_model
    for dialog in window.findChildren(FailureDialog):
        dialog.close()


def test_a_joint_is_what_the_menu_of_its_slider_says(
    qtbot: QtBot, window: MainWindow, arm_file: Path
) -> None:
    model = dropped(qtbot, window, arm_file)
    document = window.document
    code = int(np.flatnonzero(model.space.joint_of_code[6:] == 1)[0]) + 6
    domain = model.code_effects[code].domain
    menu = window._body_menus.part_menu(domain, code)
    (roles,) = (a.menu() for a in menu.actions() if a.text().startswith("Joint &role"))
    texts = {action.text(): action for action in roles.actions()}
    assert [text for text, action in texts.items() if action.isChecked()] == ["Left elbow"]
    assert not texts["From the rig"].isEnabled()
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        texts["Right knee"].trigger()
    changed = document.model
    assert isinstance(changed, RigBody)
    assert (changed.space.roles[1].name, changed.space.sides[1].value) == ("SHIN", "right")
    assert open_body(arm_file).fingerprint == changed.fingerprint
    menu.close()


def test_a_greyed_action_says_why(qtbot: QtBot, tmp_path: Path, arm_file: Path) -> None:
    """For a body whose only arm has no other side, and without a body."""
    window = MainWindow(PoseDocument(library_folder=tmp_path), settings_in(tmp_path))
    window.show()
    actions = window.actions_by_key
    for key in ("mirror", "export", "contacts", "learn_character", "reset_camera"):
        assert not actions[key].isEnabled()
        assert "Open a character or a model first" in actions[key].toolTip()
    dropped(qtbot, window, arm_file)
    assert actions["mirror"].statusTip() == (
        "Cannot be mirrored: its joint names do not say left and right, and its joints are not "
        "symmetric"
    )
    assert actions["undo"].statusTip() == "There is nothing to undo"
    for key, action in actions.items():
        assert action.isEnabled() == (action.statusTip() == window.commands.by_key[key].tip), key
    window.document.motion.set_code(7, 0.1)
    assert actions["undo"].isEnabled()
    assert actions["undo"].statusTip() == window.commands.by_key["undo"].tip


@pytest.mark.slow
def test_starter_poses_are_loaded_and_those_of_hands_change_hands_only(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    panel, document = window.library, window.document
    assert panel.starter.isHidden()
    person = character_from(WITH_FINGERS, turn=UPRIGHT, up=(0.0, 0.0, 1.0))
    model = dropped(qtbot, window, write_gltf(person, tmp_path / "person.glb"))
    assert not panel.starter.isHidden()
    panel.starter.setChecked(True)
    names = [panel.list.item(row).text() for row in range(panel.list.count())]
    assert names[0] == "Stand"
    assert len(names) == 12
    panel.list.scrollToItem(panel.list.item(11))
    qtbot.waitUntil(lambda: not panel.list.item(11).icon().isNull(), timeout=PATIENCE)
    take_picture(window, "starter poses")
    panel.list.setCurrentRow(names.index("Sit"))
    panel.load_chosen()
    sitting = document.history.latent.copy()
    assert document.history.pose.name == "Sit"
    panel.list.setCurrentRow(names.index("Fists"))
    panel.load_chosen()
    changed = np.flatnonzero(document.history.latent != sitting)
    moves = model.starter_poses[-4].moves
    assert len(changed)
    assert moves[changed].all()
    assert document.history.pose.name == "Sit"
    document.history.undo()
    np.testing.assert_array_equal(document.history.latent, sitting)
    assert document.library.poses == ()
    assert document.library.add_poses(panel.chosen_poses) == 1
    assert [pose.name for pose in document.library.poses] == ["Fists"]
