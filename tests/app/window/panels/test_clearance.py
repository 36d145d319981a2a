"""The clearance in the window: its field, Resolve and Solid, and the nearest pair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtWidgets import QLabel
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.window.main_window import MainWindow
from app.window.widgets import unbroken
from lcollision_core.bodies import LearnedBody, RigBody, sample_poses
from lcollision_core.resolve import ResolveResult
from tests.app.window.panels.test_collision import resolve
from tests.app.windows import PATIENCE, close_window, open_window, rest, settings_in
from tests.rigged_shapes import rigged_body

pytestmark = pytest.mark.one_window

FloatArray = npt.NDArray[np.float64]

DEFAULT = 0.001


@pytest.fixture(scope="module")
def colliding(body: LearnedBody) -> FloatArray:
    return sample_poses(body, 1, 0, colliding=True)[0]


def go_to(qtbot: QtBot, window: MainWindow, latent: FloatArray) -> None:
    """Show a pose, and wait until it is measured."""
    window.document.motion.set_solid(False)
    window.document.motion.blend_towards(latent, 1.0)
    measured(qtbot, window)


def measured(qtbot: QtBot, window: MainWindow) -> None:
    rest(qtbot, window)
    qtbot.waitUntil(lambda: window.document.motion.is_measured, timeout=PATIENCE)


def resolved(qtbot: QtBot, window: MainWindow) -> ResolveResult:
    result = resolve(qtbot, window)
    measured(qtbot, window)
    return result


@pytest.mark.slow
def test_the_field_says_the_clearance_and_the_next_window_has_it(
    qtbot: QtBot, body: LearnedBody, tmp_path: Path
) -> None:
    settings = settings_in(tmp_path)
    first = open_window(qtbot, PoseDocument(body, library_folder=tmp_path / "one"), settings)
    field = first.collision.resolve.clearance
    assert first.document.motion.clearance == DEFAULT
    assert field.text() == "0.1 %"
    field.setValue(0.25)
    assert first.document.motion.clearance == pytest.approx(0.0025)
    close_window(first)
    second = open_window(qtbot, PoseDocument(body, library_folder=tmp_path / "two"), settings)
    assert second.document.motion.clearance == pytest.approx(0.0025)
    assert second.collision.resolve.clearance.text() == "0.25 %"


def test_of_a_character_it_is_in_millimetres(qtbot: QtBot, body_window: MainWindow) -> None:
    model = RigBody.of(rigged_body())
    assert model.known_metres == model.card.metres
    body_window.document.set_model(model)
    rest(qtbot, body_window)
    field = body_window.collision.resolve.clearance
    size = 1000.0 * model.card.metres * model.body_size
    assert field.suffix() == " mm"
    assert field.value() == pytest.approx(DEFAULT * size, abs=0.005)
    # Showing it in another unit does not change it.
    assert body_window.document.motion.clearance == DEFAULT
    field.setValue(0.002 * size)
    assert body_window.document.motion.clearance == pytest.approx(0.002, abs=0.01 / size)


def test_resolve_keeps_the_clearance_and_says_the_least_distance(
    qtbot: QtBot, body_window: MainWindow, body: LearnedBody, colliding: FloatArray
) -> None:
    window, document = body_window, body_window.document
    go_to(qtbot, window, colliding)
    assert document.motion.nearest is not None
    assert document.motion.nearest.distance < 0.0
    assert window.collision.exact.nearest.text().startswith("Deepest overlap ")
    result = resolved(qtbot, window)
    assert (result.exactly_free, result.clearance) == (True, DEFAULT)
    assert body.exact_check(clearance=DEFAULT).is_free(document.history.latent)
    shown = [label.text() for label in window.collision.outcome.findChildren(QLabel)]
    assert "Lacks clearance" in shown
    if result.least_distance is not None:
        told = f"least distance {100.0 * result.least_distance:.3g} %"
        assert unbroken(f"No collisions (checked), {told}") in shown
        assert window.collision.exact.nearest.text() == told.capitalize()
    window.collision.resolve.clearance.setValue(0.0)
    document.history.undo()
    measured(qtbot, window)
    assert resolved(qtbot, window).clearance == 0.0
    shown = [label.text() for label in window.collision.outcome.findChildren(QLabel)]
    assert {"Overlap", "No collisions (checked)"} <= set(shown)


def test_a_press_shows_where_the_pose_comes_nearest(
    qtbot: QtBot, body_window: MainWindow, colliding: FloatArray
) -> None:
    window, button = body_window, body_window.collision.exact.nearest
    go_to(qtbot, window, colliding)
    scene = window.viewport.scene
    assert scene is not None
    assert (button.isEnabled(), scene.selection.n_faces) == (True, 0)
    before = scene.view
    button.click()
    assert scene.selection.n_faces > 2
    # The camera moves to look at it.
    nearest = window.document.motion.nearest
    assert nearest is not None
    middle = nearest.points.mean(axis=0)
    size = window.document.model.body_size
    assert np.linalg.norm(before.focus - middle) > 0.05 * size
    qtbot.waitUntil(
        lambda: bool(np.linalg.norm(scene.view.focus - middle) < 1e-3 * size), timeout=PATIENCE
    )
    button.click()
    assert scene.selection.n_faces == 0
    button.click()
    # Another pose, which is nowhere near itself.
    go_to(qtbot, window, np.zeros_like(colliding))
    assert scene.selection.n_faces == 0
    assert not button.isChecked()
    nearest = window.document.motion.nearest
    assert button.isEnabled() == (nearest is not None)
    if nearest is None:
        assert button.text() == "Least distance above 0.2 %"


@pytest.mark.slow
def test_solid_keeps_the_clearance_and_shows_no_collision_that_is_none(
    qtbot: QtBot, body_window: MainWindow, body: LearnedBody, colliding: FloatArray
) -> None:
    window, document = body_window, body_window.document
    go_to(qtbot, window, body.free_latent[0])
    document.motion.set_solid(True)
    document.motion.blend_towards(colliding, 1.0)
    qtbot.waitUntil(lambda: not document.motion.moving, timeout=PATIENCE)
    measured(qtbot, window)
    reached = document.history.latent
    assert np.abs(reached - body.free_latent[0]).max() > 0.01
    assert body.exact_check(clearance=DEFAULT).is_free(reached)
    # With a larger clearance, the resolved pose is too near, although nothing collides.
    window.collision.resolve.clearance.setValue(5.0)
    assert not body.exact_check(clearance=0.05).is_free(reached)
    document.motion.set_code(0, float(reached[0]) + 0.01)
    qtbot.waitUntil(lambda: not document.motion.moving, timeout=PATIENCE)
    rest(qtbot, window)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert window.collision.exact.verdict.text() == "No collisions (checked)"
