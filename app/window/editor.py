"""Starting the editor: first the window, then what takes time to load."""

from __future__ import annotations

import ctypes
import logging
import os
import socket
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PySide6.QtGui import QSurfaceFormat
    from PySide6.QtWidgets import QApplication

    from app.editing.settings import Settings

_NO_DISPLAY = (
    "lcollision: there is no display to open a window on ({reason}); without one, use "
    "commands such as `lcollision resolve`; see `lcollision --help`"
)
_HEADLESS = ("offscreen", "minimal", "vnc")
_CHOICE = "QT_QPA_PLATFORM"


def open_editor(path: Path | None = None, model_name: str | None = None) -> int:
    """Open the editor and return when it is closed.

    Parameters
    ----------
    path : a file of poses, a character, a mesh or a model; None opens the model with its own pose
    model_name : a model's file, or the name of a bundled or user model; by default the one that
        was used last

    Returns
    -------
    status : 0, or 2 after one sentence on standard error if no window can be opened
    """
    reason = why_no_window(os.environ, sys.platform)
    if reason is not None:
        print(_NO_DISPLAY.format(reason=reason), file=sys.stderr)  # noqa: T201 - no log to read yet
        return 2
    return _run(path, model_name)


def why_no_window(environment: Mapping[str, str], platform: str) -> str | None:
    """Say why no window can be opened here; None if one can be.

    Qt aborts the process where it finds no display, so that this has to be asked before.

    Parameters
    ----------
    environment : the process's variables
    platform : as `sys.platform`
    """
    if platform in ("win32", "darwin"):
        return None
    asked = environment.get(_CHOICE, "")
    wayland, display = environment.get("WAYLAND_DISPLAY"), environment.get("DISPLAY")
    if not asked and not wayland and not display:
        return "neither DISPLAY nor WAYLAND_DISPLAY is set"
    # As Qt does, one after the other, until one works.
    chosen = [name.partition(":")[0] for name in asked.split(";")] if asked else []
    names = chosen or ["wayland"] * bool(wayland) + ["xcb"] * bool(display)
    reasons = []
    for name in names:
        reason = _why_not_by(name, environment)
        if reason is None:
            return None
        reasons.append(reason)
    unset = f": unset {_CHOICE}, which is {asked!r}" if asked else ""
    return f"{' and '.join(reasons)}{unset}"


def _why_not_by(name: str, environment: Mapping[str, str]) -> str | None:
    """Say why a platform plugin of Qt, by its name, opens no window."""
    if name.startswith("wayland"):
        display = environment.get("WAYLAND_DISPLAY") or "wayland-0"
        if not _wayland_answers(environment, display):
            return f"nothing answers at the Wayland display {display}"
    elif name == "xcb":
        display = environment.get("DISPLAY", "")
        return _why_no_x(display) if display else "DISPLAY is not set"
    elif name not in _HEADLESS and not environment.get("QT_QPA_PLATFORM_PLUGIN_PATH"):
        return None if any(_plugins(name)) else f"Qt has no platform plugin {name!r}"
    return None


def _wayland_answers(environment: Mapping[str, str], name: str) -> bool:
    path = Path(environment.get("XDG_RUNTIME_DIR", "")) / name
    with socket.socket(socket.AF_UNIX) as connection:
        try:
            connection.connect(str(path))
        except OSError:
            return False
    return True


def _why_no_x(display: str) -> str | None:
    """Connect as Qt would: the address, the cookie and the library all have to be right."""
    try:
        xcb = ctypes.CDLL("libxcb.so.1")
    except OSError:
        return "the library libxcb.so.1 is not installed"
    xcb.xcb_connect.restype = ctypes.c_void_p
    xcb.xcb_connect.argtypes = (ctypes.c_char_p, ctypes.c_void_p)
    xcb.xcb_connection_has_error.argtypes = (ctypes.c_void_p,)
    xcb.xcb_disconnect.argtypes = (ctypes.c_void_p,)
    connection = xcb.xcb_connect(display.encode(), None)
    failed = xcb.xcb_connection_has_error(connection)
    xcb.xcb_disconnect(connection)
    return f"nothing answers at the display {display}" if failed else _why_no_plugin()


def _why_no_plugin() -> str | None:
    """Load Qt's plugin for X, which aborts the process if a system library is missing."""
    for plugin in _plugins("xcb"):
        try:
            ctypes.CDLL(str(plugin))
        except OSError as error:
            return f"a system library is missing: {str(error).partition(':')[0]}"
    return None


def _plugins(name: str) -> Iterator[Path]:
    """Yield the files of Qt's plugin of this name."""
    from PySide6.QtCore import QLibraryInfo

    folder = Path(QLibraryInfo.path(QLibraryInfo.LibraryPath.PluginsPath)) / "platforms"
    return folder.glob(f"libq{name}.so")


def _surface_format() -> QSurfaceFormat:
    """Return what VTK draws with, which all windows must share from the first one on.

    On Wayland the canvas stays black otherwise: it is made after its window, and pyvistaqt sets
    this default only then.
    """
    from PySide6.QtGui import QSurfaceFormat

    wanted = QSurfaceFormat()
    wanted.setRenderableType(QSurfaceFormat.RenderableType.OpenGL)
    wanted.setProfile(QSurfaceFormat.OpenGLContextProfile.CoreProfile)
    wanted.setVersion(3, 2)
    wanted.setDepthBufferSize(8)
    wanted.setAlphaBufferSize(8)
    wanted.setStencilBufferSize(0)
    return wanted


def make_application(settings: Settings) -> QApplication:
    """Make the editor's application, before its first window and its first thread."""
    from PySide6.QtGui import QSurfaceFormat
    from PySide6.QtWidgets import QApplication

    from app.view.theme import apply_theme, wanted_theme
    from app.window.garbage_collection import GarbageCollector
    from app.window.process_memory import keep_memory_small

    keep_memory_small()
    QSurfaceFormat.setDefaultFormat(_surface_format())
    application = QApplication(sys.argv[:1])
    GarbageCollector(application)
    application.setApplicationName("lcollision")
    application.setApplicationDisplayName("LCollision")
    application.setDesktopFileName("lcollision")
    apply_theme(application, wanted_theme(settings["theme"]))
    return application


def _run(path: Path | None, model_name: str | None) -> int:
    from app.work.compile_ahead import AHEAD

    # Before what takes seconds to import.
    AHEAD.begin()
    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from app.window.main_window import MainWindow
    from app.window.start_up import StartUp
    from app.work.log import start_logging
    from app.work.threads import any_unfinished

    settings = Settings()
    application = make_application(settings)
    window = MainWindow(PoseDocument(), settings)
    start_logging(window.show_failure)
    window.show()
    StartUp(window, path, model_name).begin()
    status = application.exec()
    AHEAD.end()
    if any_unfinished():
        # All is saved; a thread in the middle of compiling ends with the process, or not at all.
        logging.shutdown()
        os._exit(status)
    return status
