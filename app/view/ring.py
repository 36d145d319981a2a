"""A ring that turns while something of unknown length is done."""

from __future__ import annotations

from PySide6.QtCore import QRectF, Qt, QTimer, Slot
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QWidget

from app.view.icons import pixmap
from app.view.theme import current_theme

_TURN_MILLISECONDS, _DEGREES_PER_STEP = 100, 33
"""Each step composes the whole window anew, which without a graphics card takes both cores from
what is waited for."""

_ARC = 100
_SIDE_PER_WIDTH = 11.0


class Ring(QWidget):
    """A ring that turns, and once it is stopped a sign of warning.

    Parameters
    ----------
    side : pixels
    """

    def __init__(self, side: int) -> None:
        super().__init__()
        self.setFixedSize(side, side)
        self._angle = 0
        self._timer = QTimer(self, interval=_TURN_MILLISECONDS)
        self._timer.timeout.connect(self._on_turn)

    @property
    def turns(self) -> bool:
        """Whether it turns."""
        return self._timer.isActive()

    def start(self) -> None:
        """Turn until it is stopped."""
        self._timer.start()

    def stop(self) -> None:
        """Stop turning."""
        self._timer.stop()
        self.update()

    @Slot()
    def _on_turn(self) -> None:
        self._angle = (self._angle + _DEGREES_PER_STEP) % 360
        self.update()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the ring or the sign."""
        theme, painter, side = current_theme(), QPainter(self), self.width()
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        if not self.turns:
            sign = pixmap("warning", theme.colliding, side, self.devicePixelRatioF())
            painter.drawPixmap(0, 0, sign)
            return
        width = side / _SIDE_PER_WIDTH
        inset = 0.5 * width
        ring = QRectF(self.rect()).adjusted(inset, inset, -inset, -inset)
        painter.setPen(QPen(QColor(theme.track), width))
        painter.drawEllipse(ring)
        painter.setPen(
            QPen(QColor(theme.accent), width, Qt.PenStyle.SolidLine, Qt.PenCapStyle.RoundCap)
        )
        painter.drawArc(ring, -16 * self._angle, 16 * _ARC)
