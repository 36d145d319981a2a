"""The list of a scene's bodies: shown for several bodies, and its check boxes."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import pyvista
from PySide6.QtCore import Qt
from PySide6.QtGui import QAccessible, QImage
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractSpinBox,
    QDialog,
    QFileDialog,
    QInputDialog,
    QLabel,
    QMessageBox,
    QTabBar,
    QToolButton,
    QWidget,
)
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.window import file_actions
from app.window.dialogs.forms import SceneExportDialog
from app.window.dialogs.questions import FailureDialog, ask_to_join
from app.window.main_window import MainWindow
from app.window.widgets import NameLabel
from lcollision_core.bodies import (
    Body,
    LibraryChange,
    NamedPose,
    PoseLibrary,
    as_scene,
    open_body,
    user_poses_folder,
    write_poses,
)
from lcollision_core.bodies.scene_file import open_scene_file
from lcollision_core.tasks.scenes import kept_scene, scene_of_files, with_body
from tests.app.windows import PATIENCE, answer, drop, open_window, settings_in
from tests.core.shapes import box
from tests.rigged_shapes import rigged_body, write_gltf


@pytest.fixture(scope="module")
def hero(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a character."""
    return write_gltf(rigged_body(), tmp_path_factory.mktemp("body") / "hero.glb")


def opaque(picture: QImage) -> float:
    """Return the share of a picture's pixels that are drawn on."""
    places = itertools.product(range(picture.width()), range(picture.height()))
    alphas = [picture.pixelColor(x, y).alpha() for x, y in places]
    return sum(alpha > 127 for alpha in alphas) / len(alphas)


def offers_to_learn(window: MainWindow) -> list[bool]:
    buttons = window.findChildren(QToolButton)
    return [one.isVisible() for one in buttons if one.text() == "Learn it…"]


def test_a_part_s_name_outlives_that_of_its_body(qtbot: QtBot) -> None:
    label = NameLabel("mannequin: Left shin")
    qtbot.addWidget(label)
    metrics = label.fontMetrics()
    label.resize(metrics.horizontalAdvance(label.text()), 20)
    assert label.fitting() == label.text()
    label.resize(metrics.horizontalAdvance("manne…: Left shin"), 20)
    body, _, name = label.fitting().partition(": ")
    assert name == "Left shin"
    assert body.endswith("…")
    assert "mannequin".startswith(body[:-1])
    label.resize(metrics.horizontalAdvance("Left shin") + 1, 20)
    assert label.fitting() == "Left shin"


def test_a_scene_offers_the_library_poses_of_its_bodies(
    qtbot: QtBot, hero: Path, tmp_path: Path
) -> None:
    body = open_body(hero)
    codes = 0.1 * np.random.default_rng(2).normal(size=body.latent_size)
    library = PoseLibrary(body, user_poses_folder(), print)
    library.change([LibraryChange(None, NamedPose("Bow", codes), 0)])
    library.take(library.writing()())
    scene = open_scene_file(kept_scene(scene_of_files([hero, hero])))
    window = open_window(qtbot, PoseDocument(scene), settings_in(tmp_path))
    window.library.starter.setChecked(True)
    offered = {pose.name: pose for pose in window.library._poses}
    assert {"hero: Bow", "hero 2: Bow"} <= offered.keys()
    window.document.motion.load_pose(offered["hero 2: Bow"])
    latent = window.document.history.latent
    np.testing.assert_array_equal(scene.codes_of_member("hero 2", latent), codes)
    assert not scene.codes_of_member("hero", latent).any()


def test_bodies_of_a_scene_are_listed_locked_and_left_out(
    qtbot: QtBot, hero: Path, tmp_path: Path
) -> None:
    scene = open_scene_file(kept_scene(scene_of_files([hero, hero])))
    window = open_window(qtbot, PoseDocument(scene), settings_in(tmp_path))
    document, tree = window.document, window.bodies.tree
    assert window.docks["bodies"].isVisible()
    assert offers_to_learn(window) == [False]
    whole_body = window.sliders.groups[0]
    whole_body.set_open(True)
    captions = [one.text() for one in whole_body.findChildren(QLabel) if not one.isHidden()]
    assert [one for one in captions if one in ("hero", "hero 2")] == ["hero", "hero 2"]
    # The captions name the bodies; without them, while filtered, the rows do.
    names = [row.name for row in whole_body.rows]
    assert names[0] == "hero: Move left"
    assert captions.count("Move left") == 2
    window.sliders.filter.setText("move left")
    shown = [one.text() for one in whole_body.findChildren(QLabel) if one.isVisible()]
    assert shown == ["Whole body", "hero: Move left", "hero 2: Move left"]
    window.sliders.filter.clear()
    rows = [tree.topLevelItem(row) for row in range(tree.topLevelItemCount())]
    assert [row.text(0) for row in rows if row is not None] == ["hero", "hero 2"]
    second = tree.topLevelItem(1)
    assert second is not None
    # A long name is elided.
    assert second.toolTip(0) == "hero 2"
    # What is tinted of a body is hidden and shown with it.
    assert window.viewport.scene is not None
    selection, faces = window.viewport.scene.selection, np.arange(len(scene.faces))
    window.viewport.tint_faces(faces)
    second.setCheckState(1, Qt.CheckState.Unchecked)
    assert selection.n_faces == len(faces) // 2
    # So are the rings where its contact stops a drag.
    frame = document.motion.frame
    assert frame is not None
    touching = frame.vertices[[0, -1]].astype(np.float64)
    window.viewport.scene.show_contacts(replace(frame, contacts=touching, standing=touching))
    for rings in (window.viewport.scene.marks._contacts, window.viewport.scene.marks._standing):
        np.testing.assert_array_equal(rings, touching[:1])
    second.setCheckState(1, Qt.CheckState.Checked)
    assert selection.n_faces == len(faces)
    window.viewport.tint_faces(None)
    second.setCheckState(2, Qt.CheckState.Checked)
    # The row must outlive the click: it is used when the locks change.
    assert second.checkState(2) is Qt.CheckState.Checked
    assert document.motion.locked_domains == set(scene.domains_of_member("hero 2"))
    with qtbot.waitSignal(document.model_changed, timeout=PATIENCE):
        second = tree.topLevelItem(1)
        assert second is not None
        second.setCheckState(3, Qt.CheckState.Unchecked)
    assert document.model.rules.left_out == ("hero 2",)
    # The boxes are reached by keys alone.
    tree.setCurrentItem(tree.topLevelItem(0), 0)
    for key in (Qt.Key.Key_Right, Qt.Key.Key_Right, Qt.Key.Key_Space):
        QTest.keyClick(tree, key)
    assert set(scene.domains_of_member("hero")) <= document.motion.locked_domains
    QTest.keyClick(tree, Qt.Key.Key_Space)
    assert not set(scene.domains_of_member("hero")) & document.motion.locked_domains
    # Screen readers read a name of everything that takes the focus.
    for widget in window.findChildren(QWidget):
        takes_focus = widget.focusPolicy() & Qt.FocusPolicy.TabFocus and widget.isVisible()
        is_part = isinstance(widget.parentWidget(), QAbstractSpinBox)
        if takes_focus and not (is_part or isinstance(widget, QTabBar)):
            accessible = QAccessible.queryAccessibleInterface(widget)
            assert accessible.text(QAccessible.Text.Name), (widget, widget.toolTip())
    # Tab goes through the locks in their order, within the panel.
    card = window.collision.prediction
    expected = [card.rows[domain].lock for domain in document.model.domain_order]
    chain = [card.learn]
    while chain[-1] is not window.collision.resolve.button:
        chain.append(chain[-1].nextInFocusChain())
    assert [widget for widget in chain if widget in expected] == expected


def test_another_body_that_is_dropped_joins_where_that_is_wanted(
    qtbot: QtBot, hero: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file_actions, "ask_to_join", ask_to_join)
    document = PoseDocument(open_body(hero))
    window = open_window(qtbot, document, settings_in(tmp_path))
    villain, chair = tmp_path / "villain.glb", tmp_path / "chair.obj"
    shutil.copy(hero, villain)
    block = box([1.0, 0.0, 0.0], [1.5, 0.5, 0.5])
    pyvista.PolyData.from_regular_faces(block.vertices, block.faces).save(chair)
    asked = []

    def join(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        asked.append(dialog.text())
        words = "Add to the scene"
        next(one for one in dialog.buttons() if one.text().replace("&", "") == words).click()

    posed = lowered(document.model)
    document.motion.set_code(int(np.flatnonzero(posed)[0]), float(posed[posed != 0.0][0]))
    for path in (villain, chair):
        timer = answer(join)
        with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
            drop(window, path)
        timer.stop()
    assert asked[0] == "Add “villain.glb” to the scene of “hero”?"
    assert len(asked) == 2
    scene = as_scene(document.model)
    assert scene is not None
    assert [member.name for member in scene.members] == ["hero", "villain", "chair"]
    # The bodies keep their poses, which one undo puts back to rest; nothing is asked about them.
    latent = document.history.latent
    np.testing.assert_array_equal(scene.codes_of_member("hero", latent), posed)
    assert np.count_nonzero(latent) == 1
    document.history.undo()
    assert not document.history.latent.any()
    # A saved scene is found among the recent files.
    saved = tmp_path / "trio.json"
    monkeypatch.setattr(window.files, "ask_save", lambda *_: saved)
    window.bodies.save.click()
    assert window.settings["recent_files"][0] == str(saved.resolve())


@pytest.mark.slow
def test_clips_of_a_scene_play_together_with_offsets_and_each_body_gets_its_file(
    qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moving = write_gltf(rigged_body(n_frames=8), tmp_path / "moving.glb")
    scene = open_scene_file(kept_scene(scene_of_files([moving, moving])))
    window = open_window(qtbot, PoseDocument(scene), settings_in(tmp_path))
    document, panel = window.document, window.bodies
    qtbot.waitUntil(lambda: document.timeline.motion is not None, timeout=PATIENCE)
    assert len(document.timeline.motion) == 8
    panel.tree.setCurrentItem(panel.tree.topLevelItem(1))
    rate = document.timeline.motion.rate
    panel.start.setValue(0.1)
    panel.start.editingFinished.emit()
    late = round(0.1 * rate)
    qtbot.waitUntil(
        lambda: document.timeline.motion is not None and len(document.timeline.motion) == 8 + late,
        timeout=PATIENCE,
    )
    scene, motion = as_scene(document.model), document.timeline.motion
    assert scene is not None
    assert scene.plays["moving 2"][1] == 0.1
    first, second = (scene.codes_of_member(name, motion.codes) for name in scene.plays)
    np.testing.assert_allclose(first[:8], second[late:])
    # The choice is stored in the scene's file.
    assert open_scene_file(document.history.model_file).plays == scene.plays
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *_: str(out))
    monkeypatch.setattr(SceneExportDialog, "exec", lambda _: QDialog.DialogCode.Accepted)
    for export in (window.files.export, window.files.export_motion):
        with qtbot.waitSignal(
            document.message, timeout=PATIENCE, check_params_cb=lambda told: "each body" in told
        ):
            export()
        assert sorted(one.name for one in out.iterdir()) == ["moving 2.glb", "moving.glb"]
        for one in out.iterdir():
            assert open_body(one).n_vertices == open_body(moving).n_vertices
            one.unlink()
    window.settings["scene_form"], window.settings["export_axes"] = "obj", "blender"
    told = "each body"
    with qtbot.waitSignal(
        document.message, timeout=PATIENCE, check_params_cb=lambda text: told in text
    ):
        window.files.export()
    assert sorted(one.name for one in out.iterdir()) == ["moving 2.obj", "moving.obj"]


def lowered(body: Body) -> npt.NDArray[np.float64]:
    """Return the codes of the rest pose, 0.05 lower."""
    for code in range(body.latent_size):
        latent = np.zeros(body.latent_size)
        latent[code] = 0.05
        moved = body.space.decode(latent[None])[0] - body.space.decode(0.0 * latent[None])[0]
        down = moved @ body.up
        if np.ptp(moved, axis=0).max() < 1e-6 and abs(down[0]) > 0.04:
            return -np.sign(down[0]) * latent
    raise AssertionError("it has no place")


def test_the_ground_counts_where_it_is_wanted(qtbot: QtBot, hero: Path, tmp_path: Path) -> None:
    window = open_window(qtbot, PoseDocument(open_body(hero)), settings_in(tmp_path))
    document, toggle = window.document, window.actions_by_key["ground"]
    # One body has no list.
    assert window.docks["bodies"].isHidden()
    assert offers_to_learn(window) == [True]
    assert not window.docks["bodies"].toggleViewAction().isVisible()
    window.reset_layout()
    assert window.docks["bodies"].isHidden()
    sunk = lowered(document.model)
    document.motion.set_code(int(np.flatnonzero(sunk)[0]), float(sunk[sunk != 0.0][0]))
    assert document.model.exact_check().is_free(sunk)
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        toggle.trigger()
    scene = as_scene(document.model)
    assert scene is not None
    assert [member.is_ground for member in scene.members] == [False, True]
    assert toggle.isChecked()
    assert window.docks["bodies"].isHidden()
    # The view has its own floor, and looks at the body.
    hidden = window.bodies.hidden_faces
    assert hidden is not None
    np.testing.assert_array_equal(np.flatnonzero(hidden), np.r_[scene.faces_of["ground"]])
    assert len(scene.without_ground(scene.reference)) == scene.n_vertices - 4
    # Its thumbnails show the body, which fills a part of them, and no ground.
    picture = window.library._picture(document.history.pose).pixmap(64, 64).toImage()
    assert 0.03 < opaque(picture) < 0.6
    # The pose is the same, but now penetrates the ground.
    np.testing.assert_array_equal(document.history.latent, sunk)
    assert not scene.exact_check().is_free(sunk)
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        toggle.trigger()
    assert as_scene(document.model) is None
    np.testing.assert_array_equal(document.history.latent, sunk)


def test_a_further_body_stands_beside_what_is_open(hero: Path) -> None:
    body = open_body(hero)
    scene = open_scene_file(Path(with_body(body, str(hero), hero)))
    assert not scene.detector.detect(scene.reference).colliding
    more = open_scene_file(Path(with_body(scene, "", hero)))
    assert [member.name for member in more.members] == ["hero", "hero 2", "hero 3"]
    assert as_scene(body) is None


def test_a_body_is_removed_and_the_others_keep_their_pose(
    qtbot: QtBot, hero: Path, tmp_path: Path
) -> None:
    scene = open_scene_file(kept_scene(scene_of_files([hero, hero, hero])))
    window = open_window(qtbot, PoseDocument(scene), settings_in(tmp_path))
    document, tree = window.document, window.bodies.tree
    pose = 0.01 * np.arange(scene.latent_size) / scene.latent_size
    for code, value in enumerate(pose):
        document.motion.set_code(code, float(value))
    posed = {name: scene.codes_of_member(name, document.history.latent) for name in scene.faces_of}
    assert scene.file is not None
    places = [part.at for part in scene.file.bodies]
    for name, part in (("hero 2", 0), ("hero 3", 1)):
        domain = scene.domains_of_member(name)[part]
        document.motion.set_locked(domain, locked=True)

    def remove(row: int) -> None:
        tree.setCurrentItem(tree.topLevelItem(row))
        with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
            window.bodies.remove.click()

    remove(1)
    pair = as_scene(document.model)
    assert pair is not None
    assert [member.name for member in pair.members] == ["hero", "hero 3"]
    assert pair.file is not None
    assert [part.at for part in pair.file.bodies] == [places[0], places[2]]
    for name in ("hero", "hero 3"):
        codes = pair.codes_of_member(name, document.history.latent)
        np.testing.assert_array_equal(codes, posed[name])
    # A lock stays with its body.
    assert document.motion.locked_domains == {pair.domains_of_member("hero 3")[1]}
    window.bodies.remove.setFocus()
    remove(0)
    # The list is gone, and the keys go to the view, not into a search field.
    assert window.viewport.hasFocus()
    # What is left is no scene.
    assert as_scene(document.model) is None
    assert document.model.fingerprint == open_body(hero).fingerprint
    np.testing.assert_array_equal(document.history.latent, posed["hero 3"])
    assert document.motion.locked_domains == {1}
    assert window.docks["bodies"].isHidden()


@pytest.mark.parametrize("chosen", ["villain", "hero 2", None])
def test_a_pose_of_one_body_is_loaded_onto_it_in_a_scene(
    qtbot: QtBot,
    hero: Path,
    tmp_path: Path,
    chosen: str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    villain = write_gltf(rigged_body(girth=0.15), tmp_path / "villain.glb")
    scene = open_scene_file(kept_scene(scene_of_files([hero, hero, villain])))
    window = open_window(qtbot, PoseDocument(scene), settings_in(tmp_path))
    document, history = window.document, window.document.history
    before = np.linspace(0.0, 0.02, scene.latent_size)
    for code, value in enumerate(before):
        document.motion.set_code(code, float(value))
    before = history.latent
    history.mark_saved()
    body = open_body(villain if chosen == "villain" else hero)
    pose = NamedPose("wave", np.full(body.latent_size, 0.03))
    write_poses(tmp_path / "wave.json", body, [pose])
    asked: list[object] = []

    def choose(*given: object, **_: object) -> tuple[str, bool]:
        asked.append(given[2:4])
        return chosen or "hero", chosen is not None

    monkeypatch.setattr(QInputDialog, "getItem", choose)
    with qtbot.waitSignal(document.tasks.of_member, timeout=PATIENCE):
        drop(window, tmp_path / "wave.json")
    if chosen is None:
        qtbot.waitUntil(lambda: bool(asked))
        assert history.latent is before
        return
    qtbot.waitUntil(lambda: history.latent is not before)
    question = ("Which body takes the pose “wave”?", ("hero", "hero 2"))
    assert asked == ([] if chosen == "villain" else [question])
    for member in scene.standing:
        codes, kept = (scene.codes_of_member(member.name, of) for of in (history.latent, before))
        np.testing.assert_array_equal(codes, pose.latent if member.name == chosen else kept)
    history.undo_stack.undo()
    np.testing.assert_array_equal(history.latent, before)


def test_a_scene_that_cannot_be_opened_leaves_no_pose_to_the_next_body(
    qtbot: QtBot, hero: Path, tmp_path: Path
) -> None:
    lost = Path(shutil.copy(hero, tmp_path / "lost.glb"))
    scene = open_scene_file(kept_scene(scene_of_files([hero, lost])))
    window = open_window(qtbot, PoseDocument(scene), settings_in(tmp_path))
    document = window.document
    for code in range(scene.latent_size):
        document.motion.set_code(code, 0.01)
    lost.unlink()
    with qtbot.waitSignal(document.failed, timeout=PATIENCE):
        window.files.remove_from_scene("hero")
    for dialog in window.findChildren(FailureDialog):
        dialog.reject()
    document.history.mark_saved()
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        window.files.open_path(hero)
    assert not document.history.latent.any()
