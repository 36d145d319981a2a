"""What the program is, and its shortcuts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QDialog,
    QDialogButtonBox,
    QFormLayout,
    QLabel,
    QMessageBox,
    QWidget,
)

from app.view.icons import program_icon
from app.view.theme import CLOSE, NORMAL, WIDE
from app.window.dialogs.questions import message_box, widen
from app.window.mnemonics import Mnemonics
from app.window.widgets import dialog_vbox, labelled, screen_of, scrolling

if TYPE_CHECKING:
    from lcollision_core.model import PosableBody

_TITLE_BAR = 60
"""Margin for a dialog frame and the desktop, in device-independent pixels."""

_ABOUT = """\
Version {version}, Apache-2.0 licence

A pose editor that detects self-collisions and resolves them. After “LCollision: Fast Generation \
of Collision-Free Human Poses using Learned Non-Penetration Constraints” by Tan, Pan and Manocha, \
AAAI 2021.
"""
_ABOUT_MODEL = """
{model.name}: {model.n_vertices} vertices, {n_parts} body parts, {model.latent_size} sliders, \
{origin} {model.card.source}, licence {model.card.licence}.
"""


def show_about(model: PosableBody | None, parent: QWidget) -> None:
    """Show name, version, licence and origin of the program and of the model."""
    box = message_box(parent, "About LCollision", "LCollision", _ABOUT.format(version=_version()))
    if model is not None:
        origin = "trained on" if model.is_trained else "posed by the rig of"
        text = _ABOUT_MODEL.format(model=model, n_parts=len(model.domain_names), origin=origin)
        box.setInformativeText(box.informativeText() + text)
    box.setIconPixmap(program_icon().pixmap(72, 72))
    box.setStandardButtons(QMessageBox.StandardButton.Close)
    box.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    widen(box)
    box.open()


def show_shortcuts(menus: Iterable[tuple[str, Sequence[tuple[str, str]]]], parent: QWidget) -> None:
    """Show the shortcuts of the menus' commands, and what mouse and keys do elsewhere."""
    dialog = ShortcutsDialog(menus, parent)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialog.open()


class ShortcutsDialog(QDialog):
    """All actions with their shortcuts, and what mouse and keys do elsewhere.

    Parameters
    ----------
    menus : their titles, and names and keys of their commands
    """

    _ELSEWHERE = (
        ("Drag the body", "move the patch under the pointer"),
        ("Wheel or page keys while dragging", "bring the patch nearer or move it away"),
        ("Ctrl+Shift-drag the body", "let the whole body help"),
        ("Ctrl-drag the body", "twist the body part"),
        ("Escape while dragging", "put everything back"),
        ("Double-click the body, or P", "pin the patch, or unpin it"),
        ("Drag a pin", "move what it holds"),
        ("[ and ], or Ctrl and wheel", "smaller and larger patch"),
        ("Drag off the body, middle- or Alt-drag", "turn the camera"),
        ("Shift-drag", "move the camera"),
        ("Wheel or pinch in the view", "zoom in and out at the pointer"),
        ("Right-drag in the view", "zoom in and out"),
        ("Right-click in the view", "menu of the body part under the pointer"),
        ("Arrow keys on a slider", "move by a hundredth of its range"),
        ("Page keys on a slider", "move by a tenth of its range"),
        ("Home, End on a slider", "lowest and highest value"),
        ("Delete or double-click on a slider", "reset it"),
        ("Ctrl or Shift while dragging a slider", "ten times finer steps"),
        ("Escape while dragging a slider", "back to where it was"),
    )

    def __init__(
        self,
        menus: Iterable[tuple[str, Sequence[tuple[str, str]]]],
        parent: QWidget | None = None,
    ) -> None:
        super().__init__(parent)
        self.setWindowTitle("Keyboard and mouse")
        Mnemonics(self)
        self.resize(560, min(620, screen_of(parent or self).height() - _TITLE_BAR))
        page = QWidget()
        form = QFormLayout(page, horizontalSpacing=WIDE * 2, verticalSpacing=CLOSE - 2)
        form.setContentsMargins(0, 0, NORMAL, 0)
        for title, commands in menus:
            form.addRow(labelled(title, "title"))
            for name, keys in commands:
                form.addRow(QLabel(name), labelled(keys, "caption"))
            form.addRow(labelled(""))
        form.addRow(labelled("Mouse and sliders", "title"))
        for name, effect in self._ELSEWHERE:
            form.addRow(QLabel(name), labelled(effect, "caption"))
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        buttons.rejected.connect(self.reject)
        self.setLayout(dialog_vbox(scrolling(page), buttons))


def _version() -> str:
    try:
        return version("lcollision")
    except PackageNotFoundError:
        return "of a checkout"
