"""Typical first poses, made in a real window by a few mouse drags."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt, QTimer
from PySide6.QtGui import QAction
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMenu, QToolButton
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.view.camera import places_of
from app.view.shading import Shading
from app.window.main_window import MainWindow
from lcollision_core.bodies import open_body
from lcollision_core.posing import long_axis
from tests.app.views import double_click, place_of
from tests.app.windows import (
    PATIENCE,
    move_held,
    open_window,
    rest,
    settings_in,
    shown,
    take_picture,
)

LEFT, NO_KEY = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
MOST_DRAGS, NEAR = 4, 0.03
A_CLICK = 4
"""Least movement of the pointer in a drag, in pixels."""

Point = tuple[float, float, float]


class Recipe(NamedTuple):
    """Recipe for a pose: pin feet, hands and the aim, then drag the right hand's pin.

    Attributes
    ----------
    aim : target point of the hand on the surface at the start, in the data's unit
    cameras : the camera of each drag
    """

    name: str
    aim: Point
    cameras: tuple[str, ...]


RECIPES = (
    Recipe(
        "right hand on left hip", (0.12, -0.12, 0.97), ("Front", "Left", "Three-quarter", "Left")
    ),
    Recipe("hand on chin", (0.0, -0.15, 1.40), ("Front", "Right")),
)


ACROSS = 0.1
"""Least distance of each hand of crossed arms past the middle of the body, normalised."""

CROSSED: tuple[tuple[bool, Point], ...] = (
    (True, (0.13, -0.22, 1.18)),
    (False, (-0.13, -0.22, 1.12)),
    (True, (0.26, -0.20, 1.20)),
    (False, (-0.28, -0.20, 1.12)),
)
"""Drags from the front that cross the arms: whether the right hand, and its target."""


PAST_MIDDLE = 0.04
"""The same for the middles of a character's hands, normalised."""

RIGHT_ANGLE = 0.35
"""Cosine of 70 degrees: the angle between thigh and shin of a sitting body is 70 to 110."""

CHARACTERS = pytest.mark.parametrize(
    "character_window",
    [("mannequin-moves.glb", "light"), ("xbot-moves.glb", "dark")],
    indirect=True,
    ids=["mannequin", "xbot"],
)


class Hand:
    """Uses the mouse in a window like a person: clicks menus, double-clicks, drags slowly."""

    def __init__(self, qtbot: QtBot, window: MainWindow) -> None:
        assert window.viewport.canvas is not None
        self._qtbot, self._window, self._canvas = qtbot, window, window.viewport.canvas
        self._document = window.document
        self.n_drags = 0

    def choose(self, text: str) -> None:
        """Click an entry of the open menu, once it is shown."""

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
        button, chosen = self._window.findChild(QToolButton, "cameras"), list[str]()

        def choose() -> None:
            self.choose(camera)
            chosen.append(camera)

        # Up to Qt 6.11, the button's handler returns only once its menu is closed.
        QTimer.singleShot(0, self._window, choose)
        QTest.mouseClick(button, LEFT)
        self._qtbot.waitUntil(lambda: bool(chosen))
        rest(self._qtbot, self._window)

    def pin(self, vertex: int) -> None:
        """Double-click a vertex of the surface."""
        n_pins = len(self._document.history.pose.pins)
        double_click(self._canvas, place_of(self._window.viewport, vertex))
        assert len(self._document.history.pose.pins) == n_pins + 1

    def put(self, vertex: int, to: npt.NDArray[np.floating]) -> None:
        """Drag the pin of a vertex to a (3,) point, slowly enough that the body can follow."""
        self.n_drags += 1
        document, canvas = self._document, self._canvas
        (start,) = (pin.position for pin in document.history.pose.pins if pin.vertex == vertex)
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
            self._pause(20)
        assert document.motion.dragging
        self._pause(200)
        QTest.mouseRelease(canvas, LEFT, NO_KEY, places[-1])
        self._pause(100)

    def _pause(self, n_frames: int) -> None:
        """Wait until the body comes no nearer, but not for ever, like a person."""
        shown: list[None] = []
        count = self._document.motion.frame_changed.connect(lambda: shown.append(None))
        self._qtbot.wait(16)
        self._qtbot.waitUntil(
            lambda: not self._document.motion.moving or len(shown) >= n_frames, timeout=PATIENCE
        )
        self._document.disconnect(count)


@pytest.mark.parametrize(
    "recipe",
    [pytest.param(RECIPES[0], marks=pytest.mark.slow), *RECIPES[1:]],
    ids=lambda recipe: recipe.name,
)
def test_a_pose_is_made_by_mouse_alone(
    qtbot: QtBot, body_window: MainWindow, recipe: Recipe
) -> None:
    document, model = body_window.document, body_window.document.model
    document.motion.set_solid(True)
    hand = Hand(qtbot, body_window)
    names, domains = model.domain_names, model.space.vertex_domain
    aim = int(np.linalg.norm(shown(body_window) - np.array(recipe.aim), axis=1).argmin())
    take_picture(body_window, f"{recipe.name}, before")
    hand.choose_in_bar("Pose", "Pin feet")
    hand.choose_in_bar("Pose", "Pin hands")
    hand.look_from("Front")
    hand.pin(aim)
    (taken,) = (
        p.vertex for p in document.history.pose.pins if names[domains[p.vertex]] == "right hand"
    )
    grip = document.motion.grip_at(taken)

    def miss() -> float:
        """Return the normalised distance of the hand's patch from the aim on the body."""
        vertices = shown(body_window)
        return float(np.linalg.norm(grip.position(vertices) - vertices[aim]) / model.body_size)

    assert miss() > 2 * NEAR
    for number, camera in enumerate(recipe.cameras, 1):
        hand.look_from(camera)
        hand.put(taken, shown(body_window)[aim])
        take_picture(body_window, f"{recipe.name}, drag {number}")
    rest(qtbot, body_window)
    hand.look_from("Front")
    take_picture(body_window, f"{recipe.name}, after")
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert document.motion.solid
    assert hand.n_drags <= MOST_DRAGS
    assert miss() < NEAR


@pytest.mark.slow
def test_arms_are_crossed_by_mouse_alone(qtbot: QtBot, body_window: MainWindow) -> None:
    document = body_window.document
    document.motion.set_solid(True)
    hand = Hand(qtbot, body_window)
    take_picture(body_window, "arms crossed, before")
    hand.choose_in_bar("Pose", "Pin feet")
    hand.choose_in_bar("Pose", "Pin hands")
    hand.choose_in_bar("Pose", "Move whole body")
    hand.look_from("Front")
    # The hands are the highest pins; the body's left is at positive x.
    places = {pin.vertex: pin.position for pin in document.history.pose.pins}
    hands = sorted(places, key=lambda vertex: places[vertex][2])[-2:]
    right, left = sorted(hands, key=lambda vertex: places[vertex][0])
    for number, (is_right, to) in enumerate(CROSSED, 1):
        hand.put(right if is_right else left, np.array(to))
        take_picture(body_window, f"arms crossed, drag {number}")
    rest(qtbot, body_window)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert hand.n_drags <= MOST_DRAGS
    past = ACROSS * document.model.body_size
    vertices = shown(body_window)
    assert vertices[right][0] > past
    assert vertices[left][0] < -past


class Puppeteer(Hand):
    """Drags a character by the middles of its body parts, from the front or the side."""

    def part(self, name: str) -> npt.NDArray[np.float64]:
        """Return the (3,) middle of a body part as shown."""
        return shown(self._window)[self.inside(name)].astype(np.float64).mean(axis=0)

    def drag(
        self, name: str, to: npt.NDArray[np.floating], key: Qt.KeyboardModifier = NO_KEY
    ) -> None:
        """Drag a body part to the position of a (3,) point on the screen, unless it is there."""
        canvas, (end,) = self._canvas, self._places(to[None])
        start = self._seen(name)
        if np.abs(end - start).max() < A_CLICK:
            return
        self.n_drags += 1
        places = np.linspace(start, end, 30)
        QTest.mousePress(canvas, LEFT, key, _pixel(places[0]))
        for place in places[1:]:
            move_held(canvas, _pixel(place), key)
            self._pause(20)
        assert self._document.motion.dragging
        self._pause(200)
        take_picture(self._window, f"{self._document.model.name}, dragging {name}")
        QTest.mouseRelease(canvas, LEFT, key, _pixel(end))
        self._pause(100)

    def inside(self, name: str) -> npt.NDArray[np.bool_]:
        """Return the (V,) mask of a body part's vertices."""
        model = self._document.model
        (domain,) = (k for k, n in enumerate(model.domain_names) if n.casefold() == name)
        inside: npt.NDArray[np.bool_] = model.space.vertex_domain == domain
        return inside

    def _places(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        scene, canvas = self._window.viewport.scene, self._canvas
        assert scene is not None
        size = canvas.width(), canvas.height()
        return places_of(scene.view, points.astype(np.float64), size)

    def _seen(self, name: str) -> npt.NDArray[np.float64]:
        """Return the (2,) visible position nearest to the middle of a body part."""
        scene, inside = self._window.viewport.scene, self.inside(name)
        assert scene is not None
        (middle,) = self._places(self.part(name)[None])
        places = self._places(shown(self._window)[inside])
        for place in places[np.linalg.norm(places - middle, axis=1).argsort()]:
            picked = self._canvas.pick(QPointF(_pixel(place)), scene.body)
            if picked is not None and inside[picked[0]]:
                return place
        raise AssertionError(f"{name} is not in sight")


class Studio:
    """Poses a character from its rest pose; lengths are normalised."""

    def __init__(self, qtbot: QtBot, window: MainWindow) -> None:
        self._qtbot, self._window, self._document = qtbot, window, window.document
        model, space = window.document.model, window.document.model.space
        self.size, self.up, self.front = model.body_size, space.up, space.front
        self.left = np.cross(self.up, self.front)
        self.hips = space.origins[space.joint_of_code[0]]
        self.hand = Puppeteer(qtbot, window)

    def begin(self) -> None:
        """Return to the rest pose."""
        self._document.motion.reset_all()
        rest(self._qtbot, self._window)
        self.hand.n_drags = 0

    def drag(self, camera: str, part: str, to: npt.NDArray[np.floating]) -> None:
        """Drag a body part from a camera."""
        self.hand.look_from(camera)
        self.hand.drag(part, self.size * to)

    def done(self, pose: str) -> npt.NDArray[np.float64]:
        """Take pictures of a pose, check that it is free, and return its vertices."""
        rest(self._qtbot, self._window)
        name = self._document.model.name
        self._window.viewport.set_shading(Shading.TEXTURED)
        for camera in ("Three-quarter", "Front", "Left"):
            self.hand.look_from(camera)
            take_picture(self._window, f"{name}, {pose}, {camera}")
        self._window.viewport.set_shading(Shading.DOMAINS)
        rest(self._qtbot, self._window)
        take_picture(self._window, f"{name}, {pose}, body parts")
        assert self.hand.n_drags <= MOST_DRAGS
        assert self._document.motion.exact is not None
        assert not self._document.motion.exact.colliding
        return shown(self._window).astype(np.float64) / self.size

    def way(self, part: str, since: npt.NDArray[np.floating]) -> list[float]:
        """Return how far to the left, in front of and above a point a body part is."""
        arm = self.hand.part(part) / self.size - since
        return [float(arm @ axis) for axis in (self.left, self.front, self.up)]


def _pixel(place: npt.NDArray[np.floating]) -> QPoint:
    return QPoint(*np.round(place).astype(int).tolist())


@pytest.fixture
def character_window(
    qtbot: QtBot, tmp_path: Path, characters: Path, request: pytest.FixtureRequest
) -> MainWindow:
    """Return a window of a character in its rest pose, with Solid on."""
    name, theme = request.param
    document = PoseDocument(open_body(characters / name), library_folder=tmp_path / "library")
    settings = settings_in(tmp_path)
    settings["theme"], settings["solid"] = theme, True
    return open_window(qtbot, document, settings, (1280, 860))


@pytest.mark.long
@CHARACTERS
def test_a_character_is_posed_by_mouse_in_four_drags_each(
    qtbot: QtBot, character_window: MainWindow
) -> None:
    """Each hand comes to rest on the body, not behind it, and parts that are not held stay."""
    studio = Studio(qtbot, character_window)
    begin, drag, done, way, hand = studio.begin, studio.drag, studio.done, studio.way, studio.hand
    window, size = character_window, studio.size
    left, up, front = studio.left, studio.up, studio.front
    hips, head = studio.hips, hand.part("head") / size
    chin = head - 0.06 * up
    begin()
    drag("Front", "right hand", chin)
    done("hand on chin")
    # The face is 0.05 to 0.06 in front of the middle of the head.
    assert way("right hand", chin) == pytest.approx([0.0, 0.07, 0.0], abs=0.03)

    begin()
    chest = 0.6 * hips + 0.4 * head
    for _ in range(2):
        drag("Front", "right hand", chest + 0.10 * left + 0.05 * up)
        drag("Front", "left hand", chest - 0.10 * left)
        # Contacts with the other arm on the way do not stop it: one drag suffices.
        assert way("left hand", chest)[0] < -PAST_MIDDLE
    done("arms crossed")
    rights, lefts = way("right hand", chest), way("left hand", chest)
    assert rights[0] > PAST_MIDDLE
    assert lefts[0] < -PAST_MIDDLE
    assert min(rights[1], lefts[1]) > 0.06
    assert max(abs(rights[2]), abs(lefts[2])) < 0.1

    begin()
    before = shown(window) / size
    drag("Left", "hips", hand.part("hips") / size - 0.2 * up - 0.12 * front)
    after = done("sit")
    for side in ("left", "right"):
        stood = hand.inside(f"{side} foot")
        drift = np.linalg.norm(after[stood] - before[stood], axis=1)
        assert np.sqrt((drift**2).mean()) < 0.005
        thigh, shin = (
            long_axis(after[hand.inside(f"{side} {part}")]) for part in ("thigh", "shin")
        )
        assert abs(thigh @ shin) < RIGHT_ANGLE
    assert way("hips", hips)[2] == pytest.approx(-0.2, abs=0.03)
    assert way("head", head)[2] == pytest.approx(-0.2, abs=0.04)

    begin()
    hip = hips + 0.08 * left
    # The hand moves forward, then across, and is laid on the hip from the side.
    drag("Right", "right hand", hips + 0.25 * front + 0.1 * up)
    drag("Front", "right hand", hip)
    drag("Front", "right hand", hip)
    drag("Left", "right hand", hip + 0.05 * front)
    done("right hand on left hip")
    # The hips are 0.08 to 0.09 wide on each side, and 0.06 deep in front.
    assert way("right hand", hip) == pytest.approx([0.0, 0.06, 0.0], abs=0.03)
