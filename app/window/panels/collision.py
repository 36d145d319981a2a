"""The right panel: the exact check, beneath it the estimate, and Resolve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt, QTimer, Signal, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QWidget

from app.view.theme import CLOSE, ROW_HEIGHT, TIGHT
from app.window.panels.dock import Docking
from app.window.panels.exact import ExactCard
from app.window.panels.prediction import PredictionCard
from app.window.panels.proposal import ProposalCard
from app.window.panels.resolve import OutcomeCard, ResolveCard
from app.window.widgets import scrolling, vbox

if TYPE_CHECKING:
    from app.editing.document import PoseDocument

_MIN_WIDTH = 250
"""Width that shows every card beside a scroll bar."""


class CollisionPanel(QWidget):
    """Cards, one below the other; the headline and Resolve, at the ends, are always in sight.

    Signals
    -------
    domain_hovered : int or None, the domain of the row that the pointer is on
    faces_named : faces by number that are to be seen in the view, or None
    places_named : (2, 3) array, two places that are to be looked at

    Parameters
    ----------
    document : followed and changed
    actions : of commands, by key: what buttons trigger
    """

    domain_hovered = Signal(object)
    faces_named = Signal(object)
    places_named = Signal(object)

    docking = Docking(
        "collision",
        "&Collisions",
        "Ctrl+Alt+2",
        "Show or hide the check, the estimate and Resolve",
        Qt.DockWidgetArea.RightDockWidgetArea,
        (0.22, 312, 380),
    )

    def __init__(self, document: PoseDocument, actions: Mapping[str, QAction]) -> None:
        super().__init__()
        self._document = document
        self.setMinimumWidth(_MIN_WIDTH)
        self.exact = ExactCard(document)
        self.proposal = ProposalCard(document)
        self.prediction = PredictionCard(document, actions["learn_character"])
        self.resolve = ResolveCard(document, actions["resolve"], actions["resolve_options"])
        self.outcome = OutcomeCard(document)
        page = QWidget()
        margins = (CLOSE, 0, CLOSE, 0)
        page.setLayout(vbox(self.proposal, self.prediction, self.outcome, None, margins=margins))
        self._area = scrolling(page)
        # In a low window it gives way to what is always in sight.
        self._area.setMinimumHeight(ROW_HEIGHT - TIGHT)
        headline = vbox(self.exact, margins=(CLOSE, TIGHT, CLOSE, 0))
        remedy = vbox(self.resolve, margins=(CLOSE, 0, CLOSE, CLOSE))
        self.setLayout(vbox(headline, self._area, remedy))
        self.exact.places_named.connect(self.places_named)
        for card in (self.exact, self.proposal):
            card.faces_named.connect(self.faces_named)
        self.prediction.domain_hovered.connect(self.domain_hovered)
        document.history.outcome_changed.connect(self._on_outcome)

    @Slot()
    def _on_outcome(self) -> None:
        if self._document.history.state.outcome is not None:
            # Not before it has been laid out.
            QTimer.singleShot(0, self, self._scroll_to_outcome)

    @Slot()
    def _scroll_to_outcome(self) -> None:
        """Show the whole result of Resolve, or its beginning if there is no space for all."""
        self._area.ensureWidgetVisible(self.outcome, 0, CLOSE)
        self._area.ensureWidgetVisible(self.outcome.exactly_free, 0, CLOSE)
