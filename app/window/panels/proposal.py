"""Where nearly every pose of a character collides: the rules that would change that, offered."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import Signal, Slot
from PySide6.QtWidgets import QPushButton

from app.window.widgets import Card, hbox, labelled
from app.wording import counted

if TYPE_CHECKING:
    from app.editing.document import PoseDocument

_LISTED = 12
"""Most pairs of names that are listed."""


class ProposalCard(Card):
    """Offers to leave out places that touch in nearly every pose; hidden where there are none.

    They are listed, and tinted in the view, from the beginning. An answer is remembered for the
    character.

    Parameters
    ----------
    document : its proposed rules are shown, and applied by a click

    Attributes
    ----------
    text, listed : what they would change, and where the places are
    ignore, dismiss : buttons

    Signals
    -------
    faces_named : faces by number to be tinted in the view, or None
    """

    faces_named = Signal(object)

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self.text, self.listed = (labelled("", "caption", wraps=True) for _ in range(2))
        self.ignore, self.dismiss = QPushButton("Ignore them"), QPushButton("Not now")
        self.ignore.clicked.connect(self._apply)
        self.ignore.setToolTip("Don't count crossings at the tinted places; all others still count")
        self.dismiss.clicked.connect(self._decline)
        self.dismiss.setToolTip("Count them, and don't ask again; Edit > Contacts has them too")
        self.column.addWidget(labelled("Places that always touch", "title"))
        self.column.addWidget(self.text)
        self.column.addWidget(self.listed)
        self.column.addLayout(hbox(self.ignore, self.dismiss, None))
        for changed in (document.tasks.rules_proposed, document.model_changed):
            changed.connect(self._show_proposed)
        document.tasks.busy_changed.connect(
            lambda: self.ignore.setEnabled(not document.tasks.changing_model)
        )
        self._show_proposed()

    @Slot()
    def _show_proposed(self) -> None:
        """List the places and have them tinted, until there is an answer."""
        from lcollision_core.meshes.contact_rules import pair_in_words

        proposed = self._document.tasks.proposed_rules
        if proposed is None or not self._document.tasks.offers_rules:
            self._end()
            return
        then = proposed.n_colliding_then
        remaining = f"{then} still would, elsewhere" if then else "none would"
        self.text.setText(
            f"{proposed.n_colliding} of {counted(proposed.n_poses, 'pose')} collide, and the "
            f"same parts touch in nearly all of them. With "
            f"{counted(len(proposed.new), 'such place')} not counted, {remaining}."
        )
        lines = [
            f"{pair_in_words(pair)}: {counted(n, 'place')}" for pair, n in proposed.places.items()
        ]
        more = [f"and {len(lines) - _LISTED} more"] if len(lines) > _LISTED else []
        self.listed.setText("\n".join([*lines[:_LISTED], *more]))
        self.show()
        self.faces_named.emit(proposed.faces)

    @Slot()
    def _end(self) -> None:
        self.hide()
        self.faces_named.emit(None)

    @Slot()
    def _decline(self) -> None:
        self._end()
        self._document.tasks.decline_offer()

    @Slot()
    def _apply(self) -> None:
        proposed = self._document.tasks.proposed_rules
        if proposed is not None:
            self._end()
            self._document.tasks.set_rules(proposed.rules)
