"""Contents and look of the menus, and the small dialogs that they open."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QAction, QImage
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QDialog, QMenu, QToolBar, QToolButton
from pytestqt.qtbot import QtBot

from app.editing.recovery import RecoverablePose, Session, SessionNote
from app.window.dialogs.questions import ask_about_recovery, ask_to_replace, ask_to_switch
from app.window.main_window import MainWindow
from lcollision_core.bodies import LearnedBody, user_models_folder
from lcollision_core.files import write_mesh
from tests.app.windows import PATIENCE, answer, rest, take_picture

pytestmark = pytest.mark.one_window

WIDEST_TITLE = "Recover a pose — LCollision"
TITLE_BUTTONS = 160
"""Width in pixels of the window manager's buttons beside a title."""


def listed(menu: QMenu) -> dict[str, QAction]:
    """Return the actions of an opened menu, by text."""
    menu.aboutToShow.emit()
    return {action.text(): action for action in menu.actions()}


def ticked(menu: QMenu) -> list[str]:
    return [text for text, action in listed(menu).items() if action.isChecked()]


@pytest.fixture
def own_model(
    editor_model: LearnedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> LearnedBody:
    """Return a model stored in the user's folder as "dancer & co"."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    file = user_models_folder() / "dancer & co.safetensors"
    file.parent.mkdir(parents=True)
    editor_model.save(file)
    return LearnedBody.load(file)


def test_the_models_that_there_are_open_from_a_menu(
    qtbot: QtBot, window: MainWindow, own_model: LearnedBody
) -> None:
    document, menu = window.document, window.files.models_menu
    assert menu.menuAction() in window.menus["&File"].actions()
    assert list(listed(menu)) == ["body", "body-jump", "body-swing", "dancer && co"]
    assert ticked(menu) == []
    before = document.model
    document.motion.set_code(0, 0.5)
    asked = answer(lambda dialog: dialog.reject())
    listed(menu)["dancer && co"].trigger()
    assert not asked.isActive()
    assert not document.tasks.busy
    assert document.model is before
    document.history.undo()
    with qtbot.waitSignal(document.model_changed, timeout=PATIENCE):
        listed(menu)["dancer && co"].trigger()
    assert document.model.fingerprint == own_model.fingerprint
    assert ticked(menu) == ["dancer && co"]
    rest(qtbot, window)


def test_only_files_that_opened_are_recent_and_one_that_is_gone_is_dropped(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, model, menu = window.document, window.document.model, window.files.recent_menu
    files = [tmp_path / name for name in ("poses.json", "mine.safetensors", "bent.obj")]
    broken = [tmp_path / f"broken{file.suffix}" for file in files]
    for file in broken:
        file.write_text("garbage")
        with qtbot.waitSignal(document.failed, timeout=PATIENCE):
            window.files.open_path(file)
    assert list(listed(menu)) == ["No files yet"]
    document.tasks.save(files[0])
    document.tasks.wait_for_saves()
    model.save(files[1])
    write_mesh(files[2], model.decode(document.history.latent), model.faces)
    signals = (document.history.pose_loaded, document.model_changed, document.tasks.imported)
    for file, opened in zip(files, signals, strict=True):
        with qtbot.waitSignal(opened, timeout=PATIENCE):
            window.files.open_path(file)
    newest_first = [f"&{place}  {file.name}" for place, file in enumerate(files[::-1], start=1)]
    assert list(listed(menu)) == newest_first
    files[0].unlink()
    listed(menu)["&3  poses.json"].trigger()
    assert list(listed(menu)) == ["&1  bent.obj", "&2  mine.safetensors"]
    rest(qtbot, window)


def test_a_tick_shows_what_is_on(window: MainWindow) -> None:
    menu, ghost = window.menus["&View"], window.actions_by_key["ghost"]

    def entry() -> QImage:
        return menu.grab(menu.actionGeometry(ghost)).toImage()

    menu.popup(window.pos())
    assert ghost.isChecked()
    on = entry()
    ghost.trigger()
    assert entry() != on
    ghost.trigger()
    assert entry() == on
    menu.close()


def test_no_title_is_cut(window: MainWindow, tmp_path: Path) -> None:
    widths: list[int] = []

    def look(dialog: QDialog) -> None:
        widths.append(dialog.width())
        dialog.reject()

    lost = RecoverablePose(Session.new(tmp_path), SessionNote("tube", "kick", None), time.time())
    window.document.library.add_pose("kick")
    window.document.motion.set_code(0, 0.5)
    window.library.choose_own("kick")
    for act in (
        window.actions_by_key["keep"].trigger,
        window.actions_by_key["rename"].trigger,
        window.actions_by_key["new"].trigger,
        window.actions_by_key["tags"].trigger,
        lambda: ask_to_replace(window, "kick"),
        lambda: ask_to_switch(window, "kick.json", "snake"),
        lambda: ask_about_recovery(window, lost),
    ):
        asked = answer(look)
        act()
        assert not asked.isActive()
    least = window.fontMetrics().horizontalAdvance(WIDEST_TITLE) + TITLE_BUTTONS
    assert len(widths) == 7
    assert min(widths) >= least


def test_the_focus_is_seen_on_what_is_chosen(qtbot: QtBot, window: MainWindow) -> None:
    window.set_theme("dark")
    bar, poses = window.findChild(QToolBar), window.library.list
    segments = bar.findChildren(QToolButton, "segment")
    (chosen,) = (button for button in segments if button.isChecked())
    window.viewport.setFocus()
    before = chosen.grab().toImage()
    chosen.setFocus(Qt.FocusReason.TabFocusReason)
    assert chosen.grab().toImage() != before
    take_picture(window, "focused segment")
    poses.setFocus()
    poses.setCurrentRow(1)
    before = poses.viewport().grab().toImage()
    # Move on without choosing.
    QTest.keyClick(poses, Qt.Key.Key_Right, Qt.KeyboardModifier.ControlModifier)
    assert poses.currentRow() == 2
    assert [index.row() for index in poses.selectedIndexes()] == [1]
    assert poses.viewport().grab().toImage() != before
    take_picture(window, "focused pose")
    assert window.viewport.canvas.accessibleName()
    rest(qtbot, window)


def test_every_action_is_up_to_date_after_each_step(qtbot: QtBot, window: MainWindow) -> None:
    """Steps of undo refresh only some commands; the others must not depend on them."""
    document, commands = window.document, window.commands
    motion, library = document.motion, document.library

    def states() -> dict[str, tuple[object, ...]]:
        return {
            key: (action.text(), action.toolTip(), action.isEnabled(), action.isChecked())
            for key, action in commands.actions.items()
        }

    texts = {commands.actions["undo"].text()}
    for act in (
        lambda: motion.set_code(0, 0.3),
        lambda: document.pins.pin([motion.grip_at(0)]),
        lambda: library.add_pose("kept"),
        lambda: motion.set_code(1, 0.2),
        document.history.undo,
        document.history.redo,
        lambda: library.update_pose(),
        lambda: library.rename_pose("kept", "renamed"),
        lambda: motion.set_locked(0, True),
        lambda: motion.load_pose(library.poses[0]),
        lambda: motion.randomise(1.0, 3),
        lambda: library.remove_poses(["renamed"]),
        motion.reset_all,
        document.new_pose,
    ):
        act()
        rest(qtbot, window)
        before = states()
        commands.refresh()
        assert states() == before
        texts.add(commands.actions["undo"].text())
    assert len(texts) > 8
