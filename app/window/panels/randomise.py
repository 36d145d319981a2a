"""A random pose: how far to go towards it, and which one."""

from __future__ import annotations

from PySide6.QtCore import Qt, Signal, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QHBoxLayout, QPushButton

from app.view.icons import give_icon
from app.view.theme import CLOSE
from app.window.number_box import QuietIntegerBox
from app.window.widgets import Card, Slider, labelled

_LARGEST_SEED = 999_999
_SEED_WIDTH = 76


class RandomiseCard(Card):
    """Amount and seed; the seed counts up, so that each press draws another pose.

    Signals
    -------
    wanted : float and int, amount from 0 to 1 and seed
    refused : str, why a seed that was typed is not taken

    Parameters
    ----------
    action : the menu's, which the button triggers
    amount : from 0 to 1, at the start
    """

    wanted = Signal(float, int)
    refused = Signal(str)

    def __init__(self, action: QAction, amount: float) -> None:
        super().__init__()
        self._action = action
        self.amount = Slider()
        self.amount.setRange(1, 100)
        self.amount.setPageStep(10)
        self.amount.setValue(round(100 * amount))
        self.amount.setAccessibleName("Amount")
        self.amount.setToolTip("How far to go to the random pose: 100 % replaces the current pose")
        self._percent = labelled("", "caption")
        self._percent.setMinimumWidth(self.fontMetrics().horizontalAdvance("100 %"))
        self._percent.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.seed = QuietIntegerBox()
        self.seed.setMinimumWidth(_SEED_WIDTH)
        self.seed.setRange(0, _LARGEST_SEED)
        self.seed.setAccessibleName("Seed")
        self.seed.setToolTip("The same seed gives the same random pose; it counts up by itself")
        self.button = QPushButton("Randomise")
        self.button.setToolTip(action.toolTip())
        give_icon(self.button, "random")
        for widgets in (
            (labelled("Amount", "caption"), self.amount, self._percent),
            (labelled("Seed", "caption"), self.seed, self.button),
        ):
            row = QHBoxLayout()
            row.setSpacing(CLOSE)
            for widget in widgets:
                row.addWidget(widget, 1 if widget in (self.amount, self.button) else 0)
            self.column.addLayout(row)
        self.amount.valueChanged.connect(self._on_amount)
        self.button.clicked.connect(action.trigger)
        self.seed.refused.connect(self.refused)
        self._on_amount(self.amount.value())

    def draw(self) -> None:
        """Ask for the next random pose."""
        self.wanted.emit(self.amount.value() / 100, self.seed.value())
        self.seed.setValue((self.seed.value() + 1) % (_LARGEST_SEED + 1))

    @Slot(int)
    def _on_amount(self, percent: int) -> None:
        self._percent.setText(f"{percent} %")
