"""The legend of the colours, and the tag of the domain under the pointer."""

from __future__ import annotations

import html

from PySide6.QtCore import QEvent, QPointF, QRectF, QSize, Qt
from PySide6.QtGui import (
    QColor,
    QFontMetricsF,
    QLinearGradient,
    QPainter,
    QPaintEvent,
    QResizeEvent,
)
from PySide6.QtWidgets import QGridLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from app.view.shading import COLLIDING_FACE, UNCOUNTED_FACE, UNIT, Legend
from app.view.theme import CLOSE, NORMAL, TIGHT, WIDE, current_theme

_RAMP_WIDTHS, _RAMP_HEIGHT = (100, 168), 10


class LegendStrip(QWidget):
    """The legend of the colours below the view, in blocks that wrap into rows.

    While only numbers change, the number of rows does not shrink, so that the mesh stays in place.
    The strip is hidden if there is nothing to explain.

    Parameters
    ----------
    parent : of the widget
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("legend")
        self.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        self.legend = Legend()
        self._title, self._note, words = QLabel(), QLabel(), QWidget(self)
        self._title.setObjectName("title")
        self._note.setObjectName("caption")
        column = QVBoxLayout(words)
        column.setSpacing(0)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self._title)
        column.addWidget(self._note)
        self._ramp = _Ramp(self)
        self._crossing, self._uncounted = QLabel(self), QLabel(self)
        self._uncounted.setToolTip(
            "Crossing triangles that the contact rules leave out: see Edit > Contacts"
        )
        self._blocks = (words, self._ramp, self._crossing, self._uncounted)
        self._rows: list[list[QWidget]] = [[]]
        self._grid = QGridLayout(self)
        self._grid.setHorizontalSpacing(WIDE)
        self._grid.setVerticalSpacing(CLOSE)
        self._grid.setContentsMargins(NORMAL, CLOSE, CLOSE, CLOSE)
        self._grid.setColumnStretch(len(self._blocks), 1)
        self._fit()
        self.hide()

    def set_legend(self, legend: Legend) -> None:
        """Show another legend."""
        if legend == self.legend:
            return
        is_other = legend.title != self.legend.title
        self.legend = legend
        self._title.setText(legend.title)
        self._note.setText(legend.note)
        self._ramp.set_legend(legend)
        self._crossing.setText(with_swatch(legend.crossing, COLLIDING_FACE))
        self._uncounted.setText(with_swatch(legend.uncounted, UNCOUNTED_FACE))
        self.setAccessibleName(f"{legend.title} {legend.note}")
        self._fit(anew=is_other)
        self.setVisible(bool(legend.title))

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Allow any width."""
        return QSize(0, super().minimumSizeHint().height())

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Fit the blocks into the new width."""
        super().resizeEvent(event)
        if event.size().width() != event.oldSize().width():
            self._fit()

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Fit the blocks to another font."""
        super().changeEvent(event)
        if event.type() in (QEvent.Type.FontChange, QEvent.Type.ApplicationFontChange):
            self._fit()

    def _fit(self, anew: bool = True) -> None:
        """Wrap the blocks into rows; unless `anew`, no fewer than before."""
        # At least as wide as the unit: a note changes with the pose and must not add a row.
        width = self._note.fontMetrics().horizontalAdvance
        needed = max(width(self.legend.note), width(UNIT)) + 1
        self._note.setWordWrap(NORMAL + needed + CLOSE > self.width())
        self._note.setMinimumWidth(0 if self._note.wordWrap() else needed)
        rows: list[list[QWidget]] = [[]]
        used = NORMAL + CLOSE
        visible_rows = (
            True,
            bool(self.legend.ramp),
            bool(self.legend.crossing),
            bool(self.legend.uncounted),
        )
        for block, is_shown in zip(self._blocks, visible_rows, strict=True):
            if not is_shown:
                continue
            needed = block.minimumSizeHint().width()
            # A block wider than the strip is cut off.
            block.setMinimumWidth(int(NORMAL + needed + CLOSE > self.width()))
            if rows[-1] and used + needed > self.width():
                rows.append([])
                used = NORMAL + CLOSE
            rows[-1].append(block)
            used += needed + WIDE
        if not anew and len(rows) <= len(self._rows):
            return
        self._rows = rows
        for block, is_shown in zip(self._blocks, visible_rows, strict=True):
            self._grid.removeWidget(block)
            block.setVisible(is_shown)
        for row, blocks in enumerate(rows):
            for column, block in enumerate(blocks):
                self._grid.addWidget(block, row, column)
        self.updateGeometry()


class _Ramp(QWidget):
    """A colour scale above its tick labels."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("caption")
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self._legend = Legend()

    def set_legend(self, legend: Legend) -> None:
        self._legend = legend
        self.updateGeometry()
        self.update()

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        return self._size(_RAMP_WIDTHS[1])

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        return self._size(_RAMP_WIDTHS[0])

    def _size(self, width: int) -> QSize:
        return QSize(round(width + self._beyond()), 2 * self.fontMetrics().height())

    def _beyond(self) -> float:
        """Return how far the last tick label extends beyond the scale; with two ticks, 0."""
        ticks = self._legend.ticks
        return 0.5 * self.fontMetrics().horizontalAdvance(ticks[-1][1]) if len(ticks) > 2 else 0.0

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        legend = self._legend
        if not legend.ramp:
            return
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        half = 0.5 * self.height()
        bar = QRectF(0, 0.5 * (half - _RAMP_HEIGHT), self.width() - self._beyond(), _RAMP_HEIGHT)
        gradient = QLinearGradient(bar.topLeft(), bar.topRight())
        for step, colour in enumerate(legend.ramp):
            gradient.setColorAt(step / (len(legend.ramp) - 1), QColor(colour))
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(gradient)
        painter.drawRoundedRect(bar, 3, 3)
        painter.setPen(QColor(current_theme().muted))
        for position, words in legend.ticks:
            width = QFontMetricsF(self.font()).horizontalAdvance(words)
            # Centre labels at their ticks; align those at the ends with the scale.
            flush = position if position == 0.0 or len(legend.ticks) == 2 else 0.5
            area = QRectF(position * bar.width() - flush * width, half, width + 2, half)
            painter.drawText(area, Qt.AlignmentFlag.AlignVCenter, words)
        painter.end()


class DomainTag(QLabel):
    """The name of the domain under the pointer, shown beside it.

    Parameters
    ----------
    parent : widget that the tag overlays
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("tag")
        self.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.hide()

    def point_at(self, position: QPointF, name: str, colour: str) -> None:
        """Show a domain's name beside a position in the parent."""
        self.setText(with_swatch(name, colour))
        self.adjustSize()
        over = self.parentWidget()
        assert over is not None
        limit = over.rect().bottomRight() - self.rect().bottomRight()
        x = min(position.x() + 16.0, limit.x() - TIGHT)
        y = min(position.y() + 16.0, limit.y() - TIGHT)
        self.move(round(x), round(y))
        self.show()


def with_swatch(name: str, colour: str) -> str:
    """Return a name after a square of a colour, as rich text."""
    return f"<span style='color: {colour}'>&#9632;</span>&nbsp; {html.escape(name)}"
