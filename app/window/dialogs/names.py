"""Asking for a name; a refused one is explained and stays in the field."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QDialog, QInputDialog, QLabel, QLineEdit, QVBoxLayout, QWidget

from app.window.widgets import Mnemonics, labelled
from lcollision_core.tasks.words import heading, menu_text

NO_FILE_NAME = frozenset('/\\:*?"<>|.')
"""Letters that the name of a model cannot have."""

_WIDTH = 400
"""Least width, so that no title is cut."""


class NameDialog(QInputDialog):
    """Asks for a name; stays open with its text while the name is refused.

    Parameters
    ----------
    parent : the window that it belongs to
    title, label : of the dialog and of its field
    proposed : in the field at first
    refuse : called with what was typed; returns the reason in a sentence, "" if allowed

    Attributes
    ----------
    reason : shows why the name was refused
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
        # Names such as "<b>" in a label are no HTML.
        for held in self.findChildren(QLabel):
            held.setTextFormat(Qt.TextFormat.PlainText)
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
        """What was typed, without spaces around it."""
        return self.textValue().strip()

    def accept(self) -> None:
        """Close if the name is allowed; else say why not."""
        reason = self._refuse(self.name)
        if not reason:
            super().accept()
            return
        self.reason.setText(f"{heading(str(reason))}.")
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
    """Return a name for a new model of the user's, numbered from a number on until it is free."""
    stem = stem[:50].replace(".", " ").strip()
    name = stem if number == 1 else f"{stem}-{number}"
    return free_model_name(stem, number + 1) if number < 100 and why_no_model_name(name) else name


def why_no_model_name(name: str) -> str:
    """Say in a sentence why a new model of the user's cannot have a name, "" if it can."""
    from lcollision_core.bodies import list_models
    from lcollision_core.files import file_stem
    from lcollision_core.learning import list_work

    if not name or len(name) > 60 or NO_FILE_NAME & set(name) or file_stem(name) != name:
        return "A model needs a name of up to 60 characters, without a dot or a slash."
    if name.casefold() in {model.name.casefold() for model in list_models()}:
        return f"A model “{name}” already exists; choose another name."
    if name.casefold() in {work.name.casefold() for work in list_work()}:
        return f"A model “{name}” is being learned; choose another name."
    return ""
