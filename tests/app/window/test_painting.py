"""Painting of a window while a pose changes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PySide6.QtCore import QEvent, QObject
from PySide6.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from app.editing import live_pose
from app.window import event_filters
from app.window.main_window import MainWindow
from lcollision_core.bodies import sample_poses
from tests.app.windows import PATIENCE, rest


class LayoutCounter(QObject):
    """Counts the layout requests of watched widgets."""

    n_asked = 0

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: ARG002, N802
        self.n_asked += event.type() is QEvent.Type.LayoutRequest
        return False


def test_the_window_is_painted_only_once_all_follows_the_pose(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_pose, "_QUICK_SECONDS", math.inf)
    monkeypatch.setattr(event_filters, "_PATIENCE_MILLISECONDS", PATIENCE)
    document, canvas = window.document, window.viewport.canvas
    assert canvas is not None
    bars = [row.bar for row in window.collision.prediction.rows]
    free = np.array(document.history.latent)
    colliding = sample_poses(document.model, 1, 0, colliding=True)[0]
    # After the first of these frames, the next one is known to be quick.
    document.motion.blend_towards(0.5 * colliding, 1.0)
    rest(qtbot, window)
    done: list[str] = []
    # Connected last, so it is called after all panels.
    document.motion.frame_changed.connect(lambda: done.append("followed"))
    canvas.frameSwapped.connect(lambda: done.append("painted"))
    for latent in (colliding, free):
        before = [bar.value() for bar in bars]
        done.clear()
        document.motion.blend_towards(latent, 1.0)
        qtbot.waitUntil(lambda: "painted" in done, timeout=PATIENCE)
        assert done[:2] == ["followed", "painted"]
        assert window.viewport.shown_frame is document.motion.frame
        assert [bar.value() for bar in bars] != before
        rest(qtbot, window)


def test_a_row_is_laid_out_only_where_its_number_may_need_more_width(window: MainWindow) -> None:
    row = window.sliders.row_of(0)
    typed = row.field.minimum(), row.field.maximum()
    # Exclude the layout requests of opening the window.
    QApplication.sendPostedEvents(None, QEvent.Type.LayoutRequest)
    counter = LayoutCounter()
    row.installEventFilter(counter)
    for number, n_asked in ((0.1, 0), (-0.1, 0), (10 * typed[1], 1), (0.1, 2), (0.2, 2)):
        row.show_number(number)
        QApplication.sendPostedEvents(None, QEvent.Type.LayoutRequest)
        assert counter.n_asked == n_asked
    assert (row.field.minimum(), row.field.maximum()) == typed
