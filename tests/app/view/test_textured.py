"""The body with its textures: pixels rendered off-screen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from app.view.camera import View
from app.view.offscreen import PoseRenderer
from app.view.shading import LIGHT
from lcollision_core.bodies import RigBody, open_body
from lcollision_core.meshes.normals import vertex_normals
from lcollision_core.posing import make_grip
from tests.core.gltf_builder import GltfBuilder
from tests.core.textured_cube import (
    BLUE,
    GREEN,
    RED,
    YELLOW,
    add_texture,
    coloured,
    cube,
    png,
    textured_cube,
)

SIDE = 200
FOUR = np.array([[RED, GREEN], [BLUE, YELLOW]], dtype=np.uint8)
SHARP = {"magFilter": 9728}

Draw = Callable[..., "Drawn"]


class Drawn:
    """A picture of the cube's front."""

    def __init__(self, model: RigBody) -> None:
        self.model = model
        self.renderer = PoseRenderer(model, SIDE, SIDE, LIGHT)
        self.scene = self.renderer.scene
        self.scene.show_floor(False)
        self.scene.set_plain_background("#ff00ff")
        self.pose(np.zeros(model.latent_size))
        self.scene.show_textured(True)

    def pose(self, latent: npt.NDArray[np.float64]) -> None:
        vertices = self.model.decode(latent).astype(np.float32)
        self.scene.show(vertices, vertex_normals(vertices, self.model.faces))
        self.scene.view = View(np.array([0.0, 0.0, 12.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))

    def at(self, x: float, y: float, z: float = 1.0) -> list[int]:
        """Return the colour at a point of the scene."""
        drawn = np.asarray(self.renderer.drawn())
        place = self._place(x, y, z)
        return drawn[place[1], place[0], :3].astype(int).tolist()

    def _place(self, x: float, y: float, z: float) -> tuple[int, int]:
        renderer = self.renderer._plotter.renderer
        renderer.SetWorldPoint(x, y, z, 1.0)
        renderer.WorldToDisplay()
        column, row, _ = renderer.GetDisplayPoint()
        return int(column), SIDE - 1 - int(row)


BEHIND = [255, 0, 255]


@pytest.fixture
def draw(tmp_path: Path) -> Iterator[Draw]:
    held: list[Drawn] = []

    def drawn(material: dict[str, Any], builder: GltfBuilder | None = None, **more: int) -> Drawn:
        file = textured_cube(material, builder, **more).write(tmp_path / "cube.glb")
        model = open_body(file)
        assert isinstance(model, RigBody)
        held.append(Drawn(model))
        return held[-1]

    yield drawn
    for one in held:
        one.renderer.close()


def laid(
    sampler: dict[str, int] | None = None, image: npt.NDArray[np.uint8] = FOUR, **transform: Any
) -> tuple[dict[str, Any], GltfBuilder]:
    """Return a material of an image, moved by `transform`, and the builder that contains it."""
    builder = GltfBuilder()
    index = add_texture(builder, png(image), SHARP | (sampler or {}))
    moved = {"KHR_texture_transform": transform} if transform else {}
    return coloured(baseColorTexture={"index": index, "extensions": moved}), builder


def test_each_quarter_of_a_face_has_its_colour_although_its_corners_are_joined(
    draw: Draw,
) -> None:
    front = draw(*laid())
    assert front.model.n_vertices == 8
    assert front.at(-0.5, 0.5) == list(RED)
    assert front.at(0.5, 0.5) == list(GREEN)
    assert front.at(-0.5, -0.5) == list(BLUE)
    assert front.at(0.5, -0.5) == list(YELLOW)
    assert front.at(-1.5, 0.0) == BEHIND


def test_a_pose_takes_its_texture_along(draw: Draw) -> None:
    front = draw(*laid())
    latent = np.zeros(front.model.latent_size)
    moves = [front.model.decode(row).mean(axis=0) for row in np.eye(len(latent))[:3]]
    along_x = int(np.argmax([abs(move[0]) for move in moves]))
    latent[along_x] = 0.5 * np.sign(moves[along_x][0])
    front.pose(latent)
    assert front.at(0.5, 0.5) == list(RED)
    assert front.at(1.5, -0.5) == list(YELLOW)
    assert front.at(-0.5, 0.5) == BEHIND


@pytest.mark.variants(3)
@pytest.mark.parametrize(
    ("wrap", "expected"),
    [
        # From left to right: twice the width of the image, and beyond it.
        ((10497, 10497), [RED, GREEN, RED, GREEN]),
        ((33648, 10497), [RED, GREEN, GREEN, RED]),
        ((33071, 10497), [RED, GREEN, GREEN, GREEN]),
    ],
    ids=["repeat", "mirror", "clamp"],
)
@pytest.mark.parametrize("across", [False, True])
def test_an_image_goes_on_as_its_sampler_says_in_each_direction(
    draw: Draw, wrap: tuple[int, int], expected: list[tuple[int, int, int]], across: bool
) -> None:
    image = FOUR[:1] if not across else FOUR[:1].transpose(1, 0, 2)
    wraps = wrap if not across else wrap[::-1]
    sampler = {"wrapS": wraps[0], "wrapT": wraps[1]}
    front = draw(*laid(sampler, image, scale=[1.0, 2.0] if across else [2.0, 1.0]))
    places = [-0.75, -0.25, 0.25, 0.75]
    found = [front.at(0.0, -at) if across else front.at(at, 0.0) for at in places]
    assert found == [list(colour) for colour in expected]


def test_a_smooth_image_blends_where_a_sharp_one_does_not(draw: Draw) -> None:
    sharp, smooth = draw(*laid()), draw(*laid({"magFilter": 9729}))
    assert sharp.at(-0.05, 0.5) == list(RED)
    middle = np.mean([RED, GREEN], axis=0)
    assert np.abs(np.array(smooth.at(-0.03, 0.5)) - middle).max() < 25


@pytest.mark.parametrize(("filtering", "fine"), [(9728, True), (9986, False)])
def test_a_fine_image_is_averaged_only_where_its_sampler_has_it_so(
    draw: Draw, filtering: int, fine: bool
) -> None:
    # Stripes of one pixel, far narrower than the screen's pixels.
    image = np.tile(FOUR[:1], (1, 512, 1))
    front = draw(*laid({"minFilter": filtering, "magFilter": 9729}, image))
    reds = [front.at(x, 0.0)[0] for x in np.linspace(-0.8, 0.8, 15)]
    assert bool(np.ptp(reds) > 30) is fine


def test_a_cut_out_shows_what_is_behind_and_nothing_of_its_opacity(draw: Draw) -> None:
    image = np.full((2, 2, 4), 255, dtype=np.uint8)
    image[..., :3], image[..., 3] = FOUR, [[255, 120], [140, 0]]
    material, builder = laid(None, image)
    front = draw(material | {"alphaMode": "MASK", "doubleSided": False}, builder)
    assert front.at(-0.5, 0.5) == list(RED)
    assert front.at(0.5, 0.5) == BEHIND
    assert front.at(-0.5, -0.5) == list(BLUE)
    assert front.at(0.5, -0.5) == BEHIND


def test_what_is_opaque_does_not_look_at_opacity(draw: Draw) -> None:
    image = np.zeros((2, 2, 4), dtype=np.uint8)
    image[..., :3] = FOUR
    front = draw(*laid(None, image))
    assert front.at(0.5, -0.5) == list(YELLOW)


def test_what_blends_is_mixed_with_what_is_behind(draw: Draw) -> None:
    image = np.full((2, 2, 4), 128, dtype=np.uint8)
    image[..., :3] = FOUR
    image[0, 0, 3] = 0
    material, builder = laid(None, image)
    front = draw(material | {"alphaMode": "BLEND"}, builder)
    assert front.at(-0.5, 0.5) == BEHIND
    mixed = 0.5 * (np.array(GREEN) + BEHIND)
    assert np.abs(np.array(front.at(0.5, 0.5)) - mixed).max() < 3


@pytest.mark.parametrize("double", [False, True])
def test_the_inside_is_seen_of_what_has_two_sides(draw: Draw, double: bool) -> None:
    image = np.full((1, 1, 4), 255, dtype=np.uint8)
    image[..., :3] = BLUE
    builder = GltfBuilder()
    # All faces except the front are drawn: the view is inside.
    material = coloured(baseColorFactor=[0.0, 0.0, 1.0, 1.0]) | {"doubleSided": double}
    alpha = np.ones((24, 4))
    alpha[:4, 3] = 0.0
    colours = builder.array(alpha)
    material |= {"alphaMode": "MASK"}
    front = draw(material, builder, COLOR_0=colours)
    assert front.at(0.0, 0.0) == ([0, 0, 255] if double else BEHIND)


def test_colours_of_vertices_are_those_of_the_screen(draw: Draw) -> None:
    builder = GltfBuilder()
    colours = builder.array(np.repeat([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]] * 3, 4, axis=0))
    front = draw(coloured(), builder, COLOR_0=colours)
    # Half the light is 188 of 255 in sRGB.
    assert front.at(0.0, 0.0) == [188, 0, 0]


def test_light_falls_on_what_is_not_unlit(draw: Draw) -> None:
    material, builder = laid()
    del material["extensions"]
    front = draw(material, builder)
    red, green, blue = front.at(-0.5, 0.5)
    assert red > 100 > max(green, blue)
    assert (red, green, blue) != RED


def test_without_its_look_the_body_has_its_colours_again(draw: Draw) -> None:
    front = draw(*laid())
    front.scene.paint(np.full((8, 3), 200, dtype=np.uint8))
    assert front.scene.is_textured
    front.scene.show_textured(False)
    assert not front.scene.is_textured
    assert np.ptp(front.at(0.5, 0.5)) < 20
    front.scene.show_textured(True)
    assert front.at(0.5, 0.5) == list(GREEN)


def test_a_copy_of_the_scene_looks_like_it(draw: Draw) -> None:
    front = draw(*laid())
    copy = PoseRenderer(front.model, SIDE, SIDE, LIGHT)
    try:
        copy.scene.copy_from(front.scene)
        shown = np.asarray(copy.drawn())[SIDE // 2 - 30, SIDE // 2 - 30]
    finally:
        copy.close()
    assert shown[:3].tolist() == list(RED)


def test_a_patch_and_colliding_faces_are_seen_on_the_texture(draw: Draw) -> None:
    front = draw(*laid())
    vertices, _, _ = cube()
    corner = int(np.linalg.norm(front.model.reference - [1.0, 1.0, 1.0], axis=1).argmin())
    assert len(vertices) == 24
    before = front.at(0.9, 0.9)
    front.scene.patch.show(make_grip(front.model.space, corner, 0.2))
    front.scene.fit_to_screen(1.0)
    assert front.at(0.9, 0.9) != before
    assert front.at(-0.5, -0.5) == list(BLUE)
    front.scene.patch.show(None)
    assert front.at(0.9, 0.9) == before
    front.scene.crossing.show(np.array([[0, 1]], dtype=np.int32))
    red, green, blue = front.at(0.5, 0.5)
    assert red > 150 > max(green, blue)
