"""The floor: beneath the body, or fixed at a height."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.view.camera import View
from app.view.offscreen import PoseRenderer
from app.view.shading import LIGHT
from lcollision_core.bodies import RigBody
from lcollision_core.meshes.normals import vertex_normals
from tests.rigged_shapes import rigged_tube


@pytest.fixture
def renderer() -> PoseRenderer:
    return PoseRenderer(RigBody.of(rigged_tube()), 40, 40, LIGHT)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "upside down"])
def test_the_ground_does_not_move_with_the_body(sign: float) -> None:
    character = rigged_tube()
    model = RigBody.of(replace(character, up=sign * character.up))
    scene = PoseRenderer(model, 40, 40, LIGHT).scene
    up, rest = np.array(model.up), model.reference.astype(np.float32)
    lowest = float((rest @ up).min())

    def level_below(raised: float) -> float:
        vertices = rest + raised * up.astype(np.float32)
        scene.show(vertices, vertex_normals(vertices, model.faces))
        return float(np.array(scene._floor.position) @ up) + scene._lift - lowest

    assert [level_below(raised) for raised in (0.0, 0.2, -0.2)] == pytest.approx(
        [0.0, 0.2, -0.2], abs=1e-6
    )
    scene.set_ground(lowest)
    assert [level_below(raised) for raised in (0.0, 0.2, -0.2)] == pytest.approx(
        [0.0] * 3, abs=1e-6
    )
    # A motion may stand lower than the rest pose, and jump.
    scene.set_ground(None, sinks=True)
    assert [level_below(raised) for raised in (-0.1, 0.2, -0.2)] == pytest.approx(
        [-0.1, -0.1, -0.2], abs=1e-6
    )


def test_neither_floor_nor_shadow_is_seen_from_below(renderer: PoseRenderer) -> None:
    scene, model = renderer.scene, RigBody.of(rigged_tube())
    vertices = model.reference.astype(np.float32)
    pictures = []
    # Without the body, which hides the floor beneath it.
    scene.show(vertices, vertex_normals(vertices, model.faces))
    scene.body.SetVisibility(False)
    for side in (1.0, -1.0):
        direction = np.full(3, 0.3)
        direction[model.up_axis] = side
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)).astype(np.float64)
        up = np.eye(3)[(model.up_axis + 1) % 3]
        scene.view = View(middle + 3.0 * model.body_size * direction, middle, up)
        scene.fit_to_screen(1.0)
        shown = renderer.pixels()
        scene.show_floor(False)
        pictures.append((shown, renderer.pixels()))
        scene.show_floor(True)
    (above, bare_above), (below, bare_below) = pictures
    assert (above != bare_above).any()
    np.testing.assert_array_equal(below, bare_below)
