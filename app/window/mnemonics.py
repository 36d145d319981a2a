"""Keyboard accelerators of a dialog: an underlined letter for each button and named field."""

from __future__ import annotations

import re

from PySide6.QtCore import QEvent, QObject
from PySide6.QtWidgets import QAbstractButton, QDialog, QLabel

_MARK = re.compile("&(?!&)(.)|&&")


class Mnemonics(QObject):
    """Gives what is visible in a dialog letters of its own, also after its texts change.

    A letter that a text has is kept unless an earlier one has it too; others get the first letter
    of a word, or any other, that is still free.

    Parameters
    ----------
    dialog : whose buttons and labels with a buddy are marked
    """

    def __init__(self, dialog: QDialog) -> None:
        super().__init__(dialog)
        self._dialog = dialog
        dialog.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Mark what has come, before it is drawn."""
        if event.type() in (QEvent.Type.Show, QEvent.Type.LayoutRequest):
            self._mark()
        return super().eventFilter(watched, event)

    def _mark(self) -> None:
        labels = [held for held in self._dialog.findChildren(QLabel) if held.buddy() is not None]
        # The text of a button that a label names is a value, such as a colour.
        named = {held.buddy() for held in labels}
        buttons = [held for held in self._dialog.findChildren(QAbstractButton) if held.text()]
        items: list[QAbstractButton | QLabel] = [held for held in buttons if held not in named]
        items += labels
        taken = set[str]()
        new: list[QAbstractButton | QLabel] = []
        for item in (held for held in items if held.isVisibleTo(self._dialog)):
            letter = mnemonic(item.text())
            if letter and letter not in taken:
                taken.add(letter)
            else:
                new.append(item)
        for item in new:
            text = _MARK.sub(lambda found: found[1] or "&&", item.text())
            marked = _with_mark(text, taken)
            taken.add(mnemonic(marked))
            if marked != item.text():
                item.setText(marked)


def mnemonic(text: str) -> str:
    """Return the marked letter of a text in lower case, "" for none."""
    return next((found[1].casefold() for found in _MARK.finditer(text) if found[1]), "")


def _with_mark(text: str, taken: set[str]) -> str:
    """Mark the best letter of a text that is not taken; the text as it is where all are."""
    starts = [found.start() for found in re.finditer(r"\b\w", text)]
    for place in (*starts, *range(len(text))):
        if text[place].isalnum() and text[place].casefold() not in taken:
            return f"{text[:place]}&{text[place:]}"
    return text
