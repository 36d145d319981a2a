"""Questions that have to be answered before anything goes on."""

from __future__ import annotations

from datetime import datetime
from enum import Enum
from typing import TYPE_CHECKING

from PySide6.QtWidgets import QMessageBox, QPushButton, QWidget

from app.icons import pixmap
from app.theme import WIDE, current_theme

if TYPE_CHECKING:
    from app.recovery import LostPose


class Answer(Enum):
    """What becomes of changes that are not saved."""

    SAVE = "save"
    DISCARD = "discard"
    CANCEL = "cancel"


def ask_about_changes(parent: QWidget, pose_name: str) -> Answer:
    """Ask what becomes of unsaved changes."""
    box = _box(parent, "Unsaved changes")
    box.setText(f"Save the changes to “{pose_name}”?")
    box.setInformativeText("They are lost if you do not save them.")
    save = box.addButton("Save", QMessageBox.ButtonRole.AcceptRole)
    discard = box.addButton("Discard", QMessageBox.ButtonRole.DestructiveRole)
    cancel = box.addButton("Cancel", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(save)
    box.setEscapeButton(cancel)
    box.exec()
    return _answer(box, save, discard)


def ask_about_recovery(parent: QWidget, lost: LostPose) -> Answer:
    """Offer a pose that an editor left when it ended without a word.

    Returns
    -------
    answer : SAVE to recover it, DISCARD to delete it, CANCEL to be asked again next time
    """
    moment = datetime.fromtimestamp(lost.saved).astimezone()
    box = _box(parent, "Recover a pose")
    box.setText(f"The editor closed unexpectedly while “{lost.pose_name}” was not saved.")
    box.setInformativeText(f"It was kept on {moment.day} {moment:%B at %H:%M}. Recover it?")
    recover = box.addButton("Recover", QMessageBox.ButtonRole.AcceptRole)
    discard = box.addButton("Delete it", QMessageBox.ButtonRole.DestructiveRole)
    later = box.addButton("Ask later", QMessageBox.ButtonRole.RejectRole)
    box.setDefaultButton(recover)
    box.setEscapeButton(later)
    box.exec()
    return _answer(box, recover, discard)


def _box(parent: QWidget, title: str) -> QMessageBox:
    box = QMessageBox(parent)
    box.setWindowTitle(title)
    box.setIconPixmap(pixmap("question", current_theme().accent, 36, parent.devicePixelRatioF()))
    layout = box.layout()
    if layout is not None:
        layout.setContentsMargins(WIDE + 4, WIDE + 4, WIDE + 4, WIDE)
    return box


def _answer(box: QMessageBox, save: QPushButton, discard: QPushButton) -> Answer:
    clicked = box.clickedButton()
    box.deleteLater()
    if clicked is save:
        return Answer.SAVE
    return Answer.DISCARD if clicked is discard else Answer.CANCEL
