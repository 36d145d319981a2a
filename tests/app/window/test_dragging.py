"""Dragging in a real window: Solid, pins, patches, and holding a pose."""

from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtCore import QEvent, QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMenu, QToolBar
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.editing.live_pose import domain_of, training_pose
from app.editing.settings import SETTINGS
from app.view.camera import View
from app.window.commands.pose import set_up_drags
from app.window.main_window import MainWindow
from tests.app.views import place_of, point_at, seen_vertex
from tests.app.windows import (
    PATIENCE,
    handle,
    move_held,
    rest,
    take_picture,
)

pytestmark = pytest.mark.one_window

LEFT, NO_KEY = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier


@pytest.fixture
def body_window(qtbot: QtBot, body_window: MainWindow) -> MainWindow:
    """Return the window of the body with Solid on."""
    body_window.document.motion.set_solid(True)
    rest(qtbot, body_window)
    return body_window


def arrived(qtbot: QtBot, window: MainWindow) -> None:
    """Wait until the dragged patch comes to rest."""
    qtbot.waitUntil(lambda: not window.document.motion.moving, timeout=2 * PATIENCE)


def test_solid_is_a_button_that_is_remembered(window: MainWindow) -> None:
    document, action = window.document, window.actions_by_key["solid"]
    assert SETTINGS["solid"].default is True
    action.trigger()
    assert action.isChecked()
    assert document.motion.solid
    assert action in window.findChild(QToolBar).actions()
    QTest.keyClick(
        window,
        Qt.Key.Key_S,
        Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.AltModifier,
    )
    assert not document.motion.solid
    assert not action.isChecked()
    assert window.settings["solid"] is False
    document.motion.set_solid(True)
    assert action.isChecked()
    assert window.settings["solid"] is True


def test_how_natural_drags_stay_is_chosen_and_remembered(window: MainWindow) -> None:
    menu = next(
        action.menu()
        for action in window.menus["&Pose"].actions()
        if action.text() == "Drag stiff&ness"
    )
    assert isinstance(menu, QMenu)
    assert [action.isChecked() for action in menu.actions()] == [False, True, False]
    menu.actions()[0].trigger()
    assert window.document.motion.drag_strength == window.settings["drag_strength"] == 0.0
    patch = window.document.motion.grip_at(0)
    window.document.motion.begin_drag(patch, "Drag")
    drag = window.document.motion._moving
    assert drag is not None
    assert drag.start.options.strength == 0.0
    window.document.motion.cancel_drag()


def test_a_key_pins_what_is_under_the_pointer_and_types_into_a_field(
    qtbot: QtBot, window: MainWindow
) -> None:
    document, pin = window.document, window.actions_by_key["pin"]
    canvas = window.viewport.canvas
    assert canvas is not None
    vertex = seen_vertex(window.viewport, 1)
    point_at(qtbot, window.viewport, vertex)
    assert pin.isEnabled()
    QTest.keyClick(window, Qt.Key.Key_P)
    assert [held.vertex for held in document.history.pose.pins] == [vertex]
    assert pin.text().replace("&", "") == "Unpin"
    radius = document.motion.grip_radius
    QTest.keyClick(window, Qt.Key.Key_BracketRight)
    assert document.motion.grip_radius > radius
    QTest.keyClick(window, Qt.Key.Key_BracketLeft)
    assert document.motion.grip_radius == pytest.approx(radius)
    window.sliders.filter.setFocus()
    QTest.keyClicks(window.sliders.filter, "p]")
    assert window.sliders.filter.text() == "p]"
    assert len(document.history.pose.pins) == 1
    assert document.motion.grip_radius == pytest.approx(radius)
    window.sliders.filter.clear()
    window.viewport.setFocus()
    QTest.keyClick(window, Qt.Key.Key_P)
    assert document.history.pose.pins == ()
    QTest.mouseMove(canvas, QPoint(3, 3))
    qtbot.waitUntil(lambda: not pin.isEnabled(), timeout=PATIENCE)
    # The small model has no parts of these names.
    for key, word in (("pin_feet", "feet"), ("pin_hands", "hands")):
        assert not window.actions_by_key[key].isEnabled()
        assert word in window.actions_by_key[key].toolTip()


def test_the_menu_of_the_body_pins_and_chooses_the_patch(qtbot: QtBot, window: MainWindow) -> None:
    document, canvas = window.document, window.viewport.canvas
    assert canvas is not None
    vertex = seen_vertex(window.viewport, 1)
    place = point_at(qtbot, window.viewport, vertex)

    def opened() -> QMenu:
        QTest.mouseClick(canvas, Qt.MouseButton.RightButton, NO_KEY, place)
        menus = [
            menu
            for menu in window.findChildren(
                QMenu, options=Qt.FindChildOption.FindDirectChildrenOnly
            )
            if menu.isVisible()
        ]
        assert len(menus) == 1
        return menus[0]

    def choose(menu: QMenu, text: str) -> None:
        (found,) = (a for a in menu.actions() if a.text().replace("&", "") == text)
        found.trigger()

    menu = opened()
    (sizes,) = (a.menu() for a in menu.actions() if a.text().replace("&", "") == "Patch size")
    assert isinstance(sizes, QMenu)
    choose(sizes, "Large (6 %)")
    assert document.motion.grip_radius == pytest.approx(0.06)
    choose(menu, "Pin")
    assert [(pin.vertex, pin.radius) for pin in document.history.pose.pins] == [(vertex, 0.06)]
    menu.close()
    menu = opened()
    choose(menu, "Unpin")
    assert document.history.pose.pins == ()
    menu.close()


def test_feet_and_hands_are_pinned_in_one_step(qtbot: QtBot, body_window: MainWindow) -> None:
    document = body_window.document
    names, space = document.model.domain_names, document.model.space
    for key, word in (("pin_feet", "foot"), ("pin_hands", "hand")):
        body_window.actions_by_key[key].trigger()
        pinned = {names[space.vertex_domain[pin.vertex]] for pin in document.history.pose.pins}
        assert pinned == {name for name in names if word in name}
        # Heels must not swing through the floor: two more vertices keep the orientation.
        assert all(len(pin.frame) == 2 for pin in document.history.pose.pins)
        assert document.history.undo_stack.count() == 1
        document.history.undo()
        assert document.history.pose.pins == ()
    rest(qtbot, body_window)


def test_a_slider_shows_where_contact_holds_it(qtbot: QtBot, body_window: MainWindow) -> None:
    document = body_window.document
    code = document.model.code_names.index("right upper arm up")
    row = body_window.sliders.row_of(code)
    start = handle(row)
    QTest.mousePress(row.slider, LEFT, NO_KEY, start)
    for step in range(1, 21):
        QTest.mouseMove(row.slider, start - QPoint(6 * step, 0))
        qtbot.wait(16)
    arrived(qtbot, body_window)
    reached = float(document.history.latent[code])
    # The handle stays under the pointer; the number shows the pose's value.
    assert row.slider.number < reached - 0.01
    assert row.slider.contact_position is not None
    assert row.field.value() == pytest.approx(reached, abs=1e-3)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert "contact" in body_window.collision.exact.details.text()
    take_picture(body_window, "held by contact")
    QTest.mouseRelease(row.slider, LEFT, NO_KEY, start - QPoint(120, 0))
    assert row.slider.number == pytest.approx(reached, abs=0.01)
    document.history.undo()
    rest(qtbot, body_window)
    assert row.slider.contact_position is None
    assert "contact" not in body_window.collision.exact.details.text()


def test_a_drag_that_starts_colliding_says_why_it_goes_no_deeper(
    qtbot: QtBot, body_window: MainWindow
) -> None:
    document, canvas = body_window.document, body_window.viewport.canvas
    assert canvas is not None
    document.motion.set_solid(False)
    for sample in document.model.latent_space.sample(40, np.random.default_rng(1)):
        if document.model.detector.detect(document.model.decode(sample)).colliding:
            break
    document.motion.blend_towards(sample, 1.0)
    rest(qtbot, body_window)
    document.motion.set_solid(True)
    card = body_window.collision.exact
    assert document.motion.exact is not None
    assert document.motion.exact.colliding
    assert "Solid" not in card.details.text()
    deeper = None
    for domain in range(len(document.model.domain_names)):
        try:
            place = place_of(body_window.viewport, seen_vertex(body_window.viewport, domain))
        except AssertionError:
            continue
        for way in (QPoint(150, 0), QPoint(-150, 0), QPoint(0, 150), QPoint(0, -150)):
            QTest.mousePress(canvas, LEFT, NO_KEY, place)
            for step in range(1, 6):
                QTest.mouseMove(canvas, place + way * step / 5)
                qtbot.wait(16)
            arrived(qtbot, body_window)
            deeper = card.details.text() if "Solid" in card.details.text() else None
            QTest.keyClick(canvas, Qt.Key.Key_Escape)
            QTest.mouseRelease(canvas, LEFT, NO_KEY, place + way)
            rest(qtbot, body_window)
            if deeper is not None:
                break
        if deeper is not None:
            break
    assert deeper is not None
    assert "Resolve" in deeper
    assert "Solid" not in card.details.text()


def test_a_part_is_mirrored_to_the_other_side_by_the_menu(
    qtbot: QtBot, body_window: MainWindow
) -> None:
    document = body_window.document
    names = document.model.domain_names
    left, right = names.index("left shin & foot"), names.index("right shin & foot")
    raised = np.abs(document.model.known_poses).sum(axis=1).argmax()
    document.motion.load_pose(training_pose(document.model, int(raised)))
    rest(qtbot, body_window)
    before = document.history.latent
    menu = body_window._body_menus.part_menu(left, None)
    (mirror,) = (a for a in menu.actions() if "irror to" in a.text().replace("&", ""))
    # An unfinished edit ends at its present pose.
    assert document.model.space.metric.any()
    document.motion.randomise(1.0, 3)
    qtbot.waitUntil(lambda: document.history.latent is not before)
    assert document.motion.moving
    mirror.trigger()
    before = document.history.latent
    qtbot.waitUntil(
        lambda: document.history.undo_stack.undoText().startswith("Mirror"), timeout=PATIENCE
    )
    rest(qtbot, body_window)
    changed = document.history.latent != before
    assert changed.any()
    assert not changed[~document.model.embedding.codes_of([right])].any()
    assert not document.motion.exact.colliding


def test_the_menu_bar_pins_the_patch_that_the_pointer_left(
    qtbot: QtBot, window: MainWindow
) -> None:
    document, pin, menu = window.document, window.actions_by_key["pin"], window.menus["&Pose"]
    viewport = window.viewport
    vertex = seen_vertex(viewport, 1)
    point_at(qtbot, viewport, vertex)
    QApplication.sendEvent(viewport.canvas, QEvent(QEvent.Type.Leave))
    assert not pin.isEnabled()
    # The key applies to the patch under the pointer.
    QTest.keyClick(window, Qt.Key.Key_P)
    assert document.history.pose.pins == ()
    menu.popup(window.mapToGlobal(QPoint(60, 30)))
    assert pin.isEnabled()
    assert viewport.hovered_domain == domain_of(document.model, vertex)
    take_picture(window, "pose menu")
    menu.setActiveAction(pin)
    QTest.keyClick(menu, Qt.Key.Key_Return)
    assert [held.vertex for held in document.history.pose.pins] == [vertex]
    qtbot.waitUntil(lambda: not pin.isEnabled(), timeout=PATIENCE)
    menu.popup(window.mapToGlobal(QPoint(60, 30)))
    assert pin.text().replace("&", "") == "Unpin"
    menu.close()
    document.set_model(document.model)
    menu.popup(window.mapToGlobal(QPoint(60, 30)))
    assert not pin.isEnabled()
    menu.close()
    rest(qtbot, window)


def test_the_whole_body_is_shown_from_the_same_side(qtbot: QtBot, window: MainWindow) -> None:
    viewport = window.viewport
    assert viewport.scene is not None
    viewport.set_camera("Back", animated=False)
    back = viewport.scene.view
    arm = back.position - back.focus
    viewport.scene.view = View(back.focus + 0.2 * arm + 0.1, back.focus + 0.1, back.up)
    window.actions_by_key["reset_camera"].trigger()
    rest(qtbot, window)
    for name in ("position", "focus", "up"):
        np.testing.assert_allclose(
            getattr(viewport.scene.view, name), getattr(back, name), atol=1e-6
        )


def test_feet_stay_and_the_whole_body_helps_as_the_menu_says(window: MainWindow) -> None:
    document = window.document
    for key, at_first in (("standing", True), ("whole_body", False)):
        action = window.actions_by_key[key]
        assert action in window.menus["&Pose"].actions()
        assert action.isChecked() is getattr(document.motion, key) is at_first
        action.trigger()
        assert getattr(document.motion, key) is not at_first
    assert window.settings["standing"] is False
    document.motion.begin_drag(document.motion.grip_at(0), "Drag")
    drag = document.motion._moving
    assert drag is not None
    assert drag.start.options.whole_body
    assert not drag.start.options.standing
    document.motion.cancel_drag()


@pytest.mark.slow
def test_a_drag_hints_at_what_else_can_be_done_and_says_that_the_body_helps(
    qtbot: QtBot, window: MainWindow
) -> None:
    viewport, status = window.viewport, window.statusBar()
    canvas, mouse = viewport.canvas, viewport.mouse
    assert canvas is not None
    assert mouse is not None
    vertex = seen_vertex(viewport, 1)
    place = point_at(qtbot, viewport, vertex)
    tag = viewport._tag
    assert "whole body" not in tag.text()
    for helps in (False, True):
        if helps:
            window.actions_by_key["whole_body"].trigger()
        QTest.mousePress(canvas, LEFT, NO_KEY, place)
        for step in (8, 16):
            move_held(canvas, place + QPoint(step, 0), NO_KEY)
        hint = status.currentMessage()
        assert "Wheel or page keys: nearer or farther" in hint
        assert "P: pin it here" in hint
        assert ("Ctrl+Shift" in hint) is not helps
        assert (tag.isVisible() and ", whole body" in tag.text()) is helps
        take_picture(window, f"drag-hint-{helps}")
        QTest.mouseRelease(canvas, LEFT, NO_KEY, place + QPoint(16, 0))
        arrived(qtbot, window)
        assert status.currentMessage() == ""
    # But not in the next window.
    again = PoseDocument()
    set_up_drags(again.motion, window.settings)
    assert not again.motion.whole_body
    assert again.close()


CTRL_SHIFT = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier


def test_a_pin_is_made_to_keep_the_orientation_by_a_key(qtbot: QtBot, window: MainWindow) -> None:
    document = window.document
    point_at(qtbot, window.viewport, seen_vertex(window.viewport, 1))
    QTest.keyClick(window, Qt.Key.Key_P)
    assert [len(pin.frame) for pin in document.history.pose.pins] == [0]
    QTest.keyClick(window, Qt.Key.Key_P, CTRL_SHIFT)
    assert [len(pin.frame) for pin in document.history.pose.pins] == [2]
    QTest.keyClick(window, Qt.Key.Key_P, CTRL_SHIFT)
    assert document.history.pose.pins == ()
