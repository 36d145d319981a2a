"""Helpers of viewport tests: pictures of the screen, and positions on it."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QPoint, QPointF, Qt
from PySide6.QtGui import QGuiApplication, QImage, QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot

from app.view.canvas import Canvas
from app.view.viewport import Viewport

SIDE = 420


def dispose(shown: Viewport) -> None:
    shown.shut_down()
    shown.close()
    shown.deleteLater()
    QApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)


def rest(qtbot: QtBot, viewport: Viewport) -> None:
    """Wait until the smooth picture of the newest pose is on the screen."""

    # Booleans: pytest formats the operands of a failed assertion, here whole frames, at each look.
    def is_settled() -> bool:
        motion, canvas = viewport._document.motion, viewport.canvas
        return (
            motion.frame is not None
            and motion.frame.latent is viewport._document.history.latent
            and viewport.shown_frame is motion.frame
            and canvas is not None
            and canvas.is_settled
            and viewport.is_at_rest
        )

    qtbot.waitUntil(is_settled, timeout=20_000)


def pixels(viewport: Viewport) -> npt.NDArray[np.int64]:
    """Return the viewport's pixels on the screen, (SIDE, SIDE, 3)."""
    # Qt passes the picture to the screen after it is drawn.
    QTest.qWait(30)
    image = QGuiApplication.primaryScreen().grabWindow(viewport.winId()).toImage()
    image = image.convertToFormat(QImage.Format.Format_RGB888)
    rows = np.frombuffer(image.constBits(), dtype=np.uint8).reshape(image.height(), -1)
    return rows[:, : 3 * image.width()].reshape(image.height(), image.width(), 3).astype(int)


def steady_pixels(qtbot: QtBot, viewport: Viewport) -> npt.NDArray[np.int64]:
    """Return the viewport's pixels once they are stable: a busy machine lags."""
    shown = [pixels(viewport)]

    def stays() -> bool:
        qtbot.wait(100)
        shown.append(pixels(viewport))
        return not changed(*shown[-2:]).any()

    qtbot.waitUntil(stays, timeout=20_000)
    return shown[-1]


def changed(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    return np.abs(after - before).sum(axis=2) > 24


def on_screen(canvas: Canvas, point: npt.NDArray[np.floating]) -> QPointF:
    """Return the position of a (3,) point of the scene in the widget, in pixels of the window."""
    renderer, ratio = canvas.renderer, canvas.devicePixelRatioF()
    renderer.SetWorldPoint(*point.tolist(), 1.0)
    renderer.WorldToDisplay()
    x, y, _ = renderer.GetDisplayPoint()
    return QPointF(x / ratio, canvas.height() - 1 - y / ratio)


def place_of(viewport: Viewport, vertex: int) -> QPoint:
    assert viewport.canvas is not None
    assert viewport.scene is not None
    return on_screen(viewport.canvas, viewport.scene.surface.vertices[vertex]).toPoint()


def point_at(qtbot: QtBot, viewport: Viewport, vertex: int) -> QPoint:
    """Move the pointer to a visible vertex until the viewport notices; return its position."""
    canvas, place = viewport.canvas, place_of(viewport, vertex)
    assert canvas is not None

    def is_known() -> bool:
        # A pointer that is already there, from an earlier test, does not move.
        QTest.mouseMove(canvas, QPoint(3, 3))
        qtbot.wait(60)
        QTest.mouseMove(canvas, place)
        for _ in range(40):
            # A busy machine picks late.
            qtbot.wait(50)
            if viewport.pointed_vertex == vertex:
                return True
        return False

    qtbot.waitUntil(is_known, timeout=20_000)
    return place


def double_click(
    widget: QWidget, place: QPoint, button: Qt.MouseButton = Qt.MouseButton.LeftButton
) -> None:
    """Double-click and release the button: Qt's own double-click keeps it pressed."""
    QTest.mouseDClick(widget, button, pos=place)
    QTest.mouseRelease(widget, button, pos=place)


def point_beside(qtbot: QtBot, viewport: Viewport) -> None:
    """Move the pointer to a corner, beside the body, until the viewport notices."""
    canvas = viewport.canvas
    assert canvas is not None

    def is_known() -> bool:
        for there in (QPoint(6, 6), QPoint(3, 3)):
            QTest.mouseMove(canvas, there)
            qtbot.wait(60)
        return viewport.pointed_vertex is None

    qtbot.waitUntil(is_known, timeout=20_000)


def seen_vertex(viewport: Viewport, domain: int, among: Collection[int] | None = None) -> int:
    """Return a visible vertex of a domain, not right at the silhouette.

    It is one of `among` if given.
    """
    canvas, scene = viewport.canvas, viewport.scene
    assert canvas is not None
    assert scene is not None
    mask = viewport._document.model.attention_mask
    around = [QPointF(x, y) for x in (-2, 2) for y in (-2, 2)]
    for vertex in np.argsort(-mask[domain]).tolist():
        if among is not None and vertex not in among:
            continue
        # Use the pixel that the pointer will be on.
        place = QPointF(place_of(viewport, vertex))
        picked = canvas.pick(place, scene.body)
        is_inside = all(canvas.pick(place + step, scene.body) is not None for step in around)
        if picked is not None and picked[0] == vertex and is_inside:
            return vertex
    raise AssertionError("no vertex of the domain is seen")


def roll(
    canvas: Canvas,
    place: QPoint,
    notches: float,
    keys: Qt.KeyboardModifier = Qt.KeyboardModifier.NoModifier,
) -> None:
    """Turn the wheel, or move two fingers on a touchpad, over a position on the canvas."""
    turned = QPoint(0, round(120 * notches))
    no_buttons = Qt.MouseButton.NoButton
    phase, where = Qt.ScrollPhase.NoScrollPhase, canvas.mapToGlobal(place)
    event = QWheelEvent(
        QPointF(place), QPointF(where), QPoint(), turned, no_buttons, keys, phase, False
    )
    QApplication.sendEvent(canvas, event)
