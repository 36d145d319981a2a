"""The working pose and the library are independent: neither overwrites the other."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.history import Source
from app.editing.live_pose import training_pose
from lcollision_core.bodies import NamedPose, read_pose_file, read_poses, write_poses
from lcollision_core.errors import ModelFileError
from tests.app.editor_model import another_model


def names(document: PoseDocument) -> list[str]:
    return [pose.name for pose in document.library.poses]


def of_library(document: PoseDocument, name: str) -> NamedPose:
    (found,) = (pose for pose in document.library.poses if pose.name == name)
    return found


def in_file(document: PoseDocument) -> dict[str, bytes]:
    """Return the library that another editor would read now."""
    document.tasks.wait_for_saves()
    other = PoseDocument(document.model)
    other.motion.set_solid(False)
    found = {pose.name: pose.latent.tobytes() for pose in other.library.poses}
    assert other.close()
    return found


def open_poses(qtbot: QtBot, document: PoseDocument, path: Path) -> None:
    with qtbot.waitSignal(document.tasks.opened):
        document.tasks.open_poses(path)


def test_saving_a_changed_pose_leaves_the_kept_one_as_it_was(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    kept = document.history.latent.tobytes()
    document.library.add_pose("A")
    assert in_file(document) == {"A": kept}
    document.motion.set_code(0, 0.5)
    changed = document.history.latent.tobytes()
    assert document.history.changed
    document.tasks.save(tmp_path / "poses.json")
    document.tasks.wait_for_saves()
    document.motion.load_pose(of_library(document, "A"))
    assert document.history.latent.tobytes() == kept
    assert not document.history.changed
    assert in_file(document) == {"A": kept}
    open_poses(qtbot, document, tmp_path / "poses.json")
    assert document.history.latent.tobytes() == changed
    assert names(document) == ["A"]


def test_a_pose_that_is_blended_fully_into_another_leaves_the_kept_one_as_it_was(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    document.motion.load_pose(training_pose(document.model, 3))
    document.library.add_pose("hand on hip")
    kept = document.history.latent.tobytes()
    document.new_pose()
    document.motion.load_pose(of_library(document, "hand on hip"))
    document.motion.begin_gesture("Blend towards T pose")
    document.motion.blend_towards(document.model.known_poses[5], 1.0)
    document.motion.end_gesture()
    document.tasks.save(tmp_path / "work.json")
    document.tasks.wait_for_saves()
    document.new_pose()
    assert names(document) == ["hand on hip"]
    open_poses(qtbot, document, tmp_path / "work.json")
    assert np.array_equal(document.history.latent, document.model.known_poses[5])
    document.motion.load_pose(of_library(document, "hand on hip"))
    assert document.history.latent.tobytes() == kept
    assert in_file(document) == {"hand on hip": kept}


def test_update_changes_the_kept_pose_and_undo_brings_it_back_to_the_bit(
    document: PoseDocument,
) -> None:
    assert document.history.library_pose is None
    with pytest.raises(ModelFileError, match="is not in your library"):
        document.library.update_pose()
    document.library.add_pose("A")
    document.library.tag_poses(["A"], ["kick"])
    assert not document.library.can_update
    kept = document.history.latent.tobytes()
    document.motion.set_code(0, 0.5)
    changed = document.history.latent.tobytes()
    assert document.library.can_update
    document.library.update_pose()
    assert document.history.undo_stack.undoText() == "Update A"
    assert not document.library.can_update
    assert in_file(document) == {"A": changed}
    assert of_library(document, "A").tags == ("kick",)
    document.history.undo()
    assert document.library.can_update
    assert in_file(document) == {"A": kept}
    assert document.history.latent.tobytes() == changed
    document.history.redo()
    assert in_file(document) == {"A": changed}
    document.library.remove_poses(["A"])
    assert not document.library.can_update
    assert document.history.library_pose is None


def test_replace_puts_the_pose_in_another_s_place(document: PoseDocument) -> None:
    for name in ("A", "B"):
        document.library.add_pose(name)
    document.motion.set_code(0, 0.5)
    document.library.replace_pose("A")
    assert names(document) == ["A", "B"]
    assert of_library(document, "A").latent[0] == 0.5
    assert of_library(document, "B").latent[0] == 0.0
    assert document.history.pose.name == "A"
    document.history.undo()
    assert of_library(document, "A").latent[0] == 0.0
    assert document.history.pose.name == "B"


def test_the_library_is_undone_like_the_pose(document: PoseDocument) -> None:
    document.library.add_pose("kick")
    document.library.add_pose("kick")
    assert names(document) == ["kick", "kick 2"]
    assert document.history.pose.name == "kick 2"
    for name, sentence in (
        ("kick", "already has a pose “kick”"),
        ("KICK", "already has a pose “kick”"),
        ("", "needs a name"),
        ("x" * 201, "at most 200 characters"),
    ):
        with pytest.raises(ModelFileError, match=sentence):
            document.library.rename_pose("kick 2", name)
    for change in (
        lambda: document.library.rename_pose("bend 2", "leap"),
        lambda: document.library.remove_poses(["bend 2"]),
        lambda: document.library.tag_poses(["bend 2"], []),
        lambda: document.library.replace_pose("bend 2"),
    ):
        with pytest.raises(ModelFileError, match="no pose 'bend 2'"):
            change()
    document.library.rename_pose("kick 2", "jump")
    assert document.history.pose.name == "jump"
    document.library.remove_poses(["kick"])
    document.library.duplicate_poses(document.library.poses)
    document.library.tag_poses(["jump", "jump 2"], ["leg"])
    document.library.remove_poses(["jump", "jump 2"])
    history: list[tuple[str, list[str]]] = []
    while document.history.undo_stack.canUndo():
        history.append((document.history.undo_stack.undoText(), names(document)))
        assert list(in_file(document)) == names(document)
        document.history.undo()
    assert history == [
        ("Remove 2 poses", []),
        ("Tag 2 poses", ["jump", "jump 2"]),
        ("Duplicate jump", ["jump", "jump 2"]),
        ("Remove kick", ["jump"]),
        ("Rename kick 2", ["kick", "jump"]),
        ("Add kick 2", ["kick", "kick 2"]),
        ("Add kick", ["kick"]),
    ]
    assert document.library.poses == ()
    for _, after in reversed(history):
        document.history.redo()
        assert names(document) == after


def test_the_library_stays_from_start_to_start_and_from_model_to_model(
    document: PoseDocument,
) -> None:
    document.library.add_pose("A")
    model = document.model
    document.new_pose()
    assert names(document) == ["A"]
    document.set_model(model)
    document.tasks.wait_for_saves()
    assert names(document) == ["A"]


def test_what_another_editor_keeps_is_seen_and_never_lost(document: PoseDocument) -> None:
    document.library.add_pose("mine")
    document.tasks.wait_for_saves()
    other = PoseDocument(document.model)
    other.motion.set_solid(False)
    other.library.add_pose("theirs")
    other.tasks.wait_for_saves()
    document.library.refresh()
    assert names(document) == ["mine", "theirs"]
    document.history.undo()
    assert names(document) == ["theirs"]
    assert list(in_file(document)) == ["theirs"]
    assert other.close()


def test_a_damaged_library_is_told_of(qtbot: QtBot, document: PoseDocument) -> None:
    document.library.add_pose("A")
    document.tasks.wait_for_saves()
    assert document.history.store is not None
    document.history.store.path.write_text("[1, 2")
    with qtbot.waitSignal(document.failed) as told:
        document.set_model(document.model)
    assert "set aside as" in told.args[0].headline
    assert document.library.poses == ()


def test_a_pose_of_a_library_that_cannot_be_written_is_still_to_be_saved(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, where the folder should be")
    other = PoseDocument(document.model, library_folder=blocked)
    other.motion.set_solid(False)
    other.motion.set_code(0, 0.5)
    with qtbot.waitSignal(other.failed) as told:
        other.library.add_pose("A")
    assert "could not be saved" in told.args[0].headline
    assert names(other) == ["A"]
    assert other.history.modified
    blocked.unlink()
    other.library.add_pose("B")
    other.tasks.wait_for_saves()
    assert not other.history.modified
    assert sorted(blocked.glob("*.json"))
    assert other.close()


@pytest.mark.parametrize("end", ["close", "another model"])
def test_what_the_library_could_not_write_is_written_before_it_goes(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, end: str
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, where the folder should be")
    other = PoseDocument(document.model, library_folder=blocked)
    other.motion.set_solid(False)
    with qtbot.waitSignal(other.failed):
        other.library.add_pose("A")
    blocked.unlink()
    if end == "another model":
        other.set_model(document.model)
        qtbot.waitUntil(lambda: names(other) == ["A"])
    assert other.close()
    assert len(list(blocked.glob("*.json"))) == 1


def test_a_pose_that_nobody_touched_is_not_marked_changed(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    """Neither loading nor keeping it counts; a pose that is nowhere else is marked."""
    document.motion.load_pose(training_pose(document.model, 2))
    assert not document.history.modified
    document.library.add_pose("A")
    document.tasks.wait_for_saves()
    assert not document.history.modified
    document.motion.set_code(0, 0.5)
    assert document.history.modified
    document.library.update_pose()
    document.tasks.wait_for_saves()
    assert not document.history.modified
    document.library.remove_poses(["A"])
    document.tasks.wait_for_saves()
    assert document.history.modified
    document.history.undo()
    document.motion.set_code(0, 0.75)
    document.tasks.save(tmp_path / "pose.json")
    document.tasks.wait_for_saves()
    assert not document.history.modified
    # A file is open now: the loaded pose is not the file's.
    document.motion.load_pose(training_pose(document.model, 2))
    assert document.history.modified
    document.history.undo()
    document.tasks.wait_for_saves()
    assert not document.history.modified
    open_poses(qtbot, document, tmp_path / "pose.json")
    assert not document.history.modified


def test_a_files_poses_are_neither_changed_nor_put_into_the_library(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    latent, path = document.model.known_poses, tmp_path / "poses.json"
    write_poses(path, document.model, [NamedPose(n, latent[k]) for k, n in enumerate("abc")])
    document.library.add_pose("mine")
    open_poses(qtbot, document, path)
    assert [pose.name for pose in document.history.file_poses] == ["a", "b", "c"]
    assert names(document) == ["mine"]
    assert document.history.pose.name == "a"
    document.motion.load_pose(document.history.file_poses[1])
    document.motion.set_code(0, 0.5)
    assert document.history.changed
    document.tasks.save()
    document.tasks.wait_for_saves()
    assert not document.history.changed
    held = read_pose_file(path, document.model)
    assert [pose.latent.tobytes() for pose in held.poses] == [row.tobytes() for row in latent[:3]]
    assert held.working is not None
    assert held.working.latent[0] == 0.5
    assert [pose.name for pose in read_poses(path, document.model)] == ["a", "b", "c", "b 2"]
    document.library.add_poses(document.history.file_poses)
    document.library.add_poses(document.history.file_poses)
    assert names(document) == ["mine", "a", "b", "c"]
    document.history.undo()
    assert names(document) == ["mine"]
    document.new_pose()
    assert document.history.file_poses == ()


def test_a_file_of_the_first_version_opens(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    path = tmp_path / "old.json"
    write_poses(path, document.model, [NamedPose("kick", document.model.known_poses[1])])
    assert json.loads(path.read_text())["format_version"] == 1
    open_poses(qtbot, document, path)
    assert document.history.pose.name == "kick"
    assert not document.history.modified


def test_a_file_of_another_model_offers_that_model(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    snake, path = another_model(document.model), tmp_path / "snake.json"
    write_poses(path, snake, [NamedPose("kick", snake.known_poses[1])])
    before = document.history.latent
    with qtbot.waitSignal(document.tasks.of_other_model) as told:
        document.tasks.open_poses(path)
    (found,) = told.args
    assert (found.where, found.model.name) == (str(path), "snake")
    assert snake.fingerprint not in str(found)
    assert document.history.latent is before
    with qtbot.waitSignal(document.tasks.opened):
        document.tasks.open_poses(path, found.model.path)
    assert document.model.fingerprint == snake.fingerprint
    assert document.history.model_file == str(found.model.path)
    assert document.history.pose.name == "kick"
    assert np.array_equal(document.history.latent, snake.known_poses[1])


def test_the_fit_error_of_an_imported_mesh_is_kept_with_the_pose(
    document: PoseDocument, tmp_path: Path
) -> None:
    pose = NamedPose("scan", document.model.known_poses[1], None, 0.001, 0.02)
    document.history.begin_with(pose, Source.MESH)
    document.library.add_pose("scan")
    assert document.library.poses[0].fit_error_max == 0.02
    document.tasks.save(tmp_path / "scan.json")
    document.tasks.wait_for_saves()
    assert read_poses(tmp_path / "scan.json", document.model)[0].fit_error_mean == 0.001
    # The fit error does not apply to a changed pose.
    document.motion.set_code(0, 0.5)
    assert document.history.pose.fit_error_mean is None
