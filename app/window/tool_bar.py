"""The tool bar: files and edits, the shadings in the middle, the camera at the end."""

from __future__ import annotations

from PySide6.QtCore import QSize, Qt
from PySide6.QtWidgets import QSizePolicy, QToolBar, QToolButton, QWidget

from app.view.shading import Shading
from app.view.theme import ICON_SIZE, give_icon
from app.window.command import Commands

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
    camera.setToolTip("Camera view")
    camera.setAccessibleName("Camera view")
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
