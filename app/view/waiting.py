"""The page that stands in for the mesh until there is one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import Qt, Signal, Slot
from PySide6.QtWidgets import QLabel, QPushButton, QVBoxLayout, QWidget

from app.view.ring import Ring
from app.view.theme import NORMAL
from app.wording import with_capital

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.work.threads import Failure

_RING_SIDE = 38


class WaitingPage(QWidget):
    """Says what is loading beside a turning ring, or shows why loading failed.

    Signals
    -------
    open_wanted : the user wants to open another model

    Parameters
    ----------
    document : followed until its first model is in
    parent : of the widget
    """

    open_wanted = Signal()

    def __init__(self, document: PoseDocument, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("waiting")
        self.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        self._document = document
        self._what, self._reason = "Starting", ""
        self._stopped = False
        self._ring = Ring(_RING_SIDE)
        self._words = QLabel()
        self._words.setWordWrap(True)
        self._words.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self.button = QPushButton("Open another model…")
        self.button.clicked.connect(self.open_wanted)
        column = QVBoxLayout(self)
        column.setSpacing(NORMAL)
        column.addStretch(46)
        column.addWidget(self._ring, alignment=Qt.AlignmentFlag.AlignHCenter)
        column.addWidget(self._words)
        column.addWidget(self.button, alignment=Qt.AlignmentFlag.AlignHCenter)
        column.addStretch(54)
        self._wait()
        document.tasks.busy_changed.connect(self.set_text)
        document.failed.connect(self._on_failed)
        self.set_text(document.tasks.busy)

    @property
    def text(self) -> str:
        """What is loading and why it takes long, or the error."""
        return self._words.text()

    @property
    def turns(self) -> bool:
        """Whether something is loading."""
        return self._ring.turns

    @Slot(str)
    def set_text(self, text: str) -> None:
        """Say what is loading; "" changes nothing."""
        if text and not self._stopped:
            self._what = text
            self._wait()

    @Slot(str)
    def explain(self, reason: str) -> None:
        """Say why loading takes long."""
        self._reason = reason
        if self.turns:
            self._wait()

    def stop(self) -> None:
        """Stop the ring for good."""
        self._stopped = True
        self._ring.stop()

    def _wait(self) -> None:
        self._words.setText(f"{self._what}…\n{self._reason}".rstrip())
        self.button.hide()
        self._ring.start()

    @Slot(object)
    def _on_failed(self, failure: Failure) -> None:
        if self._stopped or self._document.has_model:
            return
        self._ring.stop()
        self._words.setText(f"{with_capital(failure.headline)}; open another model.")
        self.button.show()
