"""A button that does what an action does, and says so as that does now."""

from __future__ import annotations

from PySide6.QtCore import Qt, Slot
from PySide6.QtGui import QAction, QResizeEvent
from PySide6.QtWidgets import QPushButton, QSizePolicy

from app.view.theme import NORMAL
from app.wording import menu_text


class ActionButton(QPushButton):
    """A button that follows an action: its text, shortened to the room there is, and the rest.

    Parameters
    ----------
    action : triggered by a click
    """

    def __init__(self, action: QAction) -> None:
        super().__init__()
        self._action = action
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.clicked.connect(action.trigger)
        action.changed.connect(self._follow)
        self._follow()

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802
        """See how much of the text fits now."""
        super().resizeEvent(event)
        self._follow()

    @Slot()
    def _follow(self) -> None:
        action = self._action
        room = max(self.width() - 2 * NORMAL, 0)
        # Without the menu's letter, which would be a shortcut here too.
        text = action.text().replace("&&", "\0").replace("&", "").replace("\0", "&")
        shown = self.fontMetrics().elidedText(text, Qt.TextElideMode.ElideMiddle, room)
        if menu_text(shown) != self.text():
            self.setText(menu_text(shown))
        self.setToolTip(action.toolTip())
        self.setEnabled(action.isEnabled())
