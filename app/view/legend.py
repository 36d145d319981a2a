"""What explains the mesh: the legend beneath it, and the name of the domain under the pointer."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QEvent, QPointF, QRectF, QSize, Qt
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
from PySide6.QtWidgets import QSizePolicy, QWidget

from app.view.shading import Legend
from app.view.theme import CLOSE, NORMAL, RADIUS, TIGHT, WIDE, current_theme
from app.view.waiting import BACKGROUND

_SWATCH = 11
_RAMP_WIDTHS, _RAMP_HEIGHT = (168, 132, 100), 10
_OPACITY = 225


class LegendStrip(QWidget):
    """Explains the colours beneath the mesh, in blocks that go on below where a row is full.

    Its height is kept while only numbers change, so that the mesh beside it stays in its place.

    Parameters
    ----------
    parent : beneath whose mesh it lies
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self._legend = Legend()
        self._n_rows = 1

    @property
    def legend(self) -> Legend:
        """What is explained now."""
        return self._legend

    def set_legend(self, legend: Legend) -> None:
        """Explain something else."""
        if legend == self._legend:
            return
        is_other = legend.title != self._legend.title
        self._legend = legend
        self.setAccessibleName(" ".join((legend.title, legend.note)))
        self._fit(anew=is_other)
        self.update()

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the size that all rows need."""
        return QSize(0, round(self._n_rows * (self._row_height() + CLOSE) + CLOSE))

    def minimumSizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Allow any width."""
        return self.sizeHint()

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Fit the blocks into the width that there is."""
        super().resizeEvent(event)
        if event.size().width() != event.oldSize().width():
            self._fit(anew=True)

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Fit another font."""
        super().changeEvent(event)
        if event.type() in (QEvent.Type.FontChange, QEvent.Type.ApplicationFontChange):
            self._fit(anew=True)

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the blocks on what is the foot of the mesh's background."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.fillRect(self.rect(), QColor(BACKGROUND[current_theme().is_dark][0]))
        if self._legend.title:
            for draw, place in self._placed():
                draw(painter, place)
        painter.end()

    def _fit(self, anew: bool) -> None:
        """Take the rows that are needed; unless `anew`, no fewer than before."""
        rows = {place.y() for _, place in self._placed()} if self._legend.title else set()
        needed = max(1, len(rows), 1 if anew else self._n_rows)
        if needed != self._n_rows:
            self._n_rows = needed
            self.updateGeometry()

    def _placed(self) -> list[tuple[Callable[[QPainter, QRectF], None], QRectF]]:
        """Return what draws each block and where it stands: in few rows, the scale as wide then."""
        tried = [self._flowed(ramp_width) for ramp_width in _RAMP_WIDTHS]
        return min(tried, key=lambda placed: placed[-1][1].y())

    def _flowed(self, ramp_width: float) -> list[tuple[Callable[[QPainter, QRectF], None], QRectF]]:
        height = self._row_height()
        x, y = float(NORMAL), float(CLOSE)
        placed = []
        for width, draw in self._blocks(ramp_width):
            if x > NORMAL and x + width > self.width() - CLOSE:
                x, y = float(NORMAL), y + height + CLOSE
            # In a row of its own, no wider than that is.
            shown = min(width, self.width() - CLOSE - x)
            placed.append((draw, QRectF(x, y, shown, height)))
            x += width + WIDE
        return placed

    def _blocks(self, ramp_width: float) -> list[tuple[float, Callable[[QPainter, QRectF], None]]]:
        title, text = self._fonts()
        wide, line = QFontMetricsF(title), QFontMetricsF(text)
        legend = self._legend
        words = max(wide.horizontalAdvance(legend.title), line.horizontalAdvance(legend.note))
        blocks: list[tuple[float, Callable[[QPainter, QRectF], None]]] = [
            (words + 1.0, self._draw_words)
        ]
        if legend.ramp:
            blocks.append((ramp_width + self._beyond(), self._draw_ramp))
        if legend.swatches:
            longest = max(line.horizontalAdvance(name) for name, _ in legend.swatches)
            blocks.append((_SWATCH + CLOSE + longest + 1.0, self._draw_swatches))
        return blocks

    def _beyond(self) -> float:
        """Return how far the last number reaches beyond the scale; short words end with it."""
        ticks = self._legend.ticks
        width = QFontMetricsF(self._fonts()[1]).horizontalAdvance(ticks[-1][1])
        return 0.5 * width if len(ticks) > 2 else 0.0

    def _draw_words(self, painter: QPainter, place: QRectF) -> None:
        theme = current_theme()
        title, text = self._fonts()
        half = 0.5 * place.height()
        for words, font, colour, top in (
            (self._legend.title, title, theme.text, place.top()),
            (self._legend.note, text, theme.muted, place.top() + half),
        ):
            painter.setFont(font)
            painter.setPen(QColor(colour))
            row = QRectF(place.left(), top, place.width(), half)
            painter.drawText(row, Qt.AlignmentFlag.AlignVCenter, words)

    def _draw_ramp(self, painter: QPainter, place: QRectF) -> None:
        _, font = self._fonts()
        half = 0.5 * place.height()
        top = place.top() + 0.5 * (half - _RAMP_HEIGHT)
        bar = QRectF(place.left(), top, place.width() - self._beyond(), _RAMP_HEIGHT)
        gradient = QLinearGradient(bar.topLeft(), bar.topRight())
        for step, colour in enumerate(self._legend.ramp):
            gradient.setColorAt(step / (len(self._legend.ramp) - 1), QColor(colour))
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(gradient)
        painter.drawRoundedRect(bar, 3, 3)
        painter.setFont(font)
        painter.setPen(QColor(current_theme().muted))
        line = QFontMetricsF(font)
        for share, words in self._legend.ticks:
            width = line.horizontalAdvance(words)
            flush = 1.0 if share == 1.0 and len(self._legend.ticks) == 2 else 0.5
            left = bar.left() + share * bar.width() - (0.0 if share == 0.0 else flush) * width
            row = QRectF(left, place.top() + half, width + 2, half)
            painter.drawText(row, Qt.AlignmentFlag.AlignVCenter, words)

    def _draw_swatches(self, painter: QPainter, place: QRectF) -> None:
        _, font = self._fonts()
        painter.setFont(font)
        height = 0.5 * place.height()
        for number, (name, colour) in enumerate(self._legend.swatches):
            top = place.top() + number * height
            painter.setPen(Qt.PenStyle.NoPen)
            painter.setBrush(QColor(colour))
            square = QRectF(place.left(), top + 0.5 * (height - _SWATCH), _SWATCH, _SWATCH)
            painter.drawRoundedRect(square, 3, 3)
            painter.setPen(QColor(current_theme().text))
            row = QRectF(square.right() + CLOSE, top, place.width(), height)
            painter.drawText(row, Qt.AlignmentFlag.AlignVCenter, name)

    def _fonts(self) -> tuple[QFont, QFont]:
        title = QFont(self.font())
        title.setBold(True)
        text = QFont(self.font())
        text.setPointSizeF(0.92 * text.pointSizeF())
        return title, text

    def _row_height(self) -> float:
        return 2.0 * QFontMetricsF(self._fonts()[0]).height()


class DomainTag(QWidget):
    """Names the domain under the pointer, beside it.

    Parameters
    ----------
    parent : over which it lies
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self._parent = parent
        self.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self._name, self._colour = "", ""
        self.hide()

    @property
    def name(self) -> str:
        """The name that is shown, or "" while hidden."""
        return self._name if not self.isHidden() else ""

    def point_at(self, place: QPointF, name: str, colour: str) -> None:
        """Show a domain's name beside a place of the parent."""
        if (name, colour) != (self._name, self._colour):
            self._name, self._colour = name, colour
            line = QFontMetricsF(self.font())
            width = line.horizontalAdvance(name) + _SWATCH + CLOSE + 2 * CLOSE
            self.resize(round(width), round(line.height() + 2 * TIGHT))
            self.update()
        x = min(place.x() + 16.0, self._parent.width() - self.width() - TIGHT)
        y = min(place.y() + 16.0, self._parent.height() - self.height() - TIGHT)
        self.move(round(x), round(y))
        self.show()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the tag."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        _draw_card(painter, QRectF(self.rect()))
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(QColor(self._colour))
        painter.drawRoundedRect(
            QRectF(CLOSE, 0.5 * (self.height() - _SWATCH), _SWATCH, _SWATCH), 3, 3
        )
        painter.setPen(QColor(current_theme().text))
        place = QRectF(2 * CLOSE + _SWATCH, 0, self.width(), self.height())
        painter.drawText(place, Qt.AlignmentFlag.AlignVCenter, self._name)
        painter.end()


def _draw_card(painter: QPainter, area: QRectF) -> None:
    theme = current_theme()
    fill = QColor(theme.card)
    fill.setAlpha(_OPACITY)
    painter.setBrush(fill)
    painter.setPen(QPen(QColor(theme.border), 1.0))
    painter.drawRoundedRect(area.adjusted(0.5, 0.5, -0.5, -0.5), RADIUS, RADIUS)
