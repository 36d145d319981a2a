"""Match the joints of the body to those of a motion of another skeleton."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QWheelEvent
from PySide6.QtWidgets import QComboBox, QGridLayout, QWidget

from app.view.theme import CLOSE, NORMAL, TIGHT
from app.window.dialogs.questions import Dialog
from app.window.widgets import (
    Card,
    ElidedLabel,
    ThemedIcon,
    described,
    labelled,
    scrolling,
    vbox,
    wheel_if_focused,
)
from lcollision_core.tasks.words import with_capital

if TYPE_CHECKING:
    from lcollision_core.bodies.partners import JointMatch

_SIGN = 16
_COLUMNS = (_SIGN, 0), (180, 1), (_SIGN, 0), (110, 0), (170, 0)
"""Minimum width and stretch of the columns: sign, choice, arrow, joint's role, joint's name."""

_NOTHING = "— nothing —"


class JointsDialog(Dialog):
    """List the joints of the body, each with a choice of the motion's joint that it follows.

    Parameters
    ----------
    match : the current match of the joints
    motion, body : their names
    parent : window of the dialog

    Signals
    -------
    chosen : `partners.JointMap`, the motion's joint for each joint of the body

    Attributes
    ----------
    choices : by the name of the body's joint, for each joint listed
    use : button that accepts
    """

    chosen = Signal(object)

    def __init__(self, match: JointMatch, motion: str, body: str, parent: QWidget) -> None:
        from lcollision_core.bodies.partners import LEAST_JOINTS

        super().__init__("Joints of the motion", parent)
        self.resize(680, 680)
        self._match = match
        self.choices: dict[str, QComboBox] = {}
        cards = []
        listed = [
            (joint, words)
            for joint, words in zip(match.rig_joints, match.labels, strict=True)
            if words or match.followed[joint] or joint in match.unsure
        ]
        for title, is_unsure in (("To be checked", True), ("Recognised", False)):
            rows = [joint for joint in listed if (joint[0] in match.unsure) is is_unsure]
            if rows:
                cards.append(self._card(title, rows, motion, body))
        about = (
            f"Each joint of “{body}” turns as the joint of “{motion}” that is chosen beside it. "
            "A joint without one moves with its parent; "
            f"at least {LEAST_JOINTS} shoulders, elbows, hips and knees need one."
        )
        if match.unsure:
            about += " The joints at the top could not be matched by name and position."
        page = QWidget()
        page.setLayout(vbox(*cards, None, spacing=NORMAL, margins=(0, 0, CLOSE, 0)))
        note = labelled(
            "Remembered for all motions of this skeleton on this body.", "caption", wraps=True
        )
        about_label = labelled(about, wraps=True)
        self.use = self.lay_out(about_label, scrolling(page), note, accept="Use these", grows=1)

    def _card(self, title: str, rows: list[tuple[str, str]], motion: str, body: str) -> Card:
        card, grid = Card(), QGridLayout()
        grid.setHorizontalSpacing(NORMAL)
        grid.setVerticalSpacing(TIGHT)
        # Without this label, an empty column of signs has no spacing.
        grid.addWidget(labelled(""), 0, 0)
        grid.addWidget(_elided(motion), 0, 1)
        grid.addWidget(_elided(body), 0, 3, 1, 2)
        for row, (joint, words) in enumerate(rows, 1):
            choice = _Choice(self._match.source_joints, self._match.followed[joint])
            self.choices[joint] = described(choice, "", f"Joint of the motion for {words or joint}")
            if joint in self._match.unsure:
                sign = described(ThemedIcon(_SIGN), "Not recognised by name and position")
                sign.show_icon("question", "colliding")
                grid.addWidget(sign, row, 0)
            grid.addWidget(choice, row, 1)
            grid.addWidget(labelled("→", "caption"), row, 2)
            grid.addWidget(labelled(with_capital(words)), row, 3)
            grid.addWidget(_elided(joint), row, 4)
        for column, (width, stretch) in enumerate(_COLUMNS):
            grid.setColumnMinimumWidth(column, width)
            grid.setColumnStretch(column, stretch)
        card.add(labelled(title, "title"), grid)
        return card

    def accept(self) -> None:
        """Close, and emit the chosen joints."""
        partner_of_joint = {joint: choice.currentData() for joint, choice in self.choices.items()}
        super().accept()
        self.chosen.emit({**self._match.followed, **partner_of_joint})


def _elided(name: str) -> ElidedLabel:
    """Return a caption that takes no more width than its column has: names may be long."""
    label = ElidedLabel(name, Qt.TextElideMode.ElideMiddle)
    label.setObjectName("caption")
    return label


class _Choice(QComboBox):
    """A choice of one joint of a motion, or none."""

    def __init__(self, names: tuple[str, ...], now: str | None) -> None:
        super().__init__()
        self.addItem(_NOTHING, None)
        for name in names:
            self.addItem(name, name)
        self.setCurrentIndex(0 if now is None else 1 + names.index(now))
        self.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        self.setMinimumContentsLength(16)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Leave the wheel to the page unless focused."""
        wheel_if_focused(self, event, super().wheelEvent)
