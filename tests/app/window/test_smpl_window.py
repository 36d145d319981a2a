"""A body model and a motion of it in the window: opened, in the motion's shape, and exported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PySide6.QtCore import QTimer
from pytestqt.qtbot import QtBot

from app.editing.recovery import Autosave, find_recoverable_poses
from app.window.main_window import MainWindow
from tests.app.windows import PATIENCE, accept_and_choose, answer, drop
from tests.smpl_files import motion_arrays, tiny_arrays

N_FRAMES = 4


def test_a_motion_shapes_the_body_and_comes_back(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, out = window.document, tmp_path / "out.npz"
    model, walk = tmp_path / "SMPL_NEUTRAL.npz", tmp_path / "walk.npz"
    np.savez(model, **tiny_arrays())
    np.savez(walk, **motion_arrays(24, N_FRAMES))
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        drop(window, model)
    assert document.model.name == "SMPL_NEUTRAL"
    assert len(document.model.known_poses) == 1
    plain, timeline = document.model, document.timeline
    drop(window, walk)
    qtbot.waitUntil(lambda: timeline.motion is not None)
    assert timeline.motion is not None
    assert (timeline.motion.name, len(timeline.motion)) == ("walk", N_FRAMES)
    assert document.model is not plain
    assert document.model.fingerprint != plain.fingerprint
    assert Path(document.history.model_file) == model
    qtbot.waitUntil(lambda: timeline.checks.n_checked == N_FRAMES)
    timeline.go_to(2)
    document.motion.set_code(document.model.latent_size - 1, 0.2)
    document.motion.end_gesture()
    qtbot.waitUntil(lambda: bool(timeline.changes))
    # As after a crash: the autosaved edits, and the body as first opened.
    codes = timeline.motion.codes
    sessions = tmp_path / "sessions"
    assert Autosave(document, sessions, seconds=1000.0).close(keep=True)
    timeline.mark_saved()
    with qtbot.waitSignal(document.tasks.opened, timeout=PATIENCE):
        document.tasks.open_model(model)
    assert document.model.fingerprint == plain.fingerprint
    (lost,) = find_recoverable_poses(sessions)
    autosave = Autosave(document, sessions, seconds=1000.0)
    with qtbot.waitSignal(autosave.recovered, timeout=PATIENCE):
        autosave.recover(lost)
    assert autosave.close()
    assert timeline.motion.codes.tobytes() == codes.tobytes()
    timers: list[QTimer] = []
    timers.append(answer(accept_and_choose(out, timers)))
    window.actions_by_key["export_timeline"].trigger()
    qtbot.waitUntil(timeline.are_saved)
    with np.load(walk) as old, np.load(out) as new:
        assert new.files == old.files
        assert (new["poses"][2] != old["poses"][2]).any()
