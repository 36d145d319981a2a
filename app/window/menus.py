"""The menus and the tool bar: the places of the actions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QMainWindow, QMenu, QSizePolicy, QToolBar, QToolButton, QWidget

from app.view.icons import ICON_SIZE, give_icon

SEPARATOR = ""

MENUS: dict[str, tuple[str, ...]] = {
    "&File": (
        *("new", "open", "open_model", "models", "recent", SEPARATOR),
        *("new_model", "learn_character", "learning", SEPARATOR),
        *("save", "save_as", SEPARATOR),
        *("import", "export", SEPARATOR),
        *("screenshot", "turntable", SEPARATOR, "quit"),
    ),
    "&Edit": (
        *("undo", "redo", SEPARATOR),
        *("reset", "randomise", "mirror", SEPARATOR, "filter", "unlock", "parts", "contacts"),
    ),
    "&Pose": (
        *("solid", "standing", "whole_body", "arrows", SEPARATOR),
        *(
            "pin",
            "pin_turn",
            "pin_feet",
            "pin_hands",
            "unpin_all",
            SEPARATOR,
            "smaller",
            "larger",
            "strengths",
            SEPARATOR,
        ),
        *("resolve", "cancel", "resolve_options"),
    ),
    "&Library": (
        *("load", "blend", SEPARATOR),
        *("rename", "tags", "duplicate", "mirror_poses", "remove", "add", SEPARATOR),
        *("keep", "update", SEPARATOR),
        *(
            "import_poses",
            "export_poses",
            "export_motion",
            "export_library",
            SEPARATOR,
            "find_pose",
        ),
    ),
    "&View": (
        *("shading", SEPARATOR, "ghost", SEPARATOR),
        *("cameras", "reset_camera", "upright", SEPARATOR),
        *("docks", "reset_layout", SEPARATOR, "themes", "full_screen"),
    ),
    "&Help": ("shortcuts", "log", SEPARATOR, "about"),
}
"""Keys of actions, groups and submenus, in order."""

_BAR = (
    *("open", "save", SEPARATOR, "undo", "redo", SEPARATOR),
    *("reset", "randomise", "mirror", SEPARATOR, "solid"),
)


def fill_menus(
    window: QMainWindow,
    actions: Mapping[str, QAction],
    groups: Mapping[str, Iterable[QAction]],
    submenus: Mapping[str, QMenu],
) -> dict[str, QMenu]:
    """Fill the menu bar.

    Parameters
    ----------
    actions : by key
    groups : that stand in a menu one below the other, by key
    submenus : by key

    Returns
    -------
    menus : by title, without those inside others
    """
    menus = {}
    for title, keys in MENUS.items():
        menu = menus[title] = window.menuBar().addMenu(title)
        menu.setToolTipsVisible(True)
        for key in keys:
            if key == SEPARATOR:
                menu.addSeparator()
            elif key in submenus:
                menu.addMenu(submenus[key])
            else:
                menu.addActions(list(groups.get(key) or [actions[key]]))
    return menus


def make_bar(
    actions: Mapping[str, QAction], shadings: Sequence[QAction], cameras: QMenu
) -> QToolBar:
    """Make the tool bar: files and edits, the shadings in the middle, the camera at the end."""
    bar = QToolBar("Tool bar", iconSize=QSize(ICON_SIZE, ICON_SIZE), movable=False)
    bar.setObjectName("bar")
    bar.setContextMenuPolicy(Qt.ContextMenuPolicy.PreventContextMenu)
    for key in _BAR:
        if key == SEPARATOR:
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
    camera.setMenu(cameras)
    give_icon(camera, "camera")
    camera.setObjectName("cameras")
    camera.setToolTip("Camera view")
    camera.setAccessibleName("Camera view")
    bar.addWidget(camera)
    bar.addAction(actions["screenshot"])
    for button in bar.findChildren(QToolButton):
        button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        if button.objectName() == "qt_toolbar_ext_button":
            # Qt's own button for what a narrow bar has no space for has a black arrow in any theme.
            give_icon(button, "more")
            button.setToolTip("More actions")
    return bar


def _spring() -> QWidget:
    spring = QWidget()
    spring.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
    return spring
