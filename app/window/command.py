"""Commands of the window, their menus and actions, and the interface of the window to them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QPoint, Qt, Slot
from PySide6.QtGui import QAction, QActionGroup
from PySide6.QtWidgets import QApplication, QMainWindow, QMenu, QWidget

from app.view.theme import apply_theme, give_icon, redraw_icons, wanted_theme
from app.window.dialogs.questions import FailureDialog
from app.window.widgets import NATIVE, equip, explain
from app.work.threads import Failure
from lcollision_core.errors import LCollisionError

if TYPE_CHECKING:
    from PySide6.QtCore import SignalInstance

    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from app.view.viewport import Viewport
    from app.window.dialogs.help import Shortcut
    from app.window.file_actions import FileActions
    from app.window.hidden_meshes import HiddenMeshes
    from app.window.layout import Layout, Panel
    from app.window.learning_actions import LearningActions
    from app.window.panels.library import LibraryPanel
    from app.window.panels.sliders import RandomiseRow, SlidersPanel
    from app.window.panels.timeline import TimelinePanel

_log = logging.getLogger(__name__)

NO_BODY = "Open a character or a model first"


@dataclass(frozen=True)
class Command:
    """One entry of a menu, made from a function by `Menu.command` and the decorators below.

    Attributes
    ----------
    run : runs the command; may raise `LCollisionError` for the window to show
    key : identifier
    text : as the menu shows it
    shortcut : in Qt's portable text format; several are separated by ", "; "" for none
    tip : describes the command in plain words
    icon : name of its icon, or ""
    why_not : returns why it is disabled, "" if it is not; if `needs_body`, called only with a body
    text_now : returns the menu's current text, for a text that changes
    checked : returns whether it is ticked, for a toggle
    needs_body : whether it is disabled while no body is open
    in_view : whether its shortcut applies in the view and on the timeline only
    follows_steps : whether any step of undo may change its state, not only the signals that all
        commands follow
    """

    run: Callable[[EditorWindow], object]
    key: str = ""
    text: str = ""
    shortcut: str = ""
    tip: str = ""
    icon: str = ""
    why_not: Callable[[EditorWindow], str] | None = None
    text_now: Callable[[EditorWindow], str] | None = None
    checked: Callable[[EditorWindow], bool] | None = None
    needs_body: bool = True
    in_view: bool = False
    follows_steps: bool = False


Run = Callable[["EditorWindow"], object]
Decorator = Callable[["Run | Command"], Command]
Made = Callable[["EditorWindow"], "QMenu | Iterable[QAction]"]


def greyed(why_not: Callable[[EditorWindow], str]) -> Decorator:
    """Disable a command while `why_not` returns a reason, shown in its tool tip."""
    return lambda run: replace(_command(run), why_not=why_not)


def unless(condition: Callable[[EditorWindow], object], reason: str) -> Decorator:
    """Disable a command, with a reason, unless a condition holds."""
    return greyed(lambda window: "" if condition(window) else reason)


def called(text_now: Callable[[EditorWindow], str]) -> Decorator:
    """Let the text of a command in the menu change."""
    return lambda run: replace(_command(run), text_now=text_now)


def ticked(checked: Callable[[EditorWindow], bool]) -> Decorator:
    """Make a command a toggle that is ticked while `checked` returns true."""
    return lambda run: replace(_command(run), checked=checked)


def without_body(run: Run | Command) -> Command:
    """Enable a command even while no body is open."""
    return replace(_command(run), needs_body=False)


def in_view(run: Run | Command) -> Command:
    """Limit the shortcut of a command to the view and the timeline."""
    return replace(_command(run), in_view=True)


def at_each_step(run: Run | Command) -> Command:
    """Refresh a command after each step of undo, such as a slider's move."""
    return replace(_command(run), follows_steps=True)


def _command(run: Run | Command) -> Command:
    return run if isinstance(run, Command) else Command(run)


class Menu:
    """The entries of a menu, in order.

    Parameters
    ----------
    title : in the menu bar, or of a submenu; "" for choices listed in the parent menu itself

    Attributes
    ----------
    entries : commands; menus of choices, one of them ticked; functions that return a submenu or
        actions of the window; None for a separator
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.entries: list[Command | Menu | Made | None] = []

    def command(self, key: str, text: str, shortcut: str, tip: str, icon: str = "") -> Decorator:
        """Return a decorator that adds a function as a command; see `Command` for parameters."""

        def add(run: Run | Command) -> Command:
            command = replace(
                _command(run), key=key, text=text, shortcut=shortcut, tip=tip, icon=icon
            )
            self.entries.append(command)
            return command

        return add

    def choices(self, title: str = "") -> Menu:
        """Add a group of exclusive commands, in a submenu if there is a title."""
        menu = Menu(title)
        self.entries.append(menu)
        return menu

    def add(self, made: Made) -> None:
        """Add a submenu or actions that the window makes."""
        self.entries.append(made)

    def line(self) -> None:
        """Add a separator."""
        self.entries.append(None)

    def commands(self) -> Iterator[Command]:
        """Yield all commands, those of choices included."""
        for entry in self.entries:
            if isinstance(entry, Menu):
                yield from entry.commands()
            elif isinstance(entry, Command):
                yield entry


class EditorWindow(QMainWindow):
    """The interface of the main window that commands act on."""

    document: PoseDocument
    settings: Settings
    viewport: Viewport
    sliders: SlidersPanel
    randomise: RandomiseRow
    library: LibraryPanel
    timeline: TimelinePanel
    files: FileActions
    meshes: HiddenMeshes
    learning: LearningActions
    docks: dict[str, Panel]
    commands: Commands
    _layout: Layout

    def attempt(self, act: Callable[[], object]) -> object:
        """Call a function, and show an error that the user can fix.

        Returns
        -------
        value : what `act` returned; None if it failed
        """
        try:
            return act()
        except LCollisionError as error:
            _log.info("shown to the user: %s", error, exc_info=True)
            self.show_failure(Failure.of(error))
            return None

    @Slot(object)
    def show_failure(self, failure: Failure) -> None:
        """Show an error in a non-modal dialog, unless it is already shown."""
        dialogs = [dialog for dialog in self.findChildren(FailureDialog) if dialog.isVisible()]
        if failure.headline in [dialog.failure.headline for dialog in dialogs]:
            return
        dialog = FailureDialog(failure, self)
        dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        dialog.show()

    def set_theme(self, choice: str) -> None:
        """Apply a theme: "system", "light" or "dark"."""
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        self.settings["theme"] = choice
        apply_theme(application, wanted_theme(choice))
        redraw_icons(self)
        self.library.redraw()

    def reset_layout(self) -> None:
        """Put all panels back in their default places."""
        self._layout.reset()
        self.timeline.follow_motion()


class Commands(QObject):
    """The actions of all commands, enabled and updated with the window's state.

    Parameters
    ----------
    window : parent of the actions; its `attempt` runs the commands
    menus : of the menu bar

    Attributes
    ----------
    by_key : commands by key
    actions : actions by key
    menus : of the menu bar, by title, once `fill` has made them
    submenus : of choices, likewise
    """

    def __init__(self, window: EditorWindow, menus: Iterable[Menu]) -> None:
        super().__init__(window)
        self._window = window
        self._listed = tuple(menus)
        self.by_key = {command.key: command for menu in self._listed for command in menu.commands()}
        self._reasons: dict[str, str] = {}
        self.actions = {key: self._action(command) for key, command in self.by_key.items()}
        self.menus: dict[str, QMenu] = {}
        self.submenus: dict[str, QMenu] = {}

    def fill(self) -> None:
        """Fill the window's menu bar."""
        for listed in self._listed:
            menu = self.menus[listed.title] = self._window.menuBar().addMenu(listed.title)
            self._fill(menu, listed)

    def follow(self, signals: Iterable[SignalInstance], of_steps: Iterable[SignalInstance]) -> None:
        """Refresh all actions now and on `signals`, and those `at_each_step` on `of_steps`."""
        for signal in signals:
            signal.connect(self.refresh)
        for signal in of_steps:
            signal.connect(self._on_step)
        self.refresh()

    @Slot()
    def refresh(self) -> None:
        """Disable unavailable actions, with the reason as tool tip; update texts and ticks."""
        self._refresh(self.by_key.values())

    @Slot()
    def _on_step(self) -> None:
        self._refresh(command for command in self.by_key.values() if command.follows_steps)

    def _refresh(self, commands: Iterable[Command]) -> None:
        has_body = self._window.document.has_model
        for command in commands:
            key, action = command.key, self.actions[command.key]
            reason = NO_BODY if command.needs_body and not has_body else ""
            if not reason and command.why_not is not None:
                reason = command.why_not(self._window)
            if reason != self._reasons.get(key):
                self._reasons[key] = reason
                action.setEnabled(not reason)
                explain(action, reason or command.tip)
            if command.checked is not None:
                action.setChecked(command.checked(self._window))
            if command.text_now is not None and has_body:
                action.setText(command.text_now(self._window))

    def add_to(self, *widgets: QWidget) -> None:
        """Let the shortcuts of `in_view` commands apply in these widgets."""
        for key, command in self.by_key.items():
            for widget in widgets if command.in_view else ():
                widget.addAction(self.actions[key])

    def shortcuts_by_menu(self) -> Iterator[tuple[str, list[Shortcut]]]:
        """Yield each menu's title and its shortcuts, submenus included."""
        for listed in self._listed:
            yield _plain(listed.title), list(self._shortcuts(self.menus[listed.title]))

    def popup(self, title: str, position: QPoint) -> None:
        """Open the enabled actions of a menu as a context menu."""
        menu = QMenu(self._window)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        for action in self.menus[title].actions():
            if action.isSeparator() or action.isEnabled():
                menu.addAction(action)
        menu.popup(position)

    def _shortcuts(self, menu: QMenu, depth: int = 0) -> Iterator[Shortcut]:
        for action in menu.actions():
            submenu = action.menu()
            if isinstance(submenu, QMenu):
                below = list(self._shortcuts(submenu, depth + 1))
                yield from ((_plain(action.text()), "", depth), *below) if below else ()
            elif keys := action.shortcuts():
                named = " or ".join(key.toString(NATIVE) for key in keys)
                yield self._name(action), named, depth

    def _name(self, action: QAction) -> str:
        command = self.by_key.get(action.objectName())
        # Not the action's text: Undo names its step there.
        return _plain(action.text() if command is None else command.text)

    def _action(self, command: Command) -> QAction:
        action = QAction(self._window)
        action.setObjectName(command.key)
        action.setCheckable(command.checked is not None)
        equip(action, command.text, command.shortcut, command.tip)
        if command.in_view:
            action.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
        if command.icon:
            give_icon(action, command.icon)
        action.triggered.connect(self._on_triggered)
        return action

    def _fill(self, menu: QMenu, listed: Menu) -> None:
        menu.setToolTipsVisible(True)
        for entry in listed.entries:
            if entry is None:
                menu.addSeparator()
            elif isinstance(entry, Command):
                menu.addAction(self.actions[entry.key])
            elif isinstance(entry, Menu):
                group = QActionGroup(self)
                for command in entry.commands():
                    group.addAction(self.actions[command.key])
                if entry.title:
                    submenu = self.submenus[entry.title] = menu.addMenu(entry.title)
                    self._fill(submenu, entry)
                else:
                    menu.addActions(group.actions())
            else:
                filled = entry(self._window)
                menu.addActions(
                    [filled.menuAction()] if isinstance(filled, QMenu) else list(filled)
                )

    @Slot()
    def _on_triggered(self) -> None:
        action = self.sender()
        if isinstance(action, QAction):
            command = self.by_key[action.objectName()]
            self._window.attempt(lambda: command.run(self._window))
            if command.checked is not None:
                # Qt has toggled the tick even if the command failed.
                action.setChecked(command.checked(self._window))


def _plain(text: str) -> str:
    return text.replace("&", "").removesuffix("…")
