"""The main workflow in a real window: drag, look, resolve, undo, export."""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QPoint, Qt, QTimer
from PySide6.QtGui import QAction, QStatusTipEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QDialog,
    QLabel,
    QMessageBox,
    QProgressBar,
    QToolTip,
    QWidget,
)
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.live_pose import code_name, training_pose
from app.view.shading import Shading
from app.view.theme import Ring
from app.window.bars import StatusBar
from app.window.dialogs.questions import FailureDialog
from app.window.main_window import MainWindow
from app.window.widgets import HANDLE
from app.work import preparing
from app.work.preparing import REASON
from app.work.threads import Failure
from lcollision_core.bodies import EncodedPose, LearnedBody, read_poses
from lcollision_core.errors import MeshFileError
from lcollision_core.files import read_mesh, write_mesh
from lcollision_core.jobs import Job
from tests.app.support import export_pose
from tests.app.views import on_screen
from tests.app.windows import (
    PATIENCE,
    accept_and_choose,
    answer,
    choose_file,
    close_window,
    colours,
    decoded,
    drag,
    drop,
    handle,
    move_held,
    name_field,
    rest,
    settings_in,
    shown,
)

pytestmark = pytest.mark.one_window

JARGON = re.compile(
    r"\b(codes?|latents?|box|domains?|energy|solver|converged?|predictor)\b(?!”)|10[⁻⁰¹²³]", re.I
)


def failures(window: MainWindow) -> list[FailureDialog]:
    return [dialog for dialog in window.findChildren(FailureDialog) if dialog.isVisible()]


def test_a_dragged_slider_changes_the_mesh_as_the_model_says(
    qtbot: QtBot, window: MainWindow
) -> None:
    document = window.document
    before, mesh_before = document.history.latent, shown(window)
    row = window.sliders.row_of(1)
    drag(qtbot, row, by=24)
    rest(qtbot, window)
    assert document.history.latent[1] > before[1]
    assert np.array_equal(np.delete(document.history.latent, 1), np.delete(before, 1))
    assert row.field.value() == pytest.approx(document.history.latent[1], abs=5.1e-4)
    assert np.array_equal(shown(window), decoded(document))
    assert not np.array_equal(shown(window), mesh_before)
    assert document.history.undo_stack.count() == 1
    assert document.history.undo_stack.undoText() == f"Move {code_name(document.model, 1)}"
    QTest.keyClick(row.slider, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    rest(qtbot, window)
    assert document.history.latent.tobytes() == before.tobytes()
    assert np.array_equal(shown(window), mesh_before)
    assert row.slider.number == pytest.approx(before[1], abs=0.01)


@pytest.mark.parametrize(
    "key", [Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier]
)
def test_a_drag_with_a_key_held_is_ten_times_finer(
    qtbot: QtBot, window: MainWindow, key: Qt.KeyboardModifier
) -> None:
    slider = window.sliders.row_of(1).slider
    start = handle(window.sliders.row_of(1))
    way, before = 20, slider.place
    per_pixel = (slider.value_range[1] - slider.value_range[0]) / (slider.width() - 2 * HANDLE)
    left, no_key = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
    QTest.mousePress(slider, left, key, start)
    for step in range(1, way + 1):
        move_held(slider, start + QPoint(step, 0), key)
    assert slider.place - before == pytest.approx(0.1 * way * per_pixel, abs=1.0)
    # When the key is released, the handle continues from its position.
    fine = slider.place
    move_held(slider, start + QPoint(way + 1, 0), no_key)
    assert slider.place - fine == pytest.approx(per_pixel, abs=1.0)
    QTest.mouseRelease(slider, left, no_key, start + QPoint(way + 1, 0))
    rest(qtbot, window)
    assert window.document.history.undo_stack.count() == 1
    assert window.document.history.latent[1] == pytest.approx(slider.number)
    assert np.array_equal(shown(window), decoded(window.document))
    assert "Ctrl" in slider.toolTip()


def test_prediction_and_exact_check_follow_the_pose(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document, model = window.document, window.document.model
    for latent in (colliding, np.zeros_like(colliding)):
        document.motion.blend_towards(latent, 1.0)
        rest(qtbot, window)
        card = window.collision.prediction
        predicted = model.predict(latent[None])
        probability = float(predicted.collision_probability[0])
        assert card.meter.probability == pytest.approx(probability, abs=1e-6)
        assert card.percent.text() == f"{100 * probability:.0f} %"
        assert document.motion.exact is not None
        if document.motion.exact.colliding == (probability > 0.5):
            assert ("colliding" in card.verdict.text()) == (probability > 0.5)
        shares = [row.bar.value() for row in card.rows]
        assert np.argmax(shares) == predicted.domain_energy[0].argmax() or max(shares) == 0
        found = model.detector.detect(decoded(document))
        words = window.collision.exact.verdict.text()
        if found.colliding:
            assert words == "Colliding (checked)"
            assert window.collision.exact.details.text().startswith(f"{len(found.pairs)} pair")
        else:
            assert words == "No collisions (checked)"
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding


def test_hovering_a_row_lights_its_domain_and_the_mesh_lights_its_row(
    qtbot: QtBot, window: MainWindow
) -> None:
    window.viewport.set_shading(Shading.DOMAINS)
    rest(qtbot, window)
    plain = colours(window)
    assert window.viewport.scene is not None
    outline = window.viewport.scene.outline
    row = window.collision.prediction.rows[1]
    QTest.mouseMove(window.statusBar(), QPoint(3, 3))
    QTest.mouseMove(row, QPoint(30, 8))
    qtbot.waitUntil(lambda: outline.is_shown)
    assert np.array_equal(colours(window), plain)
    leading = window.document.model.attention_mask.argmax(axis=0)
    QTest.mouseMove(window.statusBar(), QPoint(3, 3))
    qtbot.waitUntil(lambda: not outline.is_shown)
    slider_row = window.sliders.row_of(0)
    QTest.mouseMove(slider_row, QPoint(5, 5))
    qtbot.waitUntil(lambda: outline.is_shown)
    QTest.mouseMove(window.statusBar(), QPoint(3, 3))
    canvas, scene = window.viewport.canvas, window.viewport.scene
    assert canvas is not None
    assert scene is not None
    rest(qtbot, window)
    # Use whole pixels, like the pointer: a vertex on the outline may be just beside its pixel.
    points = [
        on_screen(canvas, scene.surface.vertices[vertex]).toPoint()
        for vertex in np.flatnonzero(leading == 1)
    ]
    seen = [point for point in points if canvas.pick(point.toPointF(), scene.body) is not None]
    place = seen[len(seen) // 2]
    with qtbot.waitSignal(window.viewport.domain_hovered) as told:
        QTest.mouseMove(canvas, place)
    lit = [header.is_lit for header in (group.header for group in window.sliders.groups)]
    assert told.args is not None
    assert lit == [group.header.domain == told.args[0] for group in window.sliders.groups]
    assert window.collision.prediction.rows[told.args[0]].is_lit


def test_resolve_ends_exactly_free_and_undo_brings_the_old_mesh_back(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document, card = window.document, window.collision.resolve
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    before, outcome = shown(window), window.collision.outcome
    assert document.model.detector.detect(before).colliding
    steps = document.history.undo_stack.count()
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=PATIENCE):
        QTest.mouseClick(card.button, Qt.MouseButton.LeftButton)
        assert document.tasks.solving
        assert card.working.isVisible()
        assert not card.resting.isVisible()
    rest(qtbot, window)
    after = shown(window)
    assert np.array_equal(after, decoded(document))
    assert not document.model.detector.detect(after).colliding
    assert window.collision.exact.verdict.text() == "No collisions (checked)"
    assert document.history.state.outcome is not None
    assert outcome.isVisible()
    assert outcome.exactly_free.answer is True
    assert outcome.predicted_free.answer == document.history.state.outcome.predicted_free
    assert document.history.undo_stack.count() == steps + 1
    assert np.array_equal(document.history.ghost, before)
    QTest.keyClick(window, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    rest(qtbot, window)
    assert document.history.latent.tobytes() == colliding.tobytes()
    assert shown(window).tobytes() == before.tobytes()
    assert not outcome.isVisible()
    QTest.keyClick(
        window,
        Qt.Key.Key_Z,
        Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier,
    )
    rest(qtbot, window)
    assert shown(window).tobytes() == after.tobytes()
    assert outcome.exactly_free.answer is True


def test_a_message_too_long_for_the_status_bar_is_shown_whole(window: MainWindow) -> None:
    bar, long = window.statusBar(), "The wall is <thinner> than 1 mm in the left hand. " * 9
    assert isinstance(bar, StatusBar)
    bar.tell("Saved")
    assert QToolTip.text() == ""
    bar.tell(long)
    assert bar.currentMessage() == long
    assert QToolTip.text() == f"<span>{escape(long)}</span>"
    QToolTip.hideText()
    bar.show_facts("a name that does not end " * 9)
    facts = next(label for label in bar.findChildren(QLabel) if "…" in label.text())
    assert facts.width() < bar.width() / 3
    assert facts.toolTip() == "a name that does not end " * 9


def test_a_message_outlives_the_pointer_s_way_over_a_button(window: MainWindow) -> None:
    bar, tip = window.statusBar(), window.actions_by_key["open"].statusTip()

    def point_at(tip: str) -> None:
        """Send what Qt sends when the pointer enters a button; "" is sent when it leaves one."""
        QApplication.sendEvent(window, QStatusTipEvent(tip))

    point_at(tip)
    assert bar.currentMessage() == tip != ""
    window.document.message.emit("All are free now")
    point_at("")
    assert bar.currentMessage() == "All are free now"
    point_at(tip)
    assert bar.currentMessage() == "All are free now"
    bar.clearMessage()
    point_at("")
    point_at(tip)
    assert bar.currentMessage() == tip
    point_at("")
    assert bar.currentMessage() == ""


def words_on_the_screen(window: MainWindow) -> Iterator[str]:
    """Return all texts and tool tips of the window, its menus and its legend."""
    for widget in window.findChildren(QWidget):
        yield widget.toolTip()
        yield widget.accessibleName()
        if isinstance(widget, QLabel | QAbstractButton):
            yield widget.text()
    for action in window.findChildren(QAction):
        yield from (action.text(), action.toolTip(), action.statusTip())
    legend = window.viewport.legend
    yield from (legend.title, legend.note, legend.crossing)


@pytest.mark.slow
def test_nothing_on_the_screen_speaks_of_the_mathematics(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document = window.document
    # Beyond the sliders' range, which Resolve notes.
    document.motion.blend_towards(1.5 * colliding, 1.0)
    rest(qtbot, window)
    for shading in Shading:
        window.viewport.set_shading(shading)
        rest(qtbot, window)
        found = [words for words in words_on_the_screen(window) if JARGON.search(words)]
        assert found == []
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=PATIENCE):
        window.actions_by_key["resolve"].trigger()
    rest(qtbot, window)
    assert document.history.state.outcome is not None
    assert "outside the trained range" in (document.history.state.outcome.note or "")
    words = list(words_on_the_screen(window))
    assert any("outside the trained range" in text for text in words)
    assert [text for text in words if JARGON.search(text)] == []


def test_cancelled_in_the_middle_resolve_leaves_everything_as_it_was(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document, card = window.document, window.collision.resolve
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    before = shown(window)
    QTest.mouseClick(card.button, Qt.MouseButton.LeftButton)
    assert document.tasks.solving
    QTest.mouseClick(card.cancel, Qt.MouseButton.LeftButton)
    assert not document.tasks.solving
    assert card.resting.isVisible()
    with qtbot.assertNotEmitted(document.history.latent_changed, wait=200):
        pass
    assert document.history.latent.tobytes() == colliding.tobytes()
    assert shown(window).tobytes() == before.tobytes()
    assert document.history.state.outcome is None
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=PATIENCE) as told:
        window.actions_by_key["resolve"].trigger()
    assert told.args is not None
    assert told.args[0].exactly_free


def test_an_edit_cancels_resolve(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document = window.document
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    window.actions_by_key["resolve"].trigger()
    assert document.tasks.solving
    QTest.keyClick(window.sliders.row_of(0).slider, Qt.Key.Key_Right)
    assert not document.tasks.solving
    rest(qtbot, window)
    with qtbot.assertNotEmitted(document.history.latent_changed, wait=200):
        pass
    assert np.array_equal(np.delete(document.history.latent, 0), np.delete(colliding, 0))
    assert np.array_equal(shown(window), decoded(document))


def test_the_window_closes_in_the_middle_of_resolve(
    qtbot: QtBot, window: MainWindow, colliding: npt.NDArray[np.float64]
) -> None:
    document = window.document
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, window)
    window.actions_by_key["resolve"].trigger()
    assert document.tasks.solving
    close_window(window)
    assert document.close()
    assert not document.tasks.solving


def test_a_dropped_mesh_becomes_the_pose(qtbot: QtBot, window: MainWindow, tmp_path: Path) -> None:
    document, model = window.document, window.document.model
    latent = 0.5 * model.latent_space.high
    vertices = model.decode(latent) + np.array([3.0, -2.0, 1.0]) * model.body_size
    write_mesh(tmp_path / "bent.obj", vertices, model.faces)
    with qtbot.waitSignal(document.history.latent_changed, timeout=PATIENCE):
        drop(window, tmp_path / "bent.obj")
    rest(qtbot, window)
    assert document.history.pose.name == "bent"
    assert document.history.undo_stack.undoText() == "Import bent"
    assert document.history.pose.placement is not None
    back = document.history.pose.placement.apply(shown(window).astype(np.float64))
    assert np.abs(back - vertices).max() < 2e-3 * model.body_size
    assert "of the body size" in window.statusBar().currentMessage()


@pytest.mark.variants(2)
@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("broken.obj", "v 1 2\nf 1 2 3\n", "broken.obj"),
        ("other.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "3 vertices"),
        ("empty.ply", "", "empty"),
        ("notes.txt", "hello", "TXT isn't supported"),
        ("poses.json", "[1, 2", "not JSON"),
        ("model.safetensors", "garbage", "model.safetensors"),
    ],
)
def test_dropped_garbage_is_refused_with_one_sentence(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, name: str, content: str, sentence: str
) -> None:
    (tmp_path / name).write_text(content)
    before, model = window.document.history.latent, window.document.model
    drop(window, tmp_path / name)
    qtbot.waitUntil(lambda: bool(failures(window)), timeout=PATIENCE)
    (dialog,) = failures(window)
    words = f"{dialog.what.text()} {dialog.advice.text()}"
    assert sentence in words
    assert "Traceback" not in words
    assert "\n" not in words
    assert dialog.advice.text()
    assert not dialog.details.isVisible()
    QTest.mouseClick(dialog.unfold, Qt.MouseButton.LeftButton)
    assert dialog.details.isVisible()
    assert "Error" in dialog.details.toPlainText()
    QTest.keyClick(dialog, Qt.Key.Key_Escape)
    qtbot.waitUntil(lambda: not failures(window))
    assert window.document.model is model
    assert window.document.history.latent.tobytes() == before.tobytes()
    drag(qtbot, window.sliders.row_of(0), by=12)
    rest(qtbot, window)
    assert np.array_equal(shown(window), decoded(window.document))


@pytest.mark.variants
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".glb"])
def test_an_exported_mesh_is_the_one_on_the_screen_and_comes_back(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, suffix: str
) -> None:
    document, model = window.document, window.document.model
    document.motion.blend_towards(0.4 * model.latent_space.low, 1.0)
    rest(qtbot, window)
    on_screen = shown(window)
    path = tmp_path / f"pose{suffix}"

    timers: list[QTimer] = []
    timers.append(answer(accept_and_choose(path, timers)))
    window.actions_by_key["export"].trigger()
    assert not any(timer.isActive() for timer in timers)
    qtbot.waitUntil(path.is_file, timeout=PATIENCE)
    mesh = read_mesh(path, topology=model.topology)
    assert np.array_equal(mesh.vertices.astype(np.float32), on_screen)
    assert np.array_equal(mesh.faces, model.faces)
    with qtbot.waitSignal(document.history.latent_changed, timeout=PATIENCE):
        drop(window, path)
    rest(qtbot, window)
    assert document.history.pose.placement is not None
    back = document.history.pose.placement.apply(shown(window).astype(np.float64))
    assert np.abs(back - on_screen).max() < 2e-3 * model.body_size


@pytest.mark.variants
@pytest.mark.parametrize(
    ("action", "name", "sentence"),
    [
        ("export", "b.fbx", ".fbx is not a known mesh format"),
        ("turntable", "b.mp4", "b.mp4 can't be written as a video"),
    ],
)
def test_no_file_is_written_in_another_format_than_was_asked_for(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, action: str, name: str, sentence: str
) -> None:
    timers: list[QTimer] = []
    timers.append(answer(accept_and_choose(tmp_path / name, timers)))
    window.actions_by_key[action].trigger()
    qtbot.waitUntil(lambda: bool(failures(window)), timeout=PATIENCE)
    (dialog,) = failures(window)
    assert sentence in f"{dialog.what.text()} {dialog.advice.text()}"
    dialog.reject()
    assert list(tmp_path.glob("b.*")) == []


def test_changes_are_saved_kept_or_given_up_as_the_user_says(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document = window.document
    drag(qtbot, window.sliders.row_of(0), by=15)
    assert window.isWindowModified()
    questions: list[str] = []

    def look(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        questions.append(dialog.text())
        dialog.reject()

    asked = answer(look)
    assert not window.close()
    assert not asked.isActive()
    assert window.isVisible()
    assert questions == [
        f"Save the pose “{document.history.pose.name}” of “{document.model.name}” to a file?"
    ]
    path = tmp_path / "mine.json"
    document.tasks.save(path)
    document.tasks.wait_for_saves()
    assert not window.isWindowModified()
    drag(qtbot, window.sliders.row_of(1), by=15)
    assert window.isWindowModified()

    def save(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        questions.append(dialog.text())
        dialog.buttons()[0].click()

    latent = document.history.latent
    asked = answer(save)
    assert window.close()
    assert not asked.isActive()
    # Save writes the file, not the library pose that this one came from.
    name = document.history.pose.name
    assert questions[1:] == [
        f"Save the pose “{name} changed” of “{document.model.name}” to “mine.json”?"
    ]
    assert read_poses(path, document.model)[0].latent.tobytes() == latent.tobytes()


def test_an_edit_while_a_file_is_read_is_asked_about(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    document, path = window.document, tmp_path / "pose.json"
    document.tasks.save(path)
    document.tasks.wait_for_saves()
    before = document.history.latent
    asked = answer(lambda dialog: dialog.reject())
    window.files.open_path(path)
    document.motion.set_code(0, 0.5)
    qtbot.waitUntil(lambda: not asked.isActive(), timeout=PATIENCE)
    assert document.history.latent[0] == 0.5
    document.history.undo()
    assert document.history.latent.tobytes() == before.tobytes()


def test_resolve_waits_for_a_mesh_that_is_read_and_undo_keeps_what_was_edited_meanwhile(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, model = window.document, window.document.model
    resolve, button = window.actions_by_key["resolve"], window.collision.resolve.button
    mesh, tip = tmp_path / "bent.obj", resolve.toolTip()
    write_mesh(mesh, model.decode(0.5 * model.latent_space.high), model.faces)
    encode, go_on = LearnedBody.encode, threading.Event()

    def slow(*arguments: Any, **options: Any) -> EncodedPose:
        go_on.wait(PATIENCE / 1000)
        return encode(*arguments, **options)

    monkeypatch.setattr(LearnedBody, "encode", slow)
    window.files.open_path(mesh)
    assert not resolve.isEnabled()
    assert not button.isEnabled()
    assert "Importing bent.obj" in button.toolTip()
    QTest.keyClick(window, Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
    assert not document.tasks.solving
    document.motion.set_code(0, 0.5)
    edited = document.history.latent
    with qtbot.waitSignal(document.tasks.imported, timeout=PATIENCE):
        go_on.set()
    qtbot.waitUntil(button.isEnabled, timeout=PATIENCE)
    assert button.toolTip() == tip
    assert document.history.pose.name == "bent"
    document.history.undo()
    assert document.history.latent.tobytes() == edited.tobytes()
    rest(qtbot, window)


@pytest.mark.parametrize("typed", ["mine", "mine.v2"])
def test_no_file_is_saved_over_under_another_name_than_was_asked_about(
    window: MainWindow, tmp_path: Path, typed: str
) -> None:
    path = tmp_path / f"{typed}.json"
    path.write_text("precious")
    questions = []

    def refuse(dialog: QDialog) -> None:
        asks = isinstance(dialog, QMessageBox)
        questions.append(dialog.text() if asks else name_field(dialog).text())
        dialog.reject()

    def choose(dialog: QDialog) -> None:
        timers.append(answer(refuse))
        choose_file(dialog, tmp_path / typed)
        if not timers[-1].isActive():
            dialog.reject()

    timers = [answer(choose)]
    window.actions_by_key["save_as"].trigger()
    assert [path.name in question for question in questions] == [True]
    assert path.read_text() == "precious"
    assert window.document.history.file is None


def test_work_that_says_not_how_far_it_is_has_a_ring_that_turns(
    qtbot: QtBot, window: MainWindow
) -> None:
    go_on, bar = threading.Event(), window.statusBar().findChild(QProgressBar)
    ring = window.statusBar().findChild(Ring)

    def work(job: Job) -> str:
        job.report(3, 3)
        return "Counted"

    window.document.tasks.write("Counting", work)
    window.document.tasks.write("Waiting", lambda *_: str(go_on.wait(PATIENCE / 1000)))
    qtbot.waitUntil(lambda: window.document.tasks.busy == "Waiting", timeout=PATIENCE)
    assert ring.isVisible()
    assert ring.turns
    assert not bar.isVisible()
    go_on.set()
    qtbot.waitUntil(lambda: not ring.isVisible(), timeout=PATIENCE)
    assert not ring.turns


def test_a_wait_for_compiling_is_explained_while_it_lasts(
    qtbot: QtBot,
    editor_model: LearnedBody,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    log, go_on = logging.getLogger("lcollision_core.compiled"), threading.Event()
    # The shared window listens too.
    listening = list(log.handlers)
    caplog.set_level(logging.INFO, log.name)
    warm_up = preparing.warm_up

    def compiling(model: LearnedBody, job: Job) -> None:
        log.info("compiling for this processor")
        go_on.wait(PATIENCE / 1000)
        warm_up(model, job)

    monkeypatch.setattr(preparing, "warm_up", compiling)
    editor_model.save(tmp_path / "tube.safetensors")
    document = PoseDocument()
    window = MainWindow(document, settings_in(tmp_path))
    window.show()
    busy = window.findChild(StatusBar).busy
    document.tasks.open_model(tmp_path / "tube.safetensors")
    qtbot.waitUntil(lambda: REASON in busy.text(), timeout=PATIENCE)
    assert busy.isVisible()
    assert window.viewport.waiting.text.endswith(REASON)
    go_on.set()
    qtbot.waitUntil(lambda: document.has_model and not document.tasks.busy, timeout=PATIENCE)
    assert busy.text() == ""
    rest(qtbot, window)
    close_window(window)
    assert log.handlers == listening


def test_files_dropped_while_the_first_model_loads_wait_for_it_or_are_refused(
    qtbot: QtBot, editor_model: LearnedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warm_up, go_on = preparing.warm_up, threading.Event()

    def slow(model: LearnedBody, job: Job) -> None:
        go_on.wait(PATIENCE / 1000)
        warm_up(model, job)

    monkeypatch.setattr(preparing, "warm_up", slow)
    editor_model.save(tmp_path / "tube.safetensors")
    for name in ("bent.glb", "bent.obj"):
        write_mesh(tmp_path / name, editor_model.reference, editor_model.faces)
    (tmp_path / "pose.json").write_text("{}")
    document = PoseDocument()
    window = MainWindow(document, settings_in(tmp_path))
    window.show()
    document.tasks.open_model(tmp_path / "tube.safetensors")
    for name in ("bent.obj", "pose.json"):
        drop(window, tmp_path / name)
        qtbot.waitUntil(lambda: bool(failures(window)), timeout=PATIENCE)
        (told,) = failures(window)
        assert told.what.text() == f"{name} can only be opened once a body is open"
        told.reject()
    drop(window, tmp_path / "bent.glb")
    qtbot.waitUntil(lambda: len(document.tasks._long._jobs) == 2, timeout=PATIENCE)
    with qtbot.waitSignal(document.tasks.imported, timeout=PATIENCE):
        go_on.set()
    assert document.history.pose.name == "bent"
    rest(qtbot, window)
    assert not failures(window)


def test_a_failure_says_what_happened_and_below_it_what_to_do(window: MainWindow) -> None:
    error = MeshFileError("was truncated", "copy it again", where="a; b.obj", expected=9, got=4)
    window.show_failure(Failure.of(error))
    window.show_failure(Failure("nothing to do"))
    first, second = failures(window)
    assert first.what.text() == "a; b.obj was truncated, expected 9, got 4"
    assert first.advice.text() == "Copy it again."
    assert second.what.text() == "Nothing to do"
    # Whether anything was changed is unknown.
    assert not second.advice.isVisible()
    assert not first.isModal()
    assert not second.isModal()


def test_a_failure_is_told_once_while_its_dialog_is_open(window: MainWindow) -> None:
    failure = Failure("the disk is full", "make room", "details")
    for _ in range(3):
        window.show_failure(failure)
    (dialog,) = failures(window)
    dialog.reject()
    window.show_failure(failure)
    assert len(failures(window)) == 1


def test_a_failing_worker_leaves_the_editor_usable(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    export_pose(window.document, tmp_path / "no such folder" / "pose.obj")
    qtbot.waitUntil(lambda: bool(failures(window)), timeout=PATIENCE)
    assert "no folder" in failures(window)[0].what.text()
    QTest.keyClick(failures(window)[0], Qt.Key.Key_Escape)
    drag(qtbot, window.sliders.row_of(0), by=12)
    rest(qtbot, window)
    assert np.array_equal(shown(window), decoded(window.document))


def test_save_as_saves_the_pose_that_was_open_when_it_was_asked_for(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, file = window.document, tmp_path / "asked.json"
    document.motion.load_pose(training_pose(document.model, 2))
    asked, later = document.history.pose, training_pose(document.model, 3)

    def answered(*_: object) -> Path:
        # As a file being read meanwhile would.
        document.motion.load_pose(later)
        return file

    monkeypatch.setattr(window.files, "ask_save", answered)
    with qtbot.waitSignal(document.message) as told:
        window.actions_by_key["save_as"].trigger()
    assert told.args == [f"Saved “{asked.name}” to asked.json; the pose opened since is unsaved"]
    (saved,) = read_poses(file, document.model)
    assert saved.latent.tobytes() == asked.latent.tobytes()
    # The loaded pose stays unchanged: it has not been saved.
    assert document.history.file is None
    assert document.history.pose.name == later.name
    monkeypatch.setattr(window.files, "ask_save", lambda *_: file)
    window.actions_by_key["save_as"].trigger()
    document.tasks.wait_for_saves()
    assert document.history.file == file
    rest(qtbot, window)
