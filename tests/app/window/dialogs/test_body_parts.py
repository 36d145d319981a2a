"""Body parts are renamed, recoloured and reordered in the window; menus on sliders and parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtGui import QColor, QContextMenuEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QColorDialog, QLabel, QLineEdit, QMenu, QWidget
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.questions import FailureDialog
from app.window.main_window import MainWindow
from lcollision_core.bodies import LearnedBody, change_model, user_models_folder
from lcollision_core.tasks.changing import PartEdits
from lcollision_core.tasks.words import heading
from tests.app.windows import PATIENCE, open_window, rest, settings_in

pytestmark = pytest.mark.one_window

LEFT = Qt.MouseButton.LeftButton


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path


@pytest.fixture
def own(qtbot: QtBot, editor_model: LearnedBody, home: Path) -> MainWindow:
    """Return a window of a model stored in a file of the user's."""
    editor_model.save(home / "dancer.safetensors")
    document = PoseDocument()
    document.tasks.open_model(home / "dancer.safetensors")
    qtbot.waitUntil(lambda: document.has_model and not document.tasks.busy, timeout=PATIENCE)
    return open_window(qtbot, document, settings_in(home))


def dialog_of(window: MainWindow) -> BodyPartsDialog:
    window.actions_by_key["parts"].trigger()
    dialogs = [d for d in window.findChildren(BodyPartsDialog) if d.isVisible()]
    return dialogs[-1]


def headings(window: MainWindow) -> list[str]:
    """Return the parts' names in the left panel, from top to bottom."""
    headers = [group.header for group in window.sliders.groups[1:]]
    headers.sort(key=lambda header: header.mapTo(window, QPoint(0, 0)).y())
    return [header.button.accessibleName() for header in headers]


def rows(window: MainWindow) -> list[str]:
    held = list(window.collision.prediction.rows)
    held.sort(key=lambda row: row.mapTo(window, QPoint(0, 0)).y())
    return [row.lock.accessibleName().removeprefix("Lock ") for row in held]


def type_name(dialog: BodyPartsDialog, name: str) -> None:
    QTest.mouseClick(dialog.rename, LEFT)
    editor = next(e for e in dialog.list.findChildren(QLineEdit) if e.isVisible())
    editor.selectAll()
    QTest.keyClicks(editor, name)
    QTest.keyClick(editor, Qt.Key.Key_Return)
    # Qt commits it once the key has been handled.
    QApplication.processEvents()
    assert dialog.list.currentItem().text() == name
    assert dialog.isVisible()


def test_parts_of_an_own_model_are_edited_in_its_file_and_the_pose_stays(
    qtbot: QtBot, own: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, file = own.document, Path(own.document.history.model_file)
    document.motion.set_code(0, 0.3)
    document.motion.set_locked(1, True)
    own.sliders.groups[2].set_open(True)
    rest(qtbot, own)
    pose, steps, view = (
        document.history.latent,
        document.history.undo_stack.count(),
        own.viewport.scene.view,
    )
    frame = document.motion.frame
    dialog = dialog_of(own)
    type_name(dialog, "knee & <b>shin</b>")
    monkeypatch.setattr(QColorDialog, "getColor", lambda *_: QColor("#00ff7f"))
    QTest.mouseClick(dialog.colour, LEFT)
    QTest.mouseClick(dialog.down, LEFT)
    assert not dialog.down.isEnabled()
    with qtbot.waitSignal(document.model_changed, timeout=PATIENCE):
        QTest.mouseClick(dialog.save, LEFT)
    rest(qtbot, own)
    written = LearnedBody.load(file)
    second = written.domain_names[1]
    assert written.domain_names[0] == "knee & <b>shin</b>"
    assert written.card.domain_colours[0] == "#00ff7f"
    assert written.domain_order == (1, 0)
    assert headings(own) == [second[:1].upper() + second[1:], "Knee & <b>shin</b>"]
    assert rows(own) == headings(own)
    # The pose, its history, locks, camera and open groups are kept.
    assert document.history.latent is pose
    assert document.history.undo_stack.count() == steps
    assert document.motion.locked_domains == {1}
    assert own.collision.prediction.rows[1].lock.isChecked()
    assert own.sliders.groups[2].header.button.isChecked()
    assert own.viewport.scene.view is not None
    assert view is not None
    assert own.viewport.scene.view.position == pytest.approx(view.position)
    assert document.motion.frame is not None
    assert frame is not None
    assert np.array_equal(document.motion.frame.vertices, frame.vertices)
    assert document.motion.frame.prediction is not None
    assert document.history.model_file == str(file)
    # Its sliders and everything else keep working.
    document.history.undo()
    assert document.history.latent[0] != 0.3
    assert "dancer" in own.statusBar().currentMessage()


def test_a_bundled_model_is_edited_in_a_copy_that_opens_in_its_place(
    qtbot: QtBot, window: MainWindow, home: Path
) -> None:
    document = window.document
    document.motion.begin_gesture("Move")
    document.motion.set_code(0, 0.3)
    rest(qtbot, window)
    pose = document.history.latent
    dialog = dialog_of(window)
    assert "can't be changed" in " ".join(label.text() for label in dialog.findChildren(QLabel))
    assert dialog.copy_name.text() == f"{document.model.name}-2"
    type_name(dialog, "knee")
    for name, word in (("Body", "already"), ("", "needs a name"), ("a/b", "slash"), ("a.b", "dot")):
        dialog.copy_name.setText(name)
        QTest.mouseClick(dialog.save, LEFT)
        assert dialog.isVisible()
        assert word in dialog.refusal.text()
    dialog.copy_name.setText("my tube")
    with qtbot.waitSignal(document.model_changed, timeout=PATIENCE):
        QTest.mouseClick(dialog.save, LEFT)
    rest(qtbot, window)
    file = user_models_folder() / "my tube.safetensors"
    assert str(file).startswith(str(home))
    assert document.model.name == "my tube"
    assert document.history.model_file == str(file)
    assert LearnedBody.load(file).domain_names[0] == document.model.domain_names[0] == "knee"
    assert document.history.latent is pose
    assert document.history.undo_stack.undoText() == "Move"
    assert "my tube" in window.windowTitle()
    # From here on, the model is the user's own.
    dialog = dialog_of(window)
    assert not dialog.copy_name.isVisible()
    dialog.reject()


def test_names_that_cannot_be_are_said_and_stay_to_be_put_right(own: MainWindow) -> None:
    before = Path(own.document.history.model_file).read_bytes()
    dialog = dialog_of(own)
    other = own.document.model.domain_names[1]
    for name, word in (
        (other, f"Two body parts are called “{other}”"),
        (" ", "1 to 60 characters"),
    ):
        type_name(dialog, name)
        QTest.mouseClick(dialog.save, LEFT)
        assert dialog.isVisible()
        assert word in dialog.refusal.text()
        assert dialog.refusal.isVisible()
    dialog.reject()
    assert Path(own.document.history.model_file).read_bytes() == before
    # Without changes, nothing is written.
    dialog = dialog_of(own)
    QTest.mouseClick(dialog.save, LEFT)
    assert not dialog.isVisible()
    assert not own.document.tasks.busy


@pytest.mark.slow
def test_another_model_that_comes_in_takes_the_dialog_of_this_one_away(own: MainWindow) -> None:
    dialog = dialog_of(own)
    type_name(dialog, "knee")
    own.document.set_model(own.document.model)
    assert not dialog.isVisible()


def test_what_another_command_wrote_meanwhile_stays(qtbot: QtBot, own: MainWindow) -> None:
    document, file = own.document, Path(own.document.history.model_file)
    change_model(file, lambda model: model.edit_domains({1: "told elsewhere"}))
    with qtbot.waitSignal(document.model_changed, timeout=PATIENCE):
        document.tasks.edit_parts(PartEdits({0: "knee"}, {}))
    assert LearnedBody.load(file).domain_names == ("knee", "told elsewhere")
    assert document.model.domain_names == ("knee", "told elsewhere")


@pytest.mark.slow
def test_a_file_that_holds_another_model_by_now_is_left_alone(
    qtbot: QtBot, own: MainWindow
) -> None:
    document, file = own.document, Path(own.document.history.model_file)
    LearnedBody.load("body").save(file)
    written = file.read_bytes()
    with qtbot.waitSignal(document.failed, timeout=PATIENCE):
        document.tasks.edit_parts(PartEdits({0: "knee"}, {}))
    assert file.read_bytes() == written
    (told,) = [held for held in own.findChildren(FailureDialog) if held.isVisible()]
    assert "has been replaced by another model" in told.what.text()
    told.reject()


# Menus.


def menu_at(widget: QWidget) -> QMenu:
    place = widget.rect().center()
    event = QContextMenuEvent(QContextMenuEvent.Reason.Mouse, place, widget.mapToGlobal(place))
    QApplication.sendEvent(widget, event)
    menu = QApplication.activePopupWidget()
    assert isinstance(menu, QMenu)
    return menu


def choose(menu: QMenu, text: str) -> None:
    (action,) = [a for a in menu.actions() if a.text().replace("&", "").removesuffix("…") == text]
    assert action.isEnabled()
    action.trigger()
    menu.close()


def test_the_menu_of_a_slider(window: MainWindow) -> None:
    document = window.document
    code = document.model.latent_space.groups[2].codes.start + 1
    row = window.sliders.row_of(code)
    part = heading(document.model.domain_names[1])
    document.motion.set_code(code, 0.4)
    menu = menu_at(row.slider)
    assert {window.actions_by_key[key] for key in ("mirror", "parts")} <= set(menu.actions())
    choose(menu, "Type a value")
    assert QApplication.focusWidget() is row.field
    choose(menu_at(row.slider), "Reset")
    assert document.history.latent[code] == 0.0
    choose(menu_at(row), f"Lock {part}")
    assert document.motion.locked_domains == {1}
    menu = menu_at(row)
    (lock,) = [a for a in menu.actions() if a.text().startswith("&Lock")]
    assert lock.isChecked()
    menu.close()


@pytest.mark.variants
@pytest.mark.parametrize("where", ["header", "row"])
def test_the_menu_of_a_body_part(qtbot: QtBot, window: MainWindow, where: str) -> None:
    document, codes = window.document, window.document.model.latent_space.groups[2].codes
    header = window.sliders.groups[2].header
    part = header if where == "header" else window.collision.prediction.rows[1]
    name = heading(document.model.domain_names[1])
    latent = np.full(document.model.latent_size, 0.2)
    document.motion.blend_towards(latent, 1.0)
    choose(menu_at(part), f"Reset {name}")
    assert not document.history.latent[codes].any()
    assert document.history.latent[1] == 0.0
    assert np.count_nonzero(document.history.latent) == len(latent) - 1 - (codes.stop - codes.start)
    window.docks["sliders"].hide()
    choose(menu_at(window.collision.prediction.rows[1]), "Show in sliders")
    assert header.isVisible()
    assert header.button.isChecked()
    qtbot.waitUntil(lambda: QApplication.focusWidget() is header.button)
    choose(menu_at(part), f"Rename {name}")
    (dialog,) = [d for d in window.findChildren(BodyPartsDialog) if d.isVisible()]
    assert dialog.list.currentItem().text() == document.model.domain_names[1]
    editor = dialog.list.findChild(QLineEdit)
    qtbot.waitUntil(editor.hasFocus)
    assert editor.text() == document.model.domain_names[1]
    dialog.reject()


def test_a_slider_says_what_it_does_and_its_number_in_the_tool_tip(window: MainWindow) -> None:
    model = window.document.model
    for code, name in enumerate(model.code_names):
        row = window.sliders.row_of(code)
        shown = row.slider.accessibleName()
        group = next(g for g in model.latent_space.groups if code < g.codes.stop)
        whole = name if group.colour is None else f"{group.name}, {name}"
        assert shown == whole[:1].upper() + whole[1:]
        assert "motion" not in shown.casefold()
        assert f"(motion {code - group.codes.start + 1})" in row.slider.toolTip()
    # It can be found by either name.
    group = model.latent_space.groups[1]
    for words in (f"{group.name} motion 2", f"{group.name} {model.code_names[3]}"):
        window.sliders.filter.setText(words)
        found = [r.code for g in window.sliders.groups for r in g.rows if r.isVisible()]
        assert 3 in found
