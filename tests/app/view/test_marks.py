"""What stands over the body: the patch that would be taken, pins, contacts."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from pytestqt.qtbot import QtBot

from app.view.camera import places_of
from app.view.shading import Shading
from app.view.viewport import Viewport
from lcollision_core.posing import make_grip
from tests.app.views import SIDE, changed, seen_vertex, steady_pixels

SIZE = (float(SIDE), float(SIDE))


def _places(viewport: Viewport, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    assert viewport.scene is not None
    canvas = viewport.canvas
    assert canvas is not None
    return places_of(viewport.scene.view, points, (canvas.width(), canvas.height()))


@pytest.mark.parametrize("shading", [Shading.PLAIN, Shading.DOMAINS])
def test_the_patch_is_painted_where_it_is_and_nowhere_else(
    qtbot: QtBot, viewport: Viewport, shading: Shading
) -> None:
    scene, canvas = viewport.scene, viewport.canvas
    assert scene is not None
    assert canvas is not None
    viewport.set_shading(shading)
    before = steady_pixels(qtbot, viewport)
    vertex = seen_vertex(viewport, 1)
    grip = make_grip(viewport._document.model.pose_space, vertex, 0.08)
    assert scene.show_grip(grip)
    assert not scene.show_grip(grip)
    canvas.redraw()
    painted = changed(before, steady_pixels(qtbot, viewport))
    column, row = _places(viewport, scene.surface.vertices[[vertex]])[0].astype(int)
    assert painted[row - 2 : row + 3, column - 2 : column + 3].all()
    # All of it within the patch, with the width of the rim.
    rows, columns = np.nonzero(painted)
    inside = _places(viewport, scene.surface.vertices[grip.vertices])
    for drawn, seen in ((columns, inside[:, 0]), (rows, inside[:, 1])):
        spread = np.ptp(seen)
        assert seen.min() - 0.5 * spread - 6 < drawn.min()
        assert drawn.max() < seen.max() + 0.5 * spread + 6
    assert scene.show_grip(None)
    canvas.redraw()
    assert not changed(before, steady_pixels(qtbot, viewport)).any()


def test_pins_and_contacts_have_one_size_near_and_far_and_are_drawn_through_the_body(
    qtbot: QtBot, viewport: Viewport
) -> None:
    scene, canvas = viewport.scene, viewport.canvas
    assert scene is not None
    assert canvas is not None
    # Inside the body, where only what is drawn through it is seen.
    middle = scene.surface.vertices.mean(axis=0, dtype=np.float64)
    sizes = []
    for zoom in (1.0, 0.6):
        view = scene.view
        scene.view = type(view)(
            view.focus + zoom * (view.position - view.focus), view.focus, view.up
        )
        for pins, contacts in (([middle], []), ([], [middle])):
            scene.marks.show_pins(np.zeros((0, 3)), [])
            scene.marks.show_contacts(np.zeros((0, 3)))
            canvas.redraw()
            before = steady_pixels(qtbot, viewport)
            scene.marks.show_pins(np.reshape(pins, (-1, 3)), ["#00ff00"] * len(pins))
            scene.marks.show_contacts(np.reshape(contacts, (-1, 3)))
            canvas.redraw()
            drawn = changed(before, steady_pixels(qtbot, viewport))
            rows, columns = np.nonzero(drawn)
            centre = _places(viewport, middle[None])[0]
            np.testing.assert_allclose([columns.mean(), rows.mean()], centre, atol=1.5)
            sizes.append(np.ptp(columns))
    assert sizes[:2] == pytest.approx(sizes[2:], abs=1)
    assert sizes[0] == pytest.approx(14, abs=2)


def test_a_pin_is_found_by_its_dot(viewport: Viewport) -> None:
    scene = viewport.scene
    assert scene is not None
    points = scene.surface.vertices[[0, -1]].astype(np.float64)
    places = places_of(scene.view, points, SIZE)
    assert np.linalg.norm(places[0] - places[1]) > 40
    assert scene.marks.pin_at((0.0, 0.0), scene.view, SIZE) is None
    scene.marks.show_pins(points, ["#ff0000", "#00ff00"])
    for index, place in enumerate(places):
        x, y = place.tolist()
        assert scene.marks.pin_at((x + 5, y), scene.view, SIZE) == index
        assert scene.marks.pin_at((x + 12, y), scene.view, SIZE) is None
