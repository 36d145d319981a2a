"""The menu Help."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.window.commands.command import Menu, without_body
from app.window.dialogs.failure import open_log_file
from app.window.dialogs.help import show_about, show_shortcuts

if TYPE_CHECKING:
    from app.window.main_window import MainWindow

HELP = Menu("&Help")


@HELP.command("shortcuts", "&Keyboard and mouse", "F1", "All shortcuts", "info")
@without_body
def _shortcuts(window: MainWindow) -> None:
    show_shortcuts(window.commands.with_shortcuts(), window)


@HELP.command("log", "Open &log file", "Ctrl+Shift+L", "Open the log with the details of errors")
@without_body
def _log(_: MainWindow) -> None:
    open_log_file()


HELP.line()


@HELP.command("about", "&About LCollision", "Shift+F1", "Version, licence and model")
@without_body
def _about(window: MainWindow) -> None:
    show_about(window.document.model if window.document.has_model else None, window)
