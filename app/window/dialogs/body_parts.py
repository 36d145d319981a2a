"""The dialog of the names, colours and order of a model's body parts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QSize, Qt, Signal, Slot
from PySide6.QtGui import QColor, QKeyEvent
from PySide6.QtWidgets import (
    QAbstractItemView,
    QColorDialog,
    QLineEdit,
    QListWidget,
    QListWidgetItem,
    QWidget,
)

from app.view.theme import NORMAL, ROW_HEIGHT
from app.window.dialogs.questions import Dialog, free_model_name, why_no_model_name
from app.window.widgets import described, hbox, labelled, push_button, swatch_icon, vbox, widget_of
from lcollision_core.errors import ModelFileError
from lcollision_core.tasks.changing import PartEdits

if TYPE_CHECKING:
    from lcollision_core.bodies import Body

_DOMAIN, _COLOUR = Qt.ItemDataRole.UserRole, Qt.ItemDataRole.UserRole + 1
_SWATCH = 16


class BodyPartsDialog(Dialog):
    """Edit the names and colours of body parts, and their order in the panels.

    Parameters
    ----------
    model : of the body parts
    copies : whether the changes go to a copy, as for a bundled model
    parent : window of the dialog

    Signals
    -------
    edited : PartEdits, when accepted with a change
    """

    edited = Signal(object)

    def __init__(self, model: Body, copies: bool, parent: QWidget) -> None:
        super().__init__("Body parts", parent)
        self.resize(420, 480)
        self._model = model
        self.list = described(QListWidget(), "", "Body parts")
        self.list.setIconSize(QSize(_SWATCH, _SWATCH))
        self.list.setDragDropMode(QAbstractItemView.DragDropMode.InternalMove)
        self.list.setEditTriggers(
            QAbstractItemView.EditTrigger.DoubleClicked
            | QAbstractItemView.EditTrigger.EditKeyPressed
        )
        for domain in model.domain_order:
            item = QListWidgetItem(model.domain_names[domain])
            item.setFlags(item.flags() | Qt.ItemFlag.ItemIsEditable)
            item.setFlags(item.flags() & ~Qt.ItemFlag.ItemIsDropEnabled)
            item.setData(_DOMAIN, domain)
            item.setSizeHint(QSize(0, ROW_HEIGHT + 2))
            self.list.addItem(item)
            self._put_colour(item, model.card.domain_colours[domain])
        self.list.setCurrentRow(0)
        self.rename = push_button("Rename", clicked=self.edit_name)
        self.colour = push_button("Colour…", clicked=self.choose_colour)
        self.up = push_button("Move up", clicked=lambda: self._move(-1))
        self.down = push_button("Move down", clicked=lambda: self._move(1))
        note = (
            f"“{model.name}” is bundled with the program and can't be changed: your changes go to "
            f"a copy among your models, which opens in its place with this pose."
            if copies
            else "The changes are saved in the model's file. Undo doesn't revert them."
        )
        if not model.is_trained:
            note = "The changes are remembered for this character; its file isn't changed."
        copy_label = labelled("Name of the copy", "caption")
        self.copy_name = described(QLineEdit(free_model_name(model.name, 2)), "", copy_label.text())
        copy_label.setBuddy(self.copy_name)
        copy_row = widget_of(hbox(copy_label, self.copy_name))
        copy_row.setVisible(copies)
        self.refusal = labelled("", "refusal", wraps=True)
        self.refusal.hide()
        self._copies = copies
        sides = vbox(self.rename, self.colour, self.up, self.down, None)
        middle = hbox(self.list, sides, wide=self.list, spacing=NORMAL)
        explained = labelled(note, "caption", wraps=True)
        action = "Save as a copy" if copies else "Save"
        self.save = self.lay_out(middle, explained, copy_row, self.refusal, accept=action, grows=0)
        self.list.currentRowChanged.connect(self._on_row)
        self.list.model().rowsMoved.connect(lambda: self._on_row(self.list.currentRow()))
        self._on_row(0)

    def choose(self, domain: int) -> None:
        """Select a body part in the list."""
        for row in range(self.list.count()):
            if self.list.item(row).data(_DOMAIN) == domain:
                self.list.setCurrentRow(row)

    @Slot()
    def edit_name(self) -> None:
        """Edit the name of the selected body part in place."""
        self.list.setFocus()
        self.list.editItem(self.list.currentItem())

    @Slot()
    def choose_colour(self) -> None:
        """Ask for another colour of the selected body part."""
        item = self.list.currentItem()
        before = QColor(item.data(_COLOUR))
        colour = QColorDialog.getColor(before, self, f"Colour of {item.text()}")
        if colour.isValid():
            self._put_colour(item, colour.name())

    def edits(self) -> PartEdits:
        """Return the differences from the model."""
        model, items = self._model, [self.list.item(row) for row in range(self.list.count())]
        named = {item.data(_DOMAIN): item.text().strip() for item in items}
        coloured = {item.data(_DOMAIN): item.data(_COLOUR) for item in items}
        order = tuple(item.data(_DOMAIN) for item in items)
        return PartEdits(
            {k: name for k, name in named.items() if name != model.domain_names[k]},
            {k: colour for k, colour in coloured.items() if colour != model.card.domain_colours[k]},
            order if order != model.domain_order else None,
            self.copy_name.text().strip() if self._copies else None,
        )

    def accept(self) -> None:
        """Emit the changes and close; stay open, with the reason, if they are invalid."""
        # Move the focus, to commit a name that is still being typed.
        self.save.setFocus()
        edits = self.edits()
        if not (edits.names or edits.colours or edits.order):
            super().accept()
            return
        reason = self._why_not(edits)
        self.refusal.setText(reason)
        self.refusal.setVisible(bool(reason))
        if not reason:
            super().accept()
            self.edited.emit(edits)

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802
        """Let Enter end the editing of a name, not the dialog."""
        focused = self.focusWidget()
        typing = focused is not None and (focused is self.list or self.list.isAncestorOf(focused))
        if not (typing and event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter)):
            super().keyPressEvent(event)

    def _why_not(self, edits: PartEdits) -> str:
        if edits.copy_name is not None and (reason := why_no_model_name(edits.copy_name)):
            return reason
        try:
            self._model.edit_domains(edits.names, edits.colours, edits.order)
        except ModelFileError as error:
            shared = {n for n in edits.names.values() if _count(self.list, n) > 1}
            if shared:
                return f"Two body parts are called “{sorted(shared)[0]}”; give each its own name."
            if any(not n or len(n) > 60 for n in edits.names.values()):
                return "A body part needs a name of 1 to 60 characters."
            return str(error)
        return ""

    def _put_colour(self, item: QListWidgetItem, colour: str) -> None:
        item.setData(_COLOUR, colour)
        item.setIcon(swatch_icon(colour, _SWATCH, self.devicePixelRatioF()))

    def _move(self, by: int) -> None:
        row = self.list.currentRow()
        item = self.list.takeItem(row)
        self.list.insertItem(row + by, item)
        self.list.setCurrentItem(item)

    @Slot(int)
    def _on_row(self, row: int) -> None:
        self.up.setEnabled(row > 0)
        self.down.setEnabled(0 <= row < self.list.count() - 1)


def _count(listed: QListWidget, name: str) -> int:
    return [listed.item(row).text().strip() for row in range(listed.count())].count(name)
