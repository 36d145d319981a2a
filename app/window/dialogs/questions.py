"""Questions that have to be answered before anything goes on."""

from __future__ import annotations

from datetime import datetime
from enum import Enum
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QGridLayout,
    QMessageBox,
    QPushButton,
    QSpacerItem,
    QWidget,
)

from app.view.icons import pixmap
from app.view.theme import WIDE, current_theme
from app.wording import menu_text, one_line, with_capital

if TYPE_CHECKING:
    from app.editing.recovery import LostPose
    from app.work.jobs import WrongScale

_WIDTH = 400
"""At least, so that no title is cut."""


class Choice(Enum):
    """What becomes of changes that are not saved."""

    SAVE = "save"
    DISCARD = "discard"
    CANCEL = "cancel"


def ask_about_changes(parent: QWidget, pose_name: str, file_name: str = "") -> Choice:
    """Ask what becomes of unsaved changes, naming what Save writes: the file, where there is one.

    The pose's name alone would promise that the library's pose of that name changes.
    """
    box = _box(parent, "Unsaved changes")
    if file_name:
        box.setText(f"Save the changes to “{one_line(file_name)}”?")
    else:
        box.setText(f"Save the pose “{one_line(pose_name)}” to a file?")
    box.setInformativeText("They are lost if you do not save them.")
    save = box.addButton("Save", QMessageBox.ButtonRole.AcceptRole)
    discard = box.addButton("Discard", QMessageBox.ButtonRole.DestructiveRole)
    cancel = box.addButton("Cancel", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(save)
    box.setEscapeButton(cancel)
    return _choice(box, save, discard)


def ask_about_recovery(parent: QWidget, lost: LostPose) -> Choice:
    """Offer a pose that an editor left when it ended without a word.

    Returns
    -------
    answer : SAVE to recover it, DISCARD to delete it, CANCEL to be asked again next time
    """
    moment = datetime.fromtimestamp(lost.saved).astimezone()
    box = _box(parent, "Recover a pose")
    box.setText(f"The editor closed unexpectedly while “{one_line(lost.pose_name)}” was not saved.")
    box.setInformativeText(f"It was kept on {moment.day} {moment:%B at %H:%M}. Recover it?")
    recover = box.addButton("Recover", QMessageBox.ButtonRole.AcceptRole)
    discard = box.addButton("Delete it", QMessageBox.ButtonRole.DestructiveRole)
    later = box.addButton("Ask later", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(recover)
    box.setEscapeButton(later)
    return _choice(box, recover, discard)


def ask_about_another_s(parent: QWidget, file: str) -> Choice:
    """Ask what to do with a file that another program has changed meanwhile.

    Returns
    -------
    answer : SAVE to replace it, DISCARD to save under another name
    """
    box = _box(parent, "Changed by another program")
    box.setText(f"“{one_line(file)}” was changed by another program since it was opened.")
    box.setInformativeText("Saving replaces what that program wrote.")
    replace = box.addButton("Replace", QMessageBox.ButtonRole.DestructiveRole)
    other = box.addButton("Save as…", QMessageBox.ButtonRole.AcceptRole)
    cancel = box.addButton("Cancel", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(other)
    box.setEscapeButton(cancel)
    return _choice(box, replace, other)


def ask_to_replace(parent: QWidget, name: str) -> bool:
    """Ask whether a pose of the library is to be replaced."""
    box = _box(parent, "Replace a pose")
    box.setText(f"Replace “{name}” in your library?")
    box.setInformativeText("Undo brings it back.")
    replace = box.addButton("Replace", QMessageBox.ButtonRole.AcceptRole)
    other = box.addButton("Choose another name", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(other)
    box.setEscapeButton(other)
    return _choice(box, replace, other) is Choice.SAVE


def ask_to_switch(parent: QWidget, file: str, model: str) -> bool:
    """Ask whether the model that a file of poses belongs to is to be opened with it."""
    box = _box(parent, "Poses of another model")
    box.setText(f"{file} holds poses of the model “{model}”.")
    box.setInformativeText(f"Open “{model}” with these poses?")
    switch = box.addButton(f"Open “{menu_text(model)}”", QMessageBox.ButtonRole.AcceptRole)
    stay = box.addButton("Cancel", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(switch)
    box.setEscapeButton(stay)
    return _choice(box, switch, stay) is Choice.SAVE


def ask_about_scale(parent: QWidget, found: WrongScale) -> bool:
    """Offer to import a mesh that is in another unit; whether it is to be scaled."""
    box = _box(parent, "Another unit")
    box.setText(f"“{found.path.name}” seems to be in another unit.")
    box.setInformativeText(
        f"{with_capital(found.what)}. Scaled by {found.factor:.6g} it fits; exported, it has its "
        f"own size again."
    )
    scale = box.addButton("Scale and import", QMessageBox.ButtonRole.AcceptRole)
    cancel = box.addButton("Cancel", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(scale)
    box.setEscapeButton(cancel)
    return _choice(box, scale, cancel) is Choice.SAVE


def _box(parent: QWidget, title: str) -> QMessageBox:
    box = QMessageBox(parent)
    box.setWindowTitle(title)
    box.setTextFormat(Qt.TextFormat.PlainText)
    box.setIconPixmap(pixmap("question", current_theme().accent, 36, parent.devicePixelRatioF()))
    return box


def _choice(box: QMessageBox, save: QPushButton, discard: QPushButton) -> Choice:
    layout = box.layout()
    if isinstance(layout, QGridLayout):
        layout.setContentsMargins(WIDE + 4, WIDE + 4, WIDE + 4, WIDE)
        # A message box takes no minimum width of its own.
        layout.addItem(QSpacerItem(_WIDTH, 0), layout.rowCount(), 0, 1, layout.columnCount())
    box.exec()
    clicked = box.clickedButton()
    box.deleteLater()
    if clicked is save:
        return Choice.SAVE
    return Choice.DISCARD if clicked is discard else Choice.CANCEL
