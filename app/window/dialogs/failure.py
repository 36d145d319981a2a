"""What went wrong, in one sentence with what to do; the details stay folded."""

from __future__ import annotations

from PySide6.QtCore import QUrl
from PySide6.QtGui import QDesktopServices
from PySide6.QtWidgets import (
    QDialog,
    QDialogButtonBox,
    QHBoxLayout,
    QLabel,
    QPlainTextEdit,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from app.view.icons import pixmap
from app.view.theme import NORMAL, WIDE, current_theme
from app.window.widgets import labelled
from app.wording import one_line, with_capital
from app.work.log import log_file
from app.work.threads import Failure


class FailureDialog(QDialog):
    """Tells of a failure and leaves the window usable behind it.

    Parameters
    ----------
    failure : kept as an attribute
    parent : the window that it belongs to
    """

    def __init__(self, failure: Failure, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setWindowTitle("Couldn't do that")
        self.setMinimumWidth(480)
        self.failure = failure
        what, advice = map(with_capital, map(one_line, (failure.headline, failure.next_step)))
        if advice and not advice.endswith((".", "?", "!")):
            advice += "."
        sign = QLabel()
        sign.setPixmap(pixmap("warning", current_theme().colliding, 36, self.devicePixelRatioF()))
        self.what = labelled(what, "verdict")
        self.what.setWordWrap(True)
        self.advice = labelled(advice or "Nothing was changed.")
        self.advice.setWordWrap(True)
        self.details = QPlainTextEdit(failure.details or failure.headline)
        self.details.setReadOnly(True)
        self.details.setMinimumHeight(200)
        self.details.hide()
        words = QVBoxLayout()
        words.setSpacing(NORMAL)
        words.addWidget(self.what)
        words.addWidget(self.advice)
        top = QHBoxLayout()
        top.setSpacing(WIDE)
        top.addWidget(sign)
        top.addLayout(words, 1)
        self.unfold = QPushButton("Show details")
        self.unfold.setCheckable(True)
        log = QPushButton("Open log file")
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        buttons.addButton(self.unfold, QDialogButtonBox.ButtonRole.ActionRole)
        buttons.addButton(log, QDialogButtonBox.ButtonRole.ActionRole)
        for button in (self.unfold, log):
            button.setAutoDefault(False)
        buttons.button(QDialogButtonBox.StandardButton.Close).setDefault(True)
        column = QVBoxLayout(self)
        column.setContentsMargins(WIDE + 4, WIDE + 4, WIDE + 4, WIDE)
        column.setSpacing(WIDE)
        column.addLayout(top)
        column.addWidget(self.details)
        column.addWidget(buttons)
        self.unfold.toggled.connect(self._on_unfold)
        log.clicked.connect(open_log_file)
        buttons.rejected.connect(self.reject)

    def _on_unfold(self, unfolded: bool) -> None:
        self.details.setVisible(unfolded)
        self.unfold.setText("Hide details" if unfolded else "Show details")
        self.adjustSize()


def open_log_file() -> None:
    """Show the log file in whatever the desktop shows text files with."""
    path = log_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    QDesktopServices.openUrl(QUrl.fromLocalFile(str(path)))
