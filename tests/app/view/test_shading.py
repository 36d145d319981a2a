"""Colours: their meaning, equal steps that look equal, and colour-blind safety."""

from __future__ import annotations

import numpy as np
import pytest

from app.editing.settings import SETTINGS
from app.view.shading import (
    COLLIDING_FACE,
    FULL_EXACT,
    FULL_PREDICTED,
    Known,
    Shader,
    Shading,
    mask_colours,
    ramp,
    rgb,
)
from app.view.theme import DARK, LIGHT
from lcollision_core.bodies.names import cielab

COLOURS = ("#0077bb", "#e69f00")
MASK = np.array([[1.0, 0.75, 0.5, 0.0], [0.0, 0.25, 0.5, 1.0]], dtype=np.float32)
FULL_SIGHT = np.eye(3)
RED_BLIND = np.array(
    [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ]
)
GREEN_BLIND = np.array(
    [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ]
)
BLUE_BLIND = np.array(
    [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ]
)
"""Machado, Oliveira and Fernandes 2009, severity 1."""


@pytest.fixture(params=[LIGHT, DARK], ids=["light", "dark"])
def shader(request: pytest.FixtureRequest) -> Shader:
    return Shader(MASK, COLOURS, request.param.skin)


def ramps(shader: Shader) -> list[list[str]]:
    known = Known(np.zeros(2), np.full(4, 1e-6), np.full(4, 1e-3))
    scales = (Shading.PREDICTED, Shading.EXACT, Shading.MOVEMENT)
    return [list(shader.legend(shading, known).ramp) for shading in scales]


def test_a_domain_owns_white_to_its_full_colour() -> None:
    colours = mask_colours(np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]]), ("#000000", "#e69f00"))
    assert colours.dtype == np.uint8
    assert colours.tolist() == [[0, 0, 0], [0xE6, 0x9F, 0], [128, 128, 128]]


def test_plain_is_one_colour(shader: Shader) -> None:
    assert (shader.colours(Shading.PLAIN, Known()) == rgb(shader.skin)).all()


def test_an_unknown_energy_is_plain_and_says_so(shader: Shader) -> None:
    for shading in (Shading.PREDICTED, Shading.EXACT, Shading.MOVEMENT):
        assert (shader.colours(shading, Known()) == rgb(shader.skin)).all()
        legend = shader.legend(shading, Known())
        assert legend.title
        assert legend.note
        # The scale is shown before its numbers, so that the legend does not grow.
        assert legend.ramp
    assert "no predictor" in shader.legend(Shading.PREDICTED, Known(), has_predictor=False).note


def test_predicted_energy_is_spread_by_the_masks(shader: Shader) -> None:
    ramp_colours = np.array([rgb(colour) for colour in ramps(shader)[0]])
    energy = np.array([0.64 * FULL_PREDICTED**2, 0.0])
    colours = shader.colours(Shading.PREDICTED, Known(energy))
    place = np.sqrt(0.64 * MASK[0]) * 255
    assert (colours == ramp_colours[place.astype(int)]).all()
    assert (colours[3] == rgb(shader.skin)).all()


def test_exact_energy_is_each_vertex_own_and_stops_at_full(shader: Shader) -> None:
    ramp_colours = np.array([rgb(colour) for colour in ramps(shader)[1]])
    energy = FULL_EXACT**2 * np.array([0.0, 0.25, 1.0, 100.0])
    colours = shader.colours(Shading.EXACT, Known(None, energy))
    assert (colours[[0, 2, 3]] == ramp_colours[[0, 255, 255]]).all()
    assert (colours[1] == ramp_colours[127]).all()


def test_movement_is_drawn_up_to_the_largest_which_the_legend_names(shader: Shader) -> None:
    moved = np.array([0.0, 0.001, 0.004, 0.002])
    scale = np.array([rgb(colour) for colour in ramps(shader)[2]])
    colours = shader.colours(Shading.MOVEMENT, Known(movement=moved))
    assert (colours == scale[[0, 63, 255, 127]]).all()
    legend = shader.legend(Shading.MOVEMENT, Known(movement=moved))
    assert legend.note == "in % of the body size"
    assert legend.ticks == ((0.0, "0"), (0.5, "0.2"), (1.0, "0.4"))
    still = np.zeros(4)
    assert (shader.colours(Shading.MOVEMENT, Known(movement=still)) == rgb(shader.skin)).all()
    assert shader.legend(Shading.MOVEMENT, Known(movement=still)).note == "nothing moved"
    assert shader.legend(Shading.MOVEMENT, Known()).note == "shown after Resolve"


def test_an_estimate_that_the_check_contradicts_says_so_in_its_legend(shader: Shader) -> None:
    energy = np.array([1e-4, 0.0])
    assert "%" in shader.legend(Shading.PREDICTED, Known(energy)).note
    assert (
        shader.legend(Shading.PREDICTED, Known(energy, np.zeros(4))).note
        == "no collisions (checked)"
    )
    assert "%" in shader.legend(Shading.PREDICTED, Known(energy, np.full(4, 1e-6))).note


def test_every_step_of_a_scale_looks_alike(shader: Shader) -> None:
    for colours in ramps(shader):
        lab = np.array([cielab(colour) for colour in colours[::15]])
        steps = np.linalg.norm(np.diff(lab, axis=0), axis=1)
        # Across one of its corners the straight path is shorter.
        assert steps.max() < 2.0 * steps.min()


@pytest.mark.parametrize("sight", [FULL_SIGHT, RED_BLIND, GREEN_BLIND, BLUE_BLIND])
def test_more_energy_is_darker_to_all_eyes(shader: Shader, sight: np.ndarray) -> None:
    for colours in ramps(shader):
        lightness = np.array([cielab(colour, sight)[0] for colour in colours[::5]])
        assert (np.diff(lightness) < 0).all()
        assert lightness[0] - lightness[-1] > 45


@pytest.mark.parametrize("sight", [FULL_SIGHT, RED_BLIND, GREEN_BLIND, BLUE_BLIND])
def test_intersecting_faces_stand_out_from_the_exact_scale(
    shader: Shader, sight: np.ndarray
) -> None:
    red = cielab(COLLIDING_FACE, sight)
    away = [np.linalg.norm(cielab(colour, sight) - red) for colour in ramps(shader)[1]]
    assert min(away) > 20


def test_a_scale_begins_and_ends_in_its_colours_and_is_not_to_be_written() -> None:
    colours = ramp(("#ffffff", "#ff0000", "#000000"))
    assert colours.shape == (256, 3)
    assert colours[[0, -1]].tolist() == [[255, 255, 255], [0, 0, 0]]
    assert np.abs(colours.astype(int) - [255, 0, 0]).sum(axis=1).min() < 12
    with pytest.raises(ValueError, match="read-only"):
        colours[0] = 0


def test_legends_name_what_is_drawn(shader: Shader) -> None:
    assert shader.legend(Shading.PLAIN, Known()).title == ""
    domains = shader.legend(Shading.DOMAINS, Known())
    assert domains.ramp[0] == "#ffffff"
    assert [text for _, text in domains.ticks] == ["shared", "alone"]
    free = shader.legend(Shading.EXACT, Known(None, np.zeros(4)))
    assert free.note == "no collisions"
    exact = shader.legend(Shading.EXACT, Known(None, np.full(4, 1e-6)))
    assert exact.crossing == "crossing triangles"
    assert [place for place, _ in exact.ticks] == [0.0, 0.5, 1.0]
    assert exact.ticks[1][1] == "0.3"


def test_each_shading_is_remembered() -> None:
    names = [shading.name.lower() for shading in Shading]
    kept = [set(SETTINGS[key].choices) for key in ("shading", "character_shading")]
    assert kept == [{*names} - {"textured"}, {*names} - {"predicted"}]
