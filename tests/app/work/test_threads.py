"""The threads: the newest request wins, no old frame is shown, a failure breaks nothing."""

from __future__ import annotations

import gc
import threading
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.tasks import Work
from app.window.memory import GarbageCollector
from app.work.frames import FrameEvaluator, PoseFrame
from app.work.threads import Failure, LongWork
from lcollision_core.bodies import LearnedBody, NamedPose, sample_poses, write_poses
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import Job
from lcollision_core.resolve import PoseResolver


def settle(qtbot: QtBot, document: PoseDocument) -> None:
    qtbot.waitUntil(lambda: document.motion.exact is not None and not document.tasks.busy)


def test_a_burst_of_changes_is_one_frame(qtbot: QtBot, document: PoseDocument) -> None:
    frames: list[PoseFrame | None] = []
    document.motion.frame_changed.connect(lambda: frames.append(document.motion.frame))
    for value in np.linspace(0.0, 1.0, 200):
        document.motion.set_code(0, value)
    settle(qtbot, document)
    assert [frame.latent[0] for frame in frames if frame] == [1.0]


def test_the_mesh_follows_250_events_and_ends_right(qtbot: QtBot, document: PoseDocument) -> None:
    values = iter(np.linspace(-1.0, 1.0, 250))
    shown: list[float] = []
    n_before: list[int] = []

    def note() -> None:
        if document.motion.frame is not None:
            shown.append(float(document.motion.frame.latent[0]))

    def step() -> None:
        value = next(values, None)
        if value is None:
            timer.stop()
            return
        n_before.append(len(shown))
        document.motion.set_code(0, value)

    document.motion.frame_changed.connect(note)
    timer = QTimer(document)
    timer.timeout.connect(step)
    document.motion.begin_gesture("Drag")
    timer.start(8)
    qtbot.waitUntil(lambda: bool(shown) and shown[-1] == 1.0, timeout=20_000)
    document.motion.end_gesture()
    settle(qtbot, document)
    # No frame is shown twice, or returns to an earlier pose of a drag in one direction.
    assert shown == sorted(set(shown))
    # Frames arrive during the drag; after the last event, only the pending and the newest one do.
    assert n_before[-1] > 1
    assert len(shown) - n_before[-1] <= 2
    assert document.motion.frame is not None
    expected = document.model.decode(document.history.latent).astype(np.float32)
    assert document.motion.frame.vertices.tobytes() == expected.tobytes()


def test_a_late_frame_is_not_told_after_the_one_that_follows_it(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    compute = FrameEvaluator.frame
    begun: list[float] = []
    held = {0.1: threading.Event(), 0.2: threading.Event()}

    def starved(evaluator: FrameEvaluator, latent: npt.NDArray[np.float64], _: None) -> PoseFrame:
        """Report a short time, but be late, like a thread that gets no core."""
        begun.append(latent[0])
        frame = compute(evaluator, latent)
        if latent[0] in held:
            held[latent[0]].wait(120)
        return frame

    monkeypatch.setattr(FrameEvaluator, "frame", starved)
    told: list[float] = []
    document.motion.frame_changed.connect(lambda: told.append(document.motion.frame.latent[0]))
    document.motion.set_code(0, 0.1)
    qtbot.waitUntil(lambda: begun == [0.1])
    document.motion.set_code(0, 0.2)
    QApplication.processEvents()
    held[0.1].set()
    qtbot.waitUntil(lambda: told == [0.1] and begun == [0.1, 0.2])
    document.motion.set_code(0, 0.3)
    QApplication.processEvents()
    held[0.2].set()
    settle(qtbot, document)
    assert told == [0.1, 0.2, 0.3]
    assert document.motion.frame is not None
    assert document.motion.frame.latent is document.history.latent


def test_a_verdict_of_a_pose_that_has_moved_on_is_not_told(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.work.frames._QUICK_CHECK_SECONDS", 0.0)
    checking, go_on = threading.Event(), threading.Event()
    check = FrameEvaluator.checked
    frames: list[PoseFrame] = []

    def slow(evaluator: FrameEvaluator, frame: PoseFrame) -> PoseFrame:
        checking.set()
        go_on.wait(120)
        checked = check(evaluator, frame)
        if document.motion.resting is frame:
            frames.append(checked)
        return checked

    monkeypatch.setattr(FrameEvaluator, "checked", slow)
    told = []
    document.motion.exact_changed.connect(lambda: told.append(document.motion.exact))
    document.motion.set_code(0, 0.1)
    qtbot.waitUntil(checking.is_set)
    document.motion.set_code(0, 0.2)
    go_on.set()
    settle(qtbot, document)
    assert document.motion.frame is not None
    assert [found for found in told if found] == [document.motion.exact]
    (found,) = frames
    assert found.latent is document.history.latent


def test_cancel_ends_a_solve_at_once_and_leaves_the_pose(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    working, ended = endless_resolve(monkeypatch)
    state = document.history.latent
    document.tasks.resolve()
    assert document.tasks.solving
    assert document.tasks.busy == "Resolving"
    qtbot.waitUntil(working.is_set)
    document.tasks.cancel_resolve()
    assert not document.tasks.solving
    assert document.tasks.busy == ""
    qtbot.waitUntil(ended.is_set)
    assert document.history.latent is state
    assert document.history.undo_stack.count() == 0


def test_an_edit_cancels_a_solve(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    working, ended = endless_resolve(monkeypatch)
    document.tasks.resolve()
    qtbot.waitUntil(working.is_set)
    with qtbot.waitSignal(
        document.tasks.solve_finished, check_params_cb=lambda result: result is None
    ):
        document.motion.set_code(0, 0.5)
    qtbot.waitUntil(ended.is_set)
    settle(qtbot, document)
    assert document.history.latent[0] == 0.5
    assert document.history.undo_stack.count() == 1


def test_the_window_stays_live_in_a_solve(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    working, ended = endless_resolve(monkeypatch)
    document.tasks.resolve()
    qtbot.waitUntil(working.is_set)
    turns: list[bool] = []
    timer = QTimer(document)
    timer.timeout.connect(lambda: turns.append(document.tasks.solving))
    timer.start(5)
    qtbot.waitUntil(lambda: len(turns) > 20)
    timer.stop()
    assert all(turns)
    assert document.tasks.solving
    document.tasks.cancel_resolve()
    qtbot.waitUntil(ended.is_set)


def test_closing_in_a_solve_ends_the_threads(
    qtbot: QtBot, editor_model: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    working, ended = endless_resolve(monkeypatch)
    document = PoseDocument(editor_model)
    document.tasks.resolve()
    qtbot.waitUntil(working.is_set)
    assert document.close()
    assert ended.is_set()
    assert document.close()


def endless_resolve(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Make Resolve run until it is cancelled; return the events of its start and end."""
    working, ended = threading.Event(), threading.Event()

    def resolve(*_: object, job: Job, **__: object) -> None:
        working.set()
        try:
            while True:
                job.check()
                job.report(1, 2)
        finally:
            ended.set()

    monkeypatch.setattr(PoseResolver, "resolve", resolve)
    return working, ended


def test_progress_of_a_solve_is_told(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, ended = endless_resolve(monkeypatch)
    with qtbot.waitSignal(document.tasks.progressed) as told:
        document.tasks.resolve()
    assert told.args == [Work.RESOLVE, 1, 2]
    document.tasks.cancel_resolve()
    qtbot.waitUntil(ended.is_set)


def test_a_solve_that_fails_leaves_the_editor_usable(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    latent = sample_poses(document.model, 1, 0, colliding=True)[0]
    document.motion.blend_towards(latent, 1.0)
    failures: list[Failure] = []
    document.failed.connect(failures.append)
    with monkeypatch.context() as broken:
        broken.setattr(PoseResolver, "resolve", lambda *_, **__: 1 / 0)
        with qtbot.waitSignal(document.tasks.solve_finished) as finished:
            document.tasks.resolve()
    assert finished.args == [None]
    qtbot.waitUntil(lambda: bool(failures))
    assert "ZeroDivisionError" in failures[0].headline
    assert not document.tasks.solving
    assert document.history.latent.tobytes() == latent.tobytes()
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=20_000):
        document.tasks.resolve()
    assert document.history.state.outcome is not None
    assert document.history.state.outcome.exactly_free


def test_a_live_worker_that_fails_tells_once_and_goes_on(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = []
    document.failed.connect(failures.append)
    calls = []

    def fail(*_: object) -> None:
        calls.append(1)
        raise MemoryError("no more")

    with monkeypatch.context() as broken:
        broken.setattr(FrameEvaluator, "frame", fail)
        for value in (0.1, 0.2, 0.3):
            n_calls = len(calls)
            document.motion.set_code(0, value)
            qtbot.waitUntil(lambda before=n_calls: len(calls) > before)
        qtbot.waitUntil(lambda: bool(failures))
    document.motion.set_code(0, 0.4)
    settle(qtbot, document)
    assert len(failures) == 1
    assert "MemoryError" in failures[0].headline
    assert document.motion.frame is not None
    assert document.motion.frame.latent[0] == 0.4


def test_a_quick_check_comes_with_its_frame_and_a_slow_one_when_the_pose_rests(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    for most_seconds, comes_with_frame in ((10.0, True), (0.0, False)):
        monkeypatch.setattr("app.work.frames._QUICK_CHECK_SECONDS", most_seconds)
        for value in (0.1, 0.2):
            document.motion.set_code(0, value + most_seconds)
            assert document.motion.exact is None
            with qtbot.waitSignal(document.motion.frame_changed):
                pass
            assert (document.motion.frame.collisions is not None) == comes_with_frame
            settle(qtbot, document)
            resting = document.motion.resting
            assert resting is None or resting.is_checked


def test_a_verdict_that_fails_from_pose_to_pose_is_told_once(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.work.frames._QUICK_CHECK_SECONDS", 0.0)
    failures = []
    document.failed.connect(failures.append)
    checked = []

    def fail(_: FrameEvaluator, frame: PoseFrame) -> None:
        checked.append(frame.latent[0])
        raise MemoryError("no more")

    with monkeypatch.context() as broken:
        broken.setattr(FrameEvaluator, "checked", fail)
        for value in (0.1, 0.2, 0.3):
            document.motion.set_code(0, value)
            qtbot.waitUntil(lambda value=value: value in checked)
    document.motion.set_code(0, 0.4)
    settle(qtbot, document)
    assert len(failures) == 1


def test_a_frame_of_another_model_is_not_shown(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, go_on = threading.Event(), threading.Event()
    compute = FrameEvaluator.frame

    def slow(evaluator: FrameEvaluator, latent: np.ndarray, _: None) -> PoseFrame:
        started.set()
        go_on.wait(120)
        return compute(evaluator, latent)

    old = document.model
    frames: list[PoseFrame | None] = []
    document.motion.frame_changed.connect(lambda: frames.append(document.motion.frame))
    with monkeypatch.context() as patched:
        patched.setattr(FrameEvaluator, "frame", slow)
        document.motion.set_code(0, 0.7)
        qtbot.waitUntil(started.is_set)
        document.set_model(LearnedBody("other", old.embedding, old.card))
        go_on.set()
        settle(qtbot, document)
    assert [frame.latent[0] for frame in frames if frame] == [old.known_poses[0, 0]]


def test_jobs_run_in_turn_and_a_cancelled_one_is_not_heard_of(qtbot: QtBot) -> None:
    work = LongWork()
    done: list[str] = []
    labels: list[str] = []
    work.busy_changed.connect(labels.append)
    started = threading.Event()

    def endless(job: Job) -> str:
        started.set()
        while True:
            job.check()

    work.start("first", endless, done.append, kind="endless")
    work.start("second", lambda *_: "second", done.append)
    qtbot.waitUntil(started.is_set)
    assert done == []
    work.cancel("endless")
    qtbot.waitUntil(lambda: done == ["second"])
    assert work.busy == ""
    assert labels == ["first", "first", "second", ""]
    assert work.close(time.monotonic() + 60)


def test_who_asks_for_work_is_told_of_its_failure_or_else_all_are(qtbot: QtBot) -> None:
    work, told, own = LongWork(), [], []
    work.failed.connect(told.append)

    def fail(*_: object) -> None:
        raise LCollisionError("the disk is full", "make room")

    work.start("first", fail, lambda _: None, own.append)
    work.start("second", fail, lambda _: None)
    qtbot.waitUntil(lambda: not work.busy)
    assert [failure.headline for failure in (*own, *told)] == ["the disk is full"] * 2
    assert work.close(time.monotonic() + 60)


def test_work_is_over_also_where_what_follows_from_it_breaks(qtbot: QtBot) -> None:
    work, labels = LongWork(), []
    work.busy_changed.connect(labels.append)

    def break_down(_: object) -> None:
        raise ValueError("nobody expects this")

    with qtbot.capture_exceptions() as raised:
        work.start("first", lambda *_: None, break_down)
        qtbot.waitUntil(lambda: labels == ["first", ""])
    assert [kind for kind, *_ in raised] == [ValueError]
    assert work.close(time.monotonic() + 60)


def test_the_newest_file_wins_and_no_file_waits_for_a_solve(
    qtbot: QtBot, document: PoseDocument, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, number in (("first", 1), ("second", 2)):
        pose = NamedPose(name, document.model.known_poses[number])
        write_poses(tmp_path / f"{name}.json", document.model, [pose])
    told: list[str] = []
    document.message.connect(told.append)
    working, ended = endless_resolve(monkeypatch)
    document.tasks.resolve()
    qtbot.waitUntil(working.is_set)
    document.tasks.open_poses(tmp_path / "first.json")
    assert not document.tasks.solving
    document.tasks.open_poses(tmp_path / "second.json")
    qtbot.waitUntil(lambda: bool(told) and not document.tasks.busy)
    assert ended.is_set()
    assert told == ["Opened second.json: 1 pose"]
    assert document.history.pose.name == "second"
    document.tasks.open_poses(tmp_path / "first.json")
    document.new_pose()
    settle(qtbot, document)
    assert document.history.pose.name == "pose"
    assert np.array_equal(document.history.latent, document.model.known_poses[0])


class Knot:
    """Refers to itself, and records the thread in which it is deleted."""

    def __init__(self, seen: list[threading.Thread]) -> None:
        self.own, self.seen = self, seen

    def __del__(self) -> None:
        self.seen.append(threading.current_thread())


def test_garbage_of_other_threads_goes_in_the_window_s_thread(
    qtbot: QtBot, qapp: QApplication
) -> None:
    seen: list[threading.Thread] = []

    def leave_knots() -> None:
        for _ in range(5000):
            Knot(seen)

    gc.enable()
    collector = GarbageCollector(qapp)
    worker = threading.Thread(target=leave_knots)
    worker.start()
    worker.join()
    assert seen == []
    qtbot.waitUntil(lambda: len(seen) == 5000)
    assert set(seen) == {threading.main_thread()}
    collector.close()
    assert gc.isenabled()
    gc.disable()
    collector.deleteLater()
