"""The page that stands in for the mesh until there is one."""

from __future__ import annotations

from PySide6.QtCore import QRectF, Qt, QTimer, Slot
from PySide6.QtGui import QColor, QFont, QLinearGradient, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QWidget

from app.theme import current_theme

_BACKGROUND = {False: ("#e4e8ed", "#fafbfc"), True: ("#191c21", "#343a44")}
_RADIUS = 17.0
_TURN_MILLISECONDS = 33
_DEGREES_A_TURN = 11
_ARC = 100


class WaitingPage(QWidget):
    """Says what is waited for, beside something that turns.

    Parameters
    ----------
    parent : of the widget
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self._text = "Starting"
        self._angle = 0
        self._timer = QTimer(self, interval=_TURN_MILLISECONDS)
        self._timer.timeout.connect(self._on_turn)
        self._timer.start()

    @property
    def text(self) -> str:
        """What is waited for."""
        return self._text

    @Slot(str)
    def set_text(self, text: str) -> None:
        """Say what is waited for; "" changes nothing, as there is always something."""
        if text:
            self._text = text
            self.update()

    def stop(self) -> None:
        """Stand still, for good."""
        self._timer.stop()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the page."""
        theme = current_theme()
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        bottom, top = _BACKGROUND[theme.is_dark]
        sky = QLinearGradient(0, 0, 0, self.height())
        sky.setColorAt(0.0, QColor(top))
        sky.setColorAt(1.0, QColor(bottom))
        painter.fillRect(self.rect(), sky)

        x, y = 0.5 * self.width(), 0.46 * self.height()
        ring = QRectF(x - _RADIUS, y - _RADIUS, 2 * _RADIUS, 2 * _RADIUS)
        painter.setPen(QPen(QColor(theme.track), 3.5))
        painter.drawEllipse(ring)
        painter.setPen(
            QPen(QColor(theme.accent), 3.5, Qt.PenStyle.SolidLine, Qt.PenCapStyle.RoundCap)
        )
        painter.drawArc(ring, -16 * self._angle, 16 * _ARC)

        font = QFont(self.font())
        font.setPointSizeF(1.1 * font.pointSizeF())
        painter.setFont(font)
        painter.setPen(QColor(theme.muted))
        words = QRectF(0, y + 2 * _RADIUS, self.width(), 3 * _RADIUS)
        painter.drawText(words, Qt.AlignmentFlag.AlignHCenter, f"{self._text} …")
        painter.end()

    @Slot()
    def _on_turn(self) -> None:
        self._angle = (self._angle + _DEGREES_A_TURN) % 360
        self.update()
