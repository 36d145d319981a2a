"""The left panel: all numbers of the pose as sliders, in groups that open and close."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QPoint, QSize, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QMouseEvent
from PySide6.QtWidgets import QLineEdit, QToolButton, QWidget

from app.view.theme import CLOSE, NORMAL, TIGHT, give_icon
from app.window.panels.code_slider import CodeRow
from app.window.panels.dock import Docking, bring_up
from app.window.widgets import (
    SWATCH,
    ElidedLabel,
    HoverRow,
    hbox,
    labelled,
    longest_name,
    plain_tip,
    scrolling,
    vbox,
)
from app.wording import heading

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.bodies import LatentGroup

FloatArray = npt.NDArray[np.float64]

_HEADER_HEIGHT, _ARROW = 28, 16

_MIN_WIDTH = 250
"""Width that leaves the view its own in a window of 1280, in device-independent pixels."""

_LEAST_HELD = 1e-3
"""Difference from what was asked for that is worth a mark: the last digit of a number."""


class GroupHeader(HoverRow):
    """The line above a group's sliders; a click or Space opens and closes it.

    Parameters
    ----------
    name : of the group
    colour : of its domain, "" for the whole body
    domain : index from 0, None for the whole body
    """

    def __init__(self, name: str, colour: str, domain: int | None) -> None:
        super().__init__(domain, colour, TIGHT + _ARROW + CLOSE)
        self.button = QToolButton()
        self.button.setObjectName("arrow")
        self.button.setCheckable(True)
        self.button.setAccessibleName(name)
        self.button.setFixedSize(_ARROW, _ARROW)
        self.button.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.button.toggled.connect(self._on_toggled)
        self._on_toggled(False)
        self.setToolTip(plain_tip(f"Show or hide the sliders of {name.lower()}"))
        self.setCursor(Qt.CursorShape.PointingHandCursor)
        self.setFixedHeight(_HEADER_HEIGHT)
        label = ElidedLabel(name)
        label.setObjectName("title")
        line = hbox(self.button, label, margins=(TIGHT, 0, TIGHT, 0))
        if colour:
            line.insertSpacing(1, SWATCH + CLOSE)
        self.setLayout(line)

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Open or close the group."""
        if event.button() is Qt.MouseButton.LeftButton:
            self.button.setFocus(Qt.FocusReason.MouseFocusReason)
            self.button.toggle()

    @Slot(bool)
    def _on_toggled(self, is_open: bool) -> None:
        give_icon(self.button, "down" if is_open else "right", "muted")


class SliderGroup(QWidget):
    """One group's header and rows; the rows are made when they are first seen."""

    def __init__(self, panel: SlidersPanel, index: int, group: LatentGroup) -> None:
        super().__init__()
        self._panel = panel
        self._group = group
        self._domain = index - 1 if index else None
        self._open_before: bool | None = None
        self.rows: list[CodeRow] = []
        self.header = GroupHeader(heading(group.name), group.colour or "", self._domain)
        self._body = QWidget()
        self._column = vbox(spacing=0, margins=(0, 0, 0, TIGHT))
        self._body.setLayout(self._column)
        self._body.hide()
        self.setLayout(vbox(self.header, self._body, spacing=0))
        self.header.button.toggled.connect(self.set_open)
        self.header.hovered.connect(panel.domain_hovered)
        self.header.menu_wanted.connect(panel.menu_wanted)

    def set_open(self, is_open: bool) -> None:
        """Show or hide the rows."""
        if is_open and not self.rows:
            self._make_rows()
        self._body.setVisible(is_open)
        self.header.button.setChecked(is_open)

    def show_matching(self, words: str) -> bool:
        """Show only rows of which all of the words are said, see `PosableBody.code_words`.

        Parameters
        ----------
        words : in lower case; "" shows all rows, and opens or closes the group as it was before

        Returns
        -------
        found : whether a row is left
        """
        names = self._panel.document.model.code_words[self._group.codes]
        matches = [all(word in name for word in words.split()) for name in names]
        if words and self._open_before is None:
            self._open_before = self.header.button.isChecked()
        if words and any(matches):
            self.set_open(True)
        elif not words and self._open_before is not None:
            self.set_open(self._open_before)
            self._open_before = None
        for row, matches_all in zip(self.rows, matches, strict=False):
            row.setVisible(matches_all)
        self.setVisible(any(matches))
        return any(matches)

    def _make_rows(self) -> None:
        document, codes = self._panel.document, self._group.codes
        name_width = longest_name(self, map(heading, document.model.code_names[codes]))
        order: list[QWidget] = [self.header.button]
        for index, code in enumerate(range(codes.start, codes.stop)):
            row = CodeRow(document, code, index, self._domain, name_width)
            row.hovered.connect(self._panel.domain_hovered)
            row.menu_wanted.connect(self._panel.menu_wanted)
            row.asked.connect(partial(self._panel.note_asked, row))
            self._column.addWidget(row)
            self.rows.append(row)
            order += [row.slider, row.field]
        for before, after in pairwise(order):
            QWidget.setTabOrder(before, after)


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
    docking = Docking(
        "sliders",
        "&Sliders",
        "Ctrl+Alt+1",
        "Show or hide the sliders",
        Qt.DockWidgetArea.LeftDockWidgetArea,
        (0.25, 344, 460),
    )

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self.document = document
        self.groups: list[SliderGroup] = []
        self._fingerprint = ""
        self._latent_size = self._natural_width = 0
        self._asked: tuple[CodeRow, float, FloatArray] | None = None
        self.filter = QLineEdit()
        self.filter.setPlaceholderText("Filter sliders, such as “finger”")
        self.filter.setToolTip("Show the sliders of a part or motion, such as “left hand twist”")
        self.filter.setAccessibleName("Filter sliders")
        self.filter.setClearButtonEnabled(True)
        self._page = QWidget()
        self._nothing = labelled("No matching sliders", "caption")
        self._nothing.setContentsMargins(TIGHT, TIGHT, TIGHT, TIGHT)
        self._nothing.hide()
        self._column = vbox(self._nothing, None, spacing=2, margins=(CLOSE, 0, CLOSE, CLOSE))
        self._page.setLayout(self._column)
        self._area = scrolling(self._page)
        self._bottom = vbox(margins=(NORMAL, 0, NORMAL, CLOSE))
        top = vbox(self.filter, margins=(NORMAL, TIGHT, NORMAL, 0))
        self.setLayout(vbox(top, self._area, self._bottom))
        self.filter.textChanged.connect(self._on_filter)
        document.model_changed.connect(self._on_model)
        document.history.latent_changed.connect(self._on_latent)
        document.motion.frame_changed.connect(self._on_frame)
        if document.has_model:
            self._on_model()

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Ask for whole names."""
        return QSize(self._natural_width, super().sizeHint().height())

    def add_below(self, widget: QWidget) -> None:
        """Put something below the sliders, where it stays in sight."""
        self._bottom.addWidget(widget)

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
        group.header.button.setFocus(Qt.FocusReason.OtherFocusReason)
        bar = self._area.verticalScrollBar()
        # Not before they have been laid out.
        QTimer.singleShot(0, group, lambda: bar.setValue(group.y()))

    def row_of(self, code: int) -> CodeRow:
        """Open the group of a code and return its row."""
        groups = self.document.model.latent_space.groups
        index = next(k for k, group in enumerate(groups) if code < group.codes.stop)
        self.groups[index].set_open(True)
        return next(row for row in self.groups[index].rows if row.code == code)

    def _on_model(self) -> None:
        self._asked = None
        for group in self.groups:
            self._column.removeWidget(group)
            group.deleteLater()
        model = self.document.model
        # Other names of the same body leave open what is open.
        opened = [True]
        if model.fingerprint == self._fingerprint:
            opened = [group.header.button.isChecked() for group in self.groups]
        self._fingerprint = model.fingerprint
        groups = model.latent_space.groups
        self.groups = [SliderGroup(self, index, group) for index, group in enumerate(groups)]
        shown = [self.groups[0], *(self.groups[1 + domain] for domain in model.domain_order)]
        before: QWidget = self.filter
        for index, group in enumerate(shown):
            self._column.insertWidget(index, group)
            QWidget.setTabOrder(before, group.header.button)
            before = group.header.button
        self._latent_size = model.latent_size
        self._natural_width = self._width_of_names()
        self.setMinimumWidth(min(self._natural_width, _MIN_WIDTH))
        for group, is_open in zip(self.groups, opened, strict=False):
            group.set_open(is_open)
        self._on_filter(self.filter.text())

    def _width_of_names(self) -> int:
        """Return the width at which no name is cut."""
        name = longest_name(self, map(heading, self.document.model.code_names))
        bar = self._area.verticalScrollBar().sizeHint().width()
        return CodeRow.width_beside(name) + 2 * CLOSE + bar

    def _on_latent(self) -> None:
        latent = self.document.history.latent
        if len(latent) != self._latent_size:
            return  # the model's own signal follows
        for group in self.groups:
            for row in group.rows:
                if row.number != latent[row.code]:
                    row.show_number(float(latent[row.code]))

    def note_asked(self, row: CodeRow, number: float) -> None:
        """Remember what number the user wants, to show where contact holds it."""
        if self._asked is not None and self._asked[0] is not row:
            self._asked[0].show_held(None)
        self._asked = row, number, np.delete(self.document.history.latent, row.code)

    def _on_frame(self) -> None:
        frame, latent = self.document.motion.frame, self.document.history.latent
        if self._asked is None or frame is None:
            return
        row, number, others = self._asked
        reached = float(latent[row.code])
        is_held = len(frame.contacts) > 0 and abs(number - reached) > _LEAST_HELD
        # What else has moved the pose since has its own contacts.
        is_held = is_held and np.array_equal(np.delete(latent, row.code), others)
        row.show_held(reached if is_held else None)
        if frame.settled:
            # Also where the number has not moved at all.
            row.show_number(reached)

    def _on_filter(self, text: str) -> None:
        words = text.strip().casefold()
        found = [group.show_matching(words) for group in self.groups]
        self._nothing.setVisible(not any(found))
