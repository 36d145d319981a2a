"""The Help menu."""

from __future__ import annotations

from app.window.command import EditorWindow, Menu, without_body
from app.window.dialogs.help import show_about, show_shortcuts
from app.window.dialogs.questions import open_log_file

HELP = Menu("&Help")


@HELP.command("shortcuts", "&Keyboard and mouse", "F1", "All shortcuts", "info")
@without_body
def _shortcuts(window: EditorWindow) -> None:
    show_shortcuts(window.commands.shortcuts_by_menu(), window)


@HELP.command("log", "Open &log file", "Ctrl+Shift+L", "Open the log with the details of errors")
@without_body
def _log(_: EditorWindow) -> None:
    open_log_file()


HELP.line()


@HELP.command("about", "&About LCollision", "Shift+F1", "Version, licence and model")
@without_body
def _about(window: EditorWindow) -> None:
    show_about(window.document.model if window.document.has_model else None, window)
