"""The right panel: what came of Resolve is seen whole."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QPoint, QRect
from PySide6.QtWidgets import QScrollArea, QWidget
from pytestqt.qtbot import QtBot

from app.main_window import MainWindow
from lcollision_core.model import PoseModel, sample_poses
from lcollision_core.resolve import ResolveResult
from tests.app.windows import PATIENCE, rest

FloatArray = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def colliding(editor_model: PoseModel) -> FloatArray:
    return sample_poses(editor_model, 1, 0, colliding=True)[0]


def resolve(qtbot: QtBot, window: MainWindow) -> ResolveResult:
    with qtbot.waitSignal(window.document.solve_finished, timeout=PATIENCE) as told:
        window.actions_by_key["resolve"].trigger()
    rest(qtbot, window)
    assert told.args is not None
    result = told.args[0]
    assert isinstance(result, ResolveResult)
    return result


def scrolled(window: MainWindow) -> QScrollArea:
    (area,) = window.collision.findChildren(QScrollArea)
    return area


def is_seen_whole(window: MainWindow, widget: QWidget) -> bool:
    seen = scrolled(window).viewport()
    return widget.isVisible() and seen.rect().contains(
        QRect(widget.mapTo(seen, QPoint(0, 0)), widget.size())
    )


def test_the_result_of_resolve_scrolls_into_sight(
    qtbot: QtBot, window: MainWindow, colliding: FloatArray
) -> None:
    card = window.collision.resolve
    window.resize(1280, 560)
    window.document.set_latent(colliding, "Test")
    rest(qtbot, window)
    assert scrolled(window).verticalScrollBar().value() == 0
    resolve(qtbot, window)
    assert scrolled(window).verticalScrollBar().maximum() > 0
    qtbot.waitUntil(lambda: is_seen_whole(window, card.outcome), timeout=PATIENCE)
