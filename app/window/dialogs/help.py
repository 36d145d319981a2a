"""The dialogs About, and Keyboard and mouse."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QDialogButtonBox, QFormLayout, QLabel, QMessageBox, QWidget

from app.view.theme import CLOSE, NORMAL, WIDE, program_icon
from app.window.dialogs.questions import Dialog, message_box, widen
from app.window.widgets import described, dialog_vbox, labelled, screen_of, scrolling
from lcollision_core import __version__

if TYPE_CHECKING:
    from lcollision_core.bodies import Body

Shortcut = tuple[str, str, int]
"""Name of a command in its menu, its keys, and the depth of its submenu; a submenu's title has no
keys, ""."""

_TITLE_BAR = 60
"""Margin for a dialog frame and the desktop, in device-independent pixels."""

_MOUSE_AND_KEYS = (
    (
        "Posing",
        (
            ("Drag the body", "move the patch under the pointer"),
            ("Wheel or page keys while dragging", "bring the patch nearer or move it away"),
            ("Ctrl+Shift-drag the body", "move the whole body"),
            ("Ctrl-drag the body", "twist the body part"),
            ("Drag a dot on the body", "move a part that is small on the screen"),
            ("Escape while dragging", "put everything back"),
            ("P, or double-click the body", "pin the patch, or unpin it"),
            ("Drag a pin", "move what it holds"),
            ("[ and ], or Ctrl and wheel", "smaller and larger patch"),
            ("Right-click in the view", "menu of the body part under the pointer"),
            ("Edit > Contacts > Propose", "leave out parts that always touch"),
        ),
    ),
    (
        "Camera",
        (
            ("Drag off the body, middle- or Alt-drag", "turn"),
            ("Shift-drag", "move"),
            ("Wheel or pinch", "zoom in and out at the pointer"),
            ("Right-drag", "zoom in and out"),
        ),
    ),
    (
        "Sliders",
        (
            ("Arrow keys", "move by a hundredth of the range"),
            ("Page keys", "move by a tenth of the range"),
            ("Home, End", "lowest and highest value"),
            ("Delete or double-click", "reset"),
            ("Ctrl or Shift while dragging", "ten times finer steps"),
            ("Escape while dragging", "back to where it was"),
        ),
    ),
)
"""Effects of mouse and keys that are in no menu, by topic."""

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


def show_about(model: Body | None, parent: QWidget) -> None:
    """Show name, version, licence and origin of the program and of the model."""
    box = message_box(parent, "About LCollision", "LCollision", _ABOUT.format(version=__version__))
    if model is not None:
        origin = "trained on" if model.is_trained else "posed by the rig of"
        text = _ABOUT_MODEL.format(model=model, n_parts=len(model.domain_names), origin=origin)
        box.setInformativeText(box.informativeText() + text)
    box.setIconPixmap(program_icon().pixmap(72, 72))
    box.setStandardButtons(QMessageBox.StandardButton.Close)
    box.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    widen(box)
    box.open()


def show_shortcuts(menus: Iterable[tuple[str, Sequence[Shortcut]]], parent: QWidget) -> None:
    """Show the shortcuts of the menus, and the effects of mouse and keys elsewhere."""
    dialog = ShortcutsDialog(menus, parent)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialog.open()


class ShortcutsDialog(Dialog):
    """List the effects of mouse and keys, then the shortcuts of commands, nested as in the menus.

    Parameters
    ----------
    menus : the title and the shortcuts of each menu
    """

    def __init__(
        self,
        menus: Iterable[tuple[str, Sequence[Shortcut]]],
        parent: QWidget | None = None,
    ) -> None:
        super().__init__("Keyboard and mouse", parent)
        self.resize(560, min(620, screen_of(parent or self).height() - _TITLE_BAR))
        page = QWidget()
        form = QFormLayout(page, horizontalSpacing=WIDE * 2, verticalSpacing=CLOSE - 2)
        form.setContentsMargins(0, 0, NORMAL, 0)
        for title, entries in _MOUSE_AND_KEYS:
            form.addRow(labelled(title, "title"))
            for what, effect in entries:
                form.addRow(QLabel(what), labelled(effect, "caption"))
            form.addRow(labelled(""))
        for title, commands in menus:
            form.addRow(labelled(f"Menu {title}", "title"))
            for name, keys, depth in commands:
                label = QLabel(name)
                label.setIndent(depth * WIDE)
                form.addRow(label, labelled(keys, "caption"))
            form.addRow(labelled(""))
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        buttons.rejected.connect(self.reject)
        area = described(scrolling(page), "", "Keys and their effects")
        self.setLayout(dialog_vbox(area, buttons))
        # Without it, no key would scroll to the keys below.
        area.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        area.setFocus()
