"""Every action of the window: what it is called, its shortcut, its tool tip and its icon."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QObject
from PySide6.QtGui import QAction, QActionGroup, QKeySequence
from PySide6.QtWidgets import QMenu, QWidget

from app.view.camera import CAMERAS
from app.view.icons import give_icon
from app.view.shading import Shading


@dataclass(frozen=True)
class ActionSpec:
    """One action.

    Attributes
    ----------
    text : as the menu shows it
    shortcut : in Qt's portable words; several are parted by ", "
    tip : what it does, in plain words
    icon : name of its icon, or ""
    checkable : whether it is on or off
    """

    text: str
    shortcut: str
    tip: str
    icon: str = ""
    checkable: bool = False


ACTIONS: dict[str, ActionSpec] = {
    "new": ActionSpec(
        "&New pose",
        "Ctrl+N",
        "Start again from the first training pose",
        "new",
    ),
    "open": ActionSpec("&Open…", "Ctrl+O", "Open poses, a mesh or a model", "open"),
    "open_model": ActionSpec("Open &model…", "Ctrl+Shift+O", "Choose another body"),
    "save": ActionSpec("&Save", "Ctrl+S", "Save the pose to its file", "save"),
    "save_as": ActionSpec("Save &as…", "Ctrl+Shift+S", "Save under another name"),
    "import": ActionSpec("&Import mesh…", "Ctrl+I", "Turn a mesh into a pose", "import"),
    "export": ActionSpec("&Export mesh…", "Ctrl+E", "Write the mesh on the screen", "export"),
    "upright": ActionSpec(
        "Turn &upright", "Ctrl+Shift+U", "Turn the body to its next axis, which its file keeps"
    ),
    "screenshot": ActionSpec("S&creenshot…", "Ctrl+P", "Save a picture of the view", "screenshot"),
    "turntable": ActionSpec("&Turntable…", "Ctrl+T", "Save a video of one full turn", "turntable"),
    "quit": ActionSpec("&Quit", "Ctrl+Q", "Close the editor"),
    "undo": ActionSpec("&Undo", "Ctrl+Z", "Undo the last change", "undo"),
    "redo": ActionSpec(
        "&Redo", "Ctrl+Shift+Z, Ctrl+Y", "Repeat the change that was undone", "redo"
    ),
    "reset": ActionSpec(
        "Reset &all",
        "Ctrl+Backspace",
        "Set all sliders to zero: the average of the training poses",
        "reset",
    ),
    "randomise": ActionSpec("Ra&ndomise", "Ctrl+D", "Move towards a random pose", "random"),
    "mirror": ActionSpec(
        "&Mirror pose", "Ctrl+M", "Swap left and right, also of locked body parts", "mirror"
    ),
    "filter": ActionSpec("&Find a slider", "Ctrl+F", "Type part of a slider's name", "search"),
    "unlock": ActionSpec("Un&lock all", "Ctrl+L", "Unlock all body parts"),
    "parts": ActionSpec(
        "Body &parts…", "Ctrl+Alt+B", "Rename, recolour and reorder the body parts of the model"
    ),
    "resolve": ActionSpec(
        "&Resolve", "Ctrl+R", "Find the nearest pose without collisions", "resolve"
    ),
    "cancel": ActionSpec("&Cancel", "Escape", "Stop what is being computed", "cancel"),
    "resolve_options": ActionSpec("Resolve &options…", "Ctrl+Shift+R", "Choose how Resolve works"),
    "keep": ActionSpec("Add &to library…", "Ctrl+K", "Add this pose to your library", "add"),
    "update": ActionSpec(
        "&Update pose", "Ctrl+U", "Replace the library's pose by this one, which began as it"
    ),
    "load": ActionSpec("&Load selected pose", "Ctrl+Return", "Edit the selected pose"),
    "blend": ActionSpec(
        "&Blend towards selected pose", "Ctrl+B", "Go to the slider that blends towards it"
    ),
    "rename": ActionSpec("Re&name…", "F2", "Give the selected pose of your library another name"),
    "tags": ActionSpec("Ta&gs…", "Ctrl+Shift+T", "Choose by which words a pose is found"),
    "duplicate": ActionSpec("&Duplicate", "Ctrl+Shift+D", "Copy the selected poses in the library"),
    "mirror_poses": ActionSpec(
        "&Mirror into library",
        "Ctrl+Shift+M",
        "Add the selected poses with left and right exchanged to your library",
    ),
    "remove": ActionSpec(
        "R&emove", "Ctrl+Delete", "Remove the selected poses from your library", "remove"
    ),
    "add": ActionSpec(
        "Add &selected to library", "Ctrl+Shift+K", "Copy poses from here into your library"
    ),
    "import_poses": ActionSpec(
        "&Import into library…", "Ctrl+Shift+I", "Add the poses of a file to your library"
    ),
    "export_poses": ActionSpec(
        "E&xport selected poses…", "Ctrl+Shift+E", "Write the selected poses to a file"
    ),
    "export_library": ActionSpec(
        "Export libr&ary…", "Ctrl+Alt+E", "Write your whole library to a file, to share or to keep"
    ),
    "find_pose": ActionSpec("&Find a pose", "Ctrl+Shift+F", "Type what a pose is called"),
    "ghost": ActionSpec(
        "&Ghost",
        "Ctrl+G",
        "Show the pose before Resolve as a transparent body",
        "ghost",
        checkable=True,
    ),
    "reset_camera": ActionSpec(
        "Show the &whole body", "Ctrl+Home", "Fit the whole body into the view"
    ),
    "full_screen": ActionSpec("&Full screen", "F11", "Use the whole screen", "", True),
    "reset_layout": ActionSpec(
        "Reset la&yout", "Ctrl+Alt+0", "Put all panels back in their places"
    ),
    "shortcuts": ActionSpec("&Keyboard and mouse", "F1", "All shortcuts", "info"),
    "log": ActionSpec("Open &log file", "Ctrl+Shift+L", "Open the log with the details of errors"),
    "about": ActionSpec("&About LCollision", "Shift+F1", "Version, licence and model"),
}
"""All actions that stand alone, by key."""

SHADINGS: dict[Shading, ActionSpec] = {
    Shading.PLAIN: ActionSpec("&Plain", "Ctrl+1", "The body in one colour", "", True),
    Shading.DOMAINS: ActionSpec(
        "&Body parts",
        "Ctrl+2",
        "Body parts in colour; stronger colour = only this part controls it",
        "",
        True,
    ),
    Shading.PREDICTED: ActionSpec(
        "&Estimate", "Ctrl+3", "Where the model estimates that it collides, and how deep", "", True
    ),
    Shading.EXACT: ActionSpec(
        "E&xact", "Ctrl+4", "Where the check finds collisions; crossing triangles in red", "", True
    ),
    Shading.MOVEMENT: ActionSpec(
        "Mo&vement", "Ctrl+5", "How far Resolve has moved each point of the body", "", True
    ),
}
"""The ways to colour the body."""

CAMERA_ACTIONS: dict[str, ActionSpec] = {
    name: ActionSpec(
        name, f"Alt+{number}", f"Camera view: {name.lower()}", f"camera-{name.lower()}"
    )
    for number, name in enumerate(CAMERAS, start=1)
}

THEMES: dict[str, ActionSpec] = {
    "system": ActionSpec("Match &system", "F6", "Match the desktop's theme", "", True),
    "light": ActionSpec("&Light", "F7", "Dark text on light", "", True),
    "dark": ActionSpec("&Dark", "F8", "Light text on dark", "", True),
}

DOCKS: dict[str, ActionSpec] = {
    "sliders": ActionSpec("&Sliders", "Ctrl+Alt+1", "Show or hide the sliders", "", True),
    "collision": ActionSpec(
        "&Collisions", "Ctrl+Alt+2", "Show or hide the check, the estimate and Resolve", "", True
    ),
    "library": ActionSpec("&Poses", "Ctrl+Alt+3", "Show or hide the pose library", "", True),
}


def make_action(spec: ActionSpec, parent: QObject) -> QAction:
    """Make an action as its line says; its tool tip names the shortcut."""
    action = QAction(spec.text, parent)
    equip_action(action, spec)
    return action


def make_choices(
    specs: Mapping[Any, ActionSpec],
    chosen: Any,
    slot: Callable[[QAction], None],
    parent: QObject,
) -> list[QAction]:
    """Make actions of which one is chosen; each carries its key as data.

    Parameters
    ----------
    specs : by key
    chosen : key of the one that is on at first
    slot : called with the action that the user chooses
    """
    group = QActionGroup(parent)
    for key, spec in specs.items():
        action = group.addAction(make_action(spec, parent))
        action.setData(key)
        action.setChecked(key == chosen)
    group.triggered.connect(slot)
    return group.actions()


def make_menu(title: str, actions: Iterable[QAction], parent: QWidget) -> QMenu:
    """Make a menu of actions."""
    menu = QMenu(title, parent)
    menu.addActions(list(actions))
    return menu


def equip_action(action: QAction, spec: ActionSpec) -> None:
    """Give an action, perhaps one of Qt's own, what its line says."""
    action.setText(spec.text)
    keys = QKeySequence.listFromString(spec.shortcut.replace(", ", "; "))
    action.setShortcuts(keys)
    explain_action(action, spec.tip)
    action.setCheckable(spec.checkable)
    # In a menu an icon would stand where the tick is.
    action.setIconVisibleInMenu(not spec.checkable)
    if spec.icon:
        give_icon(action, spec.icon)


def explain_action(action: QAction, tip: str) -> None:
    """Say in an action's tool tip what it does, or why it cannot now, and name its shortcut."""
    shown = action.shortcut().toString(QKeySequence.SequenceFormat.NativeText)
    action.setToolTip(f"{tip} ({shown})")
    action.setStatusTip(tip)
