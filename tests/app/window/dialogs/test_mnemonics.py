"""In every dialog, each button and labelled field has its own mnemonic."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from PySide6.QtCore import QObject, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QDialog,
    QLabel,
    QPushButton,
    QVBoxLayout,
)
from pytestqt.qtbot import QtBot

from app.window.dialogs import questions
from app.window.dialogs.body_parts import BodyPartsDialog
from app.window.dialogs.forms import (
    ExportDialog,
    MotionDialog,
    SceneExportDialog,
    resolve_form,
    screenshot_form,
    video_form,
)
from app.window.dialogs.learning import LearningDialog
from app.window.dialogs.new_model import NewModelDialog
from app.window.dialogs.questions import FailureDialog, NameDialog
from app.window.event_filters import Mnemonics, mnemonic
from app.window.main_window import MainWindow
from app.work.threads import Failure
from lcollision_core.bodies import RigBody
from tests.app.windows import answer, rest
from tests.rigged_shapes import rigged_body

pytestmark = pytest.mark.one_window


def marks(dialog: QDialog) -> dict[str, QObject]:
    """Return widgets by their mnemonics, and check that none lacks one."""
    labels = [held for held in dialog.findChildren(QLabel) if held.buddy() is not None]
    named = {held.buddy() for held in labels}
    buttons = [held for held in dialog.findChildren(QAbstractButton) if held.text()]
    marked: dict[str, QObject] = {}
    for held in (*labels, *(held for held in buttons if held not in named)):
        if held.isVisible():
            letter = mnemonic(held.text())
            assert letter, f"“{held.text()}” has no mnemonic"
            assert letter not in marked, f"{letter} is of two: {held.text()}"
            marked[letter] = held
    return marked


SHOWN: dict[str, Callable[[MainWindow], QDialog]] = {
    "screenshot": lambda w: screenshot_form(w.settings, w),
    "turntable": lambda w: video_form(w.settings, w),
    "resolve": lambda w: resolve_form(w.settings, w),
    "export": lambda w: ExportDialog(w.settings, w, w.document.model),
    "scene": lambda w: SceneExportDialog(w.settings, w, w.document.model),
    "motion": lambda w: MotionDialog(w.settings, w, w.document.model, 30.0),
    "parts": lambda w: BodyPartsDialog(w.document.model, True, w),
    "failure": lambda w: FailureDialog(Failure("no such file", "look elsewhere", "x"), w),
    "learning": lambda w: LearningDialog(w.learning.runs, w.learning._work, w, w.attempt),
    "name": lambda w: NameDialog(w, "Rename", "New name of “A & B”:", "A & B", lambda _: None),
}


@pytest.mark.variants(2)
@pytest.mark.parametrize("kind", SHOWN)
def test_each_button_and_field_of_a_dialog_has_a_letter(window: MainWindow, kind: str) -> None:
    dialog = SHOWN[kind](window)
    dialog.show()
    assert marks(dialog)
    dialog.close()
    dialog.deleteLater()


@pytest.mark.variants
@pytest.mark.parametrize("kind", ["shortcuts", "about", "contacts", "parts", "resolve_options"])
def test_dialogs_of_the_menus_too(qtbot: QtBot, window: MainWindow, kind: str) -> None:
    if kind == "contacts":
        window.document.set_model(RigBody.of(rigged_body()))
        rest(qtbot, window)
    window.actions_by_key[kind].trigger()
    (dialog,) = (held for held in window.findChildren(QDialog) if held.isVisible())
    assert marks(dialog)
    dialog.close()


def test_questions_too(window: MainWindow) -> None:
    asked: list[dict[str, QObject]] = []

    def look(dialog: QDialog) -> None:
        asked.append(marks(dialog))
        dialog.reject()

    for ask in (
        lambda: questions.ask_about_changes(window, "pose", "body"),
        lambda: questions.ask_about_library(window, "body"),
        lambda: questions.ask_about_changed_file(window, "poses.json"),
        lambda: questions.ask_to_switch(window, "poses.json", "A & B"),
        lambda: questions.ask_to_replace(window, "pose"),
    ):
        timer = answer(look)
        ask()
        assert not timer.isActive()
    assert [len(marked) for marked in asked] == [3, 3, 3, 2, 2]


def test_letters_follow_the_pages_of_a_new_model(window: MainWindow) -> None:
    wizard = NewModelDialog(window.learning._work, window.settings, window)
    wizard.show()
    for number in range(len(wizard.pages)):
        wizard._go_to(number)
        QApplication.sendPostedEvents()
        assert len(marks(wizard)) >= 3
    wizard.reject()


def test_a_letter_presses_its_button_also_after_its_text_has_changed(
    qtbot: QtBot, window: MainWindow
) -> None:
    dialog = FailureDialog(Failure("no such file", "", "details"), window)
    dialog.show()
    dialog.activateWindow()
    qtbot.waitUntil(dialog.isActiveWindow)
    # Enter presses the button that has the focus.
    (focused,) = (one for one in dialog.findChildren(QPushButton) if one.hasFocus())
    assert focused.isDefault()
    for unfolded in (True, False):
        QApplication.sendPostedEvents()
        letter = mnemonic(dialog.unfold.text())
        key = getattr(Qt.Key, f"Key_{letter.upper()}")
        QTest.keyClick(dialog, key, Qt.KeyboardModifier.AltModifier)
        # It is shown pressed for a moment.
        qtbot.waitUntil(lambda u=unfolded: dialog.unfold.isChecked() == u)
    dialog.close()


def test_names_keep_their_ampersands_and_a_given_letter_is_kept(qtbot: QtBot) -> None:
    dialog = QDialog()
    Mnemonics(dialog)

    column = QVBoxLayout(dialog)
    texts = ("Open “A && B”", "Other", "S&ave", "Save", "Ärger", "&&", "…")
    for text in texts:
        column.addWidget(QPushButton(text))
    qtbot.addWidget(dialog)
    dialog.show()
    held = [button.text() for button in dialog.findChildren(QPushButton)]
    assert held == ["&Open “A && B”", "O&ther", "S&ave", "&Save", "&Ärger", "&&", "…"]
