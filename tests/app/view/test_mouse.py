"""The camera and the mouse in a viewport: turning, zooming, clicking, and drawing meanwhile."""

from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtGui import (
    QContextMenuEvent,
    QNativeGestureEvent,
    QPointingDevice,
)
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.camera import CAMERAS, View, framing, places_of, sees_all
from app.view.canvas import Smoothness
from app.view.viewport import Viewport
from lcollision_core.bodies import LearnedBody, NamedPose
from tests.app.views import (
    SIDE,
    double_click,
    on_screen,
    place_of,
    point_at,
    point_beside,
    rest,
    roll,
    seen_vertex,
)


def test_the_pointer_names_the_domain_beneath_it(qtbot: QtBot, viewport: Viewport) -> None:
    assert viewport.canvas is not None
    told: list[int | None] = []
    viewport.domain_hovered.connect(told.append)
    # A pointer that is already there, from an earlier test, would not move.
    point_beside(qtbot, viewport)
    places = [place_of(viewport, seen_vertex(viewport, domain)) for domain in (0, 1)]
    for domain, place in zip((0, 1, None), (*places, QPoint(3, 3)), strict=True):

        def is_named(domain: int | None = domain, place: QPoint = place) -> bool:
            # On a busy machine, the pointer's only move may come before the window is under it.
            for step in (QPoint(1, 0), QPoint()):
                QTest.mouseMove(viewport.canvas, place + step)
                qtbot.wait(60)
            return viewport.hovered_domain == domain

        qtbot.waitUntil(is_named)
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


@pytest.mark.variants
@pytest.mark.parametrize("closely", [False, True])
def test_who_sees_the_whole_body_goes_on_seeing_it(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, closely: bool
) -> None:
    """But a view of a part of it is not changed."""
    model, scene = document.model, viewport.scene
    assert scene is not None
    straight, bent = (
        NamedPose(name, latent)
        for name, latent in (
            ("straight", np.zeros(model.latent_size)),
            ("bent", model.known_poses[np.abs(model.known_poses).sum(axis=1).argmax()]),
        )
    )
    document.motion.load_pose(bent)
    rest(qtbot, viewport)
    vertices, up = scene.surface.vertices.copy(), np.eye(3)[model.up_axis]
    # Just wide enough for the bent tube, so that the straight one does not fit; or narrower.
    near = framing(vertices, np.array([0.3, 0.0, 1.0]), up, 1.0)
    share = 0.3 if closely else 0.9
    scene.view = View(near.focus + share * (near.position - near.focus), near.focus, near.up)
    before = scene.view
    assert sees_all(before, vertices, 1.0) is not closely
    document.motion.load_pose(straight)
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


@pytest.mark.variants(2)
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
    # The centre of rotation is as deep in the scene as the body.
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
    viewport.menu_wanted.connect(lambda domain, *_: told.append(domain))
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
        # One or two slow pictures may be caused by another program.
        assert smoothness.while_moving
    smoothness.note(0.030)
    assert not smoothness.while_moving
    # There is hysteresis: slightly faster or slower pictures change nothing.
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
            document.motion.set_code(0, float(value))
            n_painted = viewport.canvas.n_painted
            qtbot.waitUntil(lambda n=n_painted: viewport.canvas.n_painted > n, timeout=20_000)
        canvas.painted.disconnect(note)
        return drawn

    canvas._smoothness = Smoothness()
    monkeypatch.setattr("app.view.canvas._SLOW_SECONDS", 1e3)
    assert all(drag())
    monkeypatch.setattr("app.view.canvas._SLOW_SECONDS", 0.0)
    monkeypatch.setattr("app.view.canvas._FAST_SECONDS", 0.0)
    # However long a busy machine draws a picture, this does not count as rest.
    at_rest = canvas._rest.interval()
    canvas._rest.setInterval(1_000_000)
    assert not any(drag()[4:])
    canvas._rest.start(at_rest)
    rest(qtbot, viewport)
    # At rest, the picture is smooth whatever its time.
    assert canvas.is_smooth
    monkeypatch.setattr("app.view.canvas._FAST_SECONDS", 1e3)
    document.motion.set_code(0, 0.3)
    rest(qtbot, viewport)
    assert all(drag())


CONTROL, SHIFT, ALT = (
    Qt.KeyboardModifier.ControlModifier,
    Qt.KeyboardModifier.ShiftModifier,
    Qt.KeyboardModifier.AltModifier,
)
NO_KEY = Qt.KeyboardModifier.NoModifier
LEFT, MIDDLE = Qt.MouseButton.LeftButton, Qt.MouseButton.MiddleButton


def drag(
    qtbot: QtBot,
    viewport: Viewport,
    start: QPoint,
    way: QPoint,
    button: Qt.MouseButton = LEFT,
    keys: Qt.KeyboardModifier = NO_KEY,
    let_go: bool = True,
) -> None:
    """Drag with a button, in a few steps, and wait until the dragged patch has arrived."""
    canvas = viewport.canvas
    assert canvas is not None
    QTest.mousePress(canvas, button, keys, start)
    for step in range(1, 6):
        QTest.mouseMove(canvas, start + way * step / 5)
        qtbot.wait(20)
    if let_go:
        qtbot.waitUntil(lambda: not viewport._document.motion.moving, timeout=60_000)
        QTest.mouseRelease(canvas, button, keys, start + way)


def settled(qtbot: QtBot, viewport: Viewport) -> None:
    """Wait until a drag has arrived on the screen."""
    qtbot.waitUntil(lambda: not viewport._document.motion.moving, timeout=60_000)
    rest(qtbot, viewport)


@pytest.mark.variants(3)
@pytest.mark.parametrize(
    ("button", "keys", "on_body", "shifts"),
    [
        (LEFT, NO_KEY, False, False),
        (LEFT, SHIFT, False, True),
        (LEFT, SHIFT, True, True),
        (LEFT, ALT, True, False),
        (MIDDLE, NO_KEY, True, False),
        (MIDDLE, SHIFT, True, True),
    ],
)
def test_the_mouse_turns_and_shifts_the_camera(
    qtbot: QtBot,
    viewport: Viewport,
    button: Qt.MouseButton,
    keys: Qt.KeyboardModifier,
    on_body: bool,
    shifts: bool,
) -> None:
    canvas, document = viewport.canvas, viewport._document
    assert canvas is not None
    assert viewport.scene is not None
    before, latent = viewport.scene.view, document.history.latent
    start = place_of(viewport, seen_vertex(viewport, 0)) if on_body else QPoint(10, 10)
    drag(qtbot, viewport, start, QPoint(60, 20), button, keys)
    rest(qtbot, viewport)
    after = viewport.scene.view
    arms = [view.position - view.focus for view in (before, after)]
    assert np.linalg.norm(arms[1]) == pytest.approx(np.linalg.norm(arms[0]))
    assert bool(np.abs(arms[1] - arms[0]).max() < 1e-9) is shifts
    assert bool(np.abs(after.focus - before.focus).max() > 1e-3) is shifts
    np.testing.assert_array_equal(after.up, before.up)
    assert document.history.latent is latent
    assert document.history.undo_stack.count() == 0


WAY = QPoint(0, 20)
"""A drag in pixels that the tube's first body part can follow."""


def test_the_patch_that_is_dragged_follows_the_pointer_in_one_step_of_undo(
    qtbot: QtBot, viewport: Viewport, monkeypatch: pytest.MonkeyPatch
) -> None:
    canvas, scene, document = viewport.canvas, viewport.scene, viewport._document
    assert canvas is not None
    assert scene is not None
    # Half of a tube cannot move alone.
    document.motion.standing, document.motion.whole_body = False, True
    vertex = seen_vertex(viewport, 0)
    before, camera = document.history.latent, scene.view.position
    place = point_at(qtbot, viewport, vertex)
    grip = document.motion.grip_at(vertex)
    points = [grip.position(scene.surface.vertices)]
    targets: list[np.ndarray] = []
    go_on = document.motion.drag_to

    def drag_to(target: np.ndarray) -> None:
        targets.append(target)
        go_on(target)

    monkeypatch.setattr(document.motion, "drag_to", drag_to)
    drag(qtbot, viewport, place, WAY)
    settled(qtbot, viewport)
    points += [targets[-1], grip.position(scene.surface.vertices)]
    places = places_of(scene.view, np.array(points), (canvas.width(), canvas.height()))
    np.testing.assert_allclose(places[1] - places[0], [WAY.x(), WAY.y()], atol=0.1)
    # The tube moves as far in that direction as it can.
    assert np.linalg.norm(places[2] - places[1]) < 0.8 * WAY.manhattanLength()
    np.testing.assert_array_equal(scene.view.position, camera)
    name = document.model.domain_names[0]
    assert document.history.undo_stack.count() == 1
    assert document.history.undo_stack.undoText() == f"Drag {name}"
    document.history.undo()
    np.testing.assert_array_equal(document.history.latent, before)


def test_escape_in_a_drag_puts_everything_back_to_the_bit(qtbot: QtBot, viewport: Viewport) -> None:
    canvas, document = viewport.canvas, viewport._document
    assert canvas is not None
    before = document.history.latent.copy()
    place = place_of(viewport, seen_vertex(viewport, 1))
    drag(qtbot, viewport, place, QPoint(25, 0), let_go=False)
    qtbot.waitUntil(lambda: not np.array_equal(document.history.latent, before), timeout=60_000)
    assert document.motion.dragging
    QTest.keyClick(canvas, Qt.Key.Key_Escape)
    assert not document.motion.dragging
    np.testing.assert_array_equal(document.history.latent, before)
    # Further movements of the hand change nothing.
    QTest.mouseMove(canvas, place + QPoint(40, 0))
    QTest.mouseRelease(canvas, LEFT, NO_KEY, place + QPoint(40, 0))
    settled(qtbot, viewport)
    np.testing.assert_array_equal(document.history.latent, before)
    assert document.history.undo_stack.count() == 0


def test_a_drag_ends_with_its_model(qtbot: QtBot, viewport: Viewport) -> None:
    """The held patch may have vertices that the next model lacks."""
    canvas, document = viewport.canvas, viewport._document
    assert canvas is not None
    place = place_of(viewport, seen_vertex(viewport, 1))
    drag(qtbot, viewport, place, QPoint(25, 0), let_go=False)
    assert document.motion.dragging
    model = document.model
    document.set_model(LearnedBody("bare", model.embedding, model.card))
    settled(qtbot, viewport)
    scene, latent = viewport.scene, document.history.latent
    assert scene is not None
    assert not scene.patch.show(None)
    QTest.mouseMove(canvas, place + QPoint(40, 0))
    QTest.mouseRelease(canvas, LEFT, NO_KEY, place + QPoint(40, 0))
    settled(qtbot, viewport)
    assert document.history.latent is latent
    assert document.history.undo_stack.count() == 0


def test_a_drag_that_another_action_ends_shows_no_target(qtbot: QtBot, viewport: Viewport) -> None:
    canvas, scene, document = viewport.canvas, viewport.scene, viewport._document
    assert canvas is not None
    assert scene is not None
    place = place_of(viewport, seen_vertex(viewport, 1))
    drag(qtbot, viewport, place, QPoint(25, 0), let_go=False)
    document.history.undo()
    QTest.mouseMove(canvas, place + QPoint(40, 0))
    assert not scene.patch.show(None)
    settled(qtbot, viewport)
    assert scene.marks._line is None
    QTest.mouseRelease(canvas, LEFT, NO_KEY, place + QPoint(40, 0))
    settled(qtbot, viewport)


def test_a_ctrl_drag_twists_the_part(qtbot: QtBot, viewport: Viewport) -> None:
    canvas, document = viewport.canvas, viewport._document
    assert canvas is not None
    before = document.history.latent.copy()
    place = place_of(viewport, seen_vertex(viewport, 1))
    drag(qtbot, viewport, place, QPoint(30, 30), keys=CONTROL)
    settled(qtbot, viewport)
    assert not np.array_equal(document.history.latent, before)
    assert document.history.undo_stack.undoText() == f"Twist {document.model.domain_names[1]}"


def test_the_wheel_with_ctrl_changes_the_patch_and_not_the_camera(
    qtbot: QtBot, viewport: Viewport
) -> None:
    canvas, scene, document = viewport.canvas, viewport.scene, viewport._document
    assert canvas is not None
    assert scene is not None
    place = point_at(qtbot, viewport, seen_vertex(viewport, 1))
    camera, radius = scene.view.position, document.motion.grip_radius
    roll(canvas, place, 1.0, CONTROL)
    assert document.motion.grip_radius == pytest.approx(1.25 * radius)
    roll(canvas, place, -1.0, CONTROL)
    assert document.motion.grip_radius == pytest.approx(radius)
    np.testing.assert_array_equal(scene.view.position, camera)
    rest(qtbot, viewport)


def test_a_double_click_pins_and_unpins_and_a_pin_is_dragged_by_its_dot(
    qtbot: QtBot, viewport: Viewport
) -> None:
    canvas, scene, document = viewport.canvas, viewport.scene, viewport._document
    assert canvas is not None
    assert scene is not None
    document.motion.standing, document.motion.whole_body = False, True
    vertex = seen_vertex(viewport, 0)
    place = place_of(viewport, vertex)
    double_click(canvas, place)
    assert [pin.vertex for pin in document.history.pose.pins] == [vertex]
    rest(qtbot, viewport)
    size = float(canvas.width()), float(canvas.height())

    def dot() -> QPoint:
        (seen,) = places_of(scene.view, np.array([document.history.pose.pins[0].position]), size)
        return QPointF(*seen.tolist()).toPoint()

    start = dot()
    drag(qtbot, viewport, start, WAY)
    settled(qtbot, viewport)
    assert (dot() - start - WAY).manhattanLength() < 0.8 * WAY.manhattanLength()
    assert "pin" in document.history.undo_stack.undoText().casefold()
    dot_before = dot()
    double_click(canvas, dot())
    # Otherwise QTest considers the button pressed in later tests.
    QTest.mouseRelease(canvas, LEFT, NO_KEY, dot_before)
    assert document.history.pose.pins == ()
    settled(qtbot, viewport)


def test_no_pin_is_found_that_is_gone_since_the_last_picture(
    qtbot: QtBot, viewport: Viewport
) -> None:
    mouse, document = viewport.mouse, viewport._document
    assert mouse is not None
    vertex = seen_vertex(viewport, 0)
    document.pins.pin([document.motion.grip_at(vertex)])
    rest(qtbot, viewport)
    place = QPointF(place_of(viewport, vertex))
    mouse.point_at(place)
    assert mouse.pin == 0
    document.pins.remove_all()
    mouse.point_at(place)
    assert mouse.pin is None
    assert mouse.vertex == vertex


def test_keys_do_nothing_in_the_view(qtbot: QtBot, viewport: Viewport) -> None:
    canvas = viewport.canvas
    assert canvas is not None
    # Move off the body, or the part under the pointer may be highlighted a moment later.
    QTest.mouseMove(canvas, QPoint(2, 2))
    qtbot.waitUntil(lambda: viewport.hovered_domain is None, timeout=20_000)
    canvas.setFocus()
    rest(qtbot, viewport)
    n_painted = canvas.n_painted
    for key in "wsrpfe3":
        QTest.keyClick(canvas, key)
    QApplication.processEvents()
    assert canvas.n_painted == n_painted


def test_nothing_is_pointed_at_when_another_model_comes_in(
    qtbot: QtBot, viewport: Viewport
) -> None:
    document = viewport._document
    point_at(qtbot, viewport, seen_vertex(viewport, 1))
    document.set_model(document.model)
    assert viewport.pointed_vertex is None
    assert viewport.hovered_domain is None
    rest(qtbot, viewport)
