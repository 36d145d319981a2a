"""A grid of pictures with names: as many rows as there is room, names on two lines."""

from __future__ import annotations

from PySide6.QtCore import QModelIndex, QObject, QPersistentModelIndex, QRect, QSize, Qt
from PySide6.QtGui import QFontMetrics, QIcon, QPainter
from PySide6.QtWidgets import (
    QAbstractItemView,
    QListWidget,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QVBoxLayout,
)

from app.view.theme import CLOSE, TIGHT
from app.window.widgets import labelled

THUMBNAIL = 88
"""Side of a picture, in device-independent pixels."""

_BESIDE = 5
"""Pixels on either side of a picture that the name takes too."""
_LINES = 2


class PoseGrid(QListWidget):
    """Pictures of poses with their names beneath, from left to right in rows.

    Attributes
    ----------
    hint : what is shown where there is no picture
    """

    def __init__(self) -> None:
        super().__init__()
        self.setViewMode(QListWidget.ViewMode.IconMode)
        self.setFlow(QListWidget.Flow.LeftToRight)
        self.setResizeMode(QListWidget.ResizeMode.Adjust)
        self.setMovement(QListWidget.Movement.Static)
        self.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.setIconSize(QSize(THUMBNAIL, THUMBNAIL))
        names = _LINES * self.fontMetrics().lineSpacing()
        self._cell = QSize(THUMBNAIL + 2 * _BESIDE, THUMBNAIL + names + 3 * TIGHT)
        self.setGridSize(self._cell)
        self.setUniformItemSizes(True)
        self.setItemDelegate(_PoseDelegate(self._cell, self))
        self.setVerticalScrollMode(QListWidget.ScrollMode.ScrollPerPixel)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setContextMenuPolicy(Qt.ContextMenuPolicy.CustomContextMenu)
        self.hint = labelled("", "caption")
        self.hint.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self.hint.setWordWrap(True)
        QVBoxLayout(self.viewport()).addWidget(self.hint)

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for one row of pictures."""
        return QSize(400, self._cell.height() + CLOSE)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """Manage with one picture."""
        return QSize(self._cell.width() + 20, self._cell.height() + TIGHT)


class _PoseDelegate(QStyledItemDelegate):
    """Draws a picture, and its name on as many lines as it needs, at most two.

    Parameters
    ----------
    cell : size of both together
    """

    def __init__(self, cell: QSize, parent: QObject) -> None:
        super().__init__(parent)
        self._cell = cell

    def sizeHint(  # noqa: N802
        self,
        option: QStyleOptionViewItem,  # noqa: ARG002
        index: QModelIndex | QPersistentModelIndex,  # noqa: ARG002
    ) -> QSize:
        """Take the whole cell, so that what is chosen is marked with its name."""
        return self._cell

    def paint(
        self,
        painter: QPainter,
        option: QStyleOptionViewItem,
        index: QModelIndex | QPersistentModelIndex,
    ) -> None:
        """Draw what the style draws behind an item, the picture and the name."""
        held = QStyleOptionViewItem(option)
        self.initStyleOption(held, index)
        name, icon = held.text, QIcon(held.icon)
        held.text, held.icon = "", QIcon()
        held.features &= ~QStyleOptionViewItem.ViewItemFeature.HasDecoration
        held.rect = option.rect.adjusted(2, 1, -2, -1)
        style = held.widget.style()
        style.drawControl(QStyle.ControlElement.CE_ItemViewItem, held, painter, held.widget)
        area = held.rect
        left = area.left() + (area.width() - THUMBNAIL) // 2
        icon.paint(painter, QRect(left, area.top() + TIGHT, THUMBNAIL, THUMBNAIL))
        painter.setPen(held.palette.color(held.palette.ColorRole.Text))
        top = area.top() + TIGHT + THUMBNAIL + 2
        for line in lines_of(name, held.fontMetrics, area.width() - 2 * TIGHT):
            place = QRect(area.left(), top, area.width(), held.fontMetrics.lineSpacing())
            painter.drawText(place, Qt.AlignmentFlag.AlignHCenter, line)
            top += held.fontMetrics.lineSpacing()


def lines_of(name: str, metrics: QFontMetrics, width: int) -> list[str]:
    """Break a name into at most two lines, at a space where there is one; the rest is elided."""
    if metrics.horizontalAdvance(name) <= width:
        return [name]
    lengths = range(len(name), 1, -1)
    fits = next((n for n in lengths if metrics.horizontalAdvance(name[:n]) <= width), 1)
    space = name.rfind(" ", 0, fits + 1)
    cut = space if space > 0 else fits
    rest = name[cut:].strip()
    return [name[:cut], metrics.elidedText(rest, Qt.TextElideMode.ElideRight, width)]
