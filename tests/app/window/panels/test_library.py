"""The library in the window, by mouse and keyboard: kept poses do not change."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt, QTimer
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QApplication,
    QDialog,
    QLineEdit,
    QMenu,
    QMessageBox,
    QWidget,
)
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.live_pose import training_pose
from app.window.dialogs.questions import FailureDialog, NameDialog
from app.window.main_window import MainWindow
from lcollision_core import bodies as model_package
from lcollision_core.bodies import (
    NamedPose,
    read_pose_file,
    read_poses,
    user_poses_folder,
    write_poses,
)
from lcollision_core.files import write_mesh
from tests.app.editor_model import another_model
from tests.app.views import double_click
from tests.app.windows import (
    PATIENCE,
    answer,
    drag,
    drop,
    is_open,
    name_field,
    open_window,
    rest,
    settings_in,
    shown,
    take_picture,
)

pytestmark = pytest.mark.one_window

LEFT, RIGHT = Qt.MouseButton.LeftButton, Qt.MouseButton.RightButton
CONTROL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier


def own(window: MainWindow) -> dict[str, bytes]:
    return {pose.name: pose.latent.tobytes() for pose in window.document.library.poses}


def names_shown(window: MainWindow) -> list[str]:
    held = window.library.list
    rows = [row for row in range(held.count()) if not held.isRowHidden(row)]
    return [held.item(row).text() for row in rows]


def place_of(window: MainWindow, name: str) -> QPoint:
    held = window.library.list
    (item,) = held.findItems(name, Qt.MatchFlag.MatchExactly)
    held.scrollToItem(item)
    return held.visualItemRect(item).center()


def click(
    window: MainWindow,
    name: str,
    button: Qt.MouseButton = LEFT,
    key: Qt.KeyboardModifier = Qt.KeyboardModifier.NoModifier,
) -> None:
    QTest.mouseClick(window.library.list.viewport(), button, key, place_of(window, name))


def apply(qtbot: QtBot, window: MainWindow, name: str) -> None:
    viewport, place = window.library.list.viewport(), place_of(window, name)
    QTest.mouseClick(viewport, LEFT, pos=place)
    double_click(viewport, place)
    rest(qtbot, window)


def typing(text: str) -> Callable[[QDialog], None]:
    """Return a function that types a name and Enter into a name dialog."""

    def act(dialog: QDialog) -> None:
        assert isinstance(dialog, NameDialog)
        type_name(dialog, text)

    return act


def type_name(dialog: QDialog, text: str) -> None:
    field = dialog.findChild(QLineEdit)
    assert isinstance(field, QLineEdit)
    field.selectAll()
    QTest.keyClick(field, Qt.Key.Key_Delete)
    QTest.keyClicks(field, text)
    QTest.keyClick(field, Qt.Key.Key_Return)


def choosing(path: Path) -> Callable[[QDialog], None]:
    """Return a function that types a file name and Enter into a file dialog."""

    def act(dialog: QDialog) -> None:
        field = name_field(dialog)
        field.setText(str(path))
        QTest.keyClick(field, Qt.Key.Key_Return)

    return act


def pressing(text: str) -> Callable[[QDialog], None]:
    """Return a function that presses a button of a question."""

    def act(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        (button,) = [held for held in dialog.buttons() if held.text().replace("&", "") == text]
        QTest.mouseClick(button, LEFT)

    return act


def press(window: QWidget, key: Qt.Key, modifiers: Qt.KeyboardModifier, *acts: object) -> None:
    """Press a shortcut, answer the dialogs one by one, and wait until all is saved."""
    waiting = [act for act in acts if callable(act)]
    timers: list[QTimer] = []

    def expect() -> None:
        if waiting:
            act = waiting.pop(0)

            def answered(dialog: QDialog) -> None:
                expect()
                act(dialog)

            timers.append(answer(answered))

    expect()
    # Without a window manager, no window is active after a dialog has closed.
    window.activateWindow()
    assert QTest.qWaitForWindowActive(window)
    QTest.keyClick(window, key, modifiers)
    assert not any(timer.isActive() for timer in timers)
    assert not waiting
    main = window.window()
    if isinstance(main, MainWindow) and is_open(main):
        main.document.tasks.wait_for_saves()


@pytest.mark.variants
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_story_save_changes_no_kept_pose(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, theme: str
) -> None:
    settings = settings_in(tmp_path)
    settings["theme"] = theme
    window = open_window(qtbot, document, settings)
    window.library.allow_pictures()
    apply(qtbot, window, "bend 0")
    kept, mesh = document.history.latent.tobytes(), shown(window)
    assert not window.isWindowModified()
    press(window, Qt.Key.Key_K, CONTROL, typing("A"))
    assert own(window) == {"A": kept}
    assert window.windowTitle().startswith("A[*]")
    take_picture(window, f"library-{theme}-1-kept")
    drag(qtbot, window.sliders.row_of(0), by=25)
    rest(qtbot, window)
    assert window.windowTitle().startswith("A, changed[*]")
    press(window, Qt.Key.Key_S, CONTROL, choosing(tmp_path / "work.json"))
    assert window.windowTitle().startswith("A, changed — work.json[*]")
    assert not window.isWindowModified()
    changed = document.history.latent.tobytes()
    assert changed != kept
    take_picture(window, f"library-{theme}-2-saved")
    assert window.statusBar().currentMessage() == "Saved work.json"
    apply(qtbot, window, "A")
    assert window.statusBar().currentMessage() == ""
    assert document.history.latent.tobytes() == kept
    assert np.array_equal(shown(window), mesh)
    assert own(window) == {"A": kept}
    take_picture(window, f"library-{theme}-3-loaded-again")
    (saved,) = read_poses(tmp_path / "work.json", document.model)
    assert saved.latent.tobytes() == changed


def test_story_a_full_blend_is_saved_beside_the_kept_pose(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, library, path = window.document, window.library, tmp_path / "work.json"
    apply(qtbot, window, "bend 3")
    kept = document.history.latent.tobytes()
    press(window, Qt.Key.Key_K, CONTROL, typing("hand on hip"))
    apply(qtbot, window, "hand on hip")
    QTest.mouseClick(library.training, LEFT)
    click(window, "bend 5")
    press(window, Qt.Key.Key_B, CONTROL)
    assert library.blend.hasFocus()
    QTest.keyClick(library.blend, Qt.Key.Key_End)
    target = document.model.known_poses[5]
    assert np.array_equal(document.history.latent, target)
    press(window, Qt.Key.Key_S, CONTROL, choosing(path))
    press(window, Qt.Key.Key_N, CONTROL)
    assert own(window) == {"hand on hip": kept}
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, path)
    rest(qtbot, window)
    assert np.array_equal(document.history.latent, target)
    assert own(window) == {"hand on hip": kept}
    QTest.mouseClick(library.own, LEFT)
    apply(qtbot, window, "hand on hip")
    assert document.history.latent.tobytes() == kept


def test_update_is_asked_for_by_name_and_can_be_undone(qtbot: QtBot, window: MainWindow) -> None:
    document, update = window.document, window.actions_by_key["update"]
    assert not update.isEnabled()
    press(window, Qt.Key.Key_K, CONTROL, typing("A & B"))
    kept = document.history.latent.tobytes()
    assert not update.isEnabled()
    drag(qtbot, window.sliders.row_of(0), by=25)
    assert update.isEnabled()
    assert update.text() == "&Update “A && B”"
    QTest.mouseClick(window.library.update_button, LEFT)
    changed = document.history.latent.tobytes()
    assert own(window) == {"A & B": changed}
    assert not update.isEnabled()
    press(window, Qt.Key.Key_Z, CONTROL)
    assert own(window) == {"A & B": kept}
    assert document.history.latent.tobytes() == changed
    assert update.isEnabled()


def test_a_taken_name_is_refused_with_its_text_or_replaced_when_confirmed(
    qtbot: QtBot, window: MainWindow
) -> None:
    document = window.document
    for name in ("A", "B"):
        press(window, Qt.Key.Key_K, CONTROL, typing(name))
    before = own(window)
    heard: list[tuple[str, str]] = []

    def try_taken(dialog: QDialog) -> None:
        assert isinstance(dialog, NameDialog)
        for text in ("a", "", "x" * 201):
            type_name(dialog, text)
            assert dialog.isVisible()
            heard.append((dialog.textValue(), dialog.reason.text()))
            assert dialog.reason.isVisible()
        take_picture(window, "library-name-refused")
        type_name(dialog, "C")

    QTest.mouseClick(window.library.list.viewport(), LEFT, pos=place_of(window, "B"))
    press(window, Qt.Key.Key_F2, Qt.KeyboardModifier.NoModifier, try_taken)
    assert [text for text, _ in heard] == ["a", "", "x" * 201]
    assert "already has a pose “A”" in heard[0][1]
    assert "needs a name" in heard[1][1]
    assert "at most 200 characters" in heard[2][1]
    assert list(own(window)) == ["A", "C"]
    document.history.undo()
    assert own(window) == before
    drag(qtbot, window.sliders.row_of(0), by=25)

    def give_up(dialog: QDialog) -> None:
        assert isinstance(dialog, NameDialog)
        timer = answer(pressing("Choose another name"))
        type_name(dialog, "A")
        assert not timer.isActive()
        assert dialog.isVisible()
        assert dialog.textValue() == "A"
        dialog.reject()

    press(window, Qt.Key.Key_K, CONTROL, give_up)
    assert own(window) == before
    press(window, Qt.Key.Key_K, CONTROL, typing("A"), pressing("Replace"))
    assert list(own(window)) == ["A", "B"]
    assert own(window)["A"] == document.history.latent.tobytes() != before["A"]
    press(window, Qt.Key.Key_Z, CONTROL)
    assert own(window) == before


def rows_in_sight(window: MainWindow) -> int:
    held = window.library.list
    seen = held.viewport().rect()
    rects = [held.visualItemRect(held.item(row)) for row in range(held.count())]
    return len({rect.top() for rect in rects if seen.contains(rect)})


def test_the_browser_has_as_many_rows_as_there_is_room(qtbot: QtBot, window: MainWindow) -> None:
    assert rows_in_sight(window) == 1
    dock = window.docks["library"]
    window.resizeDocks([dock], [470], Qt.Orientation.Vertical)
    qtbot.waitUntil(lambda: rows_in_sight(window) >= 2, timeout=PATIENCE)
    dock.setFloating(True)
    dock.resize(700, 700)
    qtbot.waitUntil(lambda: rows_in_sight(window) >= 3, timeout=PATIENCE)


@pytest.mark.slow
def test_a_tall_window_begins_with_two_rows(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    window = open_window(qtbot, document, settings_in(tmp_path), (1280, 980))
    qtbot.waitUntil(lambda: rows_in_sight(window) == 2, timeout=PATIENCE)


@pytest.mark.variants(2)
@pytest.mark.parametrize(
    ("name", "n_lines"),
    [
        ("kick", 1),
        ("kicking with the left", 2),
        ("kicking_with_the_left", 2),
        ("a name that is longer than any name of a pose", 2),
    ],
)
def test_names_are_not_cut_but_broken(window: MainWindow, name: str, n_lines: int) -> None:
    held = window.library.list
    window.document.library.add_pose(name)
    window.library.choose_own(name)
    assert name in held.item(0).toolTip()
    cell = held.visualItemRect(held.item(0))
    picture = held.viewport().grab(cell).toImage()
    height = held.fontMetrics().lineSpacing()

    def is_inked(y: int) -> bool:
        shades = [picture.pixelColor(x, y).lightness() for x in range(8, cell.width() - 8)]
        return max(shades) - min(shades) > 100

    inked = [y for y in range(cell.height() - 2 * height - 6, cell.height() - 4) if is_inked(y)]
    assert (inked[-1] - inked[0] > height) == (n_lines == 2)


def test_search_and_tags_find_poses(window: MainWindow) -> None:
    document, library = window.document, window.library
    for name in ("left kick", "right kick", "T pose"):
        document.library.add_pose(name)
    QTest.mouseClick(library.own, LEFT)
    assert not library.tags.isVisible()
    click(window, "left kick")
    click(window, "T pose", key=CONTROL)
    document.library.tag_poses(["T pose"], ["arms"])
    press(window, Qt.Key.Key_T, CONTROL | SHIFT, typing("leg, low"))
    # Tags that are not shared were not shown, so they are not deleted.
    press(window, Qt.Key.Key_T, CONTROL | SHIFT, typing("leg, high & wide,leg"))
    assert [pose.tags for pose in document.library.poses] == [
        ("leg", "high & wide"),
        (),
        ("leg", "high & wide", "arms"),
    ]
    assert library.tags.isVisible()
    entries = {action.text(): action for action in library.tags.menu().actions()}
    assert list(entries) == ["All poses", "arms", "high && wide", "leg"]
    entries["leg"].trigger()
    # The chosen entry is not deleted while Qt still uses it.
    assert [text for text, action in entries.items() if action.isChecked()] == ["leg"]
    assert names_shown(window) == ["left kick", "T pose"]
    press(window, Qt.Key.Key_F, CONTROL | SHIFT)
    assert library.search.hasFocus()
    QTest.keyClicks(library.search, "KICK")
    assert names_shown(window) == ["left kick"]
    assert [pose.name for pose in library.chosen_poses] == ["left kick"]
    QTest.keyClicks(library.search, "ing")
    assert names_shown(window) == []
    assert library.list.hint.text() == "No pose matches"
    assert library.chosen is None
    library.search.clear()
    {action.text(): action for action in library.tags.menu().actions()}["All poses"].trigger()
    assert len(names_shown(window)) == 3
    # An added pose is shown whatever the search text.
    library.search.setText("nothing")
    press(window, Qt.Key.Key_K, CONTROL, typing("new"))
    assert library.chosen_own is not None
    assert library.chosen_own.name == "new"


def test_the_context_menu_has_the_menu_s_own_actions(qtbot: QtBot, window: MainWindow) -> None:
    document, library = window.document, window.library

    def opened_at(place: QPoint) -> list[str]:
        library.list.customContextMenuRequested.emit(place)
        menu = QApplication.activePopupWidget()
        assert isinstance(menu, QMenu)
        found = [action for action in menu.actions() if not action.isSeparator()]
        held = window.actions_by_key
        keys = [next(key for key, own in held.items() if own is action) for action in found]
        menu.close()
        return keys

    click(window, "bend 2", RIGHT)
    assert library.chosen is not None
    assert library.chosen.name == "bend 2"
    at_training = opened_at(place_of(window, "bend 2"))
    assert at_training == [
        *("load", "blend", "mirror_poses", "add", "keep"),
        *("import_poses", "export_poses", "export_motion", "find_pose"),
    ]
    document.library.add_pose("mine")
    library.choose_own("mine")
    document.motion.set_code(0, 0.5)
    assert opened_at(place_of(window, "mine")) == [
        *("load", "blend", "rename", "tags", "duplicate", "mirror_poses", "remove"),
        *("keep", "update"),
        *("import_poses", "export_poses", "export_motion", "export_library", "find_pose"),
    ]
    empty = library.list.viewport().rect().bottomRight() - QPoint(3, 3)
    assert opened_at(empty) == [*("keep", "update", "import_poses", "export_library", "find_pose")]
    library.choose_own("mine")
    press(window, Qt.Key.Key_D, CONTROL | SHIFT)
    assert list(own(window)) == ["mine", "mine 2"]
    QTest.keyClick(library.list, Qt.Key.Key_A, CONTROL)
    press(window, Qt.Key.Key_Delete, CONTROL)
    assert own(window) == {}
    assert document.history.undo_stack.undoText() == "Remove 2 poses"
    rest(qtbot, window)


def noting(threads: list[str], work: Callable[..., Any]) -> Callable[..., Any]:
    """Return a wrapper that records the thread's name if it is one of the program's threads."""

    def noted(*arguments: Any, **options: Any) -> Any:
        threads.append(threading.current_thread().name.partition("_")[0])
        return work(*arguments, **options)

    return noted


def test_a_library_is_shared_as_a_file(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, library = window.document, window.library
    threads: list[str] = []
    for name in ("read_poses", "write_poses"):
        monkeypatch.setattr(model_package, name, noting(threads, getattr(model_package, name)))
    for value, name in enumerate(("left kick", "right kick", "T pose")):
        document.motion.set_code(0, 0.25 * value)
        document.library.add_pose(name)
    document.library.tag_poses(["T pose"], ["arms"])
    whole, some = tmp_path / "library.json", tmp_path / "some.json"
    press(window, Qt.Key.Key_E, CONTROL | Qt.KeyboardModifier.AltModifier, choosing(whole))
    QTest.mouseClick(library.own, LEFT)
    click(window, "left kick")
    click(window, "right kick", key=CONTROL)
    press(window, Qt.Key.Key_E, CONTROL | SHIFT, choosing(some))
    document.tasks.wait_for_saves()
    assert "Exported 2 poses to some.json" in window.statusBar().currentMessage()
    assert [pose.name for pose in read_poses(some, document.model)] == ["left kick", "right kick"]
    assert read_pose_file(whole, document.model).poses[2].tags == ("arms",)
    before = own(window)
    document.library.remove_poses(["right kick", "T pose"])
    document.motion.set_code(0, 5.0)
    document.library.replace_pose("left kick")
    press(window, Qt.Key.Key_I, CONTROL | SHIFT, choosing(whole))
    qtbot.waitUntil(lambda: len(own(window)) > 1, timeout=PATIENCE)
    assert list(own(window)) == ["left kick", "left kick 2", "right kick", "T pose"]
    assert own(window)["left kick 2"] == before["left kick"]
    assert "Added 3 poses" in window.statusBar().currentMessage()
    press(window, Qt.Key.Key_I, CONTROL | SHIFT, choosing(some))
    qtbot.waitUntil(lambda: len(own(window)) == 5, timeout=PATIENCE)
    # The window's thread is not among them.
    assert threads == ["saving", "saving", "long work", "long work"]
    press(window, Qt.Key.Key_Z, CONTROL)
    press(window, Qt.Key.Key_Z, CONTROL)
    assert list(own(window)) == ["left kick"]
    rest(qtbot, window)


def test_a_file_of_another_model_is_offered_with_its_model(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, path = window.document, tmp_path / "snake.json"
    snake = another_model(document.model)
    write_poses(path, snake, [NamedPose("coil", snake.known_poses[1])])
    heard: list[str] = []

    def cancel(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        heard.append(f"{dialog.text()} {dialog.informativeText()}")
        take_picture(window, "library-other-model")
        dialog.reject()

    asked = answer(cancel)
    drop(window, path)
    qtbot.waitUntil(lambda: not asked.isActive(), timeout=PATIENCE)
    assert heard == [
        "snake.json contains poses of the model “snake”. Open “snake” with these poses?"
    ]
    assert document.model.name == "tube"
    asked = answer(pressing("Open “snake”"))
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, path)
    assert document.model.fingerprint == snake.fingerprint
    assert document.history.pose.name == "coil"
    rest(qtbot, window)


def test_save_asks_before_it_replaces_what_another_program_wrote_meanwhile(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, path = window.document, tmp_path / "work.json"
    latent = document.model.known_poses
    write_poses(path, document.model, [NamedPose("first", latent[1])])
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, path)
    document.motion.set_code(0, 0.25)
    # No other program has written the file, so there is no question.
    press(window, Qt.Key.Key_S, CONTROL)
    assert not document.history.modified
    write_poses(path, document.model, [NamedPose("of another", latent[2])])
    others = path.read_bytes()
    document.motion.set_code(0, 0.5)

    def cancel(dialog: QDialog) -> None:
        take_picture(window, "library-changed-by-another")
        pressing("Cancel")(dialog)

    press(window, Qt.Key.Key_S, CONTROL, cancel)
    assert path.read_bytes() == others
    assert document.history.modified
    press(window, Qt.Key.Key_S, CONTROL, pressing("Replace"))
    assert [pose.name for pose in read_pose_file(path, document.model).poses] == ["first"]
    assert not document.history.modified
    rest(qtbot, window)


@pytest.mark.variants
@pytest.mark.parametrize("is_good", [True, False])
def test_of_several_files_what_was_opened_is_told_once_it_is(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, is_good: bool
) -> None:
    document, model = window.document, window.document.model
    files = [tmp_path / name for name in ("notes.txt", "bent.obj", "other.obj")]
    files[0].write_text("no pose")
    files[1].write_text("garbage")
    if is_good:
        write_mesh(files[1], model.decode(model.known_poses[1]), model.faces)
    with qtbot.waitSignal(
        document.tasks.imported if is_good else document.failed, timeout=PATIENCE
    ):
        drop(window, *files)
    said = window.statusBar().currentMessage()
    assert ("; 2 other files were not opened" in said) == is_good
    if is_good:
        assert said.startswith("Imported bent: fit error of ")
        rest(qtbot, window)
    for dialog in window.findChildren(FailureDialog):
        dialog.reject()


def test_names_that_are_proposed_are_those_of_the_pose_and_never_taken(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document = window.document
    window.settings["last_folder"] = str(tmp_path)
    proposed: list[str] = []

    def look(dialog: QDialog) -> None:
        proposed.append(Path(name_field(dialog).text()).stem)
        dialog.reject()

    def export() -> str:
        press(window, Qt.Key.Key_E, CONTROL, lambda form: form.accept(), look)
        return proposed[-1]

    document.motion.load_pose(NamedPose("two\nlines", document.model.known_poses[1]))
    assert window.windowTitle().startswith("two\\nlines[*]")
    document.motion.load_pose(NamedPose("left/right: kick", document.model.known_poses[1]))
    assert export() == "left_right_ kick"
    (tmp_path / "left_right_ kick.obj").write_text("mine")
    assert export() == "left_right_ kick 2"
    document.motion.reset_all()
    assert window.windowTitle().startswith("left/right: kick, changed[*]")
    assert export() == "left_right_ kick changed"
    document.tasks.save(tmp_path / "poses.json")
    document.tasks.wait_for_saves()
    assert window.windowTitle().startswith("left/right: kick — poses.json[*]")
    press(window, Qt.Key.Key_S, CONTROL | SHIFT, look)
    assert proposed[-1] == "poses"
    document.new_pose()
    document.motion.set_code(0, 0.5)
    document.tasks.save(tmp_path / "squat.json")
    document.tasks.wait_for_saves()
    assert window.windowTitle().startswith("squat — squat.json[*]")
    rest(qtbot, window)


@pytest.mark.parametrize("choice", ["Try again", "Discard", "Cancel"])
def test_a_library_that_could_not_be_written_is_asked_about_before_it_goes(
    window: MainWindow, choice: str
) -> None:
    document, blocked = window.document, user_poses_folder()
    document.history.begin_with(training_pose(document.model, 2))
    blocked.parent.mkdir(parents=True, exist_ok=True)
    blocked.write_text("a file, where the folder should be")
    document.library.add_poses([training_pose(document.model, 3)])
    document.tasks.wait_for_saves()
    (told,) = window.findChildren(FailureDialog)
    told.close()
    heard: list[str] = []

    def choose(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        heard.append(dialog.text())
        take_picture(dialog, "library-unsaved")
        if choice == "Try again":
            blocked.unlink()
        (button,) = (held for held in dialog.buttons() if held.text().replace("&", "") == choice)
        button.click()

    timer = answer(choose)
    window.actions_by_key["new"].trigger()
    assert heard == []
    document.history.mark_saved()
    assert window.close() == (choice != "Cancel")
    timer.stop()
    assert heard == [f"Your library of poses of “{document.model.name}” couldn't be saved."]
    assert len(document.library.poses) == (choice != "Discard")
    assert blocked.is_dir() == (choice == "Try again")
    document.library.discard_changes()
