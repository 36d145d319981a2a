"""The camera as a map from the scene to the picture and back, and its control by the mouse."""

from __future__ import annotations

import numpy as np
import pytest

from app.view.camera import (
    VIEW_ANGLE,
    View,
    followed,
    framing,
    places_of,
    shifted,
    turn_about,
    turned,
    unproject,
)

SIZE = (640.0, 480.0)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def view() -> View:
    """Return a camera that looks at a point off the origin, from above and from the side."""
    focus = np.array([0.3, -0.2, 1.1])
    return View(focus + np.array([1.5, -3.0, 0.8]), focus, UP)


def test_the_focus_is_in_the_middle_and_the_rim_where_the_angle_of_view_ends(view: View) -> None:
    np.testing.assert_allclose(places_of(view, view.focus[None], SIZE), [[320.0, 240.0]])
    arm = view.position - view.focus
    sight = -arm / np.linalg.norm(arm)
    upward = UP - (UP @ sight) * sight
    upward /= np.linalg.norm(upward)
    edge = view.focus + np.tan(np.radians(VIEW_ANGLE / 2)) * np.linalg.norm(arm) * upward
    np.testing.assert_allclose(places_of(view, edge[None], SIZE), [[320.0, 0.0]], atol=1e-9)


def test_a_point_that_is_dragged_in_the_plane_of_the_picture_is_seen_at_the_pointer(
    view: View,
) -> None:
    generator = np.random.default_rng(3)
    sight = (view.focus - view.position) / np.linalg.norm(view.focus - view.position)
    for point in view.focus + generator.normal(0.0, 0.4, (20, 3)):
        place = tuple(generator.uniform(0.0, 480.0, 2).tolist())
        there = unproject(view, place, SIZE, point)
        np.testing.assert_allclose(places_of(view, there[None], SIZE)[0], place, atol=1e-9)
        assert (there - point) @ sight == pytest.approx(0.0, abs=1e-12)
        own = tuple(places_of(view, point[None], SIZE)[0].tolist())
        np.testing.assert_allclose(unproject(view, own, SIZE, point), point, atol=1e-12)


def test_turning_keeps_the_distance_and_stays_upright_without_going_over_the_top(
    view: View,
) -> None:
    length = np.linalg.norm(view.position - view.focus)
    for across, upwards in ((30.0, 0.0), (0.0, 20.0), (-200.0, 500.0), (3.0, -500.0)):
        after = turned(view, across, upwards)
        arm = after.position - after.focus
        assert np.linalg.norm(arm) == pytest.approx(length)
        np.testing.assert_array_equal(after.up, UP)
        assert abs(arm @ UP) < np.sin(np.radians(89.01)) * length
    back = turned(turned(view, 25.0, 10.0), -25.0, -10.0)
    np.testing.assert_allclose(back.position, view.position, atol=1e-9)


def test_what_is_before_the_focus_follows_the_mouse(view: View) -> None:
    """It moves right and down with the mouse."""
    near = view.focus + 0.1 * (view.position - view.focus)
    before = places_of(view, near[None], SIZE)[0]
    for motion, way in (((5.0, 0.0), (1.0, 0.0)), ((0.0, 5.0), (0.0, 1.0))):
        after = places_of(turned(view, *motion), near[None], SIZE)[0]
        moved = (after - before) / np.linalg.norm(after - before)
        np.testing.assert_allclose(moved, way, atol=0.05)
    at_rest = shifted(view, (100.0, 100.0), (130.0, 80.0), SIZE)
    shift = places_of(at_rest, view.focus[None], SIZE)[0] - (320.0, 240.0)
    np.testing.assert_allclose(shift, [30.0, -20.0], atol=1e-9)


@pytest.mark.parametrize("axis", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, 0, 0.8]])
def test_what_is_before_an_axis_moves_with_the_mouse_that_twists_it(
    view: View, axis: list[float]
) -> None:
    axis = np.array(axis, dtype=np.float64)
    # A point at the near side of a limb along the axis.
    arm = view.position - view.focus
    near = 0.05 * (arm - (arm @ axis) * axis) / np.linalg.norm(arm)
    turned_by = near * np.cos(0.05) + np.cross(axis, near) * np.sin(0.05)
    before, after = places_of(view, view.focus + np.stack([near, turned_by]), SIZE)
    moved = (after - before) / np.linalg.norm(after - before)
    assert moved @ turn_about(axis, view) > 0.98


def test_an_axis_that_is_seen_from_its_end_twists_by_the_horizontal_motion(view: View) -> None:
    sight = (view.focus - view.position) / np.linalg.norm(view.focus - view.position)
    np.testing.assert_array_equal(turn_about(sight, view), [1.0, 0.0])
    np.testing.assert_array_equal(turn_about(-sight, view), [-1.0, 0.0])


def test_a_camera_that_follows_stays_level_unless_the_body_leaves_the_picture() -> None:
    box = np.array(np.meshgrid((-0.3, 0.3), (0.0, 1.8), (-0.2, 0.2))).reshape(3, -1).T
    view = framing(box, np.array([0.0, 0.2, 1.0]), np.eye(3)[1], 1.2)
    step = followed(view, box, box + [2.0, 0.1, -1.0], 1, 1.2)
    np.testing.assert_allclose(step.position - view.position, [2.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(step.focus - view.focus, [2.0, 0.0, -1.0], atol=1e-12)
    storey = followed(view, box, box + [2.0, 3.0, 0.0], 1, 1.2)
    np.testing.assert_allclose(storey.position - view.position, [2.0, 3.0, 0.0], atol=1e-12)
    # A view of a hand is not changed to the whole body.
    near = View(view.position - 0.8 * (view.position - view.focus), view.focus, view.up)
    close = followed(near, box, box + [2.0, 3.0, 0.0], 1, 1.2)
    np.testing.assert_allclose(close.position - near.position, [2.0, 0.0, 0.0], atol=1e-12)
