"""Start the editor: show the window first, then load what takes time."""

from __future__ import annotations

import ctypes
import logging
import os
import socket
import sys
import threading
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
    model_name : a model file, or the name of a bundled or user model; the last used by default

    Returns
    -------
    status : exit status; 2, with a sentence on standard error, if no window can be opened
    """
    reason = why_no_window(os.environ, sys.platform)
    if reason is not None:
        print(_NO_DISPLAY.format(reason=reason), file=sys.stderr)  # noqa: T201 - no log to read yet
        return 2
    return _run(path, model_name)


def why_no_window(environment: Mapping[str, str], platform: str) -> str | None:
    """Return why no window can be opened here; None if one can be.

    Check this first: Qt aborts the process if it finds no display.

    Parameters
    ----------
    environment : the environment variables of the process
    platform : as `sys.platform`
    """
    if platform in ("win32", "darwin"):
        return None
    platform_list = environment.get(_CHOICE, "")
    wayland, display = environment.get("WAYLAND_DISPLAY"), environment.get("DISPLAY")
    if not platform_list and not wayland and not display:
        return "neither DISPLAY nor WAYLAND_DISPLAY is set"
    # Like Qt, try one after the other until one works.
    platforms = (
        [name.partition(":")[0] for name in platform_list.split(";")] if platform_list else []
    )
    names = platforms or ["wayland"] * bool(wayland) + ["xcb"] * bool(display)
    reasons = []
    for name in names:
        reason = _why_not_by(name, environment)
        if reason is None:
            return None
        reasons.append(reason)
    unset = f": unset {_CHOICE}, which is {platform_list!r}" if platform_list else ""
    return f"{' and '.join(reasons)}{unset}"


def _why_not_by(name: str, environment: Mapping[str, str]) -> str | None:
    """Return why a Qt platform plugin cannot open a window; None if it can."""
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
    """Connect as Qt would: address, cookie and library must all be valid."""
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
    """Yield the files of the Qt platform plugin of this name."""
    from PySide6.QtCore import QLibraryInfo

    folder = Path(QLibraryInfo.path(QLibraryInfo.LibraryPath.PluginsPath)) / "platforms"
    return folder.glob(f"libq{name}.so")


def _surface_format() -> QSurfaceFormat:
    """Return the surface format for VTK, which all windows must share from the first one on.

    pyvistaqt sets this default only when the canvas is made, after its window. On Wayland the
    canvas then stays black.
    """
    from PySide6.QtGui import QSurfaceFormat

    surface_format = QSurfaceFormat()
    surface_format.setRenderableType(QSurfaceFormat.RenderableType.OpenGL)
    surface_format.setProfile(QSurfaceFormat.OpenGLContextProfile.CoreProfile)
    surface_format.setVersion(3, 2)
    surface_format.setDepthBufferSize(8)
    surface_format.setAlphaBufferSize(8)
    surface_format.setStencilBufferSize(0)
    return surface_format


def make_application(settings: Settings) -> QApplication:
    """Make the editor's application; call before the first window and the first thread."""
    from PySide6.QtGui import QSurfaceFormat
    from PySide6.QtWidgets import QApplication

    from app.view.theme import apply_theme, wanted_theme
    from app.window.memory import GarbageCollector, keep_memory_small

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

    # Begin before the imports below, which take seconds.
    AHEAD.begin()
    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from app.window.main_window import MainWindow
    from app.window.start_up import StartUp
    from app.work.log import start_logging

    settings = Settings()
    application = make_application(settings)
    window = MainWindow(PoseDocument(), settings)
    start_logging(window.show_failure)
    window.show()
    StartUp(window, path, model_name).begin()
    status = application.exec()
    AHEAD.end()
    others = set(threading.enumerate()) - {threading.main_thread()}
    if any(not thread.daemon for thread in others):
        # All is saved; a thread that is still compiling can only be ended with the process.
        logging.shutdown()
        os._exit(status)
    return status
