"""Files are written in the background: the window stays usable, and the written state counts."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from lcollision_core import bodies as core
from lcollision_core.bodies import poses as pose_files
from lcollision_core.bodies import read_pose_file, read_poses


def hold(
    monkeypatch: pytest.MonkeyPatch, module: Any, write: Callable[..., Any]
) -> tuple[threading.Event, threading.Event]:
    """Make writing wait; return events that signal its start and that let it continue."""
    begun, go_on = threading.Event(), threading.Event()

    def held(*arguments: Any) -> Any:
        begun.set()
        go_on.wait(120)
        return write(*arguments)

    monkeypatch.setattr(module, "write_poses", held)
    return begun, go_on


def test_the_window_goes_on_while_a_pose_is_saved_which_counts_once_it_is_written(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = hold(monkeypatch, core, core.write_poses)
    path = tmp_path / "pose.json"
    document.motion.set_code(0, 0.5)
    document.tasks.save(path)
    qtbot.waitUntil(begun.is_set)
    assert document.history.modified
    assert document.history.file is None
    with qtbot.waitSignal(document.message) as said:
        go_on.set()
    assert said.args == ["Saved pose.json"]
    assert not document.history.modified
    assert document.history.file == path
    assert document.history.pose.name == "pose"
    (saved,) = read_poses(path, document.model)
    assert saved.latent.tobytes() == document.history.latent.tobytes()


def test_an_edit_during_a_save_is_still_to_be_saved(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = hold(monkeypatch, core, core.write_poses)
    document.motion.set_code(0, 0.5)
    document.tasks.save(tmp_path / "pose.json")
    qtbot.waitUntil(begun.is_set)
    document.motion.set_code(1, 0.75)
    go_on.set()
    document.tasks.wait_for_saves()
    assert document.history.latent[1] == 0.75
    assert document.history.file == tmp_path / "pose.json"
    assert document.history.modified
    document.history.undo()
    assert not document.history.modified


def test_a_pose_that_comes_in_during_a_save_does_not_get_its_file(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = hold(monkeypatch, core, core.write_poses)
    document.tasks.save(tmp_path / "pose.json")
    qtbot.waitUntil(begun.is_set)
    document.new_pose()
    go_on.set()
    document.tasks.wait_for_saves()
    assert (tmp_path / "pose.json").exists()
    assert document.history.file is None


def test_a_save_that_fails_is_told_and_leaves_the_pose_to_be_saved(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    document.motion.set_code(0, 0.5)
    with qtbot.waitSignal(document.failed) as told:
        document.tasks.save(tmp_path / "no folder" / "pose.json")
    assert "no folder" in told.args[0].headline
    assert document.history.modified
    assert document.history.file is None


def test_closing_waits_for_what_is_being_saved(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = PoseDocument(document.model, library_folder=tmp_path / "library")
    begun, go_on = hold(monkeypatch, core, core.write_poses)
    other.tasks.save(tmp_path / "pose.json")
    other.tasks.save(tmp_path / "again.json")
    qtbot.waitUntil(begun.is_set)
    threading.Timer(0.05, go_on.set).start()
    assert other.close()
    assert len(read_poses(tmp_path / "pose.json", document.model)) == 1
    assert len(read_poses(tmp_path / "again.json", document.model)) == 1


def test_changes_of_the_library_show_at_once_and_are_written_in_turn(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = hold(monkeypatch, pose_files, pose_files.write_poses)
    for name in ("a", "b", "c"):
        document.library.add_pose(name)
    assert [pose.name for pose in document.library.poses] == ["a", "b", "c"]
    assert not document.library.is_written
    qtbot.waitUntil(begun.is_set)
    go_on.set()
    document.tasks.wait_for_saves()
    assert document.library.is_written
    store = document.history.store
    assert store is not None
    held = read_pose_file(store.path, document.model)
    assert [pose.name for pose in held.poses] == ["a", "b", "c"]
