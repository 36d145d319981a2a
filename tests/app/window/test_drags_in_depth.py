"""Drags of a character in depth, along arrows, and with standing feet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.camera import places_of
from app.window.main_window import MainWindow
from lcollision_core.bodies import Body, open_body
from tests.app.views import place_of, point_at, point_beside, roll, seen_vertex
from tests.app.windows import (
    move_held,
    open_window,
    rest,
    settings_in,
    shown,
    take_picture,
)

LEFT, NO_KEY = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier


@pytest.fixture(scope="module")
def mannequin(characters: Path) -> Body:
    return open_body(characters / "mannequin-moves.glb")


@pytest.fixture
def stage(
    qtbot: QtBot, tmp_path: Path, mannequin: Body, request: pytest.FixtureRequest
) -> MainWindow:
    """Return a window of the mannequin, seen from the front, in a theme."""
    document = PoseDocument(mannequin, library_folder=tmp_path / "library")
    settings = settings_in(tmp_path)
    settings["theme"] = getattr(request, "param", "light")
    held = open_window(qtbot, document, settings, (1280, 860))
    document.motion.reset_all()
    held.viewport.set_camera("Front", animated=False)
    rest(qtbot, held)
    return held


def domain_of(window: MainWindow, name: str) -> int:
    names = [held.casefold() for held in window.document.model.domain_names]
    return names.index(name)


def middle(window: MainWindow, name: str) -> npt.NDArray[np.float64]:
    """Return the normalised (3,) middle of a body part as shown."""
    model = window.document.model
    inside = model.space.vertex_domain == domain_of(window, name)
    held: npt.NDArray[np.float64] = shown(window)[inside].mean(axis=0) / model.body_size
    return held


def settle(qtbot: QtBot, window: MainWindow) -> None:
    qtbot.wait(30)
    qtbot.waitUntil(lambda: not window.document.motion.moving)
    qtbot.wait(30)


def test_the_wheel_and_keys_bring_a_hand_nearer_and_farther(
    qtbot: QtBot, stage: MainWindow
) -> None:
    canvas, front = stage.viewport.canvas, stage.document.model.space.front
    assert canvas is not None
    start = place_of(stage.viewport, seen_vertex(stage.viewport, domain_of(stage, "right hand")))
    end = start + QPoint(40, -30)
    assert stage.viewport.scene is not None
    seen_from = stage.viewport.scene.view.position
    QTest.mousePress(canvas, LEFT, NO_KEY, start)
    for share in (0.3, 0.6, 1.0):
        move_held(canvas, start + share * (end - start), NO_KEY)
        qtbot.wait(20)
    settle(qtbot, stage)
    depths = [float(middle(stage, "right hand") @ front)]
    take_picture(stage, "depth, as it was")
    roll(canvas, end, 6.0)
    settle(qtbot, stage)
    depths.append(float(middle(stage, "right hand") @ front))
    take_picture(stage, "depth, nearer by the wheel")
    for _ in range(10):
        QTest.keyClick(canvas, Qt.Key.Key_PageDown)
    settle(qtbot, stage)
    depths.append(float(middle(stage, "right hand") @ front))
    take_picture(stage, "depth, farther by the key")
    for _ in range(4):
        QTest.keyClick(canvas, Qt.Key.Key_PageUp)
    settle(qtbot, stage)
    depths.append(float(middle(stage, "right hand") @ front))
    QTest.mouseRelease(canvas, LEFT, NO_KEY, end)
    rest(qtbot, stage)
    # A notch is 0.015 normalised; nothing was zoomed.
    assert np.diff(depths) == pytest.approx([0.09, -0.15, 0.06], abs=0.02)
    assert np.array_equal(stage.viewport.scene.view.position, seen_from)
    assert stage.document.history.undo_stack.count() == 1


@pytest.mark.parametrize("stage", ["light", "dark"], indirect=True)
def test_a_hand_is_dragged_along_an_arrow(qtbot: QtBot, stage: MainWindow) -> None:
    canvas, scene = stage.viewport.canvas, stage.viewport.scene
    assert canvas is not None
    assert scene is not None
    stage.viewport.set_camera("Three-quarter", animated=False)
    rest(qtbot, stage)
    vertex = seen_vertex(stage.viewport, domain_of(stage, "right hand"))
    assert stage.viewport.mouse is not None
    patch = stage.document.motion.grip_at(vertex).vertices
    beside = seen_vertex(stage.viewport, domain_of(stage, "right hand"), set(patch) - {vertex})
    # Toggling at the patch with the arrows removes them, wherever the pointer is on it.
    for place, shown_at in ((beside, beside), (vertex, None), (vertex, vertex)):
        point_at(qtbot, stage.viewport, place)
        QTest.keyClick(stage, Qt.Key.Key_A)
        assert stage.viewport.mouse.arrows == shown_at
    point_beside(qtbot, stage.viewport)
    rest(qtbot, stage)
    take_picture(stage, f"arrows, {stage.settings['theme']}")
    model = stage.document.model
    up, front = model.space.up, model.space.front
    for axis in (front, up):
        before = stage.document.motion.grip_at(vertex).position(shown(stage))
        size = float(canvas.width()), float(canvas.height())
        ends = places_of(scene.view, before + np.outer([0.04, 0.12], axis) * model.body_size, size)
        QTest.mousePress(canvas, LEFT, NO_KEY, QPoint(*ends[0].round().astype(int).tolist()))
        for place in np.linspace(*ends, 8)[1:]:
            move_held(canvas, QPoint(*place.round().astype(int).tolist()), NO_KEY)
            qtbot.wait(20)
        settle(qtbot, stage)
        take_picture(stage, f"arrow dragged, {stage.settings['theme']}")
        QTest.mouseRelease(canvas, LEFT, NO_KEY, QPoint(*ends[1].round().astype(int).tolist()))
        rest(qtbot, stage)
        way = stage.document.motion.grip_at(vertex).position(shown(stage)) - before
        way = way / model.body_size
        # A stretched arm swings a little, and may settle short of 0.08.
        assert 0.03 < way @ axis < 0.1
        assert np.linalg.norm(way - (way @ axis) * axis) < 0.02
    point_beside(qtbot, stage.viewport)
    QTest.keyClick(stage, Qt.Key.Key_A)
    assert stage.viewport.mouse.arrows is None


@pytest.mark.parametrize("stage", ["light", "dark"], indirect=True)
def test_feet_that_stand_are_ringed_while_the_hips_are_dragged(
    qtbot: QtBot, stage: MainWindow
) -> None:
    canvas, model = stage.viewport.canvas, stage.document.model
    assert canvas is not None
    stage.viewport.set_camera("Three-quarter", animated=False)
    rest(qtbot, stage)
    start = place_of(stage.viewport, seen_vertex(stage.viewport, domain_of(stage, "hips")))
    QTest.mousePress(canvas, LEFT, NO_KEY, start)
    for down in range(5, 45, 5):
        move_held(canvas, start + QPoint(0, down), NO_KEY)
        qtbot.wait(20)
    settle(qtbot, stage)
    take_picture(stage, f"standing, {stage.settings['theme']}")
    frame = stage.document.motion.frame
    assert frame is not None
    nearest = [
        int(np.linalg.norm(frame.vertices - place, axis=1).argmin()) for place in frame.standing
    ]
    ringed = {model.domain_names[k].casefold() for k in model.space.vertex_domain[nearest]}
    assert ringed == {"left foot", "right foot"}
    QTest.mouseRelease(canvas, LEFT, NO_KEY, start + QPoint(0, 40))
    rest(qtbot, stage)
    assert stage.document.motion.frame is not None
    assert len(stage.document.motion.frame.standing) == 0
