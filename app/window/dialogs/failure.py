"""An error, in one sentence with the next step; the details are folded."""

from __future__ import annotations

from PySide6.QtCore import QUrl
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import QDialog, QDialogButtonBox, QPlainTextEdit, QPushButton, QWidget

from app.view.theme import NORMAL, WIDE
from app.window.widgets import Mnemonics, Sign, dialog_vbox, hbox, labelled, vbox
from app.work.log import log_file
from app.work.threads import Failure
from lcollision_core.tasks.words import one_line, with_capital


class FailureDialog(QDialog):
    """Shows a failure and leaves the window usable behind it.

    Parameters
    ----------
    failure : kept as an attribute
    parent : the window that it belongs to
    """

    def __init__(self, failure: Failure, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setWindowTitle("Couldn't do that")
        Mnemonics(self)
        self.setMinimumWidth(480)
        self.failure = failure
        what, advice = map(with_capital, map(one_line, (failure.headline, failure.next_step)))
        if advice and not advice.endswith((".", "?", "!")):
            advice += "."
        sign = Sign(36)
        sign.show_icon("warning", "colliding")
        self.what = labelled(what, "verdict", wraps=True)
        self.advice = labelled(advice, wraps=True)
        self.advice.setVisible(bool(advice))
        self.details = QPlainTextEdit(failure.details or failure.headline, readOnly=True)
        self.details.setMinimumHeight(200)
        self.details.hide()
        words = vbox(self.what, self.advice, spacing=NORMAL)
        top = hbox(sign, words, spacing=WIDE)
        self.unfold = QPushButton("Show details")
        self.unfold.setCheckable(True)
        log = QPushButton("Open log file")
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        buttons.addButton(self.unfold, QDialogButtonBox.ButtonRole.ActionRole)
        buttons.addButton(log, QDialogButtonBox.ButtonRole.ActionRole)
        for button in (self.unfold, log):
            button.setAutoDefault(False)
        buttons.button(QDialogButtonBox.StandardButton.Close).setDefault(True)
        self.setLayout(dialog_vbox(top, self.details, buttons))
        self.unfold.toggled.connect(self._on_unfold)
        log.clicked.connect(open_log_file)
        buttons.rejected.connect(self.reject)

    def _on_unfold(self, unfolded: bool) -> None:
        self.details.setVisible(unfolded)
        self.unfold.setText("Hide details" if unfolded else "Show details")
        self.adjustSize()


def open_log_file() -> None:
    """Show the log file with the desktop's program for text files."""
    path = log_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    QDesktopServices.openUrl(QUrl.fromLocalFile(str(path)))
