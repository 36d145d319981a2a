"""The depth of a drag: around the body, by the wheel, and along an axis."""

from __future__ import annotations

import numpy as np
import pytest

from app.view.camera import DragTarget, View, along_axis, places_of

SIZE = (400.0, 400.0)
# From the front: x to the right, z up.
VIEW = View(np.array([0.0, -10.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


@pytest.fixture
def drag_target() -> DragTarget:
    """Return the depth of a flat hand left of a box, 0.1 thick and half as deep as the box."""
    hand = 0.05 * CORNERS + [-1.5, 0.0, 0.0]
    vertices, faces = np.concatenate([0.5 * CORNERS, hand]), np.concatenate([FACES, FACES + 8])
    moving = np.arange(16) >= 8
    return DragTarget(VIEW, SIZE, np.array([-1.5, -0.05, 0.0]), vertices, faces, moving, 1.0)


def place(*point: float) -> tuple[float, float]:
    x, y = places_of(VIEW, np.array([point]), SIZE)[0]
    return float(x), float(y)


def test_what_is_dragged_goes_before_the_body_and_stays_in_its_plane_beside_it(
    drag_target: DragTarget,
) -> None:
    beside, before = (
        drag_target.target(place(-1.0, -0.05, 0.1)),
        drag_target.target(place(0.1, -0.5, 0.1)),
    )
    np.testing.assert_allclose(beside, [-1.0, -0.05, 0.1], atol=1e-9)
    # In front of the surface by the hand's thickness, and a little more.
    assert 0.1 <= -0.5 - before[1] < 0.12
    np.testing.assert_allclose(places_of(VIEW, before[None], SIZE)[0], place(0.1, -0.5, 0.1))


def test_it_begins_to_give_way_before_the_rim() -> None:
    """A hand is wide: it would collide with the side."""
    vertices = 0.5 * CORNERS
    nobody = np.zeros(8, dtype=np.bool_)
    drag_target = DragTarget(VIEW, SIZE, np.array([-1.5, 0.45, 0.0]), vertices, FACES, nobody, 1.0)
    ways = [drag_target.target(place(x, -0.5, 0.5))[1] for x in (-0.6, -0.53, -0.5, -0.4)]
    assert ways[0] == pytest.approx(0.45)
    assert ways[1] < -0.5


def test_the_wheel_takes_over(drag_target: DragTarget) -> None:
    over = place(0.1, -0.5, 0.1)
    before = drag_target.target(over)
    drag_target.shift(over, 0.3)
    assert drag_target.target(over)[1] == pytest.approx(before[1] + 0.3)
    # Nothing else changes the depth, on the body or beside it.
    assert drag_target.target(place(-0.8, 0.0, 0.0))[1] == pytest.approx(before[1] + 0.3)


def test_a_point_along_an_axis_is_the_one_nearest_to_the_pointer() -> None:
    origin = np.array([0.2, 0.3, -0.1])
    for axis in np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.6, -0.8, 0.0]]):
        seen = place(*(origin + 0.7 * axis))
        assert along_axis(VIEW, seen, SIZE, origin, axis) == pytest.approx(0.7)
