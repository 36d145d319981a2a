"""The log file: unhandled errors and Qt's messages."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from PySide6.QtCore import QtMsgType, qInstallMessageHandler, qWarning

from app.work import log
from app.work.threads import Failure


@pytest.fixture
def logging_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Log to a file of the test, and restore everything."""
    path = tmp_path / "logs" / "editor.log"
    monkeypatch.setattr(log, "log_file", lambda: path)
    root = logging.getLogger()
    handlers, level = root.handlers.copy(), root.level
    hooks = sys.excepthook, threading.excepthook
    yield path
    sys.excepthook, threading.excepthook = hooks
    qInstallMessageHandler(None)
    for handler in root.handlers[:]:
        if handler not in handlers:
            root.removeHandler(handler)
            handler.close()
    root.setLevel(level)


def test_the_log_holds_what_nobody_caught_and_what_qt_says(logging_into: Path) -> None:
    told: list[Failure] = []
    log.start_logging(told.append)
    log.start_logging(told.append)
    try:
        raise KeyError("missing bone")
    except KeyError as error:
        sys.excepthook(KeyError, error, error.__traceback__)
    qWarning("a timer of another thread")
    thread = threading.Thread(target=lambda: 1 / 0, name="worker")
    thread.start()
    thread.join()
    # Qt's threads do this with errors in slots.
    slot = threading.Thread(target=sys.excepthook, args=(OSError, OSError("lost disk"), None))
    slot.start()
    slot.join()
    text = logging_into.read_text()
    assert text.count("unhandled error\n") == 2
    assert "lost disk" in text
    assert "missing bone" in text
    assert "test_log" in text
    assert "a timer of another thread" in text
    assert "ZeroDivisionError" in text
    (failure,) = told
    assert "missing bone" in failure.headline
    assert "Traceback" in failure.details
    assert len(log._QT_LEVELS) == len(QtMsgType)


def test_no_log_file_is_no_reason_not_to_start(logging_into: Path) -> None:
    logging_into.parent.write_text("a file, where the folder should be")
    log.start_logging()
    logging.getLogger("app").error("into the void")
    assert logging_into.parent.is_file()
