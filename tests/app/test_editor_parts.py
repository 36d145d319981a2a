"""Settings, log: the small parts under the document."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from PySide6.QtCore import QSettings, QtMsgType, qInstallMessageHandler, qWarning

from app.editing.settings import SETTINGS, Settings
from app.window.start_up import DEFAULT_MODEL, last_model
from app.work import log
from app.work.threads import Failure


@pytest.fixture
def store(tmp_path: Path) -> QSettings:
    return QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)


def test_every_setting_has_its_default_and_comes_back(store: QSettings) -> None:
    settings = Settings(store)
    for key, setting in SETTINGS.items():
        assert settings[key] == setting.default
    settings["theme"] = "dark"
    settings["show_ghost"] = False
    settings["randomise_amount"] = 0.25
    settings["screenshot_width"] = 640
    store.sync()
    again = Settings(QSettings(store.fileName(), QSettings.Format.IniFormat))
    assert again["theme"] == "dark"
    assert again["show_ghost"] is False
    assert again["randomise_amount"] == 0.25
    assert again["screenshot_width"] == 640


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("theme", "mauve"),
        ("show_ghost", "perhaps"),
        ("randomise_amount", "many"),
        ("randomise_amount", 17.0),
        ("screenshot_width", -5),
        # As an older version allowed: more frames than memory may hold.
        ("turntable_seconds", 60.0),
    ],
)
def test_what_cannot_be_reads_as_the_default(store: QSettings, key: str, value: object) -> None:
    store.setValue(key, value)
    assert Settings(store)[key] == SETTINGS[key].default


def test_a_value_beyond_its_limits_is_drawn_back(store: QSettings) -> None:
    settings = Settings(store)
    settings["screenshot_width"] = 10**9
    assert settings["screenshot_width"] == SETTINGS["screenshot_width"].high


def test_recent_files_are_few_and_each_there_once(store: QSettings) -> None:
    settings = Settings(store)
    settings.remember_file("only")
    store.sync()
    # A list of one comes back from an ini file as its item.
    settings = Settings(QSettings(store.fileName(), QSettings.Format.IniFormat))
    assert settings["recent_files"] == ("only",)
    for number in range(20):
        settings.remember_file(f"{number}.json")
    settings.remember_file("15.json")
    assert settings["recent_files"][:3] == ("15.json", "19.json", "18.json")
    assert len(settings["recent_files"]) == len(set(settings["recent_files"])) == 8
    settings.forget_file("19.json")
    assert settings["recent_files"][:2] == ("15.json", "18.json")


def test_a_model_that_is_gone_gives_way_to_the_default(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    assert last_model(str(file)) == DEFAULT_MODEL
    file.touch()
    assert last_model(str(file)) == str(file)
    assert last_model("body-swing") == "body-swing"
    assert last_model("") == last_model("no such model") == DEFAULT_MODEL


@pytest.fixture
def logging_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Log into a file of the test's own, and put everything back."""
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
    # As Qt's threads do with what their slots raise.
    slot = threading.Thread(target=sys.excepthook, args=(OSError, OSError("lost disk"), None))
    slot.start()
    slot.join()
    text = logging_into.read_text()
    assert text.count("unhandled error\n") == 2
    assert "lost disk" in text
    assert "missing bone" in text
    assert "test_editor_parts" in text
    assert "a timer of another thread" in text
    assert "ZeroDivisionError" in text
    (failure,) = told
    assert "missing bone" in failure.sentence
    assert "Traceback" in failure.details
    assert len(log._QT_LEVELS) == len(QtMsgType)


def test_no_log_file_is_no_reason_not_to_start(logging_into: Path) -> None:
    logging_into.parent.write_text("a file, where the folder should be")
    log.start_logging()
    logging.getLogger("app").error("into the void")
    assert logging_into.parent.is_file()
