"""The camera and the mouse in a viewport: turned, zoomed, clicked, and drawn meanwhile."""

from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtGui import (
    QContextMenuEvent,
    QNativeGestureEvent,
    QPointingDevice,
    QWheelEvent,
)
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.camera import CAMERAS, View, framing, sees_all
from app.view.canvas import Canvas, Smoothness
from app.view.viewport import Viewport
from lcollision_core.model import NamedPose
from tests.app.views import (
    SIDE,
    on_screen,
    place_of,
    rest,
    seen_vertex,
)


def test_the_pointer_names_the_domain_beneath_it(qtbot: QtBot, viewport: Viewport) -> None:
    assert viewport.canvas is not None
    told: list[int | None] = []
    viewport.domain_hovered.connect(told.append)
    for domain in (0, 1):
        place = place_of(viewport, seen_vertex(viewport, domain))
        QTest.mouseMove(viewport.canvas, place)
        qtbot.waitUntil(lambda domain=domain: viewport.hovered_domain == domain)
    QTest.mouseMove(viewport.canvas, QPoint(3, 3))
    qtbot.waitUntil(lambda: viewport.hovered_domain is None)
    assert told[-3:] == [0, 1, None]


def test_each_camera_shows_the_whole_body(viewport: Viewport) -> None:
    assert viewport.canvas is not None
    assert viewport.scene is not None
    positions = set()
    for name in CAMERAS:
        viewport.set_camera(name, animated=False)
        places = [on_screen(viewport.canvas, vertex) for vertex in viewport.scene.surface.vertices]
        across = np.array([(place.x(), place.y()) for place in places])
        assert across.min() > 0
        assert across.max() < SIDE
        assert np.ptp(across, axis=0).max() > 0.4 * SIDE
        assert viewport.scene.view is not None
        positions.add(viewport.scene.view.position.tobytes())
    assert len(positions) == len(CAMERAS)


@pytest.mark.parametrize("closely", [False, True])
def test_who_sees_the_whole_body_goes_on_seeing_it(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, closely: bool
) -> None:
    """But who looks at a part of it is left in peace."""
    model, scene = document.model, viewport.scene
    assert scene is not None
    straight, bent = (
        NamedPose(name, latent)
        for name, latent in (
            ("straight", np.zeros(model.latent_size)),
            ("bent", model.training_latent[np.abs(model.training_latent).sum(axis=1).argmax()]),
        )
    )
    document.load_pose(bent)
    rest(qtbot, viewport)
    vertices, up = scene.surface.vertices.copy(), np.eye(3)[model.up_axis]
    # As narrow as the bent tube allows, so that the straight one does not fit; or narrower.
    near = framing(vertices, np.array([0.3, 0.0, 1.0]), up, 1.0)
    share = 0.3 if closely else 0.9
    scene.view = View(near.focus + share * (near.position - near.focus), near.focus, near.up)
    before = scene.view
    assert sees_all(before, vertices, 1.0) is not closely
    document.load_pose(straight)
    rest(qtbot, viewport)
    assert not sees_all(before, scene.surface.vertices, 1.0)
    after = scene.view
    assert sees_all(after, scene.surface.vertices, 1.0) is not closely
    arms = [view.position - view.focus for view in (before, after)]
    directions = [arm / np.linalg.norm(arm) for arm in arms]
    np.testing.assert_allclose(directions[0], directions[1], atol=1e-6)
    if closely:
        np.testing.assert_array_equal(after.position, before.position)


def test_a_camera_is_turned_to_by_degrees_and_arrives(qtbot: QtBot, viewport: Viewport) -> None:
    viewport.set_camera("Back", animated=False)
    assert viewport.scene.view is not None
    back = viewport.scene.view
    viewport.set_camera("Front")
    assert viewport.scene.view is not None
    rest(qtbot, viewport)
    arms = [view.position - view.focus for view in (back, viewport.scene.view)]
    directions = [arm / np.linalg.norm(arm) for arm in arms]
    np.testing.assert_allclose(directions[0], -directions[1], atol=1e-6)


def roll(canvas: Canvas, place: QPoint, notches: float) -> None:
    """Turn the wheel, or move two fingers on a touchpad, over a place of the canvas."""
    turned = QPoint(0, round(120 * notches))
    no_keys, no_buttons = Qt.KeyboardModifier.NoModifier, Qt.MouseButton.NoButton
    phase, where = Qt.ScrollPhase.NoScrollPhase, canvas.mapToGlobal(place)
    event = QWheelEvent(
        QPointF(place), QPointF(where), QPoint(), turned, no_buttons, no_keys, phase, False
    )
    QApplication.sendEvent(canvas, event)


@pytest.mark.parametrize("steps", [[3.0, 3.0], [0.1] * 20, [-2.0], [2.0, -2.0]])
def test_the_wheel_zooms_at_the_pointer(
    qtbot: QtBot, viewport: Viewport, steps: list[float]
) -> None:
    canvas, scene = viewport.canvas, viewport.scene
    assert canvas is not None
    assert scene is not None
    vertex = seen_vertex(viewport, 1)
    place, before = place_of(viewport, vertex), scene.view
    point = scene.surface.vertices[vertex]
    for step in steps:
        roll(canvas, place, step)
        rest(qtbot, viewport)
        away = place_of(viewport, vertex) - place
        assert away.manhattanLength() <= 2
    after = scene.view
    nearer = np.linalg.norm(after.position - point) / np.linalg.norm(before.position - point)
    assert nearer == pytest.approx(1.15 ** -sum(steps), rel=0.02)
    sights = [view.focus - view.position for view in (before, after)]
    np.testing.assert_allclose(*(sight / np.linalg.norm(sight) for sight in sights), atol=1e-6)
    # What turning goes round is as deep in the scene as the body.
    depths = (scene.surface.vertices - after.position) @ (sights[1] / np.linalg.norm(sights[1]))
    assert depths.min() - 1e-6 <= np.linalg.norm(sights[1]) <= depths.max() + 1e-6


def test_zooming_beside_the_body_and_without_end_keeps_a_view_of_it(
    qtbot: QtBot, viewport: Viewport
) -> None:
    canvas, scene = viewport.canvas, viewport.scene
    assert canvas is not None
    assert scene is not None
    corner, before = QPoint(5, 5), scene.view
    roll(canvas, corner, 3.0)
    assert np.linalg.norm(scene.view.position - before.position) > 0.0
    roll(canvas, corner, -3.0)
    np.testing.assert_allclose(scene.view.position, before.position, atol=1e-6)
    height = viewport._document.model.body_size
    place = place_of(viewport, seen_vertex(viewport, 0))
    for notches, nearest, farthest in ((100.0, 0.03, 1.0), (-200.0, 5.0, 40.0)):
        for _ in range(3):
            roll(canvas, place, notches)
        distances = np.linalg.norm(scene.surface.vertices - scene.view.position, axis=1)
        assert nearest * height < distances.min() < farthest * height
        assert np.isfinite(scene.view.focus).all()
    rest(qtbot, viewport)


def test_two_fingers_spread_zoom_in(viewport: Viewport) -> None:
    canvas, scene = viewport.canvas, viewport.scene
    assert canvas is not None
    assert scene is not None
    place = QPointF(place_of(viewport, seen_vertex(viewport, 0)))
    before = scene.view
    pinch = QNativeGestureEvent(
        Qt.NativeGestureType.ZoomNativeGesture,
        QPointingDevice.primaryPointingDevice(),
        2,
        place,
        place,
        place,
        0.25,
        QPointF(),
    )
    QApplication.sendEvent(canvas, pinch)
    arms = [np.linalg.norm(view.position - view.focus) for view in (before, scene.view)]
    assert arms[1] < 0.95 * arms[0]


def test_a_right_click_asks_for_a_menu_and_a_right_drag_does_what_it_did(
    qtbot: QtBot, viewport: Viewport
) -> None:
    canvas, scene = viewport.canvas, viewport.scene
    assert canvas is not None
    assert scene is not None
    right = Qt.MouseButton.RightButton
    told: list[int | None] = []
    viewport.menu_wanted.connect(lambda domain, _: told.append(domain))
    before = scene.view
    for domain in (0, 1):
        place = place_of(viewport, seen_vertex(viewport, domain))
        QTest.mousePress(canvas, right, pos=place)
        QTest.mouseMove(canvas, place + QPoint(2, 1))
        QTest.mouseRelease(canvas, right, pos=place + QPoint(2, 1))
        assert told == [0, 1][: domain + 1]
    QTest.mouseClick(canvas, right, pos=QPoint(3, 3))
    assert told == [0, 1, None]
    np.testing.assert_array_equal(scene.view.position, before.position)
    QTest.mousePress(canvas, right, pos=QPoint(200, 200))
    for y in range(205, 300, 5):
        QTest.mouseMove(canvas, QPoint(200, y))
        qtbot.wait(2)
    QTest.mouseRelease(canvas, right, pos=QPoint(200, 300))
    assert told == [0, 1, None]
    rest(qtbot, viewport)
    arms = [np.linalg.norm(view.position - view.focus) for view in (before, scene.view)]
    assert arms[0] != pytest.approx(arms[1], rel=0.02)
    by_key = QContextMenuEvent(QContextMenuEvent.Reason.Keyboard, QPoint(3, 3), QPoint(3, 3))
    QApplication.sendEvent(canvas, by_key)
    assert len(told) == 4


def test_a_drag_is_smooth_until_pictures_are_slow_and_again_once_they_are_fast() -> None:
    smoothness = Smoothness()
    assert smoothness.while_moving
    for seconds in (0.2, 0.030, 0.005, 0.030, 0.030):
        smoothness.note(seconds)
        # One slow picture, or two, may be another program's fault.
        assert smoothness.while_moving
    smoothness.note(0.030)
    assert not smoothness.while_moving
    # Not to and fro: neither a little faster nor a little slower changes it.
    for seconds in (0.018, 0.015, 0.022, 0.013):
        smoothness.note(seconds)
        assert not smoothness.while_moving
    smoothness.note(0.011)
    for seconds in (0.013, 0.019, 0.022, 0.022, 0.019, 0.022, 0.022):
        smoothness.note(seconds)
        assert smoothness.while_moving


def test_the_canvas_draws_a_drag_as_smoothly_as_the_machine_can(
    qtbot: QtBot,
    document: PoseDocument,
    viewport: Viewport,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    canvas = viewport.canvas
    assert canvas is not None

    def drag() -> list[bool]:
        drawn: list[bool] = []
        note = lambda _: drawn.append(canvas.is_smooth)  # noqa: E731
        canvas.painted.connect(note)
        for value in np.linspace(-1.0, 1.0, 12):
            document.set_code(0, float(value))
            n_painted = viewport.canvas.n_painted
            qtbot.waitUntil(lambda n=n_painted: viewport.canvas.n_painted > n, timeout=20_000)
        canvas.painted.disconnect(note)
        return drawn

    canvas._smoothness = Smoothness()
    monkeypatch.setattr("app.view.canvas._SLOW_SECONDS", 1e3)
    assert all(drag())
    monkeypatch.setattr("app.view.canvas._SLOW_SECONDS", 0.0)
    monkeypatch.setattr("app.view.canvas._FAST_SECONDS", 0.0)
    assert not any(drag()[4:])
    rest(qtbot, viewport)
    # At rest it is smooth whatever that takes.
    assert canvas.is_smooth
    monkeypatch.setattr("app.view.canvas._FAST_SECONDS", 1e3)
    document.set_code(0, 0.3)
    rest(qtbot, viewport)
    assert all(drag())


def test_the_mouse_turns_the_camera_upright_and_keys_do_nothing(
    qtbot: QtBot, viewport: Viewport
) -> None:
    canvas = viewport.canvas
    assert canvas is not None
    assert viewport.scene.view is not None
    before = viewport.scene.view
    QTest.mousePress(canvas, Qt.MouseButton.LeftButton, pos=QPoint(200, 200))
    QTest.mouseMove(canvas, QPoint(240, 215))
    QTest.mouseMove(canvas, QPoint(280, 230))
    QTest.mouseRelease(canvas, Qt.MouseButton.LeftButton, pos=QPoint(280, 230))
    rest(qtbot, viewport)
    turned = viewport.scene.view
    assert np.linalg.norm(turned.position - before.position) > 1.0
    np.testing.assert_allclose(turned.up, before.up)
    up = viewport._document.model.up_axis
    assert turned.up[up] == 1.0
    # Off the body, or the part under the pointer may light up a moment later.
    QTest.mouseMove(canvas, QPoint(2, 2))
    qtbot.waitUntil(lambda: viewport.hovered_domain is None, timeout=20_000)
    canvas.setFocus()
    rest(qtbot, viewport)
    n_painted = canvas.n_painted
    for key in "wsrpfe3":
        QTest.keyClick(canvas, key)
    QApplication.processEvents()
    assert canvas.n_painted == n_painted
