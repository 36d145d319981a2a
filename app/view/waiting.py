"""The page that stands in for the mesh until there is one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import QRectF, Qt, QTimer, Signal, Slot
from PySide6.QtGui import (
    QColor,
    QFont,
    QFontMetricsF,
    QLinearGradient,
    QPainter,
    QPaintEvent,
    QPen,
    QResizeEvent,
)
from PySide6.QtWidgets import QPushButton, QWidget

from app.view.icons import pixmap
from app.view.theme import current_theme
from app.wording import with_capital

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.work.threads import Failure

BACKGROUND = {False: ("#e4e8ed", "#fafbfc"), True: ("#191c21", "#343a44")}
"""Bottom and top of the page and of the scene after it, by whether the theme is dark."""

_RADIUS = 17.0
_TURN_MILLISECONDS = 33
_DEGREES_A_TURN = 11
_ARC = 100
_WIDEST_WORDS = 520
_SIGN = 36
_WORDS = Qt.AlignmentFlag.AlignHCenter.value | Qt.TextFlag.TextWordWrap.value


class WaitingPage(QWidget):
    """Says what is waited for, beside something that turns; or why nothing is waited for any more.

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
        self._document = document
        self._text, self._reason = "Starting", ""
        self._angle = 0
        self._failed = self._stopped = False
        self.button = QPushButton("Open another model…", self)
        self.button.hide()
        self.button.clicked.connect(self.open_wanted)
        self._timer = QTimer(self, interval=_TURN_MILLISECONDS)
        self._timer.timeout.connect(self._on_turn)
        self._timer.start()
        document.busy_changed.connect(self.set_text)
        document.failed.connect(self._on_failed)
        self.set_text(document.busy)

    @property
    def text(self) -> str:
        """What is waited for and why it takes long, or what went wrong."""
        return self._text if self._failed else f"{self._text}…\n{self._reason}".rstrip()

    @property
    def turns(self) -> bool:
        """Whether something is waited for."""
        return self._timer.isActive()

    @Slot(str)
    def set_text(self, text: str) -> None:
        """Say what is waited for; "" changes nothing, as there is always something."""
        if text and not self._stopped:
            self._text, self._failed = text, False
            self.button.hide()
            self._timer.start()
            self.update()

    @Slot(str)
    def explain(self, reason: str) -> None:
        """Say why what is waited for takes long."""
        self._reason = reason
        self.update()

    @Slot(object)
    def _on_failed(self, failure: Failure) -> None:
        if self._stopped or self._document.has_model:
            return
        self._timer.stop()
        text = with_capital(failure.headline)
        self._text, self._failed = f"{text}; open another model.", True
        self._place_button()
        self.button.show()
        self.update()

    def stop(self) -> None:
        """Stand still, for good."""
        self._stopped = True
        self._timer.stop()

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Keep the button below the words."""
        super().resizeEvent(event)
        self._place_button()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the page."""
        theme = current_theme()
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        bottom, top = BACKGROUND[theme.is_dark]
        sky = QLinearGradient(0, 0, 0, self.height())
        sky.setColorAt(0.0, QColor(top))
        sky.setColorAt(1.0, QColor(bottom))
        painter.fillRect(self.rect(), sky)

        if self._failed:
            sign = pixmap("warning", theme.colliding, _SIGN, self.devicePixelRatioF())
            left, high = 0.5 * (self.width() - _SIGN), self._middle() - 0.5 * _SIGN
            painter.drawPixmap(round(left), round(high), sign)
        else:
            self._draw_ring(painter)
        painter.setFont(self._font())
        painter.setPen(QColor(theme.text if self._failed else theme.muted))
        painter.drawText(self._words(), _WORDS, self.text)
        painter.end()

    def _draw_ring(self, painter: QPainter) -> None:
        theme = current_theme()
        x, y = 0.5 * self.width(), self._middle()
        ring = QRectF(x - _RADIUS, y - _RADIUS, 2 * _RADIUS, 2 * _RADIUS)
        painter.setPen(QPen(QColor(theme.track), 3.5))
        painter.drawEllipse(ring)
        painter.setPen(
            QPen(QColor(theme.accent), 3.5, Qt.PenStyle.SolidLine, Qt.PenCapStyle.RoundCap)
        )
        painter.drawArc(ring, -16 * self._angle, 16 * _ARC)

    def _middle(self) -> float:
        return 0.46 * self.height()

    def _font(self) -> QFont:
        font = QFont(self.font())
        font.setPointSizeF(1.1 * font.pointSizeF())
        return font

    def _words(self) -> QRectF:
        """Return where the words are, as high as they need."""
        width = min(_WIDEST_WORDS, 0.9 * self.width())
        room = QRectF(0.5 * (self.width() - width), self._middle() + 2 * _RADIUS, width, 1e4)
        return QFontMetricsF(self._font()).boundingRect(room, _WORDS, self.text)

    def _place_button(self) -> None:
        self.button.adjustSize()
        left = 0.5 * (self.width() - self.button.width())
        self.button.move(round(left), round(self._words().bottom() + _RADIUS))

    @Slot()
    def _on_turn(self) -> None:
        self._angle = (self._angle + _DEGREES_A_TURN) % 360
        self.update()
