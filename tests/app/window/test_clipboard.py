"""Copying and pasting a pose or a limb: with locks, with undo, never into another body."""

from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtCore import QMimeData, QPoint, Qt
from PySide6.QtGui import QGuiApplication
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QMenu
from pytestqt.qtbot import QtBot

from app.window.commands.edit import _KIND, paste_pose
from app.window.dialogs.questions import FailureDialog
from app.window.main_window import MainWindow
from lcollision_core.bodies import LearnedBody, RigBody
from lcollision_core.errors import LCollisionError
from tests.app.windows import rest
from tests.rigged_shapes import rigged_body

pytestmark = pytest.mark.one_window

CTRL = Qt.KeyboardModifier.ControlModifier


@pytest.fixture
def body(qtbot: QtBot, window: MainWindow) -> RigBody:
    model = RigBody.of(rigged_body())
    window.document.set_model(model)
    rest(qtbot, window)
    window.viewport.setFocus()
    return model


def vertex_of(body: RigBody, domain: str) -> int:
    return int(np.flatnonzero(body.space.vertex_domain == body.domain_names.index(domain))[0])


def choose(window: MainWindow, vertex: int, text: str) -> None:
    domain = int(window.document.model.space.vertex_domain[vertex])
    window.viewport.menu_wanted.emit(domain, vertex, window.mapToGlobal(QPoint(500, 300)))
    (menu,) = (held for held in window.findChildren(QMenu) if held.isVisible())
    (action,) = (one for one in menu.actions() if one.text().replace("&", "") == text)
    action.trigger()
    menu.close()


def test_a_pose_and_a_limb_of_it_are_pasted(window: MainWindow, body: RigBody) -> None:
    document = window.document
    held = np.random.default_rng(1).uniform(-0.2, 0.2, body.latent_size)
    document.motion.blend_towards(held, 1.0)
    QTest.keyClick(window, Qt.Key.Key_C, CTRL)
    assert window.statusBar().currentMessage() == "Copied the pose"
    document.motion.reset_all()
    QTest.keyClick(window, Qt.Key.Key_V, CTRL)
    np.testing.assert_array_equal(document.history.latent, held)
    assert document.history.undo_stack.undoText() == "Paste pose"
    document.history.undo()
    assert not document.history.latent.any()
    # Only one arm: all of it, and nothing else.
    forearm = vertex_of(body, "Left forearm")
    choose(window, forearm, "Paste into limb")
    moved = document.history.latent != 0.0
    arm = [name for name in body.domain_names if name.startswith("Left") and "arm" in name]
    assert body.space.codes_of(map(body.domain_names.index, arm))[moved].any()
    legs = [index for index, name in enumerate(body.domain_names) if "thigh" in name]
    assert not moved[body.space.codes_of(legs)].any()
    assert not moved[body.space.codes_of([body.domain_names.index("Right forearm")])].any()
    np.testing.assert_array_equal(document.history.latent[moved], held[moved])
    assert moved[body.space.codes_of([body.domain_names.index("Left upper arm")])].all()
    # A copied limb is pasted to the same limb, also by Ctrl+V.
    choose(window, forearm, "Copy limb")
    document.motion.reset_all()
    document.motion.set_locked(body.domain_names.index("Left forearm"), True)
    QTest.keyClick(window, Qt.Key.Key_V, CTRL)
    assert document.history.undo_stack.undoText() == "Paste limb"
    now = document.history.latent != 0.0
    locked = body.space.codes_of([body.domain_names.index("Left forearm")])
    np.testing.assert_array_equal(now, moved & ~locked)
    choose(window, vertex_of(body, "Left thigh"), "Paste into limb")
    (dialog,) = window.findChildren(FailureDialog)
    assert "has no values for this limb" in dialog.failure.headline
    dialog.close()


def test_what_is_no_pose_of_this_body_is_refused(
    window: MainWindow, editor_model: LearnedBody, body: RigBody
) -> None:
    QTest.keyClick(window, Qt.Key.Key_C, CTRL)
    window.document.set_model(editor_model)
    with pytest.raises(LCollisionError, match=f"is one of “{body.name}”, not of"):
        paste_pose(window.document)
    for content in (b"", b"[]", b'{"latent": [1e999]}', b"\xff" * 9):
        data = QMimeData()
        data.setData(_KIND, content)
        QGuiApplication.clipboard().setMimeData(data)
        with pytest.raises(LCollisionError, match="there is no pose on the clipboard"):
            paste_pose(window.document)
    # A text field handles its own keys.
    QGuiApplication.clipboard().setText("shoulder")
    window.sliders.filter.setFocus()
    QTest.keyClick(window.sliders.filter, Qt.Key.Key_V, CTRL)
    assert window.sliders.filter.text() == "shoulder"
