"""Autosave: unsaved work survives a crash, and no running editor loses its session."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from shutil import copyfile

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.recovery import Autosave, Session, find_recoverable_poses
from app.editing.timeline import Timeline
from lcollision_core.bodies import (
    LearnedBody,
    NamedPose,
    as_scene,
    open_body,
    read_pose_file,
    read_poses,
    write_poses,
)
from lcollision_core.bodies.motions import read_motions
from lcollision_core.motion import Motion
from lcollision_core.tasks.scenes import kept_scene, scene_of_files
from tests.core.motion.swings import CLIP, OTHER

EDITOR = """
import sys
from pathlib import Path
from PySide6.QtCore import QTimer
from PySide6.QtGui import QGuiApplication
from app.editing.document import PoseDocument
from app.editing.recovery import Autosave

application = QGuiApplication(sys.argv)
document = PoseDocument()
document.motion.set_solid(False)
autosave = Autosave(document, Path(sys.argv[2]), seconds=0.1)
autosave.written.connect(lambda: print("written", flush=True))
autosave.failed.connect(lambda failure: print(failure.headline, flush=True))

def edit():
    document.library.add_pose("kick")
    document.motion.set_code(2, 0.625)
    document.motion.set_locked(1, True)

document.failed.connect(lambda failure: print(failure.headline, flush=True))
QTimer.singleShot(60_000, application.quit)
document.model_changed.connect(edit)
document.tasks.open_model(sys.argv[1])
application.exec()
"""

EDITOR_OF_MOTION = """
import sys
from pathlib import Path
from PySide6.QtCore import QTimer
from PySide6.QtGui import QGuiApplication
from app.editing.document import PoseDocument
from app.editing.recovery import Autosave

application = QGuiApplication(sys.argv)
document = PoseDocument()
document.motion.set_solid(False)
document.failed.connect(lambda failure: print(failure.headline, flush=True))
timeline = document.timeline

def resolve():
    if timeline.motion is None:
        QTimer.singleShot(10, resolve)
        return
    timeline.go_to(7)
    timeline.resolve()
    edit()

def edit():
    global autosave
    if document.tasks.solving_motion:
        QTimer.singleShot(10, edit)
        return
    document.motion.set_code(10, 0.25)
    autosave = Autosave(document, Path(sys.argv[2]), seconds=0.1)
    autosave.failed.connect(lambda failure: print(failure.headline, flush=True))
    autosave.written.connect(lambda: print("written", flush=True))
    document.motion.set_locked(1, True)

QTimer.singleShot(60_000, application.quit)
document.model_changed.connect(resolve)
document.tasks.open_model(sys.argv[1])
application.exec()
"""


@pytest.fixture(scope="module")
def model_file(editor_model: LearnedBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "tube.safetensors"
    editor_model.save(path)
    return path


@pytest.fixture
def autosave(document: PoseDocument, tmp_path: Path) -> Iterator[Autosave]:
    held = Autosave(document, tmp_path / "sessions", seconds=0.05)
    yield held
    assert held.close()


def let_die(script: str, opened: Path, folder: Path) -> None:
    """Kill an editor, run by a script on a file, once it reports its autosave."""
    editor = subprocess.Popen(
        [sys.executable, "-c", script, str(opened), str(folder)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert editor.stdout is not None
        assert editor.stdout.readline() == "written\n"
        # A running editor's session is not lost.
        assert find_recoverable_poses(folder) == []
    finally:
        editor.send_signal(signal.SIGKILL)
        editor.wait()
        editor.stdout.close()


@pytest.mark.slow
def test_a_killed_editor_loses_nothing_that_was_written(
    qtbot: QtBot, document: PoseDocument, model_file: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "sessions"
    let_die(EDITOR, model_file, folder)
    (lost,) = find_recoverable_poses(folder)
    assert lost.note.pose_name == "kick"
    assert Path(lost.note.model) == model_file
    assert lost.note.file is None
    # Another editor that starts now finds nothing: this one holds the session.
    assert find_recoverable_poses(folder) == []

    autosave = Autosave(document, folder, seconds=0.05)
    with qtbot.waitSignal(autosave.recovered, timeout=20_000):
        autosave.recover(lost)
    assert document.history.latent[2] == 0.625
    assert document.motion.locked_domains == {1}
    assert document.history.pose.name == "kick"
    assert [pose.name for pose in document.library.poses] == ["kick"]
    assert document.history.modified
    assert document.history.model_file == str(model_file)
    # The session is kept until its contents are saved.
    assert lost.poses_file.is_file()
    document.tasks.save(tmp_path / "kick.json")
    document.tasks.wait_for_saves()
    qtbot.waitUntil(lambda: not lost.poses_file.exists())
    assert autosave.close()
    assert list(folder.iterdir()) == []


@pytest.mark.slow
def test_what_cannot_be_read_stays_for_another_day(model_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "sessions"
    let_die(EDITOR, model_file, folder)
    (session,) = folder.iterdir()
    kept = (session / "session.json").read_text()
    # Simulate a disk error.
    (session / "session.json").unlink()
    (session / "session.json").mkdir()
    assert find_recoverable_poses(folder) == []
    (session / "session.json").rmdir()
    (session / "session.json").write_text(kept)
    (lost,) = find_recoverable_poses(folder)
    assert lost.note.pose_name == "kick"
    lost.session.discard()
    # A session without a pose is useless.
    session.mkdir()
    (session / "session.json").write_text(kept)
    assert find_recoverable_poses(folder) == []
    assert not session.exists()


def test_an_editor_told_to_end_keeps_its_last_edit(document: PoseDocument, tmp_path: Path) -> None:
    """Even an edit that was not due to be written yet; without an edit, nothing is kept."""
    folder = tmp_path / "sessions"
    for edited in (False, True):
        if edited:
            document.motion.set_code(0, 0.5)
            document.pins.pin([document.motion.grip_at(3)])
        autosave = Autosave(document, folder, seconds=1000.0)
        assert autosave.close(keep=True)
        found = find_recoverable_poses(folder)
        assert len(found) == edited
    (kept,) = read_poses(found[0].poses_file, document.model)
    assert kept.latent[0] == 0.5
    assert [pin.vertex for pin in kept.pins] == [3]
    assert kept.pins == document.history.pose.pins


def test_the_poses_of_the_file_are_recovered_beside_the_working_pose(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    path, folder = tmp_path / "poses.json", tmp_path / "sessions"
    held = [NamedPose(name, document.model.known_poses[k]) for k, name in enumerate("ab")]
    write_poses(path, document.model, held)
    with qtbot.waitSignal(document.tasks.opened):
        document.tasks.open_poses(path)
    document.motion.set_code(0, 0.5)
    working = document.history.latent.tobytes()
    assert Autosave(document, folder, seconds=1000.0).close(keep=True)
    document.history.mark_saved()
    document.new_pose()
    (lost,) = find_recoverable_poses(folder)
    autosave = Autosave(document, folder, seconds=1000.0)
    with qtbot.waitSignal(autosave.recovered):
        autosave.recover(lost)
    assert document.history.latent.tobytes() == working
    assert document.history.pose.name == "a"
    assert document.history.file == path
    assert document.history.modified
    assert [pose.latent.tobytes() for pose in document.history.file_poses] == [
        pose.latent.tobytes() for pose in held
    ]
    document.tasks.save()
    document.tasks.wait_for_saves()
    assert not document.history.modified
    assert read_pose_file(path, document.model).poses[0].latent[0] == held[0].latent[0]
    assert autosave.close()


@pytest.mark.parametrize("end", ["untouched", "newer", "unknown"])
def test_save_after_a_recovery_sees_that_another_program_wrote_the_file(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, end: str
) -> None:
    path, folder = tmp_path / "poses.json", tmp_path / "sessions"
    document.tasks.save(path)
    document.tasks.wait_for_saves()
    document.motion.set_code(0, 0.5)
    assert Autosave(document, folder, seconds=1000.0).close(keep=True)
    document.history.mark_saved()
    document.new_pose()
    if end == "newer":
        write_poses(path, document.model, document.history.file_poses, document.history.pose)
    if end == "unknown":
        # A session of an older version.
        (session,) = folder.glob("*/session.json")
        held = json.loads(session.read_text())
        del held["file_stamp"]
        session.write_text(json.dumps(held))
    (lost,) = find_recoverable_poses(folder)
    autosave = Autosave(document, folder, seconds=1000.0)
    with qtbot.waitSignal(autosave.recovered):
        autosave.recover(lost)
    assert document.history.file == path
    assert document.history.file_changed_elsewhere == (end != "untouched")
    document.tasks.save()
    document.tasks.wait_for_saves()
    assert not document.history.file_changed_elsewhere
    assert autosave.close()


def test_nothing_is_kept_of_what_is_saved(
    qtbot: QtBot, document: PoseDocument, autosave: Autosave, tmp_path: Path
) -> None:
    with qtbot.waitSignal(autosave.written):
        document.motion.set_code(0, 0.5)
    (kept,) = (tmp_path / "sessions").glob("*/poses.json")
    document.history.undo()
    qtbot.waitUntil(lambda: not kept.exists())
    with qtbot.waitSignal(autosave.written):
        document.history.redo()
    document.tasks.save(tmp_path / "pose.json")
    document.tasks.wait_for_saves()
    qtbot.waitUntil(lambda: not kept.exists())


def test_a_long_drag_is_kept_while_it_lasts(
    qtbot: QtBot, document: PoseDocument, autosave: Autosave
) -> None:
    document.motion.begin_gesture("Drag")
    document.motion.set_code(0, 0.5)
    with qtbot.waitSignal(autosave.written):
        document.motion.set_code(0, 0.6)
    document.motion.end_gesture()


def test_a_lock_that_changes_later_is_kept_too(
    qtbot: QtBot, document: PoseDocument, autosave: Autosave, tmp_path: Path
) -> None:
    with qtbot.waitSignal(autosave.written):
        document.motion.set_code(0, 0.5)
    with qtbot.waitSignal(autosave.written):
        document.motion.set_locked(0, True)
    autosave.close(keep=True)
    (lost,) = find_recoverable_poses(tmp_path / "sessions")
    assert lost.note.locked == (0,)


@pytest.mark.usefixtures("autosave")
def test_sessions_of_living_editors_are_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "sessions"
    (mine,) = folder.iterdir()
    assert Session.try_lock(mine) is None
    assert find_recoverable_poses(folder) == []
    assert mine.is_dir()


def test_a_session_without_a_pose_is_cleared_away(tmp_path: Path) -> None:
    session = Session.new(tmp_path)
    session.release()
    (session.folder / "session.json").write_text("{ this is not JSON")
    assert find_recoverable_poses(tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_a_recovery_that_fails_keeps_what_there_is(
    qtbot: QtBot, document: PoseDocument, autosave: Autosave, tmp_path: Path
) -> None:
    lost_folder = tmp_path / "lost"
    session = Session.new(lost_folder)
    session.release()
    (session.folder / "poses.json").write_text("[]")
    (session.folder / "session.json").write_text(
        '{"model": "/no/such/model.safetensors", "pose_name": "kick", "file": null}'
    )
    (lost,) = find_recoverable_poses(lost_folder)
    with qtbot.waitSignal(document.failed):
        autosave.recover(lost)
    assert lost.poses_file.is_file()
    assert not document.history.modified
    lost.session.discard()
    assert list(lost_folder.iterdir()) == []


def test_an_editor_without_a_disk_to_write_to_works(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, where the folder should be")
    autosave = Autosave(document, blocked, seconds=0.01)
    document.motion.set_code(0, 0.5)
    qtbot.waitUntil(lambda: document.motion.exact is not None)
    assert autosave.close()


def test_an_unforeseen_failure_to_write_is_told(
    qtbot: QtBot, document: PoseDocument, autosave: Autosave, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lcollision_core.bodies.write_poses", lambda *_: 1 / 0)
    with qtbot.waitSignal(autosave.failed):
        document.motion.set_code(0, 0.5)


def test_a_failing_disk_is_told_of_once(
    qtbot: QtBot, document: PoseDocument, autosave: Autosave, tmp_path: Path
) -> None:
    (folder,) = (tmp_path / "sessions").iterdir()
    (folder / "poses.json").mkdir()
    failures = []
    autosave.failed.connect(failures.append)
    with qtbot.waitSignal(autosave.failed):
        document.motion.set_code(0, 0.5)
    (folder / "poses.json").rmdir()
    with qtbot.waitSignal(autosave.written):
        document.motion.set_code(0, 0.6)
    assert len(failures) == 1
    assert "save them to a file" in failures[0].next_step


@pytest.fixture
def swing(swing: Path, tmp_path: Path) -> Path:
    """Return a private copy of a character whose arm swings through its trunk."""
    return copyfile(swing, tmp_path / "swing.glb")


def opened(qtbot: QtBot, document: PoseDocument, swing: Path) -> Timeline:
    with qtbot.waitSignal(document.tasks.opened):
        document.tasks.open_model(swing)
    qtbot.waitUntil(lambda: document.timeline.motion is not None)
    document.motion.set_solid(False)
    return document.timeline


def edited_by_hand(document: PoseDocument, frame: int, by: float) -> Motion:
    """Edit a frame of the open motion, and return the motion."""
    document.timeline.go_to(frame)
    document.motion.set_code(10, float(document.history.latent[10]) + by)
    motion = document.timeline.motion
    assert motion is not None
    return motion


@pytest.mark.slow
def test_a_killed_editor_loses_no_edit_of_a_motion(
    qtbot: QtBot, document: PoseDocument, swing: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "sessions"
    let_die(EDITOR_OF_MOTION, swing, folder)
    (lost,) = find_recoverable_poses(folder)
    assert (lost.note.motion, lost.note.pose_name, lost.motion_loss_reason) == (
        CLIP,
        f"{CLIP} 7",
        "",
    )
    assert lost.poses_file.stat().st_size < 100_000

    autosave = Autosave(document, folder, seconds=1000.0)
    with qtbot.waitSignal(autosave.recovered):
        autosave.recover(lost)
    timeline = document.timeline
    motion, read = timeline.motion, timeline.original
    assert motion is not None
    assert read is not None
    assert (motion.name, timeline.frame, list(timeline.motions)) == (CLIP, 7, [CLIP, OTHER])
    # The resolved spans, with the correction by hand on top.
    (again,) = read_motions(open_body(swing), swing, CLIP)
    assert read.codes.tobytes() == again.codes.tobytes()
    check = document.model.exact_check()
    colliding = ~check.are_free(read.codes)
    assert colliding.any()
    assert check.are_free(motion.codes)[colliding].all()
    assert motion.codes[7, 10] == 0.25
    assert document.history.latent.tobytes() == motion.codes[7].tobytes()
    # There is nothing to undo, and everything to export.
    assert document.history.undo_stack.count() == 0
    assert document.history.modified
    assert timeline.changes == [(read, motion)]
    # Further edits are kept as well, until they are exported.
    timeline.go_to(9)
    assert autosave.close(keep=True)
    (lost,) = find_recoverable_poses(folder)
    assert lost.note.pose_name == f"{CLIP} 9"
    lost.session.release()


def test_edits_of_several_clips_are_recovered_with_what_was_exported(
    qtbot: QtBot, document: PoseDocument, swing: Path, tmp_path: Path
) -> None:
    timeline = opened(qtbot, document, swing)
    first = edited_by_hand(document, 20, 0.3)
    timeline.mark_saved([first])
    timeline.choose(OTHER)
    qtbot.waitUntil(lambda: timeline.motion is not None and timeline.motion.name == OTHER)
    second = edited_by_hand(document, 3, 0.2)
    document.pins.pin([document.motion.grip_at(3)])
    assert Autosave(document, tmp_path / "sessions", seconds=1000.0).close(keep=True)
    timeline.mark_saved()
    document.new_pose()
    (lost,) = find_recoverable_poses(tmp_path / "sessions")
    autosave = Autosave(document, tmp_path / "sessions", seconds=1000.0)
    with qtbot.waitSignal(autosave.recovered):
        autosave.recover(lost)
    assert {now.name: now.codes.tobytes() for _, now in timeline.changes} == {
        CLIP: first.codes.tobytes(),
        OTHER: second.codes.tobytes(),
    }
    assert timeline.frame == 3
    assert [pin.vertex for pin in document.history.pose.pins] == [3]
    assert not timeline.are_saved()
    motion = timeline.motion
    assert motion is not None
    assert motion.name == OTHER
    # The other one was exported.
    timeline.mark_saved([motion])
    assert timeline.are_saved()
    assert autosave.close()


def test_the_motion_of_a_scene_is_recovered_though_another_body_is_open_since(
    qtbot: QtBot, document: PoseDocument, swing: Path, tmp_path: Path
) -> None:
    path = kept_scene(scene_of_files([swing, swing]))
    timeline = opened(qtbot, document, path)
    edited = edited_by_hand(document, 20, 0.3)
    assert Autosave(document, tmp_path / "sessions", seconds=1000.0).close(keep=True)
    timeline.mark_saved()
    opened(qtbot, document, swing)
    (lost,) = find_recoverable_poses(tmp_path / "sessions")
    autosave = Autosave(document, tmp_path / "sessions", seconds=1000.0)
    with qtbot.waitSignal(autosave.recovered):
        autosave.recover(lost)
    scene = as_scene(document.model)
    assert scene is not None
    assert len(scene.members) == 2
    assert timeline.frame == 20
    ((_, now),) = timeline.changes
    assert now.codes.tobytes() == edited.codes.tobytes()
    assert autosave.close()


@pytest.mark.parametrize(
    ("happens", "told"), [("touched", "was changed since"), ("truncated", "was changed since")]
)
def test_the_pose_alone_comes_back_where_the_motion_s_file_is_another(
    qtbot: QtBot, document: PoseDocument, swing: Path, tmp_path: Path, happens: str, told: str
) -> None:
    opened(qtbot, document, swing)
    motion = edited_by_hand(document, 20, 0.3)
    assert Autosave(document, tmp_path / "sessions", seconds=1000.0).close(keep=True)
    document.timeline.mark_saved()
    document.new_pose()
    if happens == "touched":
        swing.touch()
    else:
        swing.write_bytes(swing.read_bytes()[:100])
    (lost,) = find_recoverable_poses(tmp_path / "sessions")
    assert lost.motion_loss_reason == f"swing.glb {told}"
    autosave = Autosave(document, tmp_path / "sessions", seconds=1000.0)
    with qtbot.waitSignal(document.failed) as failed:
        autosave.recover(lost)
    assert failed.args[0].headline == (
        f"The edits of “{CLIP}” can't be recovered, as swing.glb {told}; "
        "its frame is recovered as a pose"
    )
    assert document.history.latent.tobytes() == motion.codes[20].tobytes()
    assert document.history.modified
    assert document.timeline.frame is None
    assert autosave.close()


def test_a_motion_of_another_file_that_is_gone_leaves_its_pose(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    poses = [
        NamedPose(f"{k}", row.astype(np.float64))
        for k, row in enumerate(document.model.known_poses[:6])
    ]
    path = tmp_path / "walk.json"
    write_poses(path, document.model, poses)
    document.timeline.open(path)
    qtbot.waitUntil(lambda: document.timeline.motion is not None)
    document.timeline.go_to(2)
    document.motion.set_solid(False)
    document.motion.set_code(2, 0.625)
    assert Autosave(document, tmp_path / "sessions", seconds=1000.0).close(keep=True)
    document.timeline.mark_saved()
    document.new_pose()
    (lost,) = find_recoverable_poses(tmp_path / "sessions")
    assert (lost.note.motion, lost.motion_loss_reason) == ("walk", "")
    path.rename(tmp_path / "elsewhere.json")
    assert lost.motion_loss_reason == "walk.json is gone"
    autosave = Autosave(document, tmp_path / "sessions", seconds=1000.0)
    with qtbot.waitSignal(document.failed) as failed:
        autosave.recover(lost)
    assert "as walk.json is gone; its frame" in failed.args[0].headline
    assert document.history.latent[2] == 0.625
    assert document.timeline.frame is None
    assert autosave.close()


def test_edits_beyond_the_bound_are_told_of_and_the_pose_is_kept(
    qtbot: QtBot,
    document: PoseDocument,
    swing: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("app.editing.recovery.MOST_BYTES", 100)
    opened(qtbot, document, swing)
    autosave = Autosave(document, tmp_path / "sessions", seconds=0.05)
    with qtbot.waitSignal(autosave.failed) as failed:
        motion = edited_by_hand(document, 20, 0.3)
    assert f"the motion “{CLIP}” has edits of more than" in failed.args[0].headline
    assert failed.args[0].next_step == "export the motion"
    assert autosave.close(keep=True)
    (lost,) = find_recoverable_poses(tmp_path / "sessions")
    assert lost.note.motion == ""
    (pose,) = read_poses(lost.poses_file, document.model)
    assert pose.latent.tobytes() == motion.codes[20].tobytes()
    lost.session.release()
