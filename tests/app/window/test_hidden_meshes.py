"""Hidden meshes of a character: neither drawn nor checked, reported and remembered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtGui import QIcon, QImage
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QMenu
from pytestqt.qtbot import QtBot

from app.view.camera import places_of
from app.view.scene import _rows_in
from app.window.main_window import MainWindow
from app.window.panels.library import THUMBNAIL
from lcollision_core.bodies import RigBody
from lcollision_core.meshes import ContactRules
from tests.app.views import place_of
from tests.app.windows import PATIENCE, move_held, rest, shown, take_picture
from tests.rigged_shapes import rigged_body

pytestmark = pytest.mark.one_window

ARM, LEFT = "LeftArm", Qt.MouseButton.LeftButton


@pytest.fixture
def body(qtbot: QtBot, window: MainWindow) -> RigBody:
    """Open a body whose forearms cross at rest."""
    held = rigged_body()
    assert held.rig is not None
    moved = np.where(held.rest_vertices[:, :1] > 0.5, [-1.2, 0.0, -0.01], 0.0)
    rig = replace(held.rig, points=held.rig.points + moved[:, None])
    touching = replace(held, rest_vertices=held.rest_vertices + moved, rig=rig)
    model = RigBody.of(touching).with_rules(ContactRules())
    window.document.set_model(model)
    settled(qtbot, window)
    return model


def settled(qtbot: QtBot, window: MainWindow) -> None:
    qtbot.waitUntil(lambda: not window.document.tasks.busy, timeout=PATIENCE)
    rest(qtbot, window)


def entry(window: MainWindow, name: str) -> object:
    window.meshes.menu.aboutToShow.emit()
    (action,) = (one for one in window.meshes.menu.actions() if one.text() == name)
    return action


def coverage(picture: QIcon) -> float:
    """Return the number of thumbnail pixels that the body covers."""
    image = picture.pixmap(THUMBNAIL, THUMBNAIL).toImage()
    image = image.convertToFormat(QImage.Format.Format_RGBA8888)
    return float((np.frombuffer(image.constBits(), dtype=np.uint8)[3::4] / 255.0).sum())


def test_a_hidden_mesh_is_neither_drawn_nor_checked_until_it_is_shown(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    document, viewport = window.document, window.viewport
    assert window.meshes.menu.menuAction() in window.menus["&View"].actions()
    (group,) = (one for one in body.character.groups if one.name == ARM)
    assert document.motion.exact is not None
    assert document.motion.exact.colliding
    vertex = int(body.faces[group.faces[0]][0])
    viewport.menu_wanted.emit(None, vertex, window.mapToGlobal(QPoint(500, 300)))
    (menu,) = (held for held in window.findChildren(QMenu) if held.isVisible())
    (hide,) = (one for one in menu.actions() if one.text() == f"&Hide {ARM}")
    told: list[str] = []
    document.message.connect(told.append)
    hide.trigger()
    menu.close()
    settled(qtbot, window)
    assert told == [f"{ARM} is hidden and not checked; it is still posed and exported"]
    scene = viewport.scene
    assert scene is not None
    assert scene.surface.polydata.n_cells == len(body.faces) - len(group.faces)
    assert document.model.rules.left_out == (ARM,)
    assert not document.motion.exact.colliding
    assert f"Without {ARM}" in window.collision.exact.details.text()
    # A hidden mesh is not under the pointer, nor tinted.
    assert viewport.mouse is not None
    viewport.set_camera("Front", animated=False)
    rest(qtbot, window)
    drawn = np.unique(body.faces[np.setdiff1d(np.arange(len(body.faces)), group.faces)])
    for hidden in np.setdiff1d(body.faces[group.faces], drawn)[::7]:
        viewport.mouse.point_at(place_of(viewport, int(hidden)).toPointF())
        assert viewport.mouse.vertex is None or viewport.mouse.vertex in drawn
    viewport.tint_faces(group.faces)
    assert scene.selection.n_faces == 0
    take_picture(window, "hidden-mesh")
    pose = window.library._poses[0]
    without = coverage(window.library._picture(pose))
    # As when the character is opened again.
    document.set_model(document.model)
    settled(qtbot, window)
    assert window.meshes.hidden == (ARM,)
    action = entry(window, ARM)
    assert not action.isChecked()
    action.trigger()
    settled(qtbot, window)
    assert told[-1] == f"{ARM} is shown and checked"
    document.message.disconnect(told.append)
    assert window.meshes.hidden == ()
    assert document.model.rules.left_out == ()
    assert viewport.scene.surface.polydata.n_cells == len(body.faces)
    assert document.motion.exact.colliding
    assert coverage(window.library._picture(pose)) > 1.03 * without


def test_a_part_too_small_to_be_dragged_has_a_handle_that_moves_it(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    viewport, document = window.viewport, window.document
    scene, canvas, mouse = viewport.scene, viewport.canvas, viewport.mouse
    assert scene is not None
    assert canvas is not None
    assert mouse is not None
    viewport.set_camera("Front", animated=False)
    rest(qtbot, window)
    near, hips = scene.view, body.domain_names.index("Hips")
    handles = {}
    for times in (0.5, 1.2, 12.0):
        position = near.focus + times * (near.position - near.focus)
        scene.view = replace(near, position=position)
        mouse.mark(shown(window))
        handles[times] = [handle.domain for handle in mouse._handles if handle.is_shown]
    # Neither for large parts on the screen, nor for a small body.
    assert (handles[0.5], handles[12.0]) == ([], [])
    assert hips in handles[1.2]
    scene.view = replace(near, position=near.focus + 1.2 * (near.position - near.focus))
    canvas.redraw()
    rest(qtbot, window)
    size = (float(canvas.width()), float(canvas.height()))
    place = places_of(scene.view, scene.marks.handles, size)[handles[1.2].index(hips)]
    mouse.point_at(QPointF(*place))
    assert mouse.handle == hips
    assert viewport.hovered_domain == hips
    take_picture(window, "handle-of-the-hips")
    start = QPointF(*place).toPoint()
    QTest.mousePress(canvas, LEFT, Qt.KeyboardModifier.NoModifier, start)
    for step in range(1, 6):
        move_held(canvas, start + QPoint(0, 4 * step), Qt.KeyboardModifier.NoModifier)
    qtbot.waitUntil(lambda: not document.motion.moving, timeout=PATIENCE)
    QTest.mouseRelease(canvas, LEFT, Qt.KeyboardModifier.NoModifier, start + QPoint(0, 20))
    rest(qtbot, window)
    moved = (shown(window) - body.reference) / body.body_size
    of_part = [
        moved[body.space.vertex_domain == part].mean(axis=0)
        for part in range(len(body.domain_names))
    ]
    assert of_part[hips][2] < -0.02
    assert document.history.undo_stack.undoText() == "Drag Hips"
    (foot,) = (part for part, name in enumerate(body.domain_names) if name == "Left foot")
    assert np.abs(moved[body.space.vertex_domain == foot]).mean() < 0.005
    document.history.undo_stack.undo()


def test_what_counts_again_is_shown_and_one_mesh_is_left(
    qtbot: QtBot, window: MainWindow, body: RigBody
) -> None:
    entry(window, ARM).trigger()
    settled(qtbot, window)
    window.document.tasks.set_rules(ContactRules())
    settled(qtbot, window)
    assert window.meshes.hidden == ()
    names = [group.name for group in body.character.groups]
    left_out = tuple(names[1:])
    window.settings["hidden_meshes"] = tuple(f"{body.fingerprint} {name}" for name in left_out)
    window.document.tasks.set_rules(ContactRules(left_out=left_out))
    settled(qtbot, window)
    assert window.meshes.hidden == left_out
    assert not entry(window, names[0]).isEnabled()
    assert entry(window, names[1]).isEnabled()


def test_of_a_body_without_meshes_of_its_own_none_is_hidden(window: MainWindow) -> None:
    assert window.meshes.meshes == ()
    assert not window.meshes.menu.menuAction().isEnabled()
    assert window.meshes.mesh_at(0) is None


def test_rows_are_found_among_others() -> None:
    rows = np.array([[0, 1, 2], [2, 1, 0], [5, 6, 7]], dtype=np.int32)
    assert _rows_in(rows, np.array([[5, 6, 7], [0, 1, 2]])).tolist() == [True, False, True]
