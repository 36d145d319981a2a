"""The tool bar, and the status bar: messages, progress of long work, the model."""

from __future__ import annotations

from html import escape

from PySide6.QtCore import QPoint, QRect, QSize, Qt, Slot
from PySide6.QtWidgets import (
    QProgressBar,
    QSizePolicy,
    QStatusBar,
    QToolBar,
    QToolButton,
    QToolTip,
    QWidget,
)

from app.view.shading import Shading
from app.view.theme import ICON_SIZE, NORMAL, Ring, give_icon
from app.window.command import Commands
from app.window.widgets import described, labelled, plain_tip
from lcollision_core.tasks.words import one_line

_MESSAGE_MILLISECONDS, _READING_MILLISECONDS = 8000, 60
"""Shortest time of a message, and its time per character."""

_FACTS_WIDTH = 300

_LINES = 12
"""Lines above the bar at which a message that it cuts off begins."""
_RING_SIDE = 14


class StatusBar(QStatusBar):
    """Show messages for some seconds, and long work for as long as it lasts.

    Attributes
    ----------
    busy : label that names the work
    cancel : button beside it, for work that may be cancelled
    """

    def __init__(self) -> None:
        super().__init__()
        self._work, self._reason, self._is_measured, self._hint = "", "", False, ""
        self.busy = labelled("")
        self._bar = QProgressBar(textVisible=False, maximum=1)
        self._bar.setFixedWidth(120)
        self._ring = Ring(_RING_SIDE)
        # The label beside it may name other work.
        self.cancel = QToolButton()
        self.cancel.setText("Cancel export")
        self._facts = labelled("", "caption")
        self._facts.setContentsMargins(NORMAL, 0, 0, 0)
        self._permanent = (self.busy, self._ring, self._bar, self.cancel, self._facts)
        for widget in self._permanent:
            self.addPermanentWidget(widget)
        self.setSizeGripEnabled(False)
        self.setContentsMargins(NORMAL, 0, NORMAL, 0)
        self.messageChanged.connect(self.setToolTip)
        self.show_busy("")

    @Slot(str)
    def tell(self, sentence: str) -> None:
        """Show a message for as long as it takes to read, above the bar too if it is cut off."""
        text = one_line(sentence)
        duration = max(_MESSAGE_MILLISECONDS, _READING_MILLISECONDS * len(text))
        self.showMessage(text, duration)
        ends = [widget.x() for widget in self._permanent if widget.isVisible()]
        if self.fontMetrics().horizontalAdvance(text) > min(ends, default=self.width()):
            whole = f"<span>{escape(text)}</span>"  # rich text wraps
            above = QPoint(0, -_LINES * self.fontMetrics().height())
            QToolTip.showText(self.mapToGlobal(above), whole, self, QRect(), duration)

    @Slot(str)
    def show_hint(self, hint: str) -> None:
        """Show a hint until another message replaces it; "" removes it."""
        if hint:
            self._hint = one_line(hint)
            self.showMessage(self._hint)
        elif self.currentMessage() == self._hint:
            self.clearMessage()

    def show_tip(self, tip: str) -> None:
        """Show the tip of what the pointer is over, but not in place of a message."""
        if not tip or self.currentMessage() in ("", self._hint):
            self.show_hint(tip)

    def show_facts(self, facts: str) -> None:
        """Show facts about the model."""
        text, middle = one_line(facts), Qt.TextElideMode.ElideMiddle
        self._facts.setText(self.fontMetrics().elidedText(text, middle, _FACTS_WIDTH))
        self._facts.setToolTip(plain_tip(text))

    def show_busy(self, work: str, *, may_cancel: bool = False) -> None:
        """Name the work in progress, "" for none; its progress may be shown later."""
        self.cancel.setVisible(may_cancel)
        if self._work != one_line(work):
            self._is_measured = False
        self._work = one_line(work)
        self._reason = self._reason if work else ""
        self._show()

    @Slot(object, int, int)
    def show_progress(self, _: object, done: int, total: int) -> None:
        """Show how many steps of the total are done."""
        if self._work:
            self._bar.setRange(0, max(1, total))
            self._bar.setValue(done)
            self._is_measured = total > 0
            self._show()

    @Slot(str)
    def explain(self, reason: str) -> None:
        """Explain why the work takes long."""
        if self._work:
            self._reason = reason
            self._show()
        else:
            self.tell(reason)

    def _show(self) -> None:
        self.busy.setText(f"{self._work}… {self._reason}".rstrip() if self._work else "")
        self.busy.setVisible(bool(self._work))
        self._bar.setVisible(bool(self._work) and self._is_measured)
        turns = bool(self._work) and not self._is_measured
        self._ring.setVisible(turns)
        if turns != self._ring.turns:
            (self._ring.start if turns else self._ring.stop)()


_FIRST = (
    *("open", "save", None, "undo", "redo", None),
    *("reset", "randomise", "mirror", None, "solid"),
)
"""Keys of commands; None is a separator."""


def make_bar(commands: Commands) -> QToolBar:
    """Make the tool bar, once the menus of the commands are filled."""
    actions = commands.actions
    shadings = [actions[shading.name.lower()] for shading in Shading]
    bar = QToolBar("Tool bar", iconSize=QSize(ICON_SIZE, ICON_SIZE), movable=False)
    bar.setObjectName("bar")
    bar.setContextMenuPolicy(Qt.ContextMenuPolicy.PreventContextMenu)
    for key in _FIRST:
        if key is None:
            bar.addSeparator()
        else:
            bar.addAction(actions[key])
    bar.addWidget(_spring())
    ends = {shadings[0]: "first", shadings[-1]: "last"}
    for action in shadings:
        button = QToolButton()
        button.setObjectName("segment")
        button.setProperty("place", ends.get(action, "middle"))
        button.setDefaultAction(action)
        bar.addWidget(button)
    bar.addWidget(_spring())
    bar.addAction(actions["ghost"])
    camera = QToolButton(popupMode=QToolButton.ToolButtonPopupMode.InstantPopup)
    camera.setMenu(commands.submenus["&Camera view"])
    give_icon(camera, "camera")
    camera.setObjectName("cameras")
    described(camera, "Camera view", "Camera view")
    bar.addWidget(camera)
    bar.addAction(actions["screenshot"])
    for button in bar.findChildren(QToolButton):
        button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        if button.objectName() == "qt_toolbar_ext_button":
            # The arrow of Qt's own extension button is black in any theme.
            give_icon(button, "more")
            button.setToolTip("More actions")
    return bar


def _spring() -> QWidget:
    spring = QWidget()
    spring.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
    return spring
