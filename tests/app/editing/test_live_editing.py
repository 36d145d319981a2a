"""Drags, pins and solid edits: frames become the pose exactly, in one undo step each."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from app.editing import tasks
from app.editing.document import PoseDocument
from app.editing.live_pose import domain_of, part_name, training_pose
from app.work.frames import FrameEvaluator, PoseFrame
from app.work.threads import Failure
from lcollision_core.bodies import LearnedBody
from lcollision_core.errors import LCollisionError
from lcollision_core.posing import LARGEST_RADIUS, LEAST_RADIUS, Grip, Twist
from tests.app.windows import PATIENCE


@pytest.fixture
def solid(qtbot: QtBot, document: PoseDocument) -> PoseDocument:
    """Return a document with Solid on, at the free reference pose."""
    document.new_pose()
    document.motion.set_solid(True)
    qtbot.waitUntil(lambda: document.motion.exact is not None)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    return document


def settle(qtbot: QtBot, document: PoseDocument) -> None:
    qtbot.waitUntil(lambda: not document.motion.moving)
    qtbot.waitUntil(
        lambda: (
            document.motion.frame is not None
            and document.motion.frame.latent is document.history.latent
            and document.motion.exact is not None
        )
    )


def end_of(document: PoseDocument) -> Grip:
    """Return a patch at the end of the tube."""
    return document.motion.grip_at(document.model.n_vertices - 1)


def moved(document: PoseDocument, grip: Grip, way: float) -> np.ndarray:
    assert document.motion.frame is not None
    size = document.model.body_size
    target: np.ndarray = grip.position(document.motion.frame.vertices) + way * size * np.array(
        [1, -1, 0]
    )
    return target


def test_a_drag_moves_the_patch_by_one_step_and_asks_for_no_frame_again(
    qtbot: QtBot, solid: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, grip = solid.history.latent.tobytes(), end_of(solid)
    start = moved(solid, grip, 0.0)
    frames: list[bytes] = []
    solid.motion.frame_changed.connect(lambda: frames.append(solid.motion.frame.vertices.tobytes()))
    monkeypatch.delattr(FrameEvaluator, "frame")
    solid.motion.begin_drag(grip, "Drag the end")
    assert solid.motion.dragging
    for way in (0.02, 0.05, 0.08):
        solid.motion.drag_to(moved(solid, grip, way))
        settle(qtbot, solid)
    assert solid.history.undo_stack.count() == 0
    frame = solid.motion.frame
    assert frame is not None
    assert frame.latent is solid.history.latent
    assert frame.collisions is solid.motion.exact
    assert np.linalg.norm(grip.position(frame.vertices) - start) > 0.03 * solid.model.body_size
    solid.motion.end_drag()
    assert not solid.motion.dragging
    assert solid.history.undo_stack.count() == 1
    assert solid.history.undo_stack.text(0) == "Drag the end"
    after = solid.history.latent.tobytes()
    expected = solid.model.decode(solid.history.latent, n_threads=1).astype(np.float32)
    assert frames[-1] == expected.tobytes()
    monkeypatch.undo()
    solid.history.undo()
    assert solid.history.latent.tobytes() == before
    settle(qtbot, solid)
    solid.history.redo()
    assert solid.history.latent.tobytes() == after
    settle(qtbot, solid)


def test_a_rested_pointer_is_followed_until_the_pose_has_settled(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    grip = end_of(solid)
    misses: list[float] = []
    solid.motion.frame_changed.connect(lambda: misses.append(solid.motion.frame.miss))
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to(moved(solid, grip, 0.4))
    settle(qtbot, solid)
    assert len(misses) > 1
    assert misses[-1] < misses[0]
    solid.motion.end_drag()
    assert solid.history.undo_stack.count() == 1


def test_no_frame_of_an_old_target_is_shown_where_that_of_the_newest_is_quick(
    qtbot: QtBot, solid: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.editing.live_pose._QUICK_SECONDS", 600.0)
    begun, go_on = threading.Event(), threading.Event()
    compute = FrameEvaluator.moved

    def held(*arguments: Any) -> PoseFrame:
        begun.set()
        go_on.wait(120)
        return compute(*arguments)

    monkeypatch.setattr(FrameEvaluator, "moved", held)
    grip = end_of(solid)
    targets = [moved(solid, grip, way) for way in (0.02, 0.03, 0.04)]
    shown: list[bytes] = []
    solid.motion.frame_changed.connect(lambda: shown.append(solid.motion.frame.target.tobytes()))
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to(targets[0])
    qtbot.waitUntil(begun.is_set)
    for target in targets[1:]:
        solid.motion.drag_to(target)
    go_on.set()
    settle(qtbot, solid)
    solid.motion.end_drag()
    assert set(shown) == {targets[-1].tobytes()}


def test_letting_go_at_once_ends_where_a_rested_pointer_does(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    before, grip = solid.history.latent.tobytes(), end_of(solid)
    target = moved(solid, grip, 0.2)
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to(target)
    settle(qtbot, solid)
    solid.motion.end_drag()
    rested = solid.history.latent.tobytes()
    solid.history.undo()
    settle(qtbot, solid)
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to(target)
    solid.motion.end_drag()
    assert not solid.motion.dragging
    settle(qtbot, solid)
    assert solid.history.latent.tobytes() == rested != before
    assert solid.history.undo_stack.count() == 1


def test_escape_puts_everything_back_to_the_bit(qtbot: QtBot, solid: PoseDocument) -> None:
    before, grip = solid.history.latent.tobytes(), end_of(solid)
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to(moved(solid, grip, 0.1))
    settle(qtbot, solid)
    assert solid.history.latent.tobytes() != before
    solid.motion.drag_to(moved(solid, grip, 0.3))
    solid.motion.cancel_drag()
    assert not solid.motion.dragging
    assert solid.history.latent.tobytes() == before
    solid.motion.drag_to(moved(solid, grip, 0.1))
    settle(qtbot, solid)
    assert solid.history.latent.tobytes() == before
    assert solid.history.undo_stack.count() == 0
    assert not solid.history.modified


def test_a_drag_that_moves_nothing_is_no_step(qtbot: QtBot, solid: PoseDocument) -> None:
    for domain in range(len(solid.model.domain_names)):
        solid.motion.set_locked(domain, True)
    before, grip = solid.history.latent.tobytes(), end_of(solid)
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to([np.nan, 0.0, 0.0])
    settle(qtbot, solid)
    solid.motion.end_drag()
    assert solid.history.latent.tobytes() == before
    assert solid.history.undo_stack.count() == 0
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.end_drag()
    assert solid.history.undo_stack.count() == 0


def test_a_twist_is_a_drag(qtbot: QtBot, solid: PoseDocument) -> None:
    before = solid.history.latent.tobytes()
    solid.motion.begin_drag(Twist(1), "Twist")
    solid.motion.drag_to([0.3])
    settle(qtbot, solid)
    solid.motion.end_drag()
    assert solid.history.latent.tobytes() != before
    assert solid.history.undo_stack.text(0) == "Twist"


def test_a_solid_slider_lands_on_a_free_number_to_the_bit(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    start = solid.history.latent
    solid.motion.set_code(2, start[2] + 0.1)
    settle(qtbot, solid)
    assert solid.history.latent[2] == start[2] + 0.1
    assert np.delete(solid.history.latent, 2).tobytes() == np.delete(start, 2).tobytes()
    assert solid.history.undo_stack.count() == 1
    solid.history.undo()
    assert solid.history.latent.tobytes() == start.tobytes()


def test_a_solid_number_may_lie_beyond_the_slider_as_any_other(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    beyond = solid.model.latent_space.high[3] * 1.1
    solid.motion.set_code(3, beyond)
    settle(qtbot, solid)
    assert solid.history.latent[3] == beyond


def test_a_solid_edit_stops_at_contact_and_its_step_holds_what_was_reached(
    qtbot: QtBot, solid: PoseDocument, colliding: np.ndarray
) -> None:
    shown: list[bool] = []
    solid.motion.exact_changed.connect(
        lambda: shown.append(solid.motion.exact is None or solid.motion.exact.colliding)
    )
    before = solid.history.latent.tobytes()
    solid.motion.begin_gesture("Blend")
    for share in (0.3, 1.0):
        solid.motion.blend_towards(colliding, share)
        solid.motion.end_gesture()
        settle(qtbot, solid)
    reached = solid.history.latent.tobytes()
    assert before != reached != colliding.tobytes()
    assert shown
    assert not any(shown)
    settle(qtbot, solid)
    solid.history.undo()
    solid.history.undo()
    assert solid.history.latent.tobytes() == before
    solid.history.redo()
    solid.history.redo()
    assert solid.history.latent.tobytes() == reached


def test_undo_of_an_edit_that_has_not_moved_yet_only_drops_it(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.motion.set_code(0, solid.history.latent[0] + 0.1)
    settle(qtbot, solid)
    held = solid.history.latent.tobytes()
    solid.motion.randomise(1.0, 3)
    assert solid.motion.moving
    solid.history.undo()
    assert not solid.motion.moving
    settle(qtbot, solid)
    assert solid.history.latent.tobytes() == held
    assert solid.history.undo_stack.count() == 1


def test_another_edit_during_a_drag_is_a_step_of_its_own(qtbot: QtBot, solid: PoseDocument) -> None:
    other = training_pose(solid.model, 1)
    for is_solid, label, edit in (
        (False, "Reset all", solid.motion.reset_all),
        (True, f"Load {other.name}", lambda: solid.motion.load_pose(other)),
    ):
        solid.new_pose()
        solid.motion.set_solid(is_solid)
        grip = end_of(solid)
        qtbot.waitUntil(lambda: solid.motion.frame.latent is solid.history.latent)
        solid.motion.begin_drag(grip, "Drag")
        solid.motion.drag_to(moved(solid, grip, 0.05))
        settle(qtbot, solid)
        edit()
        assert not solid.motion.dragging
        held = solid.history.latent.tobytes()
        # Further movements of the hand change nothing.
        solid.motion.drag_to(moved(solid, grip, 0.1))
        settle(qtbot, solid)
        assert solid.history.latent.tobytes() == held
        texts = [
            solid.history.undo_stack.text(index)
            for index in range(solid.history.undo_stack.count())
        ]
        assert texts == ["Drag", label]


def test_an_edit_with_solid_off_ends_one_that_still_moves(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.motion.randomise(1.0, 3)
    assert solid.motion.moving
    solid.motion.set_solid(False)
    solid.motion.set_code(0, solid.history.latent[0] + 0.1)
    assert solid.history.undo_stack.undoText().startswith("Move ")
    settle(qtbot, solid)


def test_undo_of_what_has_not_moved_lets_sliders_show_the_pose_again(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.motion.set_code(0, solid.history.latent[0] + 0.1)
    assert solid.motion.moving
    with qtbot.waitSignal(solid.motion.frame_changed):
        solid.history.undo()
    settle(qtbot, solid)


def test_a_worker_keeps_no_drag_of_a_model_that_is_gone(qtbot: QtBot, solid: PoseDocument) -> None:
    grip, worker = end_of(solid), solid.motion._mailbox._worker
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to(moved(solid, grip, 0.05))
    settle(qtbot, solid)
    assert worker._dragger is not None
    model = solid.model
    solid.set_model(LearnedBody("bare", model.embedding, model.card))
    settle(qtbot, solid)
    assert worker._dragger is None


def test_solid_steps_on_one_slider_merge(qtbot: QtBot, solid: PoseDocument) -> None:
    start = solid.history.latent
    for value in (0.02, 0.04, 0.06):
        solid.motion.set_code(0, start[0] + value)
    settle(qtbot, solid)
    solid.motion.set_code(0, start[0] + 0.08)
    settle(qtbot, solid)
    assert solid.history.latent[0] == start[0] + 0.08
    assert solid.history.undo_stack.count() == 1
    solid.history.undo()
    assert solid.history.latent.tobytes() == start.tobytes()


def test_blends_by_the_keyboard_add_up(qtbot: QtBot, solid: PoseDocument) -> None:
    start, target = solid.history.latent, solid.model.known_poses[1].astype(np.float64)
    for _ in range(2):
        solid.motion.blend_towards(target, 0.1)
    settle(qtbot, solid)
    np.testing.assert_allclose(solid.history.latent, start + 0.19 * (target - start), atol=1e-6)


def test_a_drag_that_fails_is_told_once_and_holds_nothing_up(
    qtbot: QtBot, solid: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures: list[Failure] = []
    solid.failed.connect(failures.append)
    before = solid.history.latent
    with monkeypatch.context() as broken:
        broken.setattr(LearnedBody, "dragger", lambda *_: 1 / 0)
        for code in (0, 1):
            solid.motion.set_code(code, before[code] + 0.1)
            qtbot.waitUntil(lambda: not solid.motion.moving)
    assert len(failures) == 1
    assert "ZeroDivisionError" in failures[0].headline
    assert solid.history.latent is before
    assert solid.history.undo_stack.count() == 0
    solid.motion.set_code(0, before[0] + 0.1)
    settle(qtbot, solid)
    assert solid.history.latent[0] == before[0] + 0.1


def test_a_predictor_that_comes_in_mid_drag_lets_it_go_on(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    grip, model = end_of(solid), solid.model
    solid.motion.predicts = False
    solid.motion._mailbox._worker._evaluator.predicts = False
    solid.motion.begin_drag(grip, "Drag")
    solid.motion.drag_to(moved(solid, grip, 0.05))
    settle(qtbot, solid)
    assert solid.motion.frame is not None
    assert solid.motion.frame.prediction is None
    solid.tasks._on_prepared(model)
    assert solid.motion.dragging
    solid.motion.end_drag()
    latent = solid.history.latent
    qtbot.waitUntil(
        lambda: solid.motion.frame is not None and solid.motion.frame.prediction is not None
    )
    assert solid.motion.frame.latent is latent is solid.history.latent


def test_a_pose_is_measured_even_where_predictions_cannot_be_loaded(
    qtbot: QtBot, solid: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise LCollisionError("the predictor is damaged")

    failures: list[Failure] = []
    solid.failed.connect(failures.append)
    monkeypatch.setattr(tasks, "prepare", broken)
    solid.set_model(solid.model)
    qtbot.waitUntil(lambda: solid.motion.is_measured, timeout=PATIENCE)
    assert [failure.headline for failure in failures] == ["the predictor is damaged"]


def test_edits_that_follow_at_once_are_not_lost(qtbot: QtBot, solid: PoseDocument) -> None:
    start = solid.history.latent
    for code in (0, 1):
        solid.motion.set_code(code, start[code] + 0.05)
    settle(qtbot, solid)
    np.testing.assert_array_equal(solid.history.latent[:2], start[:2] + 0.05)


def test_what_is_loaded_stays_as_it_is_even_where_it_collides(
    qtbot: QtBot, solid: PoseDocument, colliding: np.ndarray
) -> None:
    solid.motion.load_pose(training_pose(solid.model, 1))
    assert np.array_equal(solid.history.latent, solid.model.known_poses[1])
    solid.motion.set_solid(False)
    solid.motion.blend_towards(colliding, 1.0)
    solid.motion.set_solid(True)
    settle(qtbot, solid)
    assert solid.history.latent.tobytes() == colliding.tobytes()
    assert solid.motion.exact is not None
    energy = solid.motion.exact.energy
    solid.motion.set_code(0, solid.history.latent[0] * 0.9)
    settle(qtbot, solid)
    assert solid.history.latent.tobytes() != colliding.tobytes()
    assert solid.motion.exact.energy < energy


def test_pins_are_of_the_pose_and_of_undo(solid: PoseDocument) -> None:
    told: list[int] = []
    solid.history.pins_changed.connect(lambda: told.append(len(solid.history.pose.pins)))
    first, second = end_of(solid), solid.motion.grip_at(0)
    assert not solid.history.modified
    solid.pins.pin([first])
    assert solid.history.modified
    solid.pins.pin([first, second], "Pin both")
    assert [pin.vertex for pin in solid.history.pose.pins] == [first.vertex, second.vertex]
    solid.pins.toggle(first.vertex)
    solid.pins.remove_all()
    solid.pins.remove_all()
    assert told == [1, 2, 1, 0]
    assert solid.history.undo_stack.count() == 4
    for count in (1, 2, 1, 0):
        solid.history.undo()
        assert len(solid.history.pose.pins) == count
    assert not solid.history.modified
    solid.history.redo()
    assert solid.history.pose.pins[0].vertex == first.vertex


def test_a_pin_is_where_the_pose_has_its_patch_though_the_frame_is_late(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.motion.set_solid(False)
    grip = end_of(solid)
    solid.motion.load_pose(training_pose(solid.model, 1))
    assert solid.motion.frame is not None
    assert solid.motion.frame.latent is not solid.history.latent
    solid.pins.pin([grip])
    settle(qtbot, solid)
    place = grip.position(solid.motion.frame.vertices)
    np.testing.assert_allclose(
        solid.history.pose.pins[0].position, place, atol=1e-5 * solid.model.body_size
    )


def test_a_pin_stays_in_a_drag_and_comes_along_in_its_own(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    end, other = end_of(solid), solid.motion.grip_at(solid.model.n_vertices // 2)
    size = solid.model.body_size
    solid.pins.pin([end])
    (held,) = solid.history.pose.pins
    solid.motion.begin_drag(other, "Drag")
    solid.motion.drag_to(moved(solid, other, 0.05))
    settle(qtbot, solid)
    solid.motion.end_drag()
    assert solid.motion.frame is not None
    assert solid.history.pose.pins == (held,)
    drift = np.linalg.norm(end.position(solid.motion.frame.vertices) - held.position)
    assert drift < 0.02 * size
    solid.motion.begin_pin_drag(0)
    solid.motion.drag_to(moved(solid, end, 0.1))
    settle(qtbot, solid)
    solid.motion.end_drag()
    (pin,) = solid.history.pose.pins
    np.testing.assert_array_equal(pin.position, end.position(solid.motion.frame.vertices))
    assert np.linalg.norm(np.subtract(pin.position, held.position)) > 0.02 * size
    solid.history.undo()
    assert solid.history.pose.pins == (held,)


def test_a_vertex_belongs_to_the_domain_that_owns_most(document: PoseDocument) -> None:
    mask = document.model.attention_mask
    led = [domain_of(document.model, vertex) for vertex in range(document.model.n_vertices)]
    assert set(led) == {0, 1}
    np.testing.assert_array_equal(mask[led, range(len(led))], mask.max(axis=0))
    assert part_name(document.model, 0) == document.model.domain_names[led[0]]


def test_the_radius_of_grips_has_limits(document: PoseDocument) -> None:
    grip = document.motion.grip_at(3)
    assert document.motion.grip_at(3) is grip
    document.motion.set_grip_radius(100.0)
    assert document.motion.grip_radius == LARGEST_RADIUS
    assert len(document.motion.grip_at(3).vertices) > len(grip.vertices)
    document.motion.set_grip_radius(0.0)
    assert document.motion.grip_radius == LEAST_RADIUS
    last, model = document.motion.grip_at(3), document.model
    document.set_model(LearnedBody("bare", model.embedding, model.card))
    assert document.motion.grip_at(3) is not last


@pytest.fixture
def seen(solid: PoseDocument) -> Iterator[list[tuple[bool, bool]]]:
    """Record whether each shown frame collides, by a separate check, and if it has contacts."""
    shown: list[tuple[bool, bool]] = []

    def look() -> None:
        assert solid.motion.frame is not None
        found = solid.model.detector.detect(solid.motion.frame.vertices)
        shown.append((found.colliding, len(solid.motion.frame.contacts) > 0))

    solid.motion.frame_changed.connect(look)
    yield shown
    solid.motion.frame_changed.disconnect(look)


@pytest.mark.slow
def test_no_random_sequence_shows_a_colliding_pose(
    qtbot: QtBot,
    solid: PoseDocument,
    colliding: np.ndarray,
    seen: list[tuple[bool, bool]],
) -> None:
    chance = random.Random(5)
    model = solid.model

    def drag() -> None:
        vertex = chance.randrange(model.n_vertices)
        if solid.history.pose.pins and chance.random() < 0.3:
            vertex = solid.history.pose.pins[0].vertex
            solid.motion.begin_pin_drag(0)
        else:
            solid.motion.begin_drag(solid.motion.grip_at(vertex), "Drag")
        locked, before = model.embedding.codes_of(solid.motion.locked_domains), solid.history.latent
        for _ in range(chance.randrange(1, 6)):
            assert solid.motion.frame is not None
            step = np.array([chance.gauss(0.0, 0.3) for _ in range(3)]) * model.body_size
            solid.motion.drag_to(solid.motion.frame.vertices[vertex] + step)
            qtbot.wait(chance.choice((0, 5, 20)))
            assert (solid.history.latent[locked] == before[locked]).all()
        chance.choice((solid.motion.end_drag, solid.motion.end_drag, solid.motion.cancel_drag))()

    def slide() -> None:
        code = chance.randrange(model.latent_size)
        low, high = model.latent_space.low[code], model.latent_space.high[code]
        solid.motion.set_code(code, chance.uniform(low, high))

    def wander() -> None:
        solid.motion.randomise(chance.random(), chance.randrange(1000))

    def meet() -> None:
        solid.motion.blend_towards(colliding, 1.0)

    def lock() -> None:
        solid.motion.set_locked(chance.randrange(len(model.domain_names)), chance.random() < 0.4)

    def pin() -> None:
        if len(solid.history.pose.pins) > 2:
            solid.pins.remove_all()
        else:
            solid.pins.pin([solid.motion.grip_at(chance.randrange(model.n_vertices))])

    acts = [
        drag,
        drag,
        slide,
        slide,
        wander,
        meet,
        meet,
        lock,
        pin,
        solid.history.undo,
        solid.history.redo,
    ]
    for _ in range(150):
        chance.choice(acts)()
        if chance.random() < 0.5:
            settle(qtbot, solid)
    settle(qtbot, solid)
    states = [solid.history.latent.tobytes()]
    while solid.history.undo_stack.canUndo():
        solid.history.undo()
        states.append(solid.history.latent.tobytes())
    for state in reversed(states[:-1]):
        solid.history.redo()
        assert solid.history.latent.tobytes() == state
    settle(qtbot, solid)
    collide, touch = zip(*seen, strict=True)
    assert len(seen) > 100
    assert not any(collide)
    assert any(touch)


def test_reset_all_is_one_step_that_takes_the_pins_and_says_what_stays(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    other = next(k for k in range(9) if training_pose(solid.model, k).latent.any())
    solid.motion.load_pose(training_pose(solid.model, other))
    solid.pins.pin([end_of(solid)])
    solid.motion.set_locked(0, True)
    settle(qtbot, solid)
    before, pins, steps = (
        solid.history.latent,
        solid.history.pose.pins,
        solid.history.undo_stack.count(),
    )
    assert pins
    with qtbot.waitSignal(solid.message) as told:
        solid.motion.reset_all()
    assert told.args == ["Everything was reset except 1 locked body part: see Edit > Unlock all"]
    locked = solid.model.space.codes_of([0])
    # Even with Solid on: the pose is set at once, so contact cannot stop it.
    assert not solid.motion.moving
    assert not solid.history.latent[~locked].any()
    assert (solid.history.latent[locked] == before[locked]).all()
    assert solid.history.pose.pins == ()
    assert solid.history.undo_stack.count() == steps + 1
    solid.history.undo()
    assert solid.history.latent.tobytes() == before.tobytes()
    assert solid.history.pose.pins == pins
    solid.motion.set_locked(0, False)
    with qtbot.assertNotEmitted(solid.message):
        solid.motion.reset_all()
    assert not solid.history.latent.any()
    settle(qtbot, solid)
