"""Marks over the body: the patch under the pointer, pins, contacts."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from pytestqt.qtbot import QtBot

from app.view.actors import PIN_RADIUS
from app.view.camera import View, places_of, preset_view
from app.view.offscreen import PoseRenderer
from app.view.shading import LIGHT, Shading
from app.view.viewport import Viewport
from lcollision_core.bodies import LearnedBody
from lcollision_core.posing import make_grip
from tests.app.views import SIDE, changed, seen_vertex, steady_pixels

SIZE = (float(SIDE), float(SIDE))


def _places(viewport: Viewport, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    assert viewport.scene is not None
    canvas = viewport.canvas
    assert canvas is not None
    return places_of(viewport.scene.view, points, (canvas.width(), canvas.height()))


@pytest.mark.variants
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
    grip = make_grip(viewport._document.model.space, vertex, 0.08)
    assert scene.patch.show(grip)
    assert not scene.patch.show(grip)
    canvas.redraw()
    painted = changed(before, steady_pixels(qtbot, viewport))
    column, row = _places(viewport, scene.surface.vertices[[vertex]])[0].astype(int)
    assert painted[row - 2 : row + 3, column - 2 : column + 3].all()
    # The mark is within the patch, extended by the width of the rim.
    rows, columns = np.nonzero(painted)
    inside = _places(viewport, scene.surface.vertices[grip.vertices])
    for drawn, seen in ((columns, inside[:, 0]), (rows, inside[:, 1])):
        spread = np.ptp(seen)
        assert seen.min() - 0.5 * spread - 6 < drawn.min()
        assert drawn.max() < seen.max() + 0.5 * spread + 6
    assert scene.patch.show(None)
    canvas.redraw()
    assert not changed(before, steady_pixels(qtbot, viewport)).any()


def test_pins_and_contacts_have_one_size_near_and_far_and_are_drawn_through_the_body(
    editor_model: LearnedBody,
) -> None:
    renderer = PoseRenderer(editor_model, SIDE, SIDE, LIGHT)
    scene, vertices = renderer.scene, editor_model.reference
    scene.show(vertices, np.zeros_like(vertices))
    # Inside the body, where only marks drawn through it are visible.
    middle = vertices.mean(axis=0, dtype=np.float64)[None]
    nothing = np.zeros((0, 3))
    front = preset_view("Front", vertices, editor_model.up, editor_model.front, 1.0)
    drawn_sizes = []
    for zoom in (1.0, 0.6):
        arm = front.position - front.focus
        scene.view = View(front.focus + zoom * arm, front.focus, front.up)
        for pins, contacts in ((middle, nothing), (nothing, middle)):
            pictures = []
            for shown in ((nothing, nothing), (pins, contacts)):
                scene.marks.show_pins(shown[0], ["#00ff00"] * len(shown[0]))
                scene.marks.show_contacts(shown[1])
                scene.fit_to_screen(1.0)
                pictures.append(np.asarray(renderer.drawn(), dtype=np.int64))
            rows, columns = np.nonzero(changed(*pictures))
            (centre,) = places_of(scene.view, middle, SIZE)
            found = 0.5 * (columns.min() + columns.max()), 0.5 * (rows.min() + rows.max())
            np.testing.assert_allclose(found, centre, atol=1.5)
            drawn_sizes.append(np.ptp(columns))
    renderer.close()
    assert drawn_sizes[:2] == pytest.approx(drawn_sizes[2:], abs=1)
    assert drawn_sizes[0] == pytest.approx(2 * PIN_RADIUS, abs=2)


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
