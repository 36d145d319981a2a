"""The editor starts even if the files that it keeps for a user are replaced by pipes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from app.editing.recovery import find_recoverable_poses
from app.editing.settings import SETTINGS, Settings
from app.work import log


@pytest.mark.parametrize("name", ["lcollision/editor.conf", "lcollision.conf"])
def test_settings_that_are_a_pipe_are_not_waited_for(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "lcollision").mkdir()
    os.mkfifo(tmp_path / name)
    settings = Settings()
    assert settings["theme"] == SETTINGS["theme"].default
    settings["theme"] = "dark"
    assert settings["theme"] == "dark"


def test_a_log_file_that_is_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "editor.log")
    assert type(log._handler(tmp_path / "editor.log")).__name__ == "NullHandler"
    assert type(log._handler(tmp_path / "other.log")).__name__ == "RotatingFileHandler"


@pytest.mark.parametrize("name", ["lock", "session.json"])
def test_a_session_of_pipes_is_passed_over(name: str, tmp_path: Path) -> None:
    session = tmp_path / "0123"
    session.mkdir()
    os.mkfifo(session / name)
    assert find_recoverable_poses(tmp_path) == []


@pytest.mark.parametrize(
    "content",
    [
        b"[]",
        b"[" * 100_000,
        json.dumps({"model": "m", "pose_name": "p", "file": None, "locked": [1e999]}).encode(),
        json.dumps({"model": "m", "pose_name": "p", "file": {"a": 1}}).encode(),
        b" " * 2_000_000,
    ],
)
def test_a_damaged_session_is_cleared_away(content: bytes, tmp_path: Path) -> None:
    session = tmp_path / "0123"
    session.mkdir()
    (session / "session.json").write_bytes(content)
    (session / "poses.json").write_bytes(b"{}")
    assert find_recoverable_poses(tmp_path) == []
    assert not session.exists()
