"""Poses that people make first, made in a real window by the mouse alone, in a few drags."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QPoint, Qt, QTimer
from PySide6.QtGui import QAction
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMenu, QToolButton
from pytestqt.qtbot import QtBot

from app.view.camera import places_of
from app.window.main_window import MainWindow
from tests.app.views import place_of
from tests.app.windows import (
    PATIENCE,
    move_held,
    rest,
    shown,
    take_picture,
)

LEFT, NO_KEY = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
MOST_DRAGS, MOST_SECONDS, NEAR = 4, 30.0, 0.03

Point = tuple[float, float, float]


class Recipe(NamedTuple):
    """How a pose is made: with feet, hands and the aim pinned, the right hand's pin is dragged.

    Attributes
    ----------
    aim : place of the surface where the hand is to end, in the data's unit, at the start
    cameras : from which the hand is dragged to it, one a drag
    """

    name: str
    aim: Point
    cameras: tuple[str, ...]


RECIPES = (
    Recipe("right hand on left hip", (0.12, -0.12, 0.97), ("Front", "Left", "Left")),
    Recipe("hand on chin", (0.0, -0.15, 1.40), ("Front", "Right")),
)


ACROSS = 0.1
"""Normalised: how far past the middle of the body each hand of crossed arms ends at least."""

CROSSED: tuple[tuple[bool, Point], ...] = (
    (True, (0.13, -0.22, 1.18)),
    (False, (-0.13, -0.22, 1.12)),
    (True, (0.20, -0.20, 1.18)),
    (False, (-0.20, -0.20, 1.14)),
)
"""Drags from the front that cross the arms: whether of the right hand, and where to."""


class Hand:
    """Uses the mouse in a window as a person does: clicks menus, double-clicks, drags slowly."""

    def __init__(self, qtbot: QtBot, window: MainWindow) -> None:
        assert window.viewport.canvas is not None
        self._qtbot, self._window, self._canvas = qtbot, window, window.viewport.canvas
        self._document = window.document
        self.n_drags = 0

    def choose(self, text: str) -> None:
        """Click an entry of the menu that is open, once it is there."""

        def entries() -> list[QAction]:
            menu = QApplication.activePopupWidget()
            held = menu.actions() if isinstance(menu, QMenu) else []
            return [action for action in held if action.text().replace("&", "") == text]

        self._qtbot.waitUntil(lambda: len(entries()) == 1, timeout=PATIENCE)
        menu, (entry,) = QApplication.activePopupWidget(), entries()
        assert isinstance(menu, QMenu)
        assert entry.isEnabled()
        QTest.mouseClick(menu, LEFT, NO_KEY, menu.actionGeometry(entry).center())

    def choose_in_bar(self, title: str, text: str) -> None:
        """Click a menu of the menu bar, and an entry of it."""
        bar = self._window.menuBar()
        (menu,) = (a for a in bar.actions() if a.text().replace("&", "") == title)
        QTest.mouseClick(bar, LEFT, NO_KEY, bar.actionGeometry(menu).center())
        self.choose(text)

    def look_from(self, camera: str) -> None:
        """Choose a camera in the menu of the tool bar."""
        button = self._window.findChild(QToolButton, "cameras")
        # The button goes on when its menu has been closed.
        QTimer.singleShot(0, self._window, lambda: self.choose(camera))
        QTest.mouseClick(button, LEFT)
        rest(self._qtbot, self._window)

    def pin(self, vertex: int) -> None:
        """Double-click a place of the surface."""
        n_pins = len(self._document.pins)
        QTest.mouseDClick(self._canvas, LEFT, NO_KEY, place_of(self._window.viewport, vertex))
        assert len(self._document.pins) == n_pins + 1

    def put(self, vertex: int, to: npt.NDArray[np.floating]) -> None:
        """Drag the pin of a vertex to a (3,) point, slowly enough that the body can follow."""
        self.n_drags += 1
        document, canvas = self._document, self._canvas
        (start,) = (pin.position for pin in document.pins if pin.vertex == vertex)
        assert self._window.viewport.scene is not None
        ends = places_of(
            self._window.viewport.scene.view,
            np.array([start, to], dtype=np.float64),
            (canvas.width(), canvas.height()),
        )
        places = [QPoint(*np.round(p).astype(int).tolist()) for p in np.linspace(*ends, 15)]
        QTest.mousePress(canvas, LEFT, NO_KEY, places[0])
        for place in places[1:]:
            move_held(canvas, place, NO_KEY)
            self._pause(0.3)
        assert document.dragging
        self._pause(3.0)
        QTest.mouseRelease(canvas, LEFT, NO_KEY, places[-1])
        self._pause(1.5)

    def _pause(self, seconds: float) -> None:
        """Wait until the body comes no further, but not for ever: people go on."""
        end = time.monotonic() + seconds
        self._qtbot.wait(16)
        while self._document.moving and time.monotonic() < end:
            self._qtbot.wait(5)


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.name)
def test_a_pose_is_made_by_mouse_alone(
    qtbot: QtBot, body_window: MainWindow, recipe: Recipe
) -> None:
    document, model = body_window.document, body_window.document.model
    document.set_solid(True)
    hand = Hand(qtbot, body_window)
    names, domains = model.domain_names, model.pose_space.vertex_domain
    aim = int(np.linalg.norm(shown(body_window) - np.array(recipe.aim), axis=1).argmin())
    began = time.monotonic()
    take_picture(body_window, f"{recipe.name}, before")
    hand.choose_in_bar("Pose", "Pin feet")
    hand.choose_in_bar("Pose", "Pin hands")
    hand.look_from("Front")
    hand.pin(aim)
    (taken,) = (p.vertex for p in document.pins if names[domains[p.vertex]] == "right hand")
    grip = document.grip_at(taken)

    def miss() -> float:
        """Return how far the hand's patch is from the aim on the body, normalised."""
        vertices = shown(body_window)
        return float(np.linalg.norm(grip.position(vertices) - vertices[aim]) / model.body_size)

    assert miss() > 2 * NEAR
    for number, camera in enumerate(recipe.cameras, 1):
        hand.look_from(camera)
        hand.put(taken, shown(body_window)[aim])
        take_picture(body_window, f"{recipe.name}, drag {number}")
    rest(qtbot, body_window)
    seconds = time.monotonic() - began
    hand.look_from("Front")
    take_picture(body_window, f"{recipe.name}, after")
    assert document.exact is not None
    assert not document.exact.colliding
    assert document.solid
    assert hand.n_drags <= MOST_DRAGS
    assert miss() < NEAR
    assert seconds < MOST_SECONDS


def test_arms_are_crossed_by_mouse_alone(qtbot: QtBot, body_window: MainWindow) -> None:
    document = body_window.document
    document.set_solid(True)
    hand = Hand(qtbot, body_window)
    began = time.monotonic()
    take_picture(body_window, "arms crossed, before")
    hand.choose_in_bar("Pose", "Pin feet")
    hand.choose_in_bar("Pose", "Pin hands")
    hand.look_from("Front")
    # The hands are the highest pins; the body's left is at positive x.
    places = {pin.vertex: pin.position for pin in document.pins}
    hands = sorted(places, key=lambda vertex: places[vertex][2])[-2:]
    right, left = sorted(hands, key=lambda vertex: places[vertex][0])
    for number, (is_right, to) in enumerate(CROSSED, 1):
        hand.put(right if is_right else left, np.array(to))
        take_picture(body_window, f"arms crossed, drag {number}")
    rest(qtbot, body_window)
    seconds = time.monotonic() - began
    assert document.exact is not None
    assert not document.exact.colliding
    assert hand.n_drags <= MOST_DRAGS
    past = ACROSS * document.model.body_size
    vertices = shown(body_window)
    assert vertices[right][0] > past
    assert vertices[left][0] < -past
    assert seconds < MOST_SECONDS
