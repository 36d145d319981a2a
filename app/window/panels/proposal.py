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

    They are listed and tinted in the view before they can be left out.

    Parameters
    ----------
    document : its proposed rules are shown, and applied by a click

    Attributes
    ----------
    text, listed : what they would change, and where the places are
    show_them, ignore, dismiss : buttons

    Signals
    -------
    faces_named : faces by number to be tinted in the view, or None
    """

    faces_named = Signal(object)

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self.text, self.listed = (labelled("", "caption", wraps=True) for _ in range(2))
        self.show_them, self.ignore = QPushButton("Show them"), QPushButton("Ignore them")
        self.dismiss = QPushButton("Not now")
        self.show_them.clicked.connect(self._on_show)
        self.ignore.clicked.connect(self._apply)
        self.ignore.setToolTip("Don't count crossings at the tinted places; all others still count")
        self.dismiss.clicked.connect(self._end)
        self.dismiss.setToolTip("Edit > Contacts has them too")
        self.column.addWidget(labelled("Places that always touch", "title"))
        self.column.addWidget(self.text)
        self.column.addWidget(self.listed)
        self.column.addLayout(hbox(self.show_them, self.ignore, self.dismiss, None))
        for changed in (document.tasks.rules_proposed, document.model_changed):
            changed.connect(self._show_proposed)
        document.tasks.busy_changed.connect(
            lambda: self.ignore.setEnabled(not document.tasks.changing_model)
        )
        self._show_proposed()

    @Slot()
    def _show_proposed(self) -> None:
        proposed = self._document.tasks.proposed_rules
        self._end()
        if proposed is None:
            return
        self.show()
        then = proposed.n_colliding_then
        self.text.setText(
            f"{proposed.n_colliding} of {counted(proposed.n_poses, 'pose')} collide, because the "
            f"same places touch in nearly all of them. With "
            f"{counted(len(proposed.new), 'such place')} "
            f"not counted, {then or 'none'} would."
        )
        for widget, shown in ((self.show_them, True), (self.ignore, False), (self.listed, False)):
            widget.setVisible(shown)

    @Slot()
    def _on_show(self) -> None:
        """List the places and have them tinted; now they can be left out."""
        from lcollision_core.meshes.contact_rules import pair_in_words

        proposed = self._document.tasks.proposed_rules
        if proposed is None:
            return
        places = proposed.places.items()
        lines = [f"{pair_in_words(pair)}: {counted(n, 'place')}" for pair, n in places]
        more = [f"and {len(lines) - _LISTED} more"] if len(lines) > _LISTED else []
        self.listed.setText("\n".join([*lines[:_LISTED], *more]))
        for widget, shown in ((self.show_them, False), (self.ignore, True), (self.listed, True)):
            widget.setVisible(shown)
        self.faces_named.emit(proposed.faces)

    @Slot()
    def _end(self) -> None:
        self.hide()
        self.faces_named.emit(None)

    @Slot()
    def _apply(self) -> None:
        proposed = self._document.tasks.proposed_rules
        if proposed is not None:
            self._end()
            self._document.tasks.set_rules(proposed.rules)
