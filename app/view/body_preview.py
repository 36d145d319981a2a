"""A small picture of a body that slowly turns, before it is opened as anything."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QRectF, QSize, Qt, QTimer, Slot
from PySide6.QtGui import (
    QColor,
    QHideEvent,
    QImage,
    QLinearGradient,
    QPainter,
    QPainterPath,
    QPaintEvent,
    QShowEvent,
)
from PySide6.QtWidgets import QWidget
from scipy.spatial.transform import Rotation, Slerp

from app.view.camera import VIEW_ANGLE
from app.view.offscreen import off_screen_plotter
from app.view.theme import current_theme

if TYPE_CHECKING:
    import pyvista as pv

_FRAME_MILLISECONDS = 80
_LEAST_REST = 3
"""Times as long as drawing takes are left to the window between two pictures, at least."""

_DEGREES_A_FRAME = 2.0
_FRAMES_A_POSE = 30
_FRAMES_UPRIGHT = 8
"""In which the body turns to another axis."""

_MARGIN, _ELEVATION = 1.06, 0.12
_MOST_AIMED_AT = 4000
"""Vertices, evenly spaced, that tell how large the body is."""

_ROUNDED = 8

_UPRIGHT = (
    Rotation.from_euler("y", -90.0, degrees=True),
    Rotation.from_euler("x", 90.0, degrees=True),
    Rotation.identity(),
)
"""What turns x, y and z up."""

FloatArray = npt.NDArray[np.float32]


class BodyPreview(QWidget):
    """Shows some poses of a body, one after the other, from all sides.

    It draws off the screen, in the window's thread, and only while it is seen.

    Attributes
    ----------
    up_axis : 0, 1 or 2 for x, y or z
    """

    def __init__(self) -> None:
        super().__init__()
        self.setMinimumSize(180, 200)
        self.setAccessibleName("Preview of the body")
        self.up_axis = 2
        self._text = ""
        self._plotter: pv.Plotter | None = None
        self._shown = self._normals = np.empty((0, 0, 3), dtype=np.float32)
        self._picture: QImage | None = None
        self._turn, self._frame = 0.0, 0
        self._from, self._since_turned = _UPRIGHT[2], _FRAMES_UPRIGHT
        self._timer = QTimer(self, interval=_FRAME_MILLISECONDS)
        self._timer.timeout.connect(self._on_frame)

    @property
    def has_body(self) -> bool:
        """Whether there is something to see."""
        return self._plotter is not None

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Ask for a portrait."""
        return QSize(250, 320)

    def show_body(
        self,
        faces: npt.NDArray[np.int32],
        shown: FloatArray,
        normals: FloatArray,
        up_axis: int,
    ) -> None:
        """Show another body.

        Parameters
        ----------
        faces : (F, 3) array
        shown, normals : (P, V, 3) arrays, of its poses
        up_axis : 0, 1 or 2
        """
        # Loads VTK: not before there is something to see.
        from app.view.surface import Surface, body_actor

        self.clear("")
        centre = 0.5 * (shown[0].min(axis=0) + shown[0].max(axis=0))
        self._shown, self._normals = shown - centre, normals
        self.up_axis = up_axis
        self._from, self._since_turned = _UPRIGHT[up_axis], _FRAMES_UPRIGHT
        self._turn, self._frame = 25.0, 0
        self._plotter = off_screen_plotter(*self._pixels())
        self._plotter.enable_anti_aliasing("msaa", multi_samples=4)
        self._surface = Surface(faces, self._shown.shape[1])
        self._body = body_actor(self._surface.polydata, coloured=False)
        self._plotter.renderer.AddActor(self._body)
        if self.isVisible():
            self._timer.start()
        self._on_frame()

    def set_up(self, up_axis: int) -> None:
        """Turn the body so that another axis is up."""
        if up_axis != self.up_axis:
            self._from, self._since_turned = self._rotation(), 0
            self.up_axis = up_axis

    def clear(self, text: str) -> None:
        """Show a text and no body."""
        self._timer.stop()
        if self._plotter is not None:
            self._plotter.close()
        self._plotter = self._picture = None
        self._text = text
        self.update()

    def showEvent(self, event: QShowEvent) -> None:  # noqa: N802 - Qt's name
        """Begin to turn."""
        super().showEvent(event)
        if self.has_body:
            self._timer.start()

    def hideEvent(self, event: QHideEvent) -> None:  # noqa: N802 - Qt's name
        """Stop turning, as nobody looks."""
        super().hideEvent(event)
        self._timer.stop()

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Draw in the new theme."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.StyleChange and self.has_body:
            self._draw()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802 - Qt's names
        """Draw the body, or the text, on the sky of the window's view."""
        theme, painter = current_theme(), QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        frame = QRectF(self.rect()).adjusted(0.5, 0.5, -0.5, -0.5)
        sky = QLinearGradient(frame.topLeft(), frame.bottomLeft())
        sky.setColorAt(0.0, QColor(theme.sky_top))
        sky.setColorAt(1.0, QColor(theme.sky_bottom))
        shape = QPainterPath()
        shape.addRoundedRect(frame, _ROUNDED, _ROUNDED)
        painter.fillPath(shape, sky)
        if self._picture is not None:
            painter.setClipPath(shape)
            painter.drawImage(self.rect(), self._picture)
            painter.setClipping(False)
        elif self._text:
            painter.setPen(QColor(theme.muted))
            flags = int(Qt.AlignmentFlag.AlignCenter) | int(Qt.TextFlag.TextWordWrap)
            painter.drawText(self.rect().adjusted(16, 16, -16, -16), flags, self._text)
        painter.setPen(QColor(theme.border))
        painter.drawPath(shape)

    def _pixels(self) -> tuple[int, int]:
        ratio = self.devicePixelRatioF()
        return max(1, round(ratio * self.width())), max(1, round(ratio * self.height()))

    def _rotation(self) -> Rotation:
        """Return what turns the body upright, on its way from the axis before."""
        share = self._since_turned / _FRAMES_UPRIGHT
        if share >= 1.0:
            return _UPRIGHT[self.up_axis]
        both = Rotation.concatenate([self._from, _UPRIGHT[self.up_axis]])
        return Slerp([0.0, 1.0], both)([share * share * (3.0 - 2.0 * share)])[0]

    @Slot()
    def _on_frame(self) -> None:
        began = time.monotonic()
        self._draw()
        taken = round(1000.0 * (time.monotonic() - began))
        self._timer.setInterval(max(_FRAME_MILLISECONDS, (1 + _LEAST_REST) * taken))
        self._frame += 1
        self._turn = (self._turn + _DEGREES_A_FRAME) % 360.0
        self._since_turned += 1

    def _draw(self) -> None:
        if self._plotter is None:
            return
        plotter, theme = self._plotter, current_theme()
        pose = self._frame // _FRAMES_A_POSE % len(self._shown)
        turned = Rotation.from_euler("z", self._turn, degrees=True) * self._rotation()
        matrix = turned.as_matrix().T.astype(np.float32)
        surface = self._surface
        surface.vertices[:] = self._shown[pose] @ matrix
        surface.normals[:] = self._normals[pose] @ matrix
        plotter.renderer.set_background(theme.sky_bottom, top=theme.sky_top)
        self._body.prop.color = theme.skin
        self._aim(plotter)
        width, height = self._pixels()
        if tuple(plotter.window_size) != (width, height):
            plotter.window_size = (width, height)
        plotter.render()
        pixels = np.ascontiguousarray(plotter.screenshot(return_img=True)[:, :, :3])
        rows, columns = pixels.shape[:2]
        self._picture = QImage(
            pixels.data, columns, rows, 3 * columns, QImage.Format.Format_RGB888
        ).copy()
        self.update()

    def _aim(self, plotter: pv.Plotter) -> None:
        """Look at all poses together, a little from above."""
        points = self._shown.reshape(-1, 3)
        points = points[:: max(1, len(points) // _MOST_AIMED_AT)]
        upright = points @ self._rotation().as_matrix().T.astype(np.float32)
        low, high = float(upright[:, 2].min()), float(upright[:, 2].max())
        radius = float(np.sqrt((upright[:, :2] ** 2).sum(axis=1).max()))
        width, height = self._pixels()
        half = np.tan(np.radians(VIEW_ANGLE / 2.0))
        distance = _MARGIN * max(0.5 * (high - low) / half, radius / (half * width / height))
        focus = np.array([0.0, 0.0, 0.5 * (low + high)])
        camera = plotter.camera
        camera.view_angle = VIEW_ANGLE
        camera.focal_point = focus
        camera.position = focus + (distance + 0.3 * radius) * np.array([0.0, -1.0, _ELEVATION])
        camera.up = (0.0, 0.0, 1.0)
        plotter.renderer.ResetCameraClippingRange()
        # Otherwise pyvista turns the camera to a default view at the first picture.
        plotter.renderer.camera_set = True
