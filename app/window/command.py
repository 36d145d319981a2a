"""Commands of the window, the actions that show them, and what they find in the window."""

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
    from app.window.layout import Layout
    from app.window.learning_actions import LearningActions
    from app.window.panels.dock import Panel
    from app.window.panels.library import LibraryPanel
    from app.window.panels.sliders import RandomiseRow, SlidersPanel
    from app.window.panels.timeline import TimelinePanel

_log = logging.getLogger(__name__)

NO_BODY = "Open a character or a model first"


@dataclass(frozen=True)
class Command:
    """One entry of a menu, as `Menu.command` and the decorators below it make of a function.

    Attributes
    ----------
    run : does it; may raise `LCollisionError` for the window to show
    key : names it, in lists of commands too
    text : as the menu shows it
    shortcut : in Qt's portable words; several are separated by ", "; "" for none
    tip : what it does, in plain words
    icon : name of its icon, or ""
    why_not : why it is greyed, "" where it is not; asked only with a body where `needs_body`
    text_now : what the menu shows now, where that changes
    checked : whether it is ticked, for one that is on or off
    needs_body : greyed while no body is open
    in_view : its keys count only in the view and on the timeline, as others need them elsewhere
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


Run = Callable[["EditorWindow"], object]
Decorator = Callable[["Run | Command"], Command]
Made = Callable[["EditorWindow"], "QMenu | Iterable[QAction]"]


def greyed(why_not: Callable[[EditorWindow], str]) -> Decorator:
    """Grey a command while a reason is given, which its tool tip then says."""
    return lambda run: replace(_command(run), why_not=why_not)


def unless(condition: Callable[[EditorWindow], object], reason: str) -> Decorator:
    """Grey a command for a reason unless something is so."""
    return greyed(lambda window: "" if condition(window) else reason)


def called(text_now: Callable[[EditorWindow], str]) -> Decorator:
    """Let the menu show another text now."""
    return lambda run: replace(_command(run), text_now=text_now)


def ticked(checked: Callable[[EditorWindow], bool]) -> Decorator:
    """Tick a command while something is so."""
    return lambda run: replace(_command(run), checked=checked)


def without_body(run: Run | Command) -> Command:
    """Offer a command while no body is open too."""
    return replace(_command(run), needs_body=False)


def in_view(run: Run | Command) -> Command:
    """Let the keys of a command count in the view and on the timeline alone."""
    return replace(_command(run), in_view=True)


def _command(run: Run | Command) -> Command:
    return run if isinstance(run, Command) else Command(run)


class Menu:
    """What a menu lists, in order.

    Parameters
    ----------
    title : in the menu bar, or of a submenu; "" for choices that stand in the menu itself

    Attributes
    ----------
    entries : commands; menus of choices, of which one is ticked; functions that return what the
        window makes, a submenu or actions; None for a line between
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.entries: list[Command | Menu | Made | None] = []

    def command(self, key: str, text: str, shortcut: str, tip: str, icon: str = "") -> Decorator:
        """Add what a function does with the window; the parameters are those of `Command`."""

        def add(run: Run | Command) -> Command:
            command = replace(
                _command(run), key=key, text=text, shortcut=shortcut, tip=tip, icon=icon
            )
            self.entries.append(command)
            return command

        return add

    def choices(self, title: str = "") -> Menu:
        """Add commands of which one is chosen, in a submenu if there is a title."""
        menu = Menu(title)
        self.entries.append(menu)
        return menu

    def add(self, made: Made) -> None:
        """Add what the window makes."""
        self.entries.append(made)

    def line(self) -> None:
        """Add a line between what is before and what comes."""
        self.entries.append(None)

    def commands(self) -> Iterator[Command]:
        """Yield all commands, also of choices."""
        for entry in self.entries:
            if isinstance(entry, Menu):
                yield from entry.commands()
            elif isinstance(entry, Command):
                yield entry


class EditorWindow(QMainWindow):
    """A window with what commands act on, which the main window makes."""

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
        """Do something, and show what a user can fix of what goes wrong.

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
        """Show an error in a dialog that is not modal; once while it is open."""
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
    """The actions of all commands, which follow what can be done now.

    Parameters
    ----------
    window : that the actions belong to; commands are run by its `attempt`
    menus : of the menu bar

    Attributes
    ----------
    by_key : the commands
    actions : likewise
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

    def follow(self, signals: Iterable[SignalInstance]) -> None:
        """Look again at what can be done whenever one of these signals is emitted."""
        for signal in signals:
            signal.connect(self.refresh)
        self.refresh()

    @Slot()
    def refresh(self) -> None:
        """Grey what cannot be done now, and say why in its tool tip; update texts and ticks."""
        has_body = self._window.document.has_model
        for key, command in self.by_key.items():
            action = self.actions[key]
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
        """Let the keys of what is `in_view` count in these widgets."""
        for key, command in self.by_key.items():
            for widget in widgets if command.in_view else ():
                widget.addAction(self.actions[key])

    def with_shortcuts(self) -> Iterator[tuple[str, list[Shortcut]]]:
        """Yield each menu's title, and what in it has a shortcut, also in its submenus."""
        for listed in self._listed:
            yield _plain(listed.title), list(self._shortcuts(self.menus[listed.title]))

    def popup(self, title: str, position: QPoint) -> None:
        """Open what can be done now of a menu as a context menu."""
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
        # Undo names its step in the menu only.
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
                made = entry(self._window)
                menu.addActions([made.menuAction()] if isinstance(made, QMenu) else list(made))

    @Slot()
    def _on_triggered(self) -> None:
        action = self.sender()
        if isinstance(action, QAction):
            command = self.by_key[action.objectName()]
            self._window.attempt(lambda: command.run(self._window))
            if command.checked is not None:
                # Qt has ticked it, whatever came of it.
                action.setChecked(command.checked(self._window))


def _plain(text: str) -> str:
    return text.replace("&", "").removesuffix("…")
