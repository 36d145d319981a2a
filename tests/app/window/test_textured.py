"""Textured characters in a real window: initial shading, switching, posing, pointing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from pytestqt.qtbot import QtBot

from app.view.shading import Shading
from app.window.main_window import MainWindow
from tests.app.views import on_screen, pixels, steady_pixels
from tests.app.window.test_characters import dropped
from tests.app.windows import PATIENCE, drop, rest, take_picture
from tests.core.gltf_builder import GltfBuilder, arm
from tests.core.textured_cube import BLUE, RED, add_texture, coloured, png, textured_cube

pytestmark = pytest.mark.one_window

HALVES = np.array([[RED, BLUE]], dtype=np.uint8)


@pytest.fixture
def cube_file(tmp_path: Path) -> Path:
    builder = GltfBuilder()
    texture = add_texture(builder, png(HALVES), {"magFilter": 9728})
    material = coloured(baseColorTexture={"index": texture})
    return textured_cube(material, builder).write(tmp_path / "cube.glb")


def place(window: MainWindow, *point: float) -> QPoint:
    canvas = window.viewport.canvas
    assert canvas is not None
    return on_screen(canvas, np.array(point)).toPoint()


def colour_at(window: MainWindow, *point: float) -> tuple[int, ...]:
    """Return the screen's colour at a point of the scene."""
    seen, shown = place(window, *point), pixels(window.viewport)
    return tuple(int(value) for value in shown[seen.y(), seen.x()])


def look_at_the_front(qtbot: QtBot, window: MainWindow) -> None:
    """Look at a character with the pointer beside it: a patch under it would be outlined."""
    canvas = window.viewport.canvas
    assert canvas is not None
    for corner in (QPoint(6, 6), QPoint(3, 3)):
        QTest.mouseMove(canvas, corner)
    window.viewport.set_camera("Front", animated=False)
    qtbot.waitUntil(lambda: window.viewport.pointed_vertex is None, timeout=PATIENCE)
    rest(qtbot, window)


def test_a_character_opens_as_it_looks_and_others_as_before(
    qtbot: QtBot, window: MainWindow, cube_file: Path, tmp_path: Path
) -> None:
    assert window.viewport.shading is Shading.DOMAINS
    model = dropped(qtbot, window, cube_file)
    assert window.viewport.shading is Shading.TEXTURED
    assert window.actions_by_key["textured"].isChecked()
    look_at_the_front(qtbot, window)
    # Its front faces the viewer; the texture's left half, as seen, is red.
    front = model.front * 1.0
    right = np.cross(np.eye(3)[model.up_axis], front)
    assert colour_at(window, *(front - 0.5 * right)) == RED
    assert colour_at(window, *(front + 0.5 * right)) == BLUE
    take_picture(window, "textured-cube")
    with qtbot.waitSignal(window.document.tasks.opened, timeout=PATIENCE):
        drop(window, arm().write(tmp_path / "arm.glb"))
    rest(qtbot, window)
    # Its plain white material is not the default shading, but can be chosen.
    assert window.viewport.shading is Shading.DOMAINS
    assert window.settings["shading"] == "domains"


@pytest.mark.slow
def test_a_shading_that_was_chosen_is_what_the_next_character_opens_with(
    qtbot: QtBot, window: MainWindow, cube_file: Path, tmp_path: Path
) -> None:
    dropped(qtbot, window, cube_file)
    look_at_the_front(qtbot, window)
    textured = steady_pixels(qtbot, window.viewport)
    QTest.keyClick(window, Qt.Key.Key_1, Qt.KeyboardModifier.ControlModifier)
    assert window.viewport.shading is Shading.PLAIN
    rest(qtbot, window)
    plain = steady_pixels(qtbot, window.viewport)
    assert np.abs(plain - textured).sum(axis=2).max() > 200
    QTest.keyClick(window, Qt.Key.Key_0, Qt.KeyboardModifier.ControlModifier)
    rest(qtbot, window)
    np.testing.assert_array_equal(steady_pixels(qtbot, window.viewport), textured)
    QTest.keyClick(window, Qt.Key.Key_1, Qt.KeyboardModifier.ControlModifier)
    assert window.settings["shading"] == "domains"
    other = tmp_path / "other.glb"
    other.write_bytes(cube_file.read_bytes())
    dropped(qtbot, window, other)
    assert window.viewport.shading is Shading.PLAIN


def test_a_posed_character_takes_its_texture_along(
    qtbot: QtBot, window: MainWindow, cube_file: Path
) -> None:
    model, document = dropped(qtbot, window, cube_file), window.document
    look_at_the_front(qtbot, window)
    right = np.cross(np.eye(3)[model.up_axis], model.front)
    moves = [model.decode(row).mean(axis=0) @ right for row in np.eye(model.latent_size)[:3]]
    code = int(np.abs(moves).argmax())
    # Move it by half a side.
    document.motion.set_code(code, float(1.0 / moves[code]))
    rest(qtbot, window)
    assert colour_at(window, *(model.front + 0.5 * right)) == RED
    assert colour_at(window, *(model.front + 1.5 * right)) == BLUE
    assert colour_at(window, *(model.front - 0.5 * right)) not in (RED, BLUE)


def test_the_patch_under_the_pointer_is_seen_on_a_texture(
    qtbot: QtBot, window: MainWindow, cube_file: Path
) -> None:
    model = dropped(qtbot, window, cube_file)
    look_at_the_front(qtbot, window)
    right = np.cross(np.eye(3)[model.up_axis], model.front)
    point = model.front + 0.97 * (right + np.eye(3)[model.up_axis])
    assert colour_at(window, *point) == BLUE
    canvas = window.viewport.canvas
    # A pointer that is already there, from an earlier test, does not move.
    QTest.mouseMove(canvas, QPoint(3, 3))
    qtbot.wait(100)
    QTest.mouseMove(canvas, place(window, *point))
    qtbot.waitUntil(lambda: window.viewport.pointed_vertex is not None, timeout=PATIENCE)
    qtbot.waitUntil(lambda: colour_at(window, *point) != BLUE, timeout=PATIENCE)


def test_a_damaged_texture_is_said_and_its_colour_is_shown(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    builder = GltfBuilder()
    base = {
        "baseColorTexture": {"index": add_texture(builder, b"no image")},
        "baseColorFactor": [0.0, 1.0, 0.0, 1.0],
    }
    told: list[str] = []
    window.document.message.connect(told.append)
    file = textured_cube(coloured(**base), builder).write(tmp_path / "damaged.glb")
    model = dropped(qtbot, window, file)
    assert any("the material 'Skin' is not shown as it is: image 0 is damaged" in t for t in told)
    look_at_the_front(qtbot, window)
    assert colour_at(window, *model.front) == (0, 255, 0)


def test_a_body_without_a_look_cannot_be_shown_textured(window: MainWindow) -> None:
    assert not window.actions_by_key["textured"].isEnabled()
    window.viewport.set_shading(Shading.TEXTURED)
    assert window.viewport.scene is not None
    assert not window.viewport.scene.is_textured
