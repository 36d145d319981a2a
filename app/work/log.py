"""The editor's log file: errors, with the tracebacks that no dialog shows."""

from __future__ import annotations

import logging
import logging.handlers
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from PySide6.QtCore import QMessageLogContext, QtMsgType, qInstallMessageHandler

from app.work.threads import Failure
from lcollision_core.files.safe import require_regular

_MAX_BYTES = 1_000_000
_N_OLD_FILES = 2
_FORMAT = "%(asctime)s %(process)d %(levelname)s %(name)s: %(message)s"

_QT_LEVELS = {
    QtMsgType.QtDebugMsg: logging.DEBUG,
    QtMsgType.QtInfoMsg: logging.INFO,
    QtMsgType.QtWarningMsg: logging.WARNING,
    QtMsgType.QtCriticalMsg: logging.ERROR,
    QtMsgType.QtFatalMsg: logging.CRITICAL,
}

_log = logging.getLogger("app")


def log_file() -> Path:
    """Return the path of the log file, which may not exist yet."""
    from platformdirs import user_log_path

    return user_log_path("lcollision", appauthor=False) / "editor.log"


def start_logging(tell: Callable[[Failure], None] | None = None) -> None:
    """Write records, Qt's messages and unhandled errors to the log file.

    If the file cannot be written, the editor runs without it.

    Parameters
    ----------
    tell : called with unhandled errors of the main thread; those of other threads are only logged
    """
    root = logging.getLogger()
    if not any(
        isinstance(handler, logging.handlers.RotatingFileHandler) for handler in root.handlers
    ):
        root.addHandler(_handler(log_file()))
        root.setLevel(logging.INFO)

    def on_exception(
        error_type: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        if not issubclass(error_type, Exception):
            sys.__excepthook__(error_type, error, trace)
            return
        _log.error("unhandled error", exc_info=(error_type, error, trace))
        # Errors in slots of other Qt threads arrive here too.
        if tell is not None and threading.current_thread() is threading.main_thread():
            tell(unexpected(error))

    def on_thread_exception(caught: threading.ExceptHookArgs) -> None:
        if caught.exc_value is not None:
            exception = (caught.exc_type, caught.exc_value, caught.exc_traceback)
            _log.error("unhandled error in a thread", exc_info=exception)

    sys.excepthook = on_exception
    threading.excepthook = on_thread_exception
    qInstallMessageHandler(_on_qt_message)


def unexpected(error: BaseException) -> Failure:
    """Return the failure that reports a bug of the program."""
    return Failure(
        f"unexpected error ({type(error).__name__}: {error})",
        "save your pose under a new name, and see the log file for details",
        "".join(traceback.format_exception(error)),
    )


def _handler(path: Path) -> logging.Handler:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handler: logging.Handler = logging.handlers.RotatingFileHandler(
            path, maxBytes=_MAX_BYTES, backupCount=_N_OLD_FILES, encoding="utf-8", delay=True
        )
        # Opening a pipe would wait for its reader for ever.
        if path.exists():
            require_regular(path)
        path.open("a").close()
    except OSError:
        return logging.NullHandler()
    handler.setFormatter(logging.Formatter(_FORMAT))
    return handler


def _on_qt_message(level: QtMsgType, context: QMessageLogContext, text: str) -> None:
    logging.getLogger("qt").log(
        _QT_LEVELS.get(level, logging.WARNING), "%s%s", f"{context.category}: ", text
    )
