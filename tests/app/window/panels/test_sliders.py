"""The panels around the viewport: which pose an action changes, and slider names."""

from __future__ import annotations

from pathlib import Path
from threading import Event

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtGui import QAccessible, QIcon
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QInputDialog, QLabel, QWidget
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.history import Source
from app.editing.live_pose import code_name
from app.view.offscreen import VideoStyle
from app.view.theme import TIGHT
from app.window.main_window import MainWindow
from app.window.panels.collision import DomainRow
from app.window.panels.library import THUMBNAIL
from app.window.panels.sliders import CodeRow
from lcollision_core.bodies import LearnedBody, NamedPose, RigBody, write_poses
from lcollision_core.files import read_character
from lcollision_core.tasks.changing import PartEdits
from lcollision_core.tasks.words import heading
from tests.app.views import double_click
from tests.app.windows import (
    PATIENCE,
    answer,
    decoded,
    open_window,
    rest,
    settings_in,
    settle_layout,
)
from tests.core.bodies.test_shapes import face
from tests.rigged_shapes import rigged_body

pytestmark = pytest.mark.one_window

CONTROL, LEFT = Qt.KeyboardModifier.ControlModifier, Qt.MouseButton.LeftButton


def own_names(window: MainWindow) -> list[str]:
    return [pose.name for pose in window.document.library.poses]


def names_shown(window: MainWindow) -> list[str]:
    held = window.library.list
    rows = [row for row in range(held.count()) if not held.isRowHidden(row)]
    return [held.item(row).text() for row in rows]


def may_change_chosen(window: MainWindow) -> bool:
    rename, remove = (window.actions_by_key[key] for key in ("rename", "remove"))
    assert rename.isEnabled() == remove.isEnabled()
    return remove.isEnabled()


def choose(window: MainWindow, name: str) -> None:
    held = window.library.list
    (item,) = held.findItems(name, Qt.MatchFlag.MatchExactly)
    held.setCurrentItem(item)
    assert window.library.chosen is not None
    assert window.library.chosen.name == name


def test_remove_and_rename_spare_a_pose_that_a_training_pose_is_called_as(
    window: MainWindow,
) -> None:
    document, library = window.document, window.library
    shared = document.model.card.pose_names[2]
    document.library.add_pose(shared)
    QTest.mouseClick(library.own, LEFT)
    choose(window, shared)
    assert may_change_chosen(window)
    QTest.mouseClick(library.training, LEFT)
    assert library.chosen is None
    assert not may_change_chosen(window)
    choose(window, shared)
    assert not may_change_chosen(window)
    QTest.keyClick(window, Qt.Key.Key_Delete, CONTROL)
    QTest.keyClick(window, Qt.Key.Key_F2)
    assert own_names(window) == [shared]
    QTest.mouseClick(library.own, LEFT)
    choose(window, shared)
    QTest.keyClick(window, Qt.Key.Key_Delete, CONTROL)
    assert own_names(window) == []
    assert not may_change_chosen(window)


def test_a_kept_pose_is_chosen_and_stays_so_when_others_go(window: MainWindow) -> None:
    document, library = window.document, window.library

    def name_it(name: str) -> None:
        asked = answer(lambda dialog: _enter(dialog, name))
        window.actions_by_key["keep"].trigger()
        assert not asked.isActive()

    choose(window, document.model.card.pose_names[0])
    for name in ("first", "second"):
        name_it(name)
        assert library.chosen_own is not None
        assert library.chosen_own.name == name
        assert may_change_chosen(window)
    document.library.remove_poses(["first"])
    assert library.chosen_own.name == "second"
    asked = answer(lambda dialog: _enter(dialog, "third"))
    window.actions_by_key["rename"].trigger()
    assert not asked.isActive()
    assert own_names(window) == ["third"]
    assert library.chosen_own.name == "third"


def _enter(dialog: object, text: str) -> None:
    assert isinstance(dialog, QInputDialog)
    dialog.setTextValue(text)
    dialog.accept()


def is_drawn(icon: QIcon) -> bool:
    picture = icon.pixmap(THUMBNAIL).toImage()
    return not picture.isNull() and picture.pixelColor(picture.rect().center()).alpha() > 0


def test_the_poses_of_a_file_that_is_opened_are_shown_beside_the_library(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, library = window.document, window.library
    held = [NamedPose(name, document.model.known_poses[1]) for name in ("kick", "jump")]
    write_poses(tmp_path / "poses.json", document.model, held)
    document.library.add_pose("mine")
    assert not library.of_file.isVisible()
    with qtbot.waitSignal(document.history.pose_loaded, timeout=PATIENCE):
        window.files.open_path(tmp_path / "poses.json")
    assert library.source is Source.FILE
    assert library.of_file.isVisible()
    assert names_shown(window) == ["kick", "jump"]
    assert own_names(window) == ["mine"]
    assert not may_change_chosen(window)
    QTest.mouseClick(library.add_button, LEFT)
    assert own_names(window) == ["mine", "kick", "jump"]
    choose(window, "jump")
    QTest.mouseClick(library.add_button, LEFT)
    assert own_names(window) == ["mine", "kick", "jump"]
    assert "already" in window.statusBar().currentMessage()
    # Another model starts without a file, and with its own library.
    document.set_model(document.model)
    document.tasks.wait_for_saves()
    assert own_names(window) == ["mine", "kick", "jump"]
    assert library.source is Source.TRAINING
    assert not library.of_file.isVisible()


@pytest.mark.slow
@pytest.mark.own_window
def test_pictures_that_were_due_while_the_library_was_hidden_are_drawn_when_it_is_seen(
    qtbot: QtBot, window: MainWindow
) -> None:
    library = window.library
    items = [library.list.item(row) for row in range(library.list.count())]
    window.docks["library"].hide()
    library.allow_pictures()
    qtbot.waitUntil(lambda: not library._thumbnail_timer.isActive(), timeout=PATIENCE)
    assert not any(is_drawn(item.icon()) for item in items)
    window.docks["library"].show()
    qtbot.waitUntil(lambda: is_drawn(items[0].icon()), timeout=PATIENCE)


@pytest.mark.slow
@pytest.mark.own_window
def test_pictures_of_poses_that_are_not_searched_for_are_not_seen(
    qtbot: QtBot, window: MainWindow
) -> None:
    library = window.library
    library.allow_pictures()
    name = library.list.item(library.list.count() - 1).text()
    library.search.setText(name)
    assert names_shown(window) == [name]
    items = [library.list.item(row) for row in range(library.list.count())]
    qtbot.waitUntil(lambda: is_drawn(items[-1].icon()), timeout=PATIENCE)
    qtbot.waitUntil(lambda: not library._thumbnail_timer.isActive(), timeout=PATIENCE)
    window.viewport.setFocus()
    QApplication.processEvents()
    seen = library.list.viewport().grab().toImage()
    library.list.doItemsLayout()
    assert library.list.viewport().grab().toImage() == seen
    library.search.clear()
    qtbot.waitUntil(lambda: is_drawn(items[0].icon()), timeout=PATIENCE)


@pytest.mark.own_window
def test_a_pose_under_two_names_is_drawn_under_both(qtbot: QtBot, window: MainWindow) -> None:
    library, document = window.library, window.document
    for name in ("one", "the same"):
        document.library.add_pose(name)
    library.choose_own("one")
    library.allow_pictures()
    library.redraw()
    icons = [library.list.item(row).icon for row in range(2)]
    qtbot.waitUntil(lambda: all(is_drawn(icon()) for icon in icons), timeout=PATIENCE)


def test_escape_stops_a_turntable_that_the_status_bar_tells_of(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    cancel = window.actions_by_key["cancel"]
    assert not cancel.isEnabled()
    window.viewport.pictures.film(tmp_path / "turn.gif", VideoStyle(width=60, height=60))
    assert cancel.isEnabled()
    assert "Making turn.gif…" in told_as_busy(window)
    with qtbot.waitSignal(window.document.message, timeout=PATIENCE) as told:
        QTest.keyClick(window, Qt.Key.Key_Escape)
    assert told.args == ["The video was cancelled"]
    assert not cancel.isEnabled()
    assert told_as_busy(window) == []
    assert not list(tmp_path.glob("*turn*"))


def told_as_busy(window: MainWindow) -> list[str]:
    labels = window.statusBar().findChildren(QLabel)
    return [label.text() for label in labels if label.isVisible() and label.text().endswith("…")]


def shown_codes(window: MainWindow) -> list[int]:
    rows = [row for group in window.sliders.groups for row in group.rows]
    return [row.code for row in rows if row.isVisible()]


def test_a_slider_is_found_by_what_its_row_and_undo_call_it(window: MainWindow) -> None:
    document, panel = window.document, window.sliders
    space = document.model.latent_space
    group = space.groups[2]
    code = group.codes.start + 2
    name = code_name(document.model, code)
    own = document.model.code_names[code]
    assert name == f"{group.name}, {own}"
    row = panel.row_of(code)
    assert heading(own) in [label.text() for label in row.findChildren(QLabel)]
    QTest.keyClick(row.slider, Qt.Key.Key_Right)
    assert document.history.undo_stack.undoText() == f"Move {name}"
    for held in panel.groups:
        held.set_open(True)
    whole, parts = space.groups[0].codes, range(space.groups[1].codes.start, space.size)
    for words, codes in (
        (f"{group.name} motion 3", [code]),
        (f"{own} motion 3", [code]),
        ("motion", list(parts)),
        ("Whole body", list(range(whole.start, whole.stop))),
        ("knuckle", []),
        ("", list(range(space.size))),
    ):
        panel.filter.setText(words)
        assert shown_codes(window) == codes
    assert panel.row_of(0).slider.accessibleName() == heading(document.model.code_names[0])


def test_what_can_be_typed_is_near_the_sliders_range(qtbot: QtBot, window: MainWindow) -> None:
    document, row = window.document, window.sliders.row_of(1)
    space = document.model.latent_space
    low, high = float(space.low[1]), float(space.high[1])
    beyond = 1.5 * (high - low)

    def type_in(text: str) -> float:
        row.field.setFocus()
        row.field.selectAll()
        QTest.keyClicks(row.field, text)
        QTest.keyClick(row.field, Qt.Key.Key_Return)
        return float(document.history.latent[1])

    for wanted in (high + 0.9 * beyond, low - 0.9 * beyond):
        assert type_in(f"{wanted:.3f}") == pytest.approx(wanted, abs=1e-3)
    before = float(document.history.latent[1])
    for far in ("9999", "-9999"):
        assert type_in(far) == before
    for limit in (low - beyond, high + beyond):
        assert f"{limit:.3f}" in row.field.toolTip()
    # Values from a file may exceed the range: they are shown and kept unchanged.
    pose = document.history.latent.copy()
    pose[1] = high + 10.0 * beyond + 1e-5
    document.motion.blend_towards(pose, 1.0)
    rest(qtbot, window)
    assert row.field.value() == pytest.approx(pose[1], abs=1e-3)
    row.field.setFocus()
    QTest.keyClick(row.field, Qt.Key.Key_Return)
    window.viewport.setFocus()
    assert document.history.latent.tobytes() == pose.tobytes()
    assert low - beyond <= type_in("0.125") <= high + beyond
    assert type_in("9999") == 0.125


def name_label(row: QWidget) -> QLabel:
    return next(label for label in row.findChildren(QLabel) if label.text())


def test_a_narrow_panel_leaves_names_what_its_sliders_spare(
    qtbot: QtBot, window: MainWindow
) -> None:
    row = window.sliders.row_of(0)
    row.show_name("mouthLowerDownRight" * 3, 500)
    window.resizeDocks([window.docks["sliders"]], [250], Qt.Orientation.Horizontal)
    settle_layout(qtbot, window)
    assert row.slider.width() == 60
    assert name_label(row).width() == row.width() - 60 - row.field.width() - 4 * TIGHT


@pytest.mark.slow
def test_a_name_is_whole_where_there_is_room_and_its_tool_tip_is_where_not(
    qtbot: QtBot, editor_model: LearnedBody, tmp_path: Path
) -> None:
    long, endless = "right arm", "arm and " * 7 + "arm"
    document = PoseDocument(editor_model.edit_domains({1: long}))
    window = open_window(qtbot, document, settings_in(tmp_path), (1580, 900))

    def labels() -> list[QLabel]:
        window.sliders.row_of(0)
        rows = [*window.sliders.findChildren(CodeRow), *window.collision.findChildren(DomainRow)]
        return [name_label(row) for row in rows if row.isVisible()]

    assert heading(long) in [label.text() for label in labels()]
    for label in labels():
        assert label.width() >= label.fontMetrics().horizontalAdvance(label.text())
        assert label.toolTip() == ""
    window.document.set_model(editor_model.edit_domains({0: long, 1: endless}))
    rest(qtbot, window)
    told = {label.text(): label.toolTip() for label in labels()}
    assert told[heading(endless)] == heading(endless)
    assert all(row.slider.width() >= 60 for row in window.sliders.groups[0].rows)


def folds(window: MainWindow) -> list[bool]:
    return [group.header.button.isChecked() for group in window.sliders.groups]


def says(widget: QWidget, text: str) -> bool:
    return text in [label.text() for label in widget.findChildren(QLabel) if label.isVisible()]


@pytest.mark.own_window
def test_a_cleared_filter_leaves_the_groups_folded_as_they_were(window: MainWindow) -> None:
    panel, find = window.sliders, window.actions_by_key["filter"]
    QTest.mouseClick(panel.groups[0].header, LEFT)
    QTest.mouseClick(panel.groups[2].header, LEFT)
    before = folds(window)
    assert before == [False, False, True]
    find.trigger()
    for text in ("motion", "left thigh", "knuckle"):
        panel.filter.selectAll()
        QTest.keyClicks(panel.filter, text)
        assert says(panel, "No matching sliders") == (text == "knuckle")
    panel.filter.clear()
    assert folds(window) == before
    assert not says(panel, "No matching sliders")
    assert shown_codes(window) == [row.code for row in panel.groups[2].rows]
    # Again, from other open groups.
    QTest.mouseClick(panel.groups[2].header, LEFT)
    QTest.keyClicks(panel.filter, "motion")
    assert any(folds(window))
    panel.filter.clear()
    assert not any(folds(window))


def test_an_empty_library_says_what_would_be_there(window: MainWindow) -> None:
    library, hint = window.library, "Poses that you add to your library appear here"
    assert not says(library, hint)
    QTest.mouseClick(library.own, LEFT)
    assert says(library, hint)
    window.document.library.add_pose("mine")
    assert not says(library, hint)
    window.actions_by_key["undo"].trigger()
    assert says(library, hint)
    QTest.mouseClick(library.training, LEFT)
    assert not says(library, hint)


def test_a_blend_tells_its_share_and_leaves_locked_parts_alone(
    qtbot: QtBot, window: MainWindow
) -> None:
    document, library = window.document, window.library
    choose(window, document.model.card.pose_names[4])
    assert library.chosen is not None
    name, target = library.chosen.name, library.chosen.latent
    lock = window.collision.prediction.rows[1].lock
    assert "drags, Resolve" in lock.toolTip()
    QTest.mouseClick(lock, LEFT)
    assert "in drags too" in lock.toolTip()
    assert document.motion.locked_domains == {1}
    start = document.history.latent
    held = np.zeros(len(start), dtype=bool)
    held[1] = held[document.model.latent_space.groups[2].codes] = True
    assert (start != target)[held].any()
    slider = library.blend
    QTest.mousePress(slider, LEFT, pos=QPoint(8, slider.height() // 2))
    QTest.mouseMove(slider, QPoint(slider.width() // 2, slider.height() // 2))
    share = slider.value()
    assert 40 < share < 60
    assert says(library, f"{share} %")
    blended = np.where(held, start, start + share / 100 * (target - start))
    np.testing.assert_allclose(document.history.latent, blended, rtol=1e-12, atol=1e-12)
    assert document.history.latent[held].tobytes() == start[held].tobytes()
    QTest.mouseRelease(slider, LEFT, pos=QPoint(slider.width() // 2, slider.height() // 2))
    rest(qtbot, window)
    assert slider.value() == 0
    assert not says(library, f"{share} %")
    assert f"{share} % of the way to {name}" in window.statusBar().currentMessage()
    np.testing.assert_allclose(document.history.latent, blended, rtol=1e-12, atol=1e-12)
    QTest.keyClick(slider, Qt.Key.Key_End)
    assert np.array_equal(document.history.latent, np.where(held, start, target))


@pytest.mark.variants
@pytest.mark.parametrize("solid", [False, True])
def test_a_double_click_far_from_the_handle_resets_in_one_step(
    qtbot: QtBot, window: MainWindow, solid: bool
) -> None:
    document, slider = window.document, window.sliders.row_of(1).slider
    document.motion.set_solid(solid)
    document.motion.set_code(1, 0.25)
    rest(qtbot, window)
    qtbot.waitUntil(lambda: not document.motion.moving, timeout=PATIENCE)
    document.history.undo_stack.clear()
    far = QPoint(slider.width() - 12, slider.height() // 2)
    QTest.mouseClick(slider, LEFT, pos=far)
    double_click(slider, far)
    rest(qtbot, window)
    qtbot.waitUntil(lambda: not document.motion.moving, timeout=PATIENCE)
    assert document.history.latent[1] == 0.0
    assert document.history.undo_stack.count() == 1
    document.history.undo()
    assert document.history.latent[1] == 0.25
    # A double-click that cancels nothing leaves the earlier steps.
    double_click(slider, far, Qt.MouseButton.RightButton)
    assert document.history.latent[1] == 0.25
    rest(qtbot, window)


@pytest.mark.variants
@pytest.mark.parametrize("of_library", [False, True], ids=["code", "blend"])
def test_escape_ends_the_drag_of_a_slider_and_no_work(
    qtbot: QtBot, window: MainWindow, of_library: bool
) -> None:
    document = window.document
    choose(window, document.model.card.pose_names[4])
    slider = window.library.blend if of_library else window.sliders.row_of(1).slider
    before, value = document.history.latent, slider.value()
    going = Event()
    document.tasks.write("Exporting a.obj", lambda *_: str(going.wait(PATIENCE / 1000)))
    middle = QPoint(0, slider.height() // 2)
    QTest.mousePress(slider, LEFT, pos=middle + QPoint(8, 0))
    QTest.mouseMove(slider, middle + QPoint(slider.width() - 12, 0))
    assert not np.array_equal(document.history.latent, before)
    QTest.keyClick(slider, Qt.Key.Key_Escape)
    assert np.array_equal(document.history.latent, before)
    assert slider.value() == value
    assert document.tasks.busy == "Exporting a.obj"
    QTest.mouseMove(slider, middle)
    QTest.mouseRelease(slider, LEFT, pos=middle)
    assert np.array_equal(document.history.latent, before)
    assert not document.history.undo_stack.canUndo()
    # Without a drag, the key belongs to the window.
    with qtbot.waitSignal(document.message) as told:
        QTest.keyClick(slider, Qt.Key.Key_Escape)
    assert told.args == ["Exporting a.obj was cancelled"]
    assert document.tasks.busy != "Exporting a.obj"
    going.set()
    rest(qtbot, window)


def test_a_slider_tells_assistive_technologies_what_is_shown(
    qtbot: QtBot, window: MainWindow
) -> None:
    row = window.sliders.row_of(1)
    window.document.motion.set_code(1, 0.25)
    assert row.slider.accessibleDescription() == row.field.text() == "0.250"
    window.document.set_model(RigBody.of(rigged_body()))
    document, panel = window.document, window.sliders
    rest(qtbot, window)
    model = document.model
    (group,) = (g for g in model.latent_space.groups if g.name == "Left forearm")
    code = group.codes.start + model.code_names[group.codes].index("bend")
    row = panel.row_of(code)
    document.motion.set_code(code, np.radians(45.3))
    rest(qtbot, window)
    told = QAccessible.queryAccessibleInterface(row.slider)
    assert told.role() is QAccessible.Role.Slider
    assert told.text(QAccessible.Text.Name) == "Left forearm, bend"
    assert told.text(QAccessible.Text.Description) == row.field.text() == "45.3°"
    value = told.valueInterface()
    assert value.currentValue() == 45
    low, high = (float(end[code]) for end in (model.latent_space.low, model.latent_space.high))
    assert value.minimumValue() == pytest.approx(np.degrees(low), abs=1.0)
    assert value.maximumValue() == pytest.approx(np.degrees(high), abs=1.0)
    # They may set it, too; values between two degrees are kept.
    value.setCurrentValue(30)
    rest(qtbot, window)
    assert document.history.latent[code] == pytest.approx(np.radians(30.0))
    QTest.keyClick(row.slider, Qt.Key.Key_Right)
    rest(qtbot, window)
    step = 0.01 * (high - low)
    assert document.history.latent[code] == pytest.approx(np.radians(30.0) + step)
    QTest.keyClick(row.slider, Qt.Key.Key_Home)
    rest(qtbot, window)
    assert document.history.latent[code] == pytest.approx(low)


def test_shapes_of_a_face_are_sliders_of_a_folded_group(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    model = RigBody.of(read_character(face(tmp_path / "face.glb")))
    window.document.set_model(model)
    document, panel = window.document, window.sliders
    rest(qtbot, window)
    group, first = panel.groups[-1], model.shape_codes.start
    assert group.header.button.accessibleName() == "Face and shapes"
    assert not group.rows
    panel.filter.setText("smile")
    assert shown_codes(window) == [first, first + 1]
    row = panel.row_of(first)
    assert [label.text() for label in row.findChildren(QLabel)] == ["smile_L"]
    QTest.keyClick(row.slider, Qt.Key.Key_Right)
    row.slider.move_to(150.0)
    rest(qtbot, window)
    assert document.history.undo_stack.undoText() == "Move smile_L"
    assert row.field.text() == "150.0 %"
    # The file's own weight is 0.25.
    panel.filter.setText("fat")
    of_file = panel.row_of(first + 2)
    assert of_file.field.text() == "25.0 %"
    of_file.field.setValue(75.0)
    rest(qtbot, window)
    posed = document.history.latent
    assert posed[first] == pytest.approx(1.5)
    assert posed[first + 2] == pytest.approx(0.5)
    np.testing.assert_allclose(decoded(document), model.decode(posed), atol=1e-6)
    document.motion.randomise(1.0, 3)
    rest(qtbot, window)
    drawn = document.history.latent
    assert (drawn[model.shape_codes] == posed[model.shape_codes]).all()
    assert (drawn != posed).any()
    document.motion.blend_towards(np.zeros(model.latent_size), 0.5)
    assert document.history.latent[first] == pytest.approx(0.75)
    document.motion.reset_shapes()
    assert not document.history.latent[model.shape_codes].any()
    document.history.undo()
    assert document.history.latent[first] == pytest.approx(0.75)


def test_escape_says_what_it_has_stopped(qtbot: QtBot, window: MainWindow) -> None:
    document = window.document
    going, told = Event(), []
    document.message.connect(told.append)
    document.tasks.write("Exporting a.obj", lambda *_: str(going.wait(PATIENCE / 1000)))
    document.tasks.edit_parts(PartEdits({0: "knee"}, {}))
    assert document.tasks.changing_model
    window.activateWindow()
    QTest.keyClick(window, Qt.Key.Key_Escape)
    assert told == ["Exporting a.obj was cancelled", "Saving the body parts was cancelled"]
    going.set()
    rest(qtbot, window)
    assert not document.tasks.changing_model
    assert document.model.domain_names[0] != "knee"
