"""What lies over the mesh: the legend, and the name of the domain under the pointer."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QFont, QFontMetricsF, QLinearGradient, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QWidget

from app.shading import Legend
from app.theme import CLOSE, NORMAL, RADIUS, TIGHT, current_theme

_SWATCH = 11
_RAMP_WIDTH, _RAMP_HEIGHT = 168, 10
_OPACITY = 225


class LegendCard(QWidget):
    """Draws a `Legend`; as large as that needs.

    Parameters
    ----------
    parent : over which it lies
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self._legend = Legend()
        self.hide()

    @property
    def legend(self) -> Legend:
        """What is explained now."""
        return self._legend

    def set_legend(self, legend: Legend) -> None:
        """Explain something else."""
        if legend == self._legend:
            return
        self._legend = legend
        self.resize(self.sizeHint())
        self.setAccessibleName(legend.title)
        self.setVisible(bool(legend.title))
        self.update()

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Return the size that the whole legend needs."""
        title, text = self._fonts()
        wide, line = QFontMetricsF(title), QFontMetricsF(text)
        legend = self._legend
        width = max(wide.horizontalAdvance(legend.title), line.horizontalAdvance(legend.note))
        height = wide.height()
        if legend.note:
            height += line.height()
        if legend.ramp:
            beyond = 0.5 * line.horizontalAdvance(legend.ticks[-1][1])
            width = max(width, _RAMP_WIDTH + (beyond if len(legend.ticks) > 2 else 0.0))
            height += CLOSE + _RAMP_HEIGHT + TIGHT + line.height()
        if legend.swatches:
            height += CLOSE + len(legend.swatches) * self._row(line)
            longest = max(line.horizontalAdvance(name) for name, _ in legend.swatches)
            width = max(width, _SWATCH + CLOSE + longest)
        return QSize(round(width + 2 * NORMAL + 1), round(height + 2 * NORMAL))

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the card."""
        theme = current_theme()
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        _draw_card(painter, QRectF(self.rect()))
        title, text = self._fonts()
        line = QFontMetricsF(text)
        x, y = float(NORMAL), float(NORMAL)
        y = self._write(painter, x, y, self._legend.title, title, theme.text)
        if self._legend.note:
            y = self._write(painter, x, y, self._legend.note, text, theme.muted)
        if self._legend.ramp:
            y = self._draw_ramp(painter, x, y + CLOSE, text)
        painter.setFont(text)
        y += CLOSE
        for name, colour in self._legend.swatches:
            row = self._row(line)
            painter.setPen(Qt.PenStyle.NoPen)
            painter.setBrush(QColor(colour))
            painter.drawRoundedRect(QRectF(x, y + 0.5 * (row - _SWATCH), _SWATCH, _SWATCH), 3, 3)
            painter.setPen(QColor(theme.text))
            place = QRectF(x + _SWATCH + CLOSE, y, self.width(), row)
            painter.drawText(place, Qt.AlignmentFlag.AlignVCenter, name)
            y += row
        painter.end()

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Fit another font."""
        super().changeEvent(event)
        if event.type() in (QEvent.Type.FontChange, QEvent.Type.ApplicationFontChange):
            self.resize(self.sizeHint())

    def _fonts(self) -> tuple[QFont, QFont]:
        title = QFont(self.font())
        title.setBold(True)
        text = QFont(self.font())
        text.setPointSizeF(0.92 * text.pointSizeF())
        return title, text

    def _row(self, line: QFontMetricsF) -> float:
        return max(line.height(), _SWATCH) + 3.0

    def _write(
        self, painter: QPainter, x: float, y: float, words: str, font: QFont, colour: str
    ) -> float:
        painter.setFont(font)
        painter.setPen(QColor(colour))
        height = QFontMetricsF(font).height()
        painter.drawText(QRectF(x, y, self.width(), height), Qt.AlignmentFlag.AlignVCenter, words)
        return y + height

    def _draw_ramp(self, painter: QPainter, x: float, y: float, font: QFont) -> float:
        bar = QRectF(x, y, _RAMP_WIDTH, _RAMP_HEIGHT)
        gradient = QLinearGradient(bar.topLeft(), bar.topRight())
        for step, colour in enumerate(self._legend.ramp):
            gradient.setColorAt(step / (len(self._legend.ramp) - 1), QColor(colour))
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(gradient)
        painter.drawRoundedRect(bar, 3, 3)
        painter.setFont(font)
        painter.setPen(QColor(current_theme().muted))
        line = QFontMetricsF(font)
        top = bar.bottom() + TIGHT
        for place, words in self._legend.ticks:
            width = line.horizontalAdvance(words)
            middle = x + place * _RAMP_WIDTH
            # Short words end with the scale, long ones reach beyond it.
            flush = 1.0 if place == 1.0 and len(self._legend.ticks) == 2 else 0.5
            left = middle - (0.0 if place == 0.0 else flush) * width
            painter.drawText(
                QRectF(left, top, width + 2, line.height()), Qt.AlignmentFlag.AlignVCenter, words
            )
        return top + line.height()


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
