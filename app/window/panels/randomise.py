"""A random pose: how far to go towards it, and which one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QToolButton, QWidget

from app.view.theme import ICON_SIZE, TIGHT
from app.window.number_box import NumberBox
from app.window.widgets import Slider, hbox, labelled

if TYPE_CHECKING:
    from app.editing.document import PoseDocument

_LARGEST_SEED = 999_999
_SEED_WIDTH = 54


class RandomiseRow(QWidget):
    """Amount and seed, in one line; the seed counts up, so that each press draws another pose.

    Parameters
    ----------
    document : changed
    action : the menu's, which the button triggers
    amount : from 0 to 1, at the start
    """

    def __init__(self, document: PoseDocument, action: QAction, amount: float) -> None:
        super().__init__()
        self._document = document
        self.amount = Slider()
        self.amount.setRange(1, 100)
        self.amount.setPageStep(10)
        self.amount.setValue(round(100 * amount))
        self.amount.setAccessibleName("Amount")
        self.amount.setToolTip("How far to go to the random pose: 100 % replaces the current pose")
        self._percent = labelled("", "caption")
        self._percent.setMinimumWidth(self.fontMetrics().horizontalAdvance("100 %"))
        self._percent.setContentsMargins(0, 0, TIGHT, 0)
        self._percent.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.seed = NumberBox(0, 0, _LARGEST_SEED)
        self.seed.setFixedWidth(_SEED_WIDTH)
        self.seed.setAccessibleName("Seed")
        self.seed.setToolTip("The same seed gives the same random pose; it increases by itself")
        self.seed.setButtonSymbols(NumberBox.ButtonSymbols.NoButtons)
        self.button = QToolButton()
        self.button.setDefaultAction(action)
        self.button.setIconSize(QSize(ICON_SIZE, ICON_SIZE))
        line = hbox(
            *(self.button, self.amount, self._percent, labelled("Seed", "caption"), self.seed),
            wide=self.amount,
            spacing=TIGHT,
        )
        self.setLayout(line)
        self.amount.valueChanged.connect(lambda percent: self._percent.setText(f"{percent} %"))
        self.seed.refused.connect(document.message)
        self.amount.valueChanged.emit(self.amount.value())

    def draw(self) -> None:
        """Take the next random pose."""
        seed = int(self.seed.value())
        self._document.motion.randomise(self.amount.value() / 100, seed)
        self.seed.setValue((seed + 1) % (_LARGEST_SEED + 1))
