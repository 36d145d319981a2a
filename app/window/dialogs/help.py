"""What the program is, and its shortcuts."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version

from PySide6.QtCore import Qt
from PySide6.QtGui import QAction, QKeySequence
from PySide6.QtWidgets import (
    QDialog,
    QDialogButtonBox,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QVBoxLayout,
    QWidget,
)

from app.view.icons import program_icon
from app.view.theme import CLOSE, NORMAL, WIDE
from app.window.actions import ACTIONS
from app.window.panels.widgets import labelled, scrolling

_TITLE_BAR = 60
"""Of a dialog and what the desktop keeps for itself, in device-independent pixels."""


class AboutDialog(QDialog):
    """Name, version, licence and origin of the program and of the model."""

    def __init__(self, model_lines: Sequence[str], parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setWindowTitle("About LCollision")
        picture = QLabel()
        picture.setPixmap(program_icon().pixmap(72, 72))
        picture.setAlignment(Qt.AlignmentFlag.AlignTop)
        words = QVBoxLayout()
        words.setSpacing(CLOSE)
        words.addWidget(labelled("LCollision", "headline"))
        words.addWidget(labelled(f"Version {_version()}, Apache-2.0 licence", "caption"))
        text = QLabel(
            "A pose editor that detects self-collisions and resolves them. After "
            "“LCollision: Fast Generation of Collision-Free Human Poses using Learned "
            "Non-Penetration Constraints” by Tan, Pan and Manocha, AAAI 2021."
        )
        text.setWordWrap(True)
        text.setMinimumWidth(360)
        words.addWidget(text)
        if model_lines:
            words.addSpacing(CLOSE)
            words.addWidget(labelled("Model", "title"))
            for line in model_lines:
                words.addWidget(labelled(line, "caption"))
        top = QHBoxLayout()
        top.setSpacing(WIDE + 4)
        top.addWidget(picture)
        top.addLayout(words, 1)
        _finish(self, top)


class ShortcutsDialog(QDialog):
    """All actions with their shortcuts, and what mouse and keys do elsewhere."""

    _ELSEWHERE = (
        ("Drag in the view", "rotate the camera"),
        ("Middle-drag or Shift-drag", "move the camera"),
        ("Wheel or pinch in the view", "come nearer, go away, at the pointer"),
        ("Right-drag in the view", "zoom"),
        ("Right-click in the view", "menu of the part under the pointer"),
        ("Arrow keys on a slider", "a hundredth of its range"),
        ("Page keys on a slider", "a tenth of its range"),
        ("Home, End on a slider", "lowest and highest value"),
        ("Delete or double-click on a slider", "reset it"),
        ("Ctrl or Shift while dragging a slider", "ten times finer steps"),
        ("Escape while dragging a slider", "back to where it was"),
    )

    def __init__(
        self, menus: Sequence[tuple[str, Sequence[QAction]]], parent: QWidget | None = None
    ) -> None:
        super().__init__(parent)
        self.setWindowTitle("Keyboard and mouse")
        room = self.screen().availableSize()
        self.resize(560, min(620, room.height() - _TITLE_BAR))
        page = QWidget()
        grid = QGridLayout(page)
        grid.setContentsMargins(0, 0, NORMAL, 0)
        grid.setHorizontalSpacing(WIDE * 2)
        grid.setVerticalSpacing(CLOSE - 2)
        line = 0
        for title, actions in menus:
            grid.addWidget(labelled(title, "title"), line, 0, 1, 2)
            line += 1
            for action in actions:
                native = QKeySequence.SequenceFormat.NativeText
                keys = " or ".join(key.toString(native) for key in action.shortcuts())
                # Undo names its step in the menu only.
                spec = ACTIONS.get(action.objectName())
                text = spec.text if spec is not None else action.text()
                name = text.replace("&", "").removesuffix("…")
                grid.addWidget(QLabel(name), line, 0)
                grid.addWidget(labelled(keys, "caption"), line, 1)
                line += 1
            grid.setRowMinimumHeight(line, NORMAL)
            line += 1
        grid.addWidget(labelled("Elsewhere", "title"), line, 0, 1, 2)
        for name, effect in self._ELSEWHERE:
            line += 1
            grid.addWidget(QLabel(name), line, 0)
            grid.addWidget(labelled(effect, "caption"), line, 1)
        grid.setColumnStretch(1, 1)
        _finish(self, scrolling(page))


def _version() -> str:
    try:
        return version("lcollision")
    except PackageNotFoundError:
        return "of a checkout"


def _finish(dialog: QDialog, content: QWidget | QHBoxLayout) -> None:
    column = QVBoxLayout(dialog)
    column.setContentsMargins(WIDE + 4, WIDE + 4, WIDE + 4, WIDE)
    column.setSpacing(WIDE)
    if isinstance(content, QWidget):
        column.addWidget(content)
    else:
        column.addLayout(content)
    buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
    buttons.rejected.connect(dialog.reject)
    column.addWidget(buttons)
