"""Drags, pins and solid edits: frames become the pose, one step of undo each, exact to the bit."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.work.frames import FrameEvaluator, LiveFrame
from app.work.threads import Failure
from lcollision_core.model import PoseModel, sample_poses
from lcollision_core.posing import LARGEST_RADIUS, LEAST_RADIUS, Grip, Twist


@pytest.fixture(scope="module")
def colliding(editor_model: PoseModel) -> np.ndarray:
    """Return a latent pose that collides."""
    return sample_poses(editor_model, 1, 0, colliding=True)[0]


@pytest.fixture
def solid(qtbot: QtBot, document: PoseDocument) -> PoseDocument:
    """Return a document with Solid on, at the free reference pose."""
    document.new_pose()
    document.set_solid(True)
    qtbot.waitUntil(lambda: document.exact is not None)
    assert document.exact is not None
    assert not document.exact.colliding
    return document


def settle(qtbot: QtBot, document: PoseDocument) -> None:
    qtbot.waitUntil(lambda: not document.moving)
    qtbot.waitUntil(
        lambda: (
            document.frame is not None
            and document.frame.latent is document.latent
            and document.exact is not None
        )
    )


def end_of(document: PoseDocument) -> Grip:
    """Return a patch at the end of the tube."""
    return document.grip_at(document.model.n_vertices - 1)


def moved(document: PoseDocument, grip: Grip, way: float) -> np.ndarray:
    assert document.frame is not None
    size = document.model.body_size
    target: np.ndarray = grip.position(document.frame.vertices) + way * size * np.array([1, -1, 0])
    return target


def test_a_drag_moves_the_patch_by_one_step_and_asks_for_no_frame_again(
    qtbot: QtBot, solid: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, grip = solid.latent.tobytes(), end_of(solid)
    start = moved(solid, grip, 0.0)
    frames: list[bytes] = []
    solid.frame_changed.connect(lambda: frames.append(solid.frame.vertices.tobytes()))
    monkeypatch.delattr(FrameEvaluator, "frame")
    solid.begin_drag(grip, "Drag the end")
    assert solid.dragging
    for way in (0.02, 0.05, 0.08):
        solid.drag_to(moved(solid, grip, way))
        settle(qtbot, solid)
    assert solid.undo_stack.count() == 0
    frame = solid.frame
    assert frame is not None
    assert frame.latent is solid.latent
    assert frame.verdict is solid.exact
    assert np.linalg.norm(grip.position(frame.vertices) - start) > 0.03 * solid.model.body_size
    solid.end_drag()
    assert not solid.dragging
    assert solid.undo_stack.count() == 1
    assert solid.undo_stack.text(0) == "Drag the end"
    after = solid.latent.tobytes()
    expected = solid.model.decode(solid.latent, n_threads=1).astype(np.float32)
    assert frames[-1] == expected.tobytes()
    monkeypatch.undo()
    solid.undo()
    assert solid.latent.tobytes() == before
    settle(qtbot, solid)
    solid.redo()
    assert solid.latent.tobytes() == after
    settle(qtbot, solid)


def test_a_rested_pointer_is_followed_until_the_pose_has_settled(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    grip = end_of(solid)
    misses: list[float] = []
    solid.frame_changed.connect(lambda: misses.append(solid.frame.miss))
    solid.begin_drag(grip, "Drag")
    solid.drag_to(moved(solid, grip, 0.4))
    settle(qtbot, solid)
    assert len(misses) > 1
    assert misses[-1] < misses[0]
    solid.end_drag()
    assert solid.undo_stack.count() == 1


def test_no_frame_of_an_old_target_is_shown_where_that_of_the_newest_is_quick(
    qtbot: QtBot, solid: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.work.live_pose._QUICK_SECONDS", 600.0)
    monkeypatch.setattr("app.work.live_pose._PATIENCE_SECONDS", 600.0)
    begun, go_on = threading.Event(), threading.Event()
    compute = FrameEvaluator.dragged

    def held(*arguments: Any) -> LiveFrame:
        begun.set()
        go_on.wait(120)
        return compute(*arguments)

    monkeypatch.setattr(FrameEvaluator, "dragged", held)
    grip = end_of(solid)
    targets = [moved(solid, grip, way) for way in (0.02, 0.03, 0.04)]
    shown: list[bytes] = []
    solid.frame_changed.connect(lambda: shown.append(solid.frame.target.tobytes()))
    solid.begin_drag(grip, "Drag")
    solid._live._is_quick = False
    solid.drag_to(targets[0])
    qtbot.waitUntil(begun.is_set)
    for target in targets[1:]:
        solid.drag_to(target)
    go_on.set()
    settle(qtbot, solid)
    solid.end_drag()
    assert set(shown) == {targets[-1].tobytes()}


def test_letting_go_at_once_ends_where_a_rested_pointer_does(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    before, grip = solid.latent.tobytes(), end_of(solid)
    target = moved(solid, grip, 0.2)
    solid.begin_drag(grip, "Drag")
    solid.drag_to(target)
    settle(qtbot, solid)
    solid.end_drag()
    rested = solid.latent.tobytes()
    solid.undo()
    settle(qtbot, solid)
    solid.begin_drag(grip, "Drag")
    solid.drag_to(target)
    solid.end_drag()
    assert not solid.dragging
    settle(qtbot, solid)
    assert solid.latent.tobytes() == rested != before
    assert solid.undo_stack.count() == 1


def test_escape_puts_everything_back_to_the_bit(qtbot: QtBot, solid: PoseDocument) -> None:
    before, grip = solid.latent.tobytes(), end_of(solid)
    solid.begin_drag(grip, "Drag")
    solid.drag_to(moved(solid, grip, 0.1))
    settle(qtbot, solid)
    assert solid.latent.tobytes() != before
    solid.drag_to(moved(solid, grip, 0.3))
    solid.cancel_drag()
    assert not solid.dragging
    assert solid.latent.tobytes() == before
    solid.drag_to(moved(solid, grip, 0.1))
    settle(qtbot, solid)
    assert solid.latent.tobytes() == before
    assert solid.undo_stack.count() == 0
    assert not solid.modified


def test_a_drag_that_moves_nothing_is_no_step(qtbot: QtBot, solid: PoseDocument) -> None:
    for domain in range(len(solid.model.domain_names)):
        solid.set_locked(domain, True)
    before, grip = solid.latent.tobytes(), end_of(solid)
    solid.begin_drag(grip, "Drag")
    solid.drag_to([np.nan, 0.0, 0.0])
    settle(qtbot, solid)
    solid.end_drag()
    assert solid.latent.tobytes() == before
    assert solid.undo_stack.count() == 0
    solid.begin_drag(grip, "Drag")
    solid.end_drag()
    assert solid.undo_stack.count() == 0


def test_a_twist_is_a_drag(qtbot: QtBot, solid: PoseDocument) -> None:
    before = solid.latent.tobytes()
    solid.begin_drag(Twist(1), "Twist")
    solid.drag_to([0.3])
    settle(qtbot, solid)
    solid.end_drag()
    assert solid.latent.tobytes() != before
    assert solid.undo_stack.text(0) == "Twist"


def test_a_solid_slider_lands_on_a_free_number_to_the_bit(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    start = solid.latent
    solid.set_code(2, start[2] + 0.1)
    settle(qtbot, solid)
    assert solid.latent[2] == start[2] + 0.1
    assert np.delete(solid.latent, 2).tobytes() == np.delete(start, 2).tobytes()
    assert solid.undo_stack.count() == 1
    solid.undo()
    assert solid.latent.tobytes() == start.tobytes()


def test_a_solid_number_may_lie_beyond_the_slider_as_any_other(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    beyond = solid.model.latent_space.high[3] * 1.1
    solid.set_code(3, beyond)
    settle(qtbot, solid)
    assert solid.latent[3] == beyond


def test_a_solid_edit_stops_at_contact_and_its_step_holds_what_was_reached(
    qtbot: QtBot, solid: PoseDocument, colliding: np.ndarray
) -> None:
    shown: list[bool] = []
    solid.exact_changed.connect(lambda: shown.append(solid.exact is None or solid.exact.colliding))
    before = solid.latent.tobytes()
    solid.begin_gesture("Blend")
    for share in (0.3, 1.0):
        solid.blend_towards(colliding, share)
        solid.end_gesture()
        settle(qtbot, solid)
    reached = solid.latent.tobytes()
    assert before != reached != colliding.tobytes()
    assert not any(shown)
    settle(qtbot, solid)
    solid.undo()
    solid.undo()
    assert solid.latent.tobytes() == before
    solid.redo()
    solid.redo()
    assert solid.latent.tobytes() == reached


def test_undo_of_an_edit_that_has_not_moved_yet_only_drops_it(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.set_code(0, solid.latent[0] + 0.1)
    settle(qtbot, solid)
    held = solid.latent.tobytes()
    solid.randomise(1.0, 3)
    assert solid.moving
    solid.undo()
    assert not solid.moving
    settle(qtbot, solid)
    assert solid.latent.tobytes() == held
    assert solid.undo_stack.count() == 1


def test_another_edit_during_a_drag_is_a_step_of_its_own(qtbot: QtBot, solid: PoseDocument) -> None:
    other = solid.training_pose(1)
    for is_solid, label, edit in (
        (False, "Reset all", solid.reset_all),
        (True, f"Load {other.name}", lambda: solid.load_pose(other)),
    ):
        solid.new_pose()
        solid.set_solid(is_solid)
        grip = end_of(solid)
        qtbot.waitUntil(lambda: solid.frame.latent is solid.latent)
        solid.begin_drag(grip, "Drag")
        solid.drag_to(moved(solid, grip, 0.05))
        settle(qtbot, solid)
        edit()
        assert not solid.dragging
        held = solid.latent.tobytes()
        # What the hand still does changes nothing.
        solid.drag_to(moved(solid, grip, 0.1))
        settle(qtbot, solid)
        assert solid.latent.tobytes() == held
        texts = [solid.undo_stack.text(index) for index in range(solid.undo_stack.count())]
        assert texts == ["Drag", label]


def test_an_edit_with_solid_off_ends_one_that_still_moves(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.randomise(1.0, 3)
    assert solid.moving
    solid.set_solid(False)
    solid.set_code(0, solid.latent[0] + 0.1)
    assert solid.undo_stack.undoText().startswith("Move ")
    settle(qtbot, solid)


def test_undo_of_what_has_not_moved_lets_sliders_show_the_pose_again(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.set_code(0, solid.latent[0] + 0.1)
    assert solid.moving
    with qtbot.waitSignal(solid.frame_changed):
        solid.undo()
    settle(qtbot, solid)


def test_a_worker_keeps_no_drag_of_a_model_that_is_gone(qtbot: QtBot, solid: PoseDocument) -> None:
    grip, worker = end_of(solid), solid._live._worker
    solid.begin_drag(grip, "Drag")
    solid.drag_to(moved(solid, grip, 0.05))
    settle(qtbot, solid)
    assert worker._dragger is not None
    model = solid.model
    solid.set_model(PoseModel("bare", model.embedding, model.card))
    settle(qtbot, solid)
    assert worker._dragger is None


def test_solid_steps_on_one_slider_merge(qtbot: QtBot, solid: PoseDocument) -> None:
    start = solid.latent
    for value in (0.02, 0.04, 0.06):
        solid.set_code(0, start[0] + value)
    settle(qtbot, solid)
    solid.set_code(0, start[0] + 0.08)
    settle(qtbot, solid)
    assert solid.latent[0] == start[0] + 0.08
    assert solid.undo_stack.count() == 1
    solid.undo()
    assert solid.latent.tobytes() == start.tobytes()


def test_blends_by_the_keyboard_add_up(qtbot: QtBot, solid: PoseDocument) -> None:
    start, target = solid.latent, solid.model.training_latent[1].astype(np.float64)
    for _ in range(2):
        solid.blend_towards(target, 0.1)
    settle(qtbot, solid)
    np.testing.assert_allclose(solid.latent, start + 0.19 * (target - start), atol=1e-6)


def test_a_drag_that_fails_is_told_once_and_holds_nothing_up(
    qtbot: QtBot, solid: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures: list[Failure] = []
    solid.failed.connect(failures.append)
    before = solid.latent
    with monkeypatch.context() as broken:
        broken.setattr(PoseModel, "dragger", lambda *_: 1 / 0)
        for code in (0, 1):
            solid.set_code(code, before[code] + 0.1)
            qtbot.waitUntil(lambda: not solid.moving)
    assert len(failures) == 1
    assert "ZeroDivisionError" in failures[0].headline
    assert solid.latent is before
    assert solid.undo_stack.count() == 0
    solid.set_code(0, before[0] + 0.1)
    settle(qtbot, solid)
    assert solid.latent[0] == before[0] + 0.1


def test_a_predictor_that_comes_in_mid_drag_lets_it_go_on(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    grip, model = end_of(solid), solid.model
    solid._predicts = False
    solid._live._worker._evaluator.predicts = False
    solid.begin_drag(grip, "Drag")
    solid.drag_to(moved(solid, grip, 0.05))
    settle(qtbot, solid)
    assert solid.frame is not None
    assert solid.frame.prediction is None
    solid._on_prepared(model)
    assert solid.dragging
    solid.end_drag()
    latent = solid.latent
    qtbot.waitUntil(lambda: solid.frame is not None and solid.frame.prediction is not None)
    assert solid.frame.latent is latent is solid.latent


def test_edits_that_follow_at_once_are_not_lost(qtbot: QtBot, solid: PoseDocument) -> None:
    start = solid.latent
    for code in (0, 1):
        solid.set_code(code, start[code] + 0.05)
    settle(qtbot, solid)
    np.testing.assert_array_equal(solid.latent[:2], start[:2] + 0.05)


def test_what_is_loaded_stays_as_it_is_even_where_it_collides(
    qtbot: QtBot, solid: PoseDocument, colliding: np.ndarray
) -> None:
    solid.load_pose(solid.training_pose(1))
    assert np.array_equal(solid.latent, solid.model.training_latent[1])
    solid.set_solid(False)
    solid.blend_towards(colliding, 1.0)
    solid.set_solid(True)
    settle(qtbot, solid)
    assert solid.latent.tobytes() == colliding.tobytes()
    assert solid.exact is not None
    energy = solid.exact.energy
    solid.set_code(0, solid.latent[0] * 0.9)
    settle(qtbot, solid)
    assert solid.exact.energy <= energy


def test_pins_are_of_the_pose_and_of_undo(solid: PoseDocument) -> None:
    told: list[int] = []
    solid.pins_changed.connect(lambda: told.append(len(solid.pins)))
    first, second = end_of(solid), solid.grip_at(0)
    assert not solid.modified
    solid.pin(first)
    assert solid.modified
    solid.pin_grips([first, second], "Pin both")
    assert [pin.vertex for pin in solid.pins] == [first.vertex, second.vertex]
    solid.unpin(0)
    solid.unpin_all()
    solid.unpin_all()
    assert told == [1, 2, 1, 0]
    assert solid.undo_stack.count() == 4
    for count in (1, 2, 1, 0):
        solid.undo()
        assert len(solid.pins) == count
    assert not solid.modified
    solid.redo()
    assert solid.pins[0].vertex == first.vertex


def test_a_pin_is_where_the_pose_has_its_patch_though_the_frame_is_late(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    solid.set_solid(False)
    grip = end_of(solid)
    solid.load_pose(solid.training_pose(1))
    assert solid.frame is not None
    assert solid.frame.latent is not solid.latent
    solid.pin(grip)
    settle(qtbot, solid)
    place = grip.position(solid.frame.vertices)
    np.testing.assert_allclose(solid.pins[0].position, place, atol=1e-5 * solid.model.body_size)


def test_a_pin_stays_in_a_drag_and_comes_along_in_its_own(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    end, other = end_of(solid), solid.grip_at(solid.model.n_vertices // 2)
    size = solid.model.body_size
    solid.pin(end)
    (held,) = solid.pins
    solid.begin_drag(other, "Drag")
    solid.drag_to(moved(solid, other, 0.05))
    settle(qtbot, solid)
    solid.end_drag()
    assert solid.frame is not None
    assert solid.pins == (held,)
    drift = np.linalg.norm(end.position(solid.frame.vertices) - held.position)
    assert drift < 0.02 * size
    solid.begin_pin_drag(0)
    solid.drag_to(moved(solid, end, 0.1))
    settle(qtbot, solid)
    solid.end_drag()
    (pin,) = solid.pins
    np.testing.assert_array_equal(pin.position, end.position(solid.frame.vertices))
    assert np.linalg.norm(np.subtract(pin.position, held.position)) > 0.02 * size
    solid.undo()
    assert solid.pins == (held,)


def test_a_vertex_belongs_to_the_domain_that_owns_most(document: PoseDocument) -> None:
    mask = document.model.attention_mask
    led = [document.domain_of(vertex) for vertex in range(document.model.n_vertices)]
    assert set(led) == {0, 1}
    np.testing.assert_array_equal(mask[led, range(len(led))], mask.max(axis=0))
    assert document.part_name(0) == document.model.domain_names[led[0]]


def test_the_radius_of_grips_has_limits(document: PoseDocument) -> None:
    grip = document.grip_at(3)
    assert document.grip_at(3) is grip
    document.set_grip_radius(100.0)
    assert document.grip_radius == LARGEST_RADIUS
    assert len(document.grip_at(3).vertices) > len(grip.vertices)
    document.set_grip_radius(0.0)
    assert document.grip_radius == LEAST_RADIUS
    last, model = document.grip_at(3), document.model
    document.set_model(PoseModel("bare", model.embedding, model.card))
    assert document.grip_at(3) is not last


@pytest.fixture
def seen(solid: PoseDocument) -> Iterator[list[tuple[bool, bool]]]:
    """Yield of each shown frame whether it collides, by a check of its own, and has contacts."""
    shown: list[tuple[bool, bool]] = []

    def look() -> None:
        assert solid.frame is not None
        found = solid.model.detector.detect(solid.frame.vertices)
        shown.append((found.colliding, len(solid.frame.contacts) > 0))

    solid.frame_changed.connect(look)
    yield shown
    solid.frame_changed.disconnect(look)


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
        if solid.pins and chance.random() < 0.3:
            vertex = solid.pins[0].vertex
            solid.begin_pin_drag(0)
        else:
            solid.begin_drag(solid.grip_at(vertex), "Drag")
        locked, before = model.embedding.codes_of(solid.locked_domains), solid.latent
        for _ in range(chance.randrange(1, 6)):
            assert solid.frame is not None
            step = np.array([chance.gauss(0.0, 0.3) for _ in range(3)]) * model.body_size
            solid.drag_to(solid.frame.vertices[vertex] + step)
            qtbot.wait(chance.choice((0, 5, 20)))
            assert (solid.latent[locked] == before[locked]).all()
        chance.choice((solid.end_drag, solid.end_drag, solid.cancel_drag))()

    def slide() -> None:
        code = chance.randrange(model.latent_size)
        low, high = model.latent_space.low[code], model.latent_space.high[code]
        solid.set_code(code, chance.uniform(low, high))

    def wander() -> None:
        solid.randomise(chance.random(), chance.randrange(1000))

    def meet() -> None:
        solid.blend_towards(colliding, 1.0)

    def lock() -> None:
        solid.set_locked(chance.randrange(len(model.domain_names)), chance.random() < 0.4)

    def pin() -> None:
        if len(solid.pins) > 2:
            solid.unpin_all()
        else:
            solid.pin(solid.grip_at(chance.randrange(model.n_vertices)))

    acts = [drag, drag, slide, slide, wander, meet, meet, lock, pin, solid.undo, solid.redo]
    for _ in range(150):
        chance.choice(acts)()
        if chance.random() < 0.5:
            settle(qtbot, solid)
    settle(qtbot, solid)
    states = [solid.latent.tobytes()]
    while solid.undo_stack.canUndo():
        solid.undo()
        states.append(solid.latent.tobytes())
    for state in reversed(states[:-1]):
        solid.redo()
        assert solid.latent.tobytes() == state
    settle(qtbot, solid)
    collide, touch = zip(*seen, strict=True)
    assert len(seen) > 100
    assert not any(collide)
    assert any(touch)


def test_reset_all_is_one_step_that_takes_the_pins_and_says_what_stays(
    qtbot: QtBot, solid: PoseDocument
) -> None:
    other = next(k for k in range(9) if solid.training_pose(k).latent.any())
    solid.load_pose(solid.training_pose(other))
    solid.pin(end_of(solid))
    solid.set_locked(0, True)
    settle(qtbot, solid)
    before, pins, steps = solid.latent, solid.pins, solid.undo_stack.count()
    assert pins
    with qtbot.waitSignal(solid.message) as told:
        solid.reset_all()
    assert told.args == ["Everything was reset except 1 locked body part: see Edit > Unlock all"]
    locked = solid.model.space.codes_of([0])
    # Also with Solid on, there is no way on which something could stop it.
    assert not solid.moving
    assert not solid.latent[~locked].any()
    assert (solid.latent[locked] == before[locked]).all()
    assert solid.pins == ()
    assert solid.undo_stack.count() == steps + 1
    solid.undo()
    assert solid.latent.tobytes() == before.tobytes()
    assert solid.pins == pins
    solid.set_locked(0, False)
    with qtbot.assertNotEmitted(solid.message):
        solid.reset_all()
    assert not solid.latent.any()
    settle(qtbot, solid)
