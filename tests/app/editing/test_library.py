"""The working pose and the library are two things: neither ever overwrites the other."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from app.editing.commands import Source
from app.editing.document import PoseDocument
from lcollision_core.errors import ModelFileError
from lcollision_core.model import NamedPose, read_pose_file, read_poses, write_poses
from tests.app.editor_model import another_model


def names(document: PoseDocument) -> list[str]:
    return [pose.name for pose in document.poses]


def of_library(document: PoseDocument, name: str) -> NamedPose:
    (found,) = (pose for pose in document.poses if pose.name == name)
    return found


def in_file(document: PoseDocument) -> dict[str, bytes]:
    """Return what another editor that starts now would have as the library."""
    other = PoseDocument(document.model)
    other.set_solid(False)
    found = {pose.name: pose.latent.tobytes() for pose in other.poses}
    assert other.close()
    return found


def open_poses(qtbot: QtBot, document: PoseDocument, path: Path) -> None:
    with qtbot.waitSignal(document.opened):
        document.open_poses(path)


def test_saving_a_changed_pose_leaves_the_kept_one_as_it_was(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    kept = document.latent.tobytes()
    document.add_pose_to_library("A")
    assert in_file(document) == {"A": kept}
    document.set_code(0, 0.5)
    changed = document.latent.tobytes()
    assert document.changed
    document.save(tmp_path / "poses.json")
    document.load_pose(of_library(document, "A"))
    assert document.latent.tobytes() == kept
    assert not document.changed
    assert in_file(document) == {"A": kept}
    open_poses(qtbot, document, tmp_path / "poses.json")
    assert document.latent.tobytes() == changed
    assert names(document) == ["A"]


def test_a_pose_that_is_blended_fully_into_another_leaves_the_kept_one_as_it_was(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    document.load_pose(document.training_pose(3))
    document.add_pose_to_library("hand on hip")
    kept = document.latent.tobytes()
    document.new_pose()
    document.load_pose(of_library(document, "hand on hip"))
    document.begin_gesture("Blend towards T pose")
    document.blend_towards(document.model.training_latent[5], 1.0)
    document.end_gesture()
    document.save(tmp_path / "work.json")
    document.new_pose()
    assert names(document) == ["hand on hip"]
    open_poses(qtbot, document, tmp_path / "work.json")
    assert np.array_equal(document.latent, document.model.training_latent[5])
    document.load_pose(of_library(document, "hand on hip"))
    assert document.latent.tobytes() == kept
    assert in_file(document) == {"hand on hip": kept}


def test_update_changes_the_kept_pose_and_undo_brings_it_back_to_the_bit(
    document: PoseDocument,
) -> None:
    assert document.library_pose is None
    with pytest.raises(ModelFileError, match="is not in your library"):
        document.update_library_pose()
    document.add_pose_to_library("A")
    document.tag_poses(["A"], ["kick"])
    assert not document.can_update
    kept = document.latent.tobytes()
    document.set_code(0, 0.5)
    changed = document.latent.tobytes()
    assert document.can_update
    document.update_library_pose()
    assert document.undo_stack.undoText() == "Update A"
    assert not document.can_update
    assert in_file(document) == {"A": changed}
    assert of_library(document, "A").tags == ("kick",)
    document.undo()
    assert document.can_update
    assert in_file(document) == {"A": kept}
    assert document.latent.tobytes() == changed
    document.redo()
    assert in_file(document) == {"A": changed}
    document.remove_poses_from_library(["A"])
    assert not document.can_update
    assert document.library_pose is None


def test_replace_puts_the_pose_in_another_s_place(document: PoseDocument) -> None:
    for name in ("A", "B"):
        document.add_pose_to_library(name)
    document.set_code(0, 0.5)
    document.replace_pose_of_library("A")
    assert names(document) == ["A", "B"]
    assert of_library(document, "A").latent[0] == 0.5
    assert of_library(document, "B").latent[0] == 0.0
    assert document.pose_name == "A"
    document.undo()
    assert of_library(document, "A").latent[0] == 0.0
    assert document.pose_name == "B"


def test_the_library_is_undone_like_the_pose(document: PoseDocument) -> None:
    document.add_pose_to_library("kick")
    document.add_pose_to_library("kick")
    assert names(document) == ["kick", "kick 2"]
    assert document.pose_name == "kick 2"
    for name, sentence in (
        ("kick", "already has a pose “kick”"),
        ("KICK", "already has a pose “kick”"),
        ("", "needs a name"),
        ("x" * 201, "at most 200 characters"),
    ):
        with pytest.raises(ModelFileError, match=sentence):
            document.rename_pose("kick 2", name)
    for change in (
        lambda: document.rename_pose("bend 2", "leap"),
        lambda: document.remove_poses_from_library(["bend 2"]),
        lambda: document.tag_poses(["bend 2"], []),
        lambda: document.replace_pose_of_library("bend 2"),
    ):
        with pytest.raises(ModelFileError, match="no pose 'bend 2'"):
            change()
    document.rename_pose("kick 2", "jump")
    assert document.pose_name == "jump"
    document.remove_poses_from_library(["kick"])
    document.duplicate_poses(document.poses)
    document.tag_poses(["jump", "jump 2"], ["leg"])
    document.remove_poses_from_library(["jump", "jump 2"])
    history: list[tuple[str, list[str]]] = []
    while document.undo_stack.canUndo():
        history.append((document.undo_stack.undoText(), names(document)))
        assert list(in_file(document)) == names(document)
        document.undo()
    assert history == [
        ("Remove 2 poses", []),
        ("Tag 2 poses", ["jump", "jump 2"]),
        ("Duplicate jump", ["jump", "jump 2"]),
        ("Remove kick", ["jump"]),
        ("Rename kick 2", ["kick", "jump"]),
        ("Add kick 2", ["kick", "kick 2"]),
        ("Add kick", ["kick"]),
    ]
    assert document.poses == ()
    for _, after in reversed(history):
        document.redo()
        assert names(document) == after


def test_the_library_stays_from_start_to_start_and_from_model_to_model(
    document: PoseDocument,
) -> None:
    document.add_pose_to_library("A")
    model = document.model
    document.new_pose()
    assert names(document) == ["A"]
    document.set_model(model)
    assert names(document) == ["A"]


def test_what_another_editor_keeps_is_seen_and_never_lost(document: PoseDocument) -> None:
    document.add_pose_to_library("mine")
    other = PoseDocument(document.model)
    other.set_solid(False)
    other.add_pose_to_library("theirs")
    document.refresh_library()
    assert names(document) == ["mine", "theirs"]
    document.undo()
    assert names(document) == ["theirs"]
    assert list(in_file(document)) == ["theirs"]
    assert other.close()


def test_a_damaged_library_is_told_of(qtbot: QtBot, document: PoseDocument) -> None:
    document.add_pose_to_library("A")
    assert document._library is not None
    document._library.path.write_text("[1, 2")
    with qtbot.waitSignal(document.failed) as told:
        document.set_model(document.model)
    assert "set aside as" in told.args[0].headline
    assert document.poses == ()


def test_a_pose_of_a_library_that_cannot_be_written_is_still_to_be_saved(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, where the folder should be")
    other = PoseDocument(document.model, library_folder=blocked)
    other.set_solid(False)
    other.set_code(0, 0.5)
    with qtbot.waitSignal(other.failed) as told:
        other.add_pose_to_library("A")
    assert "could not be saved" in told.args[0].headline
    assert names(other) == ["A"]
    assert other.modified
    blocked.unlink()
    other.add_pose_to_library("B")
    assert not other.modified
    assert sorted(blocked.glob("*.json"))
    assert other.close()


@pytest.mark.parametrize("end", ["close", "another model"])
def test_what_the_library_could_not_write_is_written_before_it_goes(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, end: str
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, where the folder should be")
    other = PoseDocument(document.model, library_folder=blocked)
    other.set_solid(False)
    with qtbot.waitSignal(other.failed):
        other.add_pose_to_library("A")
    blocked.unlink()
    if end == "another model":
        other.set_model(document.model)
        assert names(other) == ["A"]
    assert other.close()
    assert len(list(blocked.glob("*.json"))) == 1


def test_a_pose_that_nobody_touched_is_not_marked_changed(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    """Neither by loading nor by keeping; one that is nowhere else is."""
    document.load_pose(document.training_pose(2))
    assert not document.modified
    document.add_pose_to_library("A")
    assert not document.modified
    document.set_code(0, 0.5)
    assert document.modified
    document.update_library_pose()
    assert not document.modified
    document.remove_poses_from_library(["A"])
    assert document.modified
    document.undo()
    document.set_code(0, 0.75)
    document.save(tmp_path / "pose.json")
    assert not document.modified
    # A file is open now: what is loaded is not what the file holds.
    document.load_pose(document.training_pose(2))
    assert document.modified
    document.undo()
    assert not document.modified
    open_poses(qtbot, document, tmp_path / "pose.json")
    assert not document.modified


def test_a_files_poses_are_neither_changed_nor_put_into_the_library(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    latent, path = document.model.training_latent, tmp_path / "poses.json"
    write_poses(path, document.model, [NamedPose(n, latent[k]) for k, n in enumerate("abc")])
    document.add_pose_to_library("mine")
    open_poses(qtbot, document, path)
    assert [pose.name for pose in document.file_poses] == ["a", "b", "c"]
    assert names(document) == ["mine"]
    assert document.pose_name == "a"
    document.load_pose(document.file_poses[1])
    document.set_code(0, 0.5)
    assert document.changed
    document.save()
    assert not document.changed
    held = read_pose_file(path, document.model)
    assert [pose.latent.tobytes() for pose in held.poses] == [row.tobytes() for row in latent[:3]]
    assert held.working is not None
    assert held.working.latent[0] == 0.5
    assert [pose.name for pose in read_poses(path, document.model)] == ["a", "b", "c", "b 2"]
    document.add_to_library(document.file_poses)
    document.add_to_library(document.file_poses)
    assert names(document) == ["mine", "a", "b", "c"]
    document.undo()
    assert names(document) == ["mine"]
    document.new_pose()
    assert document.file_poses == ()


def test_a_file_of_the_first_version_opens(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    path = tmp_path / "old.json"
    write_poses(path, document.model, [NamedPose("kick", document.model.training_latent[1])])
    assert json.loads(path.read_text())["format_version"] == 1
    open_poses(qtbot, document, path)
    assert document.pose_name == "kick"
    assert not document.modified


def test_a_file_of_another_model_offers_that_model(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    snake, path = another_model(document.model), tmp_path / "snake.json"
    write_poses(path, snake, [NamedPose("kick", snake.training_latent[1])])
    before = document.latent
    with qtbot.waitSignal(document.of_other_model) as told:
        document.open_poses(path)
    (found,) = told.args
    assert (found.where, found.model.name) == (str(path), "snake")
    assert snake.fingerprint not in str(found)
    assert document.latent is before
    with qtbot.waitSignal(document.opened):
        document.open_poses(path, found.model.path)
    assert document.model.fingerprint == snake.fingerprint
    assert document.model_file == str(found.model.path)
    assert document.pose_name == "kick"
    assert np.array_equal(document.latent, snake.training_latent[1])


def test_the_fit_error_of_an_imported_mesh_is_kept_with_the_pose(
    document: PoseDocument, tmp_path: Path
) -> None:
    pose = NamedPose("scan", document.model.training_latent[1], None, 0.001, 0.02)
    document.begin_with(pose, Source.MESH)
    document.add_pose_to_library("scan")
    assert document.poses[0].fit_error_max == 0.02
    document.save(tmp_path / "scan.json")
    assert read_poses(tmp_path / "scan.json", document.model)[0].fit_error_mean == 0.001
    # What is changed is no longer what was fitted.
    document.set_code(0, 0.5)
    assert document.pose.fit_error_mean is None
