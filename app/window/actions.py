"""Every action of the window: its name, its shortcut, its tool tip and its icon."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from PySide6.QtCore import QObject
from PySide6.QtGui import QAction, QActionGroup, QKeySequence
from PySide6.QtWidgets import QMenu, QWidget

from app.view.camera import CAMERAS
from app.view.icons import give_icon
from app.view.shading import Shading


@dataclass(frozen=True)
class Spec:
    """One action.

    Attributes
    ----------
    text : as the menu shows it
    shortcut : in Qt's portable words; several are separated by ", "; "" for none
    tip : what it does, in plain words
    icon : name of its icon, or ""
    checkable : whether it is on or off
    """

    text: str
    shortcut: str
    tip: str
    icon: str = ""
    checkable: bool = False


ACTIONS: dict[str, Spec] = {
    "new": Spec("&New pose", "Ctrl+N", "Start again from the first pose of the body", "new"),
    "open": Spec("&Open…", "Ctrl+O", "Open poses, a character, a mesh or a model", "open"),
    "open_model": Spec("Open &model…", "Ctrl+Shift+O", "Open a character or a model"),
    "new_model": Spec(
        "New mo&del…", "Ctrl+Shift+N", "Learn a model from a character or a body in many poses"
    ),
    "learn_character": Spec(
        "Learn t&his character…",
        "Ctrl+Alt+N",
        "Give this character body parts of its own and an instant estimate",
    ),
    "learning": Spec("Learnin&g…", "Ctrl+Alt+P", "Show the progress of models being trained"),
    "save": Spec("&Save", "Ctrl+S", "Save the pose to its file", "save"),
    "save_as": Spec("Save &as…", "Ctrl+Shift+S", "Save under another name"),
    "import": Spec("&Import mesh…", "Ctrl+I", "Turn a mesh into a pose", "import"),
    "export": Spec(
        "&Export mesh…", "Ctrl+E", "Save the pose as a mesh or in your own file", "export"
    ),
    "upright": Spec(
        "Turn &upright",
        "",
        "Make the next axis point up (changes a learned model's file)",
    ),
    "screenshot": Spec("S&creenshot…", "Ctrl+P", "Save a picture of the view", "screenshot"),
    "turntable": Spec("&Turntable…", "Ctrl+T", "Save a video of one full turn", "turntable"),
    "quit": Spec("&Quit", "Ctrl+Q", "Close the editor"),
    "undo": Spec("&Undo", "Ctrl+Z", "Undo the last change", "undo"),
    "redo": Spec("&Redo", "Ctrl+Shift+Z, Ctrl+Y", "Redo the change that was undone", "redo"),
    "reset": Spec(
        "Reset &all",
        "Ctrl+Backspace",
        "Set all sliders to zero and remove the pins; locked body parts stay as they are",
        "reset",
    ),
    "randomise": Spec("Ra&ndomise", "Ctrl+D", "Move towards a random pose", "random"),
    "mirror": Spec(
        "&Mirror pose", "Ctrl+M", "Swap left and right, including locked body parts", "mirror"
    ),
    "filter": Spec("&Find a slider", "Ctrl+F", "Type part of a slider's name", "search"),
    "unlock": Spec("Un&lock all", "Ctrl+L", "Unlock all body parts"),
    "parts": Spec("Body &parts…", "Ctrl+Alt+B", "Rename, recolour and reorder the body parts"),
    "contacts": Spec(
        "&Contacts…", "Ctrl+Alt+C", "Choose which crossing triangles don't count as collisions"
    ),
    "solid": Spec(
        "&Solid", "Ctrl+Alt+S", "Keep the body from moving into itself", "solid", checkable=True
    ),
    "standing": Spec(
        "Keep feet on the &ground",
        "Ctrl+Alt+G",
        "Keep what stands on the ground in place while other parts are dragged",
        checkable=True,
    ),
    "whole_body": Spec(
        "Whole &body helps",
        "Ctrl+Alt+W",
        "Let drags move the whole body, not only the limb under the pointer",
        checkable=True,
    ),
    "arrows": Spec(
        "Show a&xes", "A", "Show arrows to drag the patch under the pointer along the body's axes"
    ),
    "pin": Spec("&Pin", "P", "Hold the patch under the pointer in place"),
    "pin_turn": Spec(
        "Pin with &orientation",
        "O",
        "Hold the patch under the pointer in place and keep its body part's orientation",
    ),
    "unpin_all": Spec("&Unpin all", "Shift+P", "Remove all pins"),
    "pin_feet": Spec("Pin &feet", "Ctrl+Alt+F", "Hold the feet in place, at their current angle"),
    "pin_hands": Spec(
        "Pin &hands", "Ctrl+Alt+H", "Hold the hands in place, at their current angle"
    ),
    "smaller": Spec("S&maller patch", "[", "Drag a smaller patch, as small as a single finger"),
    "larger": Spec("&Larger patch", "]", "Drag a larger patch of the body"),
    "resolve": Spec("&Resolve", "Ctrl+R", "Find the nearest pose without collisions", "resolve"),
    "cancel": Spec("&Cancel", "Escape", "Stop the current computation", "cancel"),
    "resolve_options": Spec("Resolve &options…", "Ctrl+Shift+R", "Choose how Resolve works"),
    "keep": Spec("Add &to library…", "Ctrl+K", "Add this pose to your library", "add"),
    "update": Spec("&Update pose", "Ctrl+U", "Replace the library's pose with this one"),
    "load": Spec("&Load selected pose", "Ctrl+Return", "Edit the selected pose"),
    "blend": Spec(
        "&Blend towards selected pose", "Ctrl+B", "Go to the slider that blends towards it"
    ),
    "rename": Spec("Re&name…", "F2", "Rename the selected pose of your library"),
    "tags": Spec("Ta&gs…", "Ctrl+Shift+T", "Edit the tags of the selected poses"),
    "duplicate": Spec("&Duplicate", "Ctrl+Shift+D", "Copy the selected poses in the library"),
    "mirror_poses": Spec(
        "&Mirror into library", "Ctrl+Shift+M", "Add the selected poses, mirrored, to your library"
    ),
    "remove": Spec(
        "R&emove", "Ctrl+Delete", "Remove the selected poses from your library", "remove"
    ),
    "add": Spec(
        "Add &selected to library", "Ctrl+Shift+K", "Copy poses from here into your library"
    ),
    "import_poses": Spec(
        "&Import into library…", "Ctrl+Shift+I", "Add the poses of a file to your library"
    ),
    "export_poses": Spec(
        "E&xport selected poses…", "Ctrl+Shift+E", "Save the selected poses to a file"
    ),
    "export_motion": Spec(
        "Export moti&on…", "Ctrl+Alt+M", "Save the selected poses as the frames of a point cache"
    ),
    "export_library": Spec("Export libr&ary…", "Ctrl+Alt+E", "Save your whole library to a file"),
    "find_pose": Spec("&Find a pose", "Ctrl+Shift+F", "Search the poses by name or tag"),
    "ghost": Spec(
        "&Ghost",
        "Ctrl+G",
        "Show the pose before Resolve as a transparent body",
        "ghost",
        checkable=True,
    ),
    "reset_camera": Spec(
        "Show the &whole body", "Ctrl+Home", "Fit the whole body into the view, from the same side"
    ),
    "full_screen": Spec("&Full screen", "F11", "Use the whole screen", "", True),
    "reset_layout": Spec(
        "Reset la&yout", "Ctrl+Alt+0", "Put all panels back in their default places"
    ),
    "shortcuts": Spec("&Keyboard and mouse", "F1", "All shortcuts", "info"),
    "log": Spec("Open &log file", "Ctrl+Shift+L", "Open the log with the details of errors"),
    "about": Spec("&About LCollision", "Shift+F1", "Version, licence and model"),
}
"""All actions outside groups, by key."""

SHADINGS: dict[Shading, Spec] = {
    Shading.TEXTURED: Spec(
        "&Textured", "Ctrl+0", "The character as it looks: its colours and textures"
    ),
    Shading.PLAIN: Spec("&Plain", "Ctrl+1", "The body in one colour"),
    Shading.DOMAINS: Spec(
        "&Body parts",
        "Ctrl+2",
        "Body parts in colour; stronger colour = only this part controls it",
    ),
    Shading.PREDICTED: Spec(
        "&Estimate", "Ctrl+3", "Where the model estimates collisions, and how deep"
    ),
    Shading.EXACT: Spec(
        "E&xact", "Ctrl+4", "Where the check finds collisions; crossing triangles in red"
    ),
    Shading.MOVEMENT: Spec(
        "Mo&vement", "Ctrl+5", "How far Resolve has moved each point of the body"
    ),
}
"""The ways to colour the body."""

CAMERA_ACTIONS: dict[str, Spec] = {
    name: Spec(name, f"Alt+{number}", f"Camera view: {name.lower()}", f"camera-{name.lower()}")
    for number, name in enumerate(CAMERAS, start=1)
}

DRAG_STRENGTHS: dict[float, Spec] = {
    0.0: Spec(
        "&Loose", "Ctrl+Alt+7", "Let drags stretch limbs and reach poses far from the model's own"
    ),
    1.0: Spec("&Normal", "Ctrl+Alt+8", "Keep drags from stretching limbs"),
    4.0: Spec("&Firm", "Ctrl+Alt+9", "Keep drags close to the model's own poses"),
}
"""How strongly drags keep to natural poses, by the setting."""

THEMES: dict[str, Spec] = {
    "system": Spec("Match &system", "F6", "Match the desktop's theme"),
    "light": Spec("&Light", "F7", "Dark text on light"),
    "dark": Spec("&Dark", "F8", "Light text on dark"),
}

DOCKS: dict[str, Spec] = {
    "sliders": Spec("&Sliders", "Ctrl+Alt+1", "Show or hide the sliders"),
    "collision": Spec(
        "&Collisions", "Ctrl+Alt+2", "Show or hide the check, the estimate and Resolve"
    ),
    "library": Spec("&Poses", "Ctrl+Alt+3", "Show or hide the pose library"),
}


def make_action(spec: Spec, parent: QObject) -> QAction:
    """Make an action from its `Spec`; its tool tip names the shortcut."""
    action = QAction(spec.text, parent)
    equip_action(action, spec)
    return action


def make_choices(
    specs: Mapping[Any, Spec], chosen: Any, choose: Callable[[Any], None], parent: QObject
) -> list[QAction]:
    """Make exclusive actions; each carries its key as data.

    Parameters
    ----------
    specs : by key
    chosen : key of the one that is on at first
    choose : called with the key that the user chooses
    """
    group = QActionGroup(parent)
    for key, spec in specs.items():
        action = group.addAction(make_action(replace(spec, checkable=chosen is not None), parent))
        action.setData(key)
        action.setChecked(key == chosen)
    group.triggered.connect(lambda action: choose(action.data()))
    return group.actions()


def make_menu(title: str, actions: Iterable[QAction], parent: QWidget) -> QMenu:
    """Make a menu of actions."""
    menu = QMenu(title, parent)
    menu.addActions(list(actions))
    return menu


def equip_action(action: QAction, spec: Spec) -> None:
    """Set up an action, perhaps one of Qt's own, from its `Spec`."""
    action.setText(spec.text)
    keys = QKeySequence.listFromString(spec.shortcut.replace(", ", "; "))
    action.setShortcuts([held for held in keys if not held.isEmpty()])
    explain_action(action, spec.tip)
    if spec.checkable:
        action.setCheckable(True)
    if spec.text.endswith("…"):
        # What a button shows, which Qt would end before the dots.
        action.setIconText(spec.text.replace("&", ""))
    # In a menu an icon would stand where the tick is.
    action.setIconVisibleInMenu(not action.isCheckable())
    if spec.icon:
        give_icon(action, spec.icon)


NO_BODY = "Open a character or a model first"


def allow_action(action: QAction, tip: str, why_not: str = "") -> None:
    """Enable an action, or grey it and say in its tool tip why it cannot be used now."""
    action.setEnabled(not why_not)
    explain_action(action, why_not or tip)


def explain_action(action: QAction, tip: str) -> None:
    """Say in an action's tool tip what it does, or why it cannot now, and name its shortcut."""
    shown = action.shortcut().toString(QKeySequence.SequenceFormat.NativeText)
    action.setToolTip(f"{tip} ({shown})" if shown else tip)
    action.setStatusTip(tip)
