"""Mirroring in a real window: a pose, twice, over a save, and a library by its menu."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMenu
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.theme import DARK, LIGHT, apply_theme
from app.window.main_window import MainWindow
from lcollision_core.bodies import LearnedBody, RigBody
from lcollision_core.tasks.words import mirrored_name
from tests.app.windows import (
    PATIENCE,
    open_window,
    rest,
    settings_in,
    shown,
    take_picture,
)
from tests.rigged_shapes import rigged_tube

pytestmark = pytest.mark.one_window

FREE_THAT_COLLIDES_MIRRORED = 1
"""The second sample of generator 0, as in the core's tests."""


@pytest.fixture
def window(body_window: MainWindow) -> MainWindow:
    return body_window


def press_mirror(qtbot: QtBot, window: MainWindow) -> str:
    """Press Ctrl+M, wait for the pose, and return the status bar's message."""
    told: list[str] = []
    window.document.message.connect(told.append)
    QTest.keyClick(window, Qt.Key.Key_M, Qt.KeyboardModifier.ControlModifier)
    qtbot.waitUntil(lambda: any("irror" in sentence for sentence in told), timeout=4 * PATIENCE)
    rest(qtbot, window)
    window.document.message.disconnect(told.append)
    return next(sentence for sentence in told if "irror" in sentence)


def test_mirroring_twice_is_the_pose_again_also_after_save_and_reopen(
    qtbot: QtBot, window: MainWindow, body: LearnedBody, tmp_path: Path
) -> None:
    document = window.document
    pose = body.latent_space.sample(1, np.random.default_rng(0))[0]
    document.motion.blend_towards(pose, 1.0)
    rest(qtbot, window)
    take_picture(window, "mirror_before")
    before = shown(window).astype(float)
    said = press_mirror(qtbot, window)
    assert said.startswith("Mirrored with a fit error of 0.")
    assert document.history.undo_stack.undoText() == "Mirror"
    symmetry = body.symmetry
    assert symmetry is not None
    distance = np.linalg.norm(shown(window) - symmetry.mirror_vertices(before), axis=1)
    assert distance.mean() / body.body_size < 0.008
    take_picture(window, "mirror_after")

    image = document.history.latent.tobytes()
    assert press_mirror(qtbot, window).startswith("Restored to the unmirrored pose")
    assert document.history.latent.tobytes() == pose.tobytes()
    document.history.undo()
    assert document.history.latent.tobytes() == image
    path = tmp_path / "image.json"
    document.tasks.save(path)
    document.tasks.wait_for_saves()
    document.new_pose()
    document.tasks.open_poses(path)
    qtbot.waitUntil(lambda: document.history.latent.tobytes() == image, timeout=PATIENCE)
    press_mirror(qtbot, window)
    assert document.history.latent.tobytes() == pose.tobytes()

    # A changed image is another pose, whose mirror image is computed anew.
    document.history.undo()
    document.motion.set_code(3, document.history.latent[3] + 0.5)
    assert press_mirror(qtbot, window).startswith("Mirrored with a fit error")
    assert document.history.latent.tobytes() != pose.tobytes()


def test_a_free_pose_that_would_collide_is_resolved_or_it_is_said(
    qtbot: QtBot, window: MainWindow, body: LearnedBody
) -> None:
    document = window.document
    pose = body.latent_space.sample(2, np.random.default_rng(0))[FREE_THAT_COLLIDES_MIRRORED]
    document.motion.blend_towards(pose, 1.0)
    rest(qtbot, window)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert "pairs of faces of the mirror image were resolved" in press_mirror(qtbot, window)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert document.history.state.outcome is not None
    assert document.history.state.outcome.exactly_free
    take_picture(window, "mirror_resolved")

    document.history.undo()
    assert document.history.state.outcome is None
    for domain in range(len(body.domain_names)):
        document.motion.set_locked(domain, True)
    said = press_mirror(qtbot, window)
    assert "that the original doesn't have" in said
    assert "unlock" in said
    assert "locked parts were mirrored too" in said
    assert document.motion.exact is not None
    assert document.motion.exact.colliding


def choose(window: MainWindow, *names: str) -> QPoint:
    held = window.library.list
    place = QPoint()
    for number, name in enumerate(names):
        (item,) = held.findItems(name, Qt.MatchFlag.MatchExactly)
        held.scrollToItem(item)
        place = held.visualItemRect(item).center()
        key = Qt.KeyboardModifier.ControlModifier if number else Qt.KeyboardModifier.NoModifier
        QTest.mouseClick(held.viewport(), Qt.MouseButton.LeftButton, key, place)
    return place


def mirror_by_menu(qtbot: QtBot, window: MainWindow, place: QPoint, picture: str = "") -> str:
    """Open the context menu of the selected poses, choose Mirror, and return the message."""
    told: list[str] = []
    window.document.message.connect(told.append)
    window.library.list.customContextMenuRequested.emit(place)
    menus = [menu for menu in window.findChildren(QMenu) if menu.isVisible()]
    (menu,) = menus
    if picture:
        QApplication.processEvents()
        take_picture(window, picture)
    action = window.actions_by_key["mirror_poses"]
    assert action in menu.actions()
    action.trigger()
    menu.close()
    qtbot.waitUntil(lambda: any("irror" in sentence for sentence in told), timeout=4 * PATIENCE)
    window.document.message.disconnect(told.append)
    return next(sentence for sentence in told if "irror" in sentence)


@pytest.mark.slow
@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_a_library_is_mirrored_and_back_to_the_bit(
    qtbot: QtBot, window: MainWindow, body: LearnedBody, theme: object
) -> None:
    apply_theme(QApplication.instance(), theme)
    ending = "dark" if theme is DARK else "light"
    document, library = window.document, window.library
    library.allow_pictures()
    names = ("twist right", "right side lunge")
    place = choose(window, *names)
    said = mirror_by_menu(qtbot, window, place, f"mirror_menu_{ending}")
    assert said.startswith("Added 2 mirrored poses to your library; off by at most 0.2 %")
    assert document.history.undo_stack.undoText() == "Add 2 poses"
    assert {pose.name for pose in document.library.poses} == {"twist left", "left side lunge"}
    assert library.own.isChecked()
    place = choose(window, "twist left", "left side lunge")
    mirror_by_menu(qtbot, window, place)
    held = {pose.name: pose for pose in document.library.poses}
    assert set(held) == {"twist left", "left side lunge", *names}
    for name in names:
        trained = body.known_poses[body.card.pose_names.index(name)].astype(np.float64)
        assert held[name].latent.tobytes() == trained.tobytes()
    place = choose(window, "twist left")
    said = mirror_by_menu(qtbot, window, place)
    assert said == "These mirrored poses are already in your library"
    assert len(document.library.poses) == 4
    qtbot.waitUntil(lambda: not library._thumbnail_timer.isActive(), timeout=PATIENCE)
    rest(qtbot, window)
    take_picture(window, f"mirror_library_{ending}")
    document.history.undo()
    document.history.undo()
    assert document.library.poses == ()
    apply_theme(QApplication.instance(), LIGHT)


def test_a_mirrored_pose_is_called_after_its_other_side() -> None:
    for name, image in (
        ("twist right", "twist left"),
        ("Left arm RIGHT", "Right arm LEFT"),
        ("bright", "bright mirrored"),
        ("bow", "bow mirrored"),
    ):
        assert mirrored_name(name) == image
        assert mirrored_name(image) == name
    assert mirrored_name(" mirrored") == " mirrored"


def test_a_model_without_two_sides_offers_no_mirror(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    character = rigged_tube(n_joints=5, frames=True)
    assert character.rig is not None
    rest = character.rig.rest.copy()
    rest[1:, [0, 2], 3] += [[0.3, 0.1], [0.0, -0.4], [-0.2, 0.3], [0.1, 0.25]]
    winding = replace(character, rig=replace(character.rig, rest=rest))
    document.set_model(RigBody.of(winding))
    held = open_window(qtbot, document, settings_in(tmp_path))
    held.library.list.selectAll()
    assert held.library.chosen_poses
    for key in ("mirror", "mirror_poses"):
        assert not held.actions_by_key[key].isEnabled()
        assert "do not say left and right" in held.actions_by_key[key].toolTip()
