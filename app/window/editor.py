"""Start the editor: show the window first, then load what takes time."""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import threading
from collections.abc import Mapping
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
        _tell_no_display(reason)
        return 2
    return _run(path, model_name)


def why_no_window(environment: Mapping[str, str], platform: str) -> str | None:
    """Return why there is clearly no display; None if Qt has to try.

    Parameters
    ----------
    environment : the environment variables of the process
    platform : as `sys.platform`
    """
    names = ("DISPLAY", "WAYLAND_DISPLAY", _CHOICE)
    if platform in ("win32", "darwin") or any(map(environment.get, names)):
        return None
    return "neither DISPLAY nor WAYLAND_DISPLAY is set"


def _tell_no_display(reason: str) -> None:
    # There is no log to read yet.
    print(_NO_DISPLAY.format(reason=reason), file=sys.stderr, flush=True)  # noqa: T201


def _missing_library() -> str | None:
    """Return why Qt's plugin for X cannot be loaded, which Qt does not say; None if it can."""
    from PySide6.QtCore import QLibraryInfo

    folder = Path(QLibraryInfo.path(QLibraryInfo.LibraryPath.PluginsPath)) / "platforms"
    try:
        for plugin in folder.glob("libqxcb.so"):
            ctypes.CDLL(str(plugin))
    except OSError as error:
        return f"a system library is missing: {str(error).partition(':')[0]}"
    return None


def _open_application() -> QApplication:
    """Make the application, or end the process with a sentence where Qt would abort it."""
    from PySide6.QtCore import QMessageLogContext, QtMsgType, qInstallMessageHandler
    from PySide6.QtWidgets import QApplication

    from app.work.compile_ahead import AHEAD

    messages: list[str] = []

    def on_message(level: QtMsgType, _: QMessageLogContext, text: str) -> None:
        messages.append(text.strip().rstrip("."))
        if level is QtMsgType.QtFatalMsg:
            choice = os.environ.get(_CHOICE)
            advice = f": unset {_CHOICE}, which is {choice!r}" if choice else ""
            _tell_no_display(f"{_missing_library() or messages[0]}{advice}")
            AHEAD.end()
            os._exit(2)

    qInstallMessageHandler(on_message)
    application = QApplication(sys.argv[:1])
    qInstallMessageHandler(None)
    return application


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

    from app.view.theme import apply_theme, wanted_theme
    from app.window.memory import GarbageCollector, keep_memory_small

    keep_memory_small()
    QSurfaceFormat.setDefaultFormat(_surface_format())
    application = _open_application()
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
