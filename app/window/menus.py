"""The menus and the tool bar: which actions stand where."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QMainWindow, QMenu, QSizePolicy, QToolBar, QToolButton, QWidget

from app.view.icons import ICON_SIZE, icon

SEPARATOR = ""

MENUS: dict[str, tuple[str, ...]] = {
    "&File": (
        *("new", "open", "open_model", "models", "recent", SEPARATOR),
        *("save", "save_as", SEPARATOR),
        *("import", "export", SEPARATOR),
        *("screenshot", "turntable", SEPARATOR, "quit"),
    ),
    "&Edit": (
        *("undo", "redo", SEPARATOR),
        *("reset", "randomise", "mirror", SEPARATOR, "filter", "unlock", "parts"),
    ),
    "&Pose": ("resolve", "cancel", "resolve_options"),
    "&Library": (
        *("load", "blend", SEPARATOR),
        *("rename", "tags", "duplicate", "mirror_poses", "remove", "add", SEPARATOR),
        *("keep", "update", SEPARATOR),
        *("import_poses", "export_poses", "export_library", SEPARATOR, "find_pose"),
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
    *("reset", "randomise", "mirror"),
)
_BAR_END = ("ghost", "cameras", "screenshot")


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
        menu = window.menuBar().addMenu(title)
        menu.setToolTipsVisible(True)
        for key in keys:
            if key == SEPARATOR:
                menu.addSeparator()
            elif key in submenus:
                menu.addMenu(submenus[key])
            elif key in groups:
                for action in groups[key]:
                    menu.addAction(action)
            else:
                menu.addAction(actions[key])
        menus[title] = menu
    return menus


def make_bar(
    actions: Mapping[str, QAction], shadings: Iterable[QAction], cameras: QMenu
) -> QToolBar:
    """Make the tool bar: files and edits, the shadings in the middle, the camera at the end."""
    bar = QToolBar("Tool bar")
    bar.setObjectName("bar")
    bar.setIconSize(QSize(ICON_SIZE, ICON_SIZE))
    bar.setMovable(False)
    bar.setContextMenuPolicy(Qt.ContextMenuPolicy.PreventContextMenu)
    for key in _BAR:
        if key == SEPARATOR:
            bar.addSeparator()
        else:
            bar.addAction(actions[key])
    bar.addWidget(_spring())
    shown = list(shadings)
    for place, action in enumerate(shown):
        button = QToolButton()
        button.setObjectName("segment")
        ends = {0: "first", len(shown) - 1: "last"}
        button.setProperty("place", ends.get(place, "middle"))
        button.setDefaultAction(action)
        button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        bar.addWidget(button)
    bar.addWidget(_spring())
    for key in _BAR_END:
        if key == "cameras":
            button = QToolButton()
            button.setMenu(cameras)
            button.setIcon(icon("camera"))
            button.setObjectName("cameras")
            button.setToolTip("Camera view")
            button.setAccessibleName("Camera view")
            button.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
            bar.addWidget(button)
        else:
            bar.addAction(actions[key])
    for button in bar.findChildren(QToolButton):
        button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
    refresh_bar(bar)
    return bar


def refresh_bar(bar: QToolBar) -> None:
    """Draw in the theme that has come what is no action's: the cameras, and the way to the rest."""
    # Qt's own button for what a narrow bar has no room for; its arrow is black in both themes.
    for name, drawing in (("cameras", "camera"), ("qt_toolbar_ext_button", "more")):
        button = bar.findChild(QToolButton, name)
        if isinstance(button, QToolButton):
            button.setIcon(icon(drawing))
            button.setToolTip(button.toolTip() or "More actions")


def _spring() -> QWidget:
    spring = QWidget()
    spring.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
    return spring
