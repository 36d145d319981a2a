"""The status bar: messages, progress of long work, and the model."""

from __future__ import annotations

from PySide6.QtCore import Slot
from PySide6.QtWidgets import QProgressBar, QStatusBar, QToolButton

from app.view.theme import NORMAL, Ring
from app.window.widgets import labelled
from lcollision_core.tasks.words import one_line

_MESSAGE_MILLISECONDS = 8000
_RING_SIDE = 14


class StatusBar(QStatusBar):
    """Show messages for some seconds, and long work for as long as it lasts.

    Attributes
    ----------
    busy : label that names the work
    cancel : button beside it, for work that may be cancelled
    """

    def __init__(self) -> None:
        super().__init__()
        self._work, self._reason, self._is_measured, self._hint = "", "", False, ""
        self.busy = labelled("")
        self._bar = QProgressBar()
        self._bar.setFixedWidth(120)
        self._bar.setTextVisible(False)
        self._bar.setRange(0, 1)
        self._ring = Ring(_RING_SIDE)
        self.cancel = QToolButton()
        self.cancel.setText("Cancel")
        self.cancel.setToolTip("Cancel the export")
        self._facts = labelled("", "caption")
        for widget in (self.busy, self._ring, self._bar, self.cancel, self._facts):
            self.addPermanentWidget(widget)
        self.setSizeGripEnabled(False)
        self.setContentsMargins(NORMAL, 0, NORMAL, 0)
        self.show_busy("")

    @Slot(str)
    def tell(self, sentence: str) -> None:
        """Show a message for some seconds."""
        self.showMessage(one_line(sentence), _MESSAGE_MILLISECONDS)

    @Slot(str)
    def show_hint(self, hint: str) -> None:
        """Show a hint until another message replaces it; "" removes it."""
        if hint:
            self._hint = one_line(hint)
            self.showMessage(self._hint)
        elif self.currentMessage() == self._hint:
            self.clearMessage()

    def show_facts(self, facts: str) -> None:
        """Show facts about the model."""
        self._facts.setText(one_line(facts))

    def show_busy(self, work: str, *, may_cancel: bool = False) -> None:
        """Name the work in progress, "" for none; its progress may be shown later."""
        self.cancel.setVisible(may_cancel)
        if self._work != one_line(work):
            self._is_measured = False
        self._work = one_line(work)
        self._reason = self._reason if work else ""
        self._show()

    @Slot(int, int)
    def show_progress(self, done: int, total: int) -> None:
        """Show how many steps of the total are done."""
        if self._work:
            self._bar.setRange(0, max(1, total))
            self._bar.setValue(done)
            self._is_measured = total > 0
            self._show()

    @Slot(str)
    def explain(self, reason: str) -> None:
        """Explain why the work takes long."""
        if self._work:
            self._reason = reason
            self._show()
        else:
            self.tell(reason)

    def _show(self) -> None:
        self.busy.setText(f"{self._work}… {self._reason}".rstrip() if self._work else "")
        self.busy.setVisible(bool(self._work))
        self._bar.setVisible(bool(self._work) and self._is_measured)
        turns = bool(self._work) and not self._is_measured
        self._ring.setVisible(turns)
        if turns != self._ring.turns:
            (self._ring.start if turns else self._ring.stop)()
