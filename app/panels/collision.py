"""The right panel: what is predicted, what is true, and Resolve."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import Signal
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QVBoxLayout, QWidget

from app.panels.exact import ExactCard
from app.panels.parts import scrolling
from app.panels.prediction import PredictionCard
from app.panels.resolve import ResolveCard
from app.theme import CLOSE, NORMAL, TIGHT

if TYPE_CHECKING:
    from app.document import PoseDocument


class CollisionPanel(QWidget):
    """Three cards, one below the other.

    Signals
    -------
    domain_hovered : int or None, the domain of the row that the pointer is on

    Parameters
    ----------
    document : followed and changed
    resolve_action : what the button of Resolve triggers
    """

    domain_hovered = Signal(object)

    def __init__(self, document: PoseDocument, resolve_action: QAction) -> None:
        super().__init__()
        self.prediction = PredictionCard(document)
        self.exact = ExactCard(document)
        self.resolve = ResolveCard(document, resolve_action)
        page = QWidget()
        cards = QVBoxLayout(page)
        cards.setContentsMargins(NORMAL, TIGHT, NORMAL, CLOSE)
        cards.setSpacing(CLOSE)
        for card in (self.prediction, self.exact, self.resolve):
            cards.addWidget(card)
        cards.addStretch()
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(scrolling(page))
        self.prediction.domain_hovered.connect(self.domain_hovered)

    def refresh_icons(self) -> None:
        """Draw all signs in the theme that has come."""
        for card in (self.prediction, self.exact, self.resolve):
            card.refresh_icons()
