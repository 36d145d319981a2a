"""The left panel: all numbers of the pose as sliders, in groups that open and close."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QEvent, QPoint, QRectF, QSize, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QColor, QContextMenuEvent, QEnterEvent, QPainter, QPaintEvent, QPixmap
from PySide6.QtWidgets import QAbstractButton, QLineEdit, QVBoxLayout, QWidget

from app.view.icons import pixmap
from app.view.theme import CLOSE, NORMAL, TIGHT, current_theme
from app.window.panels.code_slider import CodeRow, tab_order
from app.window.panels.dock import bring_up
from app.window.widgets import fill_with, labelled, longest_name, plain_tip, scrolling
from app.wording import heading

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.model import LatentGroup

_HEADER_HEIGHT = 28


class GroupHeader(QAbstractButton):
    """The line above a group's sliders; a click or Space opens and closes it.

    Signals
    -------
    hovered : int, the group's domain, or None
    menu_wanted : QPoint, where on the screen a menu of what can be done with the part is wanted

    Parameters
    ----------
    name : of the group
    colour : of its domain, None for the whole body
    domain : index from 0, None for the whole body
    """

    hovered = Signal(object)
    menu_wanted = Signal(QPoint)

    def __init__(self, name: str, colour: str | None, domain: int | None) -> None:
        super().__init__()
        self.domain = domain
        self._colour = colour
        self._lit = False
        self._arrows: tuple[str, list[QPixmap]] | None = None
        # Not as the button's own text, in which "&" makes a shortcut.
        self._name = name
        self.setAccessibleName(name)
        self.setToolTip(plain_tip(f"Show or hide the sliders of {name.lower()}"))
        self.setCheckable(True)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setCursor(Qt.CursorShape.PointingHandCursor)
        self.setMinimumHeight(_HEADER_HEIGHT)

    @property
    def is_lit(self) -> bool:
        """Whether the viewport's pointer is on this domain."""
        return self._lit

    def set_lit(self, lit: bool) -> None:
        """Show that the viewport's pointer is on this domain."""
        if lit != self._lit:
            self._lit = lit
            self.update()

    def contextMenuEvent(self, event: QContextMenuEvent) -> None:  # noqa: N802
        """Ask for the menu."""
        self.menu_wanted.emit(event.globalPos())

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for one header's height."""
        return QSize(120, _HEADER_HEIGHT)

    def enterEvent(self, event: QEnterEvent) -> None:  # noqa: N802
        """Tell the domain."""
        self.hovered.emit(self.domain)
        super().enterEvent(event)

    def leaveEvent(self, event: QEvent) -> None:  # noqa: N802
        """Tell that the pointer left."""
        self.hovered.emit(None)
        super().leaveEvent(event)

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802
        """Draw the arrow, the domain's colour and the name."""
        theme = current_theme()
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setPen(Qt.PenStyle.NoPen)
        if self.underMouse() or self._lit:
            wash = QColor(self._colour or theme.accent)
            wash.setAlpha(60 if self._lit else 36)
            painter.setBrush(wash)
            painter.drawRoundedRect(self.rect(), 5, 5)
        if self.hasFocus():
            painter.setPen(QColor(theme.accent))
            painter.setBrush(Qt.BrushStyle.NoBrush)
            painter.drawRoundedRect(QRectF(self.rect()).adjusted(0.5, 0.5, -0.5, -0.5), 5, 5)
            painter.setPen(Qt.PenStyle.NoPen)
        middle = self.height() // 2
        painter.drawPixmap(TIGHT, middle - 7, self._arrow())
        left = TIGHT + 14 + CLOSE
        if self._colour is not None:
            fill_with(painter, QRectF(left, middle - 6, 12, 12), self._colour, 3)
            left += 12 + CLOSE
        font = self.font()
        font.setBold(True)
        painter.setFont(font)
        painter.setPen(QColor(theme.text))
        room = self.rect().adjusted(left, 0, -TIGHT, 0)
        name = painter.fontMetrics().elidedText(
            self._name, Qt.TextElideMode.ElideRight, room.width()
        )
        painter.drawText(room, Qt.AlignmentFlag.AlignVCenter | Qt.AlignmentFlag.AlignLeft, name)

    def _arrow(self) -> QPixmap:
        ink = current_theme().muted
        if self._arrows is None or self._arrows[0] != ink:
            drawn = [pixmap(name, ink, 14, self.devicePixelRatioF()) for name in ("right", "down")]
            self._arrows = (ink, drawn)
        return self._arrows[1][self.isChecked()]


class SliderGroup(QWidget):
    """One group's header and rows; the rows are made when they are first seen."""

    def __init__(self, panel: SlidersPanel, place: int, group: LatentGroup) -> None:
        super().__init__()
        self._panel = panel
        self._group = group
        self._domain = place - 1 if place else None
        self._open_before: bool | None = None
        self.rows: list[CodeRow] = []
        self.header = GroupHeader(heading(group.name), group.colour, self._domain)
        self._body = QWidget()
        self._column = QVBoxLayout(self._body)
        self._column.setContentsMargins(0, 0, 0, TIGHT)
        self._column.setSpacing(0)
        self._body.hide()
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(0)
        column.addWidget(self.header)
        column.addWidget(self._body)
        self.header.toggled.connect(self.set_open)
        self.header.hovered.connect(panel.domain_hovered)
        self.header.menu_wanted.connect(self._on_menu)

    def set_open(self, is_open: bool) -> None:
        """Show or hide the rows."""
        if is_open and not self.rows:
            self._make_rows()
        self._body.setVisible(is_open)
        self.header.setChecked(is_open)

    def show_matching(self, words: str) -> bool:
        """Show only rows whose name, with that of their group, holds all of the words.

        Parameters
        ----------
        words : in lower case; "" shows all rows, and opens or closes the group as it was before

        Returns
        -------
        found : whether a row is left
        """
        if not words:
            for row in self.rows:
                row.setVisible(True)
            if self._open_before is not None:
                self.set_open(self._open_before)
            self._open_before = None
            self.setVisible(True)
            return True
        if self._open_before is None:
            self._open_before = self.header.isChecked()
        hits = []
        for place in range(len(self._group.code_names)):
            # By the number of before as well.
            own = self._panel.document.model.code_names[self._group.codes.start + place]
            name = f"{self._group.name} {own} {self._group.full_name(place)}".casefold()
            hits.append(all(word in name for word in words.split()))
        self.setVisible(any(hits))
        if any(hits):
            self.set_open(True)
            for row, hit in zip(self.rows, hits, strict=True):
                row.setVisible(hit)
        return any(hits)

    def _make_rows(self) -> None:
        document = self._panel.document
        model = document.model
        space = model.latent_space
        low, high = space.low.tolist(), space.high.tolist()
        names = [heading(name) for name in model.code_names[self._group.codes]]
        name_width = longest_name(self, names)
        for place, name in enumerate(names):
            code = self._group.codes.start + place
            domain = model.code_effects[code].domain if self._domain is None else self._domain
            row = CodeRow(
                code,
                name,
                f"motion {place + 1}",
                domain,
                low[code],
                high[code],
                model.domain_colours[domain],
                name_width,
            )
            row.menu_wanted.connect(self._on_menu)
            row.show_number(float(document.latent[code]))
            row.hovered.connect(self._panel.domain_hovered)
            row.number_changed.connect(document.set_code)
            row.reset_wanted.connect(document.reset_code)
            row.refused.connect(document.message)
            row.slider.drag_started.connect(self._panel.begin_drag)
            row.slider.drag_ended.connect(document.end_gesture)
            row.slider.drag_abandoned.connect(document.cancel_gesture)
            self._column.addWidget(row)
            self.rows.append(row)
        tab_order(self.rows, self.header)

    @Slot(QPoint)
    def _on_menu(self, place: QPoint) -> None:
        row = self.sender()
        code = row.code if isinstance(row, CodeRow) else None
        self._panel.menu_wanted.emit(self._domain, code, place)


class SlidersPanel(QWidget):
    """All sliders of the model, below a filter.

    Signals
    -------
    domain_hovered : int or None, the domain of the row that the pointer is on
    menu_wanted : int or None, int or None and QPoint: the domain, the code and where on the screen
        a menu of what can be done with them is wanted

    Parameters
    ----------
    document : followed, and changed by the sliders

    Attributes
    ----------
    groups : one for the whole body, then one for each domain, shown in the order of the model's
    """

    domain_hovered = Signal(object)
    menu_wanted = Signal(object, object, QPoint)

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self.document = document
        self.groups: list[SliderGroup] = []
        self._fingerprint = ""
        self._shown = np.zeros(0)
        self.filter = QLineEdit()
        self.filter.setPlaceholderText("Filter sliders, such as “thigh”")
        self.filter.setToolTip("Show only the sliders whose names contain these words")
        self.filter.setAccessibleName("Filter sliders")
        self.filter.setClearButtonEnabled(True)
        self._page = QWidget()
        self._column = QVBoxLayout(self._page)
        self._column.setContentsMargins(CLOSE, 0, CLOSE, CLOSE)
        self._column.setSpacing(2)
        self._nothing = labelled("No matching sliders", "caption")
        self._nothing.setContentsMargins(TIGHT, TIGHT, TIGHT, TIGHT)
        self._nothing.hide()
        self._column.addWidget(self._nothing)
        self._column.addStretch()
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(CLOSE)
        top = QVBoxLayout()
        top.setContentsMargins(NORMAL, TIGHT, NORMAL, 0)
        top.addWidget(self.filter)
        column.addLayout(top)
        self._area = scrolling(self._page)
        column.addWidget(self._area, 1)
        self._bottom = QVBoxLayout()
        self._bottom.setContentsMargins(NORMAL, 0, NORMAL, CLOSE)
        column.addLayout(self._bottom)
        self.filter.textChanged.connect(self._on_filter)
        document.model_changed.connect(self._on_model)
        document.latent_changed.connect(self._on_latent)
        if document.has_model:
            self._on_model()

    def add_card(self, card: QWidget) -> None:
        """Put something below the sliders, where it stays in sight."""
        self._bottom.addWidget(card)

    def light_domain(self, domain: int | None) -> None:
        """Show which domain the viewport's pointer is on."""
        for group in self.groups:
            group.header.set_lit(domain is not None and group.header.domain == domain)

    def find_slider(self) -> None:
        """Let the user type part of a slider's name."""
        bring_up(self)
        self.filter.setFocus(Qt.FocusReason.ShortcutFocusReason)
        self.filter.selectAll()

    def show_domain(self, domain: int) -> None:
        """Open the sliders of a domain, and scroll to them."""
        bring_up(self)
        self.filter.clear()
        group = self.groups[1 + domain]
        group.set_open(True)
        group.header.setFocus(Qt.FocusReason.OtherFocusReason)
        bar = self._area.verticalScrollBar()
        # Not before they have been laid out.
        QTimer.singleShot(0, group, lambda: bar.setValue(group.y()))

    def row_of(self, code: int) -> CodeRow:
        """Open the group of a code and return its row."""
        groups = self.document.model.latent_space.groups
        place = next(k for k, group in enumerate(groups) if code < group.codes.stop)
        self.groups[place].set_open(True)
        return next(row for row in self.groups[place].rows if row.code == code)

    def begin_drag(self) -> None:
        """Make what follows one step of undo, named after the slider that is dragged."""
        slider = self.sender()
        row = slider.parent() if slider is not None else None
        name = self.document.code_name(row.code) if isinstance(row, CodeRow) else "slider"
        self.document.begin_gesture(f"Move {name}")

    def _on_model(self) -> None:
        for group in self.groups:
            self._column.removeWidget(group)
            group.deleteLater()
        model = self.document.model
        # Other names of the same body leave open what is open.
        opened = [True]
        if model.fingerprint == self._fingerprint:
            opened = [group.header.isChecked() for group in self.groups]
        self._fingerprint = model.fingerprint
        groups = model.latent_space.groups
        self.groups = [SliderGroup(self, place, group) for place, group in enumerate(groups)]
        shown = [self.groups[0], *(self.groups[1 + domain] for domain in model.domain_order)]
        before: QWidget = self.filter
        for place, group in enumerate(shown):
            self._column.insertWidget(place, group)
            QWidget.setTabOrder(before, group.header)
            before = group.header
        self._shown = np.array(self.document.latent)
        for group, is_open in zip(self.groups, opened, strict=False):
            group.set_open(is_open)
        self._on_filter(self.filter.text())

    def _on_latent(self) -> None:
        latent = self.document.latent
        if len(latent) != len(self._shown):
            return  # the model's own signal follows
        changed = latent != self._shown
        self._shown = np.array(latent)
        for group in self.groups:
            for row in group.rows:
                if changed[row.code]:
                    row.show_number(float(latent[row.code]))

    def _on_filter(self, text: str) -> None:
        words = text.strip().casefold()
        found = [group.show_matching(words) for group in self.groups]
        self._nothing.setVisible(not any(found))
