"""Where nearly every pose of a character collides: the rules that would change that, offered."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import Slot
from PySide6.QtWidgets import QPushButton

from app.window.widgets import Card, hbox, labelled, plain_tip
from app.wording import counted

if TYPE_CHECKING:
    from app.editing.document import PoseDocument

_LISTED = 20
"""Most pairs that the tool tip lists."""


class ProposalCard(Card):
    """Offers to ignore the groups that touch in nearly every pose; hidden where none do.

    Parameters
    ----------
    document : its proposed rules are shown, and applied by a click

    Attributes
    ----------
    text : what they would change
    ignore, dismiss : buttons
    """

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self.text = labelled("", "caption", wraps=True)
        self.ignore, self.dismiss = QPushButton("Ignore them"), QPushButton("Not now")
        self.ignore.clicked.connect(self._apply)
        self.dismiss.clicked.connect(self.hide)
        self.dismiss.setToolTip("Edit > Contacts proposes them again")
        self.column.addWidget(labelled("Parts that always touch", "title"))
        self.column.addWidget(self.text)
        self.column.addLayout(hbox(self.ignore, self.dismiss, None))
        for changed in (document.rules_proposed, document.model_changed):
            changed.connect(self._show_proposed)
        document.busy_changed.connect(lambda: self.ignore.setEnabled(not document.changing_model))
        self._show_proposed()

    @Slot()
    def _show_proposed(self) -> None:
        from lcollision_core.meshes.contact_rules import pair_in_words

        proposed = self._document.proposed_rules
        self.setVisible(proposed is not None)
        if proposed is None:
            return
        held = self._document.model.rules.ignored
        new = [pair for pair in proposed.rules.ignored if pair not in held]
        then = proposed.n_colliding_then
        self.text.setText(
            f"{proposed.n_colliding} of {counted(proposed.n_poses, 'pose')} collide, as the same "
            f"parts touch in nearly all of them. With {counted(len(new), 'such pair')} not "
            f"counted, {then or 'none'} would."
        )
        listed = map(pair_in_words, new[:_LISTED])
        more = [f"and {len(new) - _LISTED} more"] if len(new) > _LISTED else []
        self.ignore.setToolTip(plain_tip("\n".join(["Don't count contacts of", *listed, *more])))

    @Slot()
    def _apply(self) -> None:
        proposed = self._document.proposed_rules
        if proposed is not None:
            self.hide()
            self._document.set_rules(proposed.rules)
