"""The body's context menu: its entries for the part under the pointer, and the camera's icons."""

from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtCore import QEvent, QPoint
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QApplication, QMenu
from pytestqt.qtbot import QtBot

from app.view.camera import CAMERAS
from app.view.shading import Shading
from app.view.theme import pixmap
from app.window.main_window import MainWindow
from lcollision_core.tasks.words import heading
from tests.app.windows import PATIENCE, rest, take_picture

pytestmark = pytest.mark.one_window


def opened(qtbot: QtBot, window: MainWindow, domain: int | None) -> QMenu:
    window.viewport.menu_wanted.emit(domain, None, window.mapToGlobal(QPoint(500, 300)))
    found = [menu for menu in window.findChildren(QMenu) if menu.isVisible()]
    qtbot.waitUntil(lambda: bool(found), timeout=PATIENCE)
    return found[0]


def chosen(menu: QMenu, start: str) -> QAction:
    (action,) = (a for a in menu.actions() if a.text().replace("&", "").startswith(start))
    return action


def test_a_part_is_locked_reset_and_found_from_the_body(qtbot: QtBot, window: MainWindow) -> None:
    document, scene = window.document, window.viewport.scene
    assert scene is not None
    name = heading(document.model.domain_names[1])
    document.motion.blend_towards(np.full(document.model.latent_size, 0.1), 1.0)
    rest(qtbot, window)
    menu = opened(qtbot, window, 1)
    assert scene.outline.is_shown
    chosen(menu, f"Reset {name}").trigger()
    codes = document.model.latent_space.groups[2].codes
    assert (document.history.latent[codes] == 0.0).all()
    assert document.history.latent[1] == 0.0
    assert (
        np.count_nonzero(document.history.latent)
        == len(document.history.latent) - (codes.stop - codes.start) - 1
    )
    assert document.history.undo_stack.undoText().lower() == f"reset {name}".lower()
    chosen(menu, f"Lock {name}").trigger()
    assert document.motion.locked_domains == {1}
    menu.close()
    qtbot.waitUntil(lambda: not scene.outline.is_shown, timeout=PATIENCE)
    menu = opened(qtbot, window, 1)
    assert chosen(menu, f"Lock {name}").isChecked()
    assert not chosen(menu, f"Reset {name}").isEnabled()
    window.docks["sliders"].hide()
    window.sliders.filter.setText("nothing")
    chosen(menu, "Show in sliders").trigger()
    group = window.sliders.groups[2]
    qtbot.waitUntil(lambda: group.rows != [] and group.rows[0].isVisible(), timeout=PATIENCE)
    assert not group.header.visibleRegion().isEmpty()
    chosen(menu, f"Lock {name}").trigger()
    assert document.motion.locked_domains == set()
    take_picture(window, "body menu")
    menu.close()


def test_the_rest_of_the_menu_is_made_of_the_window_s_own_actions(
    qtbot: QtBot, window: MainWindow
) -> None:
    menu = opened(qtbot, window, None)
    texts = [action.text().replace("&", "") for action in menu.actions()]
    assert not any(text.startswith(("Lock", "Show in sliders")) for text in texts)
    for key in ("reset_camera", "ghost", "resolve", "reset", "undo"):
        assert window.actions_by_key[key] in menu.actions()
    submenus = {a.text().replace("&", ""): a.menu() for a in menu.actions() if a.menu()}
    assert set(submenus) == {"Colour by", "Camera view"}
    chosen(submenus["Colour by"], "Exact").trigger()
    assert window.viewport.shading is Shading.EXACT
    assert window.viewport.scene.view is not None
    before = window.viewport.scene.view.position
    chosen(submenus["Camera view"], "Back").trigger()
    rest(qtbot, window)
    assert np.linalg.norm(window.viewport.scene.view.position - before) > 1.0
    menu.close()


def test_the_menu_opens_again_after_it_is_closed(window: MainWindow) -> None:
    for _ in range(3):
        window.viewport.menu_wanted.emit(1, None, window.mapToGlobal(QPoint(500, 300)))
        # Searching the window's children would hide the bug: it creates new wrappers.
        menu = QApplication.activePopupWidget()
        assert isinstance(menu, QMenu)
        assert chosen(menu, "Camera view").isEnabled()
        menu.close()
        # A closed menu is deleted, without anything of the window.
        QApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)


@pytest.mark.variants
@pytest.mark.parametrize("device_pixel_ratio", [1.0, 2.0])
def test_each_camera_has_an_icon_of_its_own(window: MainWindow, device_pixel_ratio: float) -> None:
    drawn = []
    for name in CAMERAS:
        picture = pixmap(f"camera-{name.lower()}", "#102030", 20, device_pixel_ratio).toImage()
        drawn.append(np.frombuffer(picture.constBits(), dtype=np.uint8).astype(int))
        action = window.actions_by_key[f"camera-{name.lower()}"]
        assert not action.icon().pixmap(20, 20).toImage().isNull()
    for first in range(6):
        for second in range(first):
            assert (np.abs(drawn[first] - drawn[second]) > 60).sum() > 30 * device_pixel_ratio
