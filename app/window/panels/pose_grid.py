"""A grid of pictures with names: as many rows as fit, names on two lines."""

from __future__ import annotations

from PySide6.QtCore import QModelIndex, QObject, QPersistentModelIndex, QSize, Qt, Signal
from PySide6.QtWidgets import (
    QAbstractItemView,
    QListWidget,
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

    Signals
    -------
    picture_wanted : int, a row in sight that has no picture yet

    Attributes
    ----------
    hint : what is shown where there is no picture
    """

    picture_wanted = Signal(int)

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
        self.setWordWrap(True)
        delegate = _CellDelegate(self._cell, self)
        delegate.picture_wanted.connect(self.picture_wanted)
        self.setItemDelegate(delegate)
        self.setVerticalScrollMode(QListWidget.ScrollMode.ScrollPerPixel)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setContextMenuPolicy(Qt.ContextMenuPolicy.CustomContextMenu)
        self.hint = labelled("", "caption", wraps=True)
        self.hint.setAlignment(Qt.AlignmentFlag.AlignCenter)
        QVBoxLayout(self.viewport()).addWidget(self.hint)

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for one row of pictures."""
        return QSize(400, self._cell.height() + CLOSE)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """Allow a width of one picture."""
        return QSize(self._cell.width() + 20, self._cell.height() + TIGHT)


class _CellDelegate(QStyledItemDelegate):
    """Draws a picture with its name beneath, on as many lines as fit.

    Parameters
    ----------
    cell : size of both together
    """

    picture_wanted = Signal(int)

    def __init__(self, cell: QSize, parent: QObject) -> None:
        super().__init__(parent)
        self._cell = cell

    def initStyleOption(  # noqa: N802
        self, option: QStyleOptionViewItem, index: QModelIndex | QPersistentModelIndex
    ) -> None:
        """Begin the name right beneath the picture; also names of files break into lines."""
        super().initStyleOption(option, index)
        option.displayAlignment = Qt.AlignmentFlag.AlignHCenter | Qt.AlignmentFlag.AlignTop
        if option.icon.isNull():
            option.features |= QStyleOptionViewItem.ViewItemFeature.HasDecoration
            self.picture_wanted.emit(index.row())
        option.text = option.text.replace("_", "_\u200b")

    def sizeHint(  # noqa: N802
        self,
        option: QStyleOptionViewItem,  # noqa: ARG002
        index: QModelIndex | QPersistentModelIndex,  # noqa: ARG002
    ) -> QSize:
        """Take the whole cell, so that what is chosen is marked with its name."""
        return self._cell
