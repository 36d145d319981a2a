"""Settings: defaults, limits, and values that cannot be read."""

from __future__ import annotations

from pathlib import Path

import pytest
from PySide6.QtCore import QSettings

from app.editing.settings import SETTINGS, Settings


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
        # Allowed by an older version: more frames than may fit into memory.
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
    # QSettings returns a list of one from an ini file as its item.
    settings = Settings(QSettings(store.fileName(), QSettings.Format.IniFormat))
    assert settings["recent_files"] == ("only",)
    for number in range(20):
        settings.remember_file(f"{number}.json")
    settings.remember_file("15.json")
    assert settings["recent_files"][:3] == ("15.json", "19.json", "18.json")
    assert len(settings["recent_files"]) == len(set(settings["recent_files"])) == 8
    settings.forget_file("19.json")
    assert settings["recent_files"][:2] == ("15.json", "18.json")
