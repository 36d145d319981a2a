"""Short dialogs: modal questions, names and failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from enum import Enum
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt, QUrl
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import (
    QDialog,
    QDialogButtonBox,
    QGridLayout,
    QInputDialog,
    QLabel,
    QLayout,
    QLineEdit,
    QMessageBox,
    QPlainTextEdit,
    QPushButton,
    QSpacerItem,
    QVBoxLayout,
    QWidget,
)

from app.view.theme import NORMAL, WIDE, current_theme, pixmap
from app.window.event_filters import Mnemonics
from app.window.widgets import ThemedIcon, dialog_vbox, hbox, labelled, push_button, vbox
from app.work.log import log_file
from app.work.threads import Failure
from lcollision_core.tasks.words import counted, menu_text, one_line, say, with_capital

if TYPE_CHECKING:
    from pathlib import Path

    from app.editing.document import PoseDocument
    from app.editing.recovery import RecoverablePose
    from app.view.offscreen import Pictures
    from lcollision_core.errors import WrongScaleError


_NAMED = 4
"""Largest number of files named in a question."""

_WIDTH = 400
"""Minimum width, so that no title is cut off."""

_Role = QMessageBox.ButtonRole


class Dialog(QDialog):
    """A dialog with mnemonics.

    Parameters
    ----------
    title : of its window
    parent : window of the dialog
    """

    def __init__(self, title: str, parent: QWidget | None) -> None:
        super().__init__(parent)
        self.setWindowTitle(title)
        Mnemonics(self)

    def lay_out(
        self, *items: QWidget | QLayout, accept: str, grows: int | None = None
    ) -> QPushButton:
        """Lay out items above Cancel and the button that accepts, and return this button.

        Parameters
        ----------
        accept : text of the button
        grows : index of the item that takes the remaining height
        """
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Cancel)
        button = buttons.addButton(accept, QDialogButtonBox.ButtonRole.AcceptRole)
        buttons.accepted.connect(self.accept)
        buttons.rejected.connect(self.reject)
        column = dialog_vbox(*items, buttons)
        if grows is not None:
            column.setStretch(grows, 1)
        self.setLayout(column)
        # Set only once the button is in the dialog: otherwise Enter would cancel.
        button.setDefault(True)
        return button


class Choice(Enum):
    """The answer to a question, by its effect on the user's work."""

    SAVE = _Role.AcceptRole
    DISCARD = _Role.DestructiveRole
    CANCEL = _Role.RejectRole


def ask_about_changes(
    parent: QWidget, pose_name: str, model_name: str, file_name: str = ""
) -> Choice:
    """Ask about unsaved changes, naming the file that Save writes if there is one.

    With the pose's name alone, one would expect the pose of that name in the library to change.
    """
    text = f"Save the pose “{pose_name}” of “{model_name}” to a file?"
    if file_name:
        text = f"Save the pose “{pose_name}” of “{model_name}” to “{file_name}”?"
    note = "It will be lost if you don't save it."
    return _ask(parent, "Unsaved changes", text, note, ("Save", "Discard", "Cancel"))


def ask_about_motions(parent: QWidget, names: Sequence[str]) -> Choice:
    """Ask about edited motions that are not exported.

    Returns
    -------
    answer : SAVE to export them first
    """
    text = f"Export the changes of {', '.join(f'“{name}”' for name in names)}?"
    note = "They will be lost if you don't export them."
    return _ask(parent, "Unsaved motion", text, note, ("Export…", "Discard", "Cancel"))


def ask_about_library(parent: QWidget, model: str) -> Choice:
    """Ask about a pose library whose file could not be written.

    Returns
    -------
    answer : SAVE to try again, DISCARD to lose the unwritten changes
    """
    text = f"Your library of poses of “{model}” couldn't be saved."
    note = (
        "Its latest changes will be lost. To save them elsewhere, cancel and choose Library > "
        "Export library."
    )
    return _ask(parent, "Unsaved library", text, note, ("Try again", "Discard", "Cancel"))


def ask_about_recovery(parent: QWidget, lost: RecoverablePose) -> Choice:
    """Offer to recover a pose, or an edited motion at a frame, after a crash.

    Returns
    -------
    answer : SAVE to recover it, DISCARD to delete it, CANCEL to be asked again next time
    """
    moment = datetime.fromtimestamp(lost.saved).astimezone()
    title, model = "Recover a pose", lost.model_name
    text = say(
        "The editor closed unexpectedly while the pose “{name}” of “{model}” was not saved.",
        name=lost.note.pose_name,
        model=model,
    )
    if lost.note.motion:
        title = "Recover a motion"
        text = say(
            "The editor closed unexpectedly while the motion “{name}” of “{model}” was not "
            "exported.",
            name=lost.note.motion,
            model=model,
        )
    note = f"It was saved automatically on {moment.day} {moment:%B at %H:%M}. Recover it?"
    if lost.motion_loss_reason:
        note = (
            f"As {lost.motion_loss_reason}, only the pose “{lost.note.pose_name}” can be "
            "recovered, not the edits of the motion. Recover it?"
        )
    return _ask(parent, title, text, note, ("Recover", "Delete it", "Ask later"))


def ask_about_changed_file(parent: QWidget, file: str) -> Choice:
    """Ask what to do with a file that another program has changed meanwhile.

    Returns
    -------
    answer : SAVE to save under another name, DISCARD to overwrite the other program's changes
    """
    text = f"“{file}” was changed by another program since it was opened."
    note = "Saving replaces what that program wrote."
    buttons = ("Save as…", "Replace", "Cancel")
    return _ask(parent, "Changed by another program", text, note, buttons)


def ask_to_replace(parent: QWidget, name: str) -> bool:
    """Ask whether to replace a pose of the library."""
    text, buttons = f"Replace “{name}” in your library?", ("Replace", "Choose another name")
    return _confirm(parent, "Replace a pose", text, "Undo brings it back.", buttons, careful=True)


def ask_to_switch(parent: QWidget, file: str, model: str, differs: str = "") -> bool:
    """Ask whether to open the model of a poses file along with the file.

    Parameters
    ----------
    differs : how the model differs, if it has the same name as the open one; "" otherwise
    """
    text = say("{file} contains poses of the model “{model}”.", file=file, model=model)
    if differs:
        text = f"{file} {differs}."
    note = f"Open “{model}” with these poses?"
    buttons = (f"Open “{menu_text(model)}”", "Cancel")
    return _confirm(parent, "Poses of another model", text, note, buttons)


def ask_to_join(parent: QWidget, file: str, model: str, is_prop: bool = False) -> Choice:
    """Ask whether a dropped file joins the open scene (SAVE) or is opened instead (DISCARD).

    A prop, a mesh of another body, can only join.
    """
    text = f"Add “{file}” to the scene of “{model}”?"
    note = "In a scene, bodies are posed, checked and resolved together."
    buttons = ("Add to the scene", "" if is_prop else "Open instead", "Cancel")
    default = Choice.SAVE if is_prop else Choice.DISCARD
    return _ask(parent, "Another body", text, note, buttons, default)


def ask_about_scale(parent: QWidget, file: str, error: WrongScaleError) -> bool:
    """Ask whether to scale and import a mesh that is in another unit."""
    text = f"“{file}” seems to be in another unit."
    note = (
        f"{with_capital(error.headline)}. Scaled by {error.factor:.6g} it fits; an export "
        f"restores its own size."
    )
    return _confirm(parent, "Another unit", text, note, ("Scale and import", "Cancel"))


def ask_to_discard(parent: QWidget, name: str) -> bool:
    """Ask whether to discard the results of an unfinished run."""
    text = f"Discard the unfinished model “{name}”?"
    note = "The files it learns from are not changed."
    return _confirm(parent, "Discard a model", text, note, ("Discard", "Cancel"), careful=True)


def wait_for_exports(
    parent: QWidget,
    document: PoseDocument,
    pictures: Pictures,
    title: str = "Closing",
    note: str = "The editor closes once that is done.",
) -> bool:
    """Wait for pending exports in a dialog with a Cancel button, for example as the window closes.

    Returns
    -------
    written : whether all are written; False if one fails, shown elsewhere, or the user cancels
    """

    def left() -> int:
        return document.tasks.n_exports + bool(pictures.busy)

    if not left():
        return True
    text = f"Finishing {counted(left(), 'export', 'exports')}…"
    box = message_box(parent, title, text, note)
    box.setStandardButtons(QMessageBox.StandardButton.Cancel)
    widen(box)
    failed = []

    def look() -> None:
        if not left():
            box.accept()

    def fail(failure: Failure) -> None:
        failed.append(failure)

    finished = (document.tasks.busy_changed, pictures.busy_changed)
    for changed in finished:
        changed.connect(look)
    document.failed.connect(fail)
    box.exec()
    for changed in finished:
        changed.disconnect(look)
    document.failed.disconnect(fail)
    box.deleteLater()
    return not (failed or left())


def ask_to_replace_files(parent: QWidget, files: Sequence[Path]) -> bool:
    """Ask whether to replace files beside the chosen one."""
    names = ", ".join(f"“{file.name}”" for file in files[:_NAMED])
    text = "Replace existing files?"
    note = say("Each mesh of the character gets a file of its own, replacing {files}.", files=names)
    if len(files) > _NAMED:
        note = say(
            "Each mesh of the character gets a file of its own, replacing {files} and {n} more.",
            files=names,
            n=len(files) - _NAMED,
        )
    return _confirm(parent, "Replace files", text, note, ("Replace", "Cancel"), careful=True)


def ask_to_turn(parent: QWidget, model: str) -> bool:
    """Ask whether to change the up axis in a model's file."""
    text = f"Make the next axis of “{model}” point up?"
    note = "This changes the model's file for good. Undo doesn't revert it."
    return _confirm(parent, "Turn upright", text, note, ("Turn", "Cancel"))


def message_box(parent: QWidget, title: str, text: str, note: str) -> QMessageBox:
    """Return a message box with plain text, as names may look like HTML; see `widen`."""
    box = QMessageBox(parent)
    box.setWindowTitle(title)
    Mnemonics(box)
    box.setTextFormat(Qt.TextFormat.PlainText)
    box.setText(one_line(text))
    box.setInformativeText(note)
    return box


def widen(box: QMessageBox) -> None:
    """Make a message box as wide as the other dialogs; call after adding texts and buttons."""
    layout = box.layout()
    if isinstance(layout, QGridLayout):
        layout.setContentsMargins(WIDE + 4, WIDE + 4, WIDE + 4, WIDE)
        # A message box ignores its own minimum width.
        layout.addItem(QSpacerItem(_WIDTH, 0), layout.rowCount(), 0, 1, layout.columnCount())


def _confirm(
    parent: QWidget,
    title: str,
    text: str,
    note: str,
    buttons: tuple[str, str],
    *,
    careful: bool = False,
) -> bool:
    """Show a question with two buttons; the second is the default if `careful`."""
    default = Choice.CANCEL if careful else Choice.SAVE
    yes, no = buttons
    return _ask(parent, title, text, note, (yes, "", no), default) is Choice.SAVE


def _ask(
    parent: QWidget,
    title: str,
    text: str,
    note: str,
    buttons: tuple[str, str, str],
    default: Choice = Choice.SAVE,
) -> Choice:
    """Show a question; `buttons` are labels in the order of `Choice`, "" for none."""
    box = message_box(parent, title, text, note)
    box.setIconPixmap(pixmap("question", current_theme().accent, 36, parent.devicePixelRatioF()))
    for choice, label in zip(Choice, buttons, strict=True):
        if label:
            button = box.addButton(label, choice.value)
            if choice is default:
                box.setDefaultButton(button)
            if choice is Choice.CANCEL:
                box.setEscapeButton(button)
    widen(box)
    box.exec()
    box.deleteLater()
    clicked = box.clickedButton()
    # None if the window closed without asking.
    return Choice(box.buttonRole(clicked)) if clicked is not None else Choice.CANCEL


NO_FILE_NAME = frozenset('/\\:*?"<>|.')
"""Characters that the name of a model cannot have."""


class NameDialog(QInputDialog):
    """Ask for a name; stay open while the name is refused.

    Parameters
    ----------
    parent : window of the dialog
    title, label : of the dialog and of its field
    proposed : initial text of the field
    refuse : called with the name; returns a reason as a sentence, "" if the name is allowed

    Attributes
    ----------
    reason : label that shows why the name is refused
    """

    def __init__(
        self,
        parent: QWidget,
        title: str,
        label: str,
        proposed: str,
        refuse: Callable[[str], object],
    ) -> None:
        super().__init__(parent)
        self.setWindowTitle(title)
        Mnemonics(self)
        self.setLabelText(menu_text(label))
        # A name such as "<b>" in a label is not HTML.
        for child in self.findChildren(QLabel):
            child.setTextFormat(Qt.TextFormat.PlainText)
        self.setTextValue(proposed)
        self._refuse = refuse
        self.reason = labelled("", "refusal", wraps=True)
        self.reason.hide()
        self.textValueChanged.connect(self.reason.hide)
        self.resize(_WIDTH, self.sizeHint().height())
        layout = self.layout()
        assert isinstance(layout, QVBoxLayout)
        layout.insertWidget(layout.count() - 1, self.reason)

    @property
    def name(self) -> str:
        """The typed name, without surrounding spaces."""
        return self.textValue().strip()

    def accept(self) -> None:
        """Close if the name is allowed; else show why not."""
        reason = self._refuse(self.name)
        if not reason:
            super().accept()
            return
        self.reason.setText(f"{with_capital(str(reason))}.")
        self.reason.show()
        layout = self.layout()
        assert layout is not None
        layout.activate()
        needed = layout.totalHeightForWidth(self.width())
        self.resize(self.width(), max(self.height(), needed, self.sizeHint().height()))
        field = self.findChild(QLineEdit)
        if isinstance(field, QLineEdit):
            field.setFocus()
            field.selectAll()


def ask_for_name(
    parent: QWidget,
    title: str,
    label: str,
    proposed: str,
    refuse: Callable[[str], object] = lambda _: None,
) -> str | None:
    """Ask for a name; None if the user cancels."""
    dialog = NameDialog(parent, title, label, proposed, refuse)
    accepted = dialog.exec() == QDialog.DialogCode.Accepted
    dialog.deleteLater()
    return dialog.name if accepted else None


def free_model_name(stem: str, number: int = 1) -> str:
    """Return a free name for a new user model, with the first free number from `number` on."""
    stem = stem[:50].replace(".", " ").strip()
    name = stem if number == 1 else f"{stem}-{number}"
    return free_model_name(stem, number + 1) if number < 100 and why_no_model_name(name) else name


def why_no_model_name(name: str) -> str:
    """Return, as a sentence, why a new user model cannot have a name, "" if it can."""
    from lcollision_core.bodies import list_models
    from lcollision_core.files import file_stem
    from lcollision_core.tasks.work_folder import list_work

    if not name or len(name) > 60 or NO_FILE_NAME & set(name) or file_stem(name) != name:
        return "A model needs a name of up to 60 characters, without a dot or a slash."
    if name.casefold() in {model.name.casefold() for model in list_models()}:
        return f"A model “{name}” already exists; choose another name."
    if name.casefold() in {work.name.casefold() for work in list_work()}:
        return f"A model “{name}” is being learned; choose another name."
    return ""


class FailureDialog(Dialog):
    """Show a failure without blocking the window.

    Parameters
    ----------
    failure : kept as an attribute
    parent : window of the dialog
    """

    def __init__(self, failure: Failure, parent: QWidget | None = None) -> None:
        super().__init__("Couldn't do that", parent)
        self.setMinimumWidth(480)
        self.failure = failure
        what, advice = map(with_capital, map(one_line, (failure.headline, failure.next_step)))
        if advice and not advice.endswith((".", "?", "!")):
            advice += "."
        sign = ThemedIcon(36)
        sign.show_icon("warning", "colliding")
        self.what = labelled(what, "verdict", wraps=True)
        self.advice = labelled(advice, wraps=True)
        self.advice.setVisible(bool(advice))
        self.details = QPlainTextEdit(failure.details or failure.headline, readOnly=True)
        self.details.setMinimumHeight(200)
        self.details.hide()
        words = vbox(self.what, self.advice, spacing=NORMAL)
        top = hbox(sign, words, spacing=WIDE)
        self.unfold, log = push_button("Show details"), push_button("Open log file")
        self.unfold.setCheckable(True)
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        buttons.addButton(self.unfold, QDialogButtonBox.ButtonRole.ActionRole)
        buttons.addButton(log, QDialogButtonBox.ButtonRole.ActionRole)
        close = buttons.button(QDialogButtonBox.StandardButton.Close)
        close.setDefault(True)
        self.setLayout(dialog_vbox(top, self.details, buttons))
        # Otherwise the first button looks chosen, but Enter presses this one.
        close.setFocus()
        self.unfold.toggled.connect(self._on_unfold)
        log.clicked.connect(open_log_file)
        buttons.rejected.connect(self.reject)

    def _on_unfold(self, unfolded: bool) -> None:
        self.details.setVisible(unfolded)
        self.unfold.setText("Hide details" if unfolded else "Show details")
        self.adjustSize()


def open_log_file() -> None:
    """Open the log file in the desktop's default program."""
    path = log_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    QDesktopServices.openUrl(QUrl.fromLocalFile(str(path)))
