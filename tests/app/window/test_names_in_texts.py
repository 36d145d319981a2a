"""Names of poses, body parts and models are shown literally, whatever they contain."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QAction, QColor, QKeySequence
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QDialog, QLabel, QMenu, QScrollArea, QWidget
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.live_pose import code_name
from app.window.dialogs.help import ShortcutsDialog
from app.window.dialogs.questions import FailureDialog, ask_about_changes, ask_for_name
from app.window.main_window import MainWindow
from app.window.panels.collision import DomainRow
from app.window.widgets import NATIVE
from app.work.threads import Failure
from lcollision_core.bodies import LearnedBody, sample_poses
from tests.app.windows import PATIENCE, answer, open_window, rest, settings_in

pytestmark = pytest.mark.one_window

LEFT = Qt.MouseButton.LeftButton
HOSTILE = ("arms &hands & more", "<b>bold</b><img src=x>")


@pytest.fixture
def hostile(qtbot: QtBot, editor_model: LearnedBody, tmp_path: Path) -> MainWindow:
    """Return a window whose body parts, pose and undo steps have hostile names."""
    document = PoseDocument(editor_model.edit_domains(dict(enumerate(HOSTILE))))
    window = open_window(qtbot, document, settings_in(tmp_path))
    for name in HOSTILE:
        document.library.add_pose(name)
    return window


def menu_actions(menu: QMenu) -> Iterator[QAction]:
    for action in menu.actions():
        held = action.menu()
        if isinstance(held, QMenu):
            held.aboutToShow.emit()
            yield from menu_actions(held)
        else:
            yield action


def shown_text(text: str) -> str:
    """Return a menu text as shown, without mnemonics."""
    return text.replace("&&", "\0").replace("&", "").replace("\0", "&")


def test_the_menu_shows_the_step_to_undo_to_the_letter(hostile: MainWindow) -> None:
    document, undo, redo = (hostile.document, *map(hostile.actions_by_key.get, ("undo", "redo")))
    assert undo is not None
    assert redo is not None
    for name in HOSTILE:
        document.library.add_pose(name)
        kept = document.history.pose.name
        assert shown_text(undo.text()).endswith(kept)
        document.history.undo()
        assert shown_text(redo.text()).endswith(kept)
    document.motion.set_code(0, 0.1)
    assert shown_text(undo.text()) == f"Undo move {code_name(document.model, 0)}"


def test_no_text_of_a_window_takes_a_name_for_a_shortcut_or_for_html(hostile: MainWindow) -> None:
    hostile.sliders.row_of(hostile.document.model.latent_size - 1)
    for widget in hostile.findChildren(QWidget):
        own = getattr(widget, "shortcut", None)
        held = own().toString() if callable(own) else ""
        # "arms &hands" would be Alt+H, "a & b" Alt+Space.
        assert held not in ("Alt+H", "Alt+Space"), widget
        assert "<b>bold" not in widget.toolTip()
        if isinstance(widget, QLabel) and "bold" in widget.text():
            assert widget.textFormat() is Qt.TextFormat.PlainText
    for menu in hostile.menus.values():
        for action in menu_actions(menu):
            # A menu shows HTML literally, and "&" only if it is doubled.
            if "hands" in action.text() and action.objectName() != "pin_hands":
                assert HOSTILE[0] in shown_text(action.text())


def test_dialogs_show_a_name_to_the_letter(hostile: MainWindow) -> None:
    name = "arms &hands <b>bold</b>"
    looked: list[tuple[str, Qt.TextFormat]] = []

    def look(dialog: QDialog) -> None:
        told = next(label for label in dialog.findChildren(QLabel) if "hands" in label.text())
        looked.append((told.text(), told.textFormat()))
        dialog.reject()

    for act in (
        lambda: ask_about_changes(hostile, name, "hero"),
        lambda: ask_for_name(hostile, "Rename", f"New name of “{name}”:", name),
    ):
        asked = answer(look)
        act()
        assert not asked.isActive()
    assert {form for _, form in looked} == {Qt.TextFormat.PlainText}
    # Only a field's label turns "&" into a shortcut.
    assert name in looked[0][0]
    assert name.replace("&", "&&") in looked[1][0]
    dialog = FailureDialog(Failure(f"{name} cannot be read", name), hostile)
    assert dialog.what.textFormat() is dialog.advice.textFormat() is Qt.TextFormat.PlainText
    dialog.deleteLater()


def window_key(keys: str) -> str:
    return QKeySequence(keys).toString(NATIVE)


def test_the_list_of_shortcuts_names_no_step(window: MainWindow) -> None:
    window.document.motion.set_code(0, 0.1)
    assert window.actions_by_key["undo"].text() != "&Undo"
    window.actions_by_key["shortcuts"].trigger()
    (dialog,) = window.findChildren(ShortcutsDialog)
    words = [label.text() for label in dialog.findChildren(QLabel)]
    assert {"Undo", "Redo"} <= set(words)
    assert [word for word in words if word.startswith(("Undo ", "Redo "))] == []
    # Mouse actions come first, and submenus are nested.
    assert words.index("Drag the body") < words.index("Menu File") < words.index("Menu Pose")
    assert "Edit > Contacts > Propose" in words
    indents = {label.text(): label.indent() for label in dialog.findChildren(QLabel)}
    nested = words[words.index("Drag stiffness") :]
    assert nested[:4] == ["Drag stiffness", "", "Loose", window_key("Ctrl+Alt+7")]
    # It scrolls without a mouse.
    (area,) = dialog.findChildren(QScrollArea)
    focused = dialog.focusWidget()
    assert focused is not None
    QTest.keyClick(focused, Qt.Key.Key_PageDown)
    assert area.verticalScrollBar().value() > 0
    assert indents["Loose"] > indents["Drag stiffness"] == indents["Undo"]
    dialog.reject()


@pytest.mark.variants
@pytest.mark.parametrize("how", ["button", "cancel", "shortcut"])
def test_the_keyboard_stays_where_resolve_was_asked_for(
    qtbot: QtBot, window: MainWindow, editor_model: LearnedBody, how: str
) -> None:
    card, slider = window.collision.resolve, window.sliders.row_of(0).slider
    window.document.motion.blend_towards(sample_poses(editor_model, 1, 0, colliding=True)[0], 1.0)
    rest(qtbot, window)
    asking = slider if how == "shortcut" else card.button
    asking.setFocus()
    with qtbot.waitSignal(window.document.tasks.solve_finished, timeout=PATIENCE):
        QTest.keyClick(asking, *(Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)) if (
            how == "shortcut"
        ) else QTest.keyClick(asking, Qt.Key.Key_Space)
        if how == "cancel":
            assert QApplication.focusWidget() is card.cancel
            QTest.keyClick(card.cancel, Qt.Key.Key_Space)
    rest(qtbot, window)
    assert QApplication.focusWidget() is asking


def test_a_swatch_has_the_colour_of_the_body_in_both_themes(window: MainWindow) -> None:
    dark_blue = "#332288"
    model = window.document.model
    for theme in ("light", "dark"):
        window.set_theme(theme)
        for row in window.collision.prediction.rows:
            row._colour = dark_blue
        (row, *_) = window.collision.findChildren(DomainRow)
        picture = row.grab().toImage()
        assert picture.pixelColor(10, row.height() // 2) == QColor(dark_blue)
        for group, colour in zip(window.sliders.groups[1:], model.card.domain_colours, strict=True):
            picture = group.header.grab().toImage()
            assert picture.pixelColor(32, group.header.height() // 2) == QColor(colour)
        # A colour that is hardly visible gets an edge.
        edge = row.grab().toImage().pixelColor(4, row.height() // 2)
        assert (edge == QColor(dark_blue)) == (theme == "light")
