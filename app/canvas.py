"""The widget in which VTK draws: one picture at a time, rough while it moves, smooth at rest."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QPointF, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QDragEnterEvent, QDropEvent, QKeyEvent, QMouseEvent, QResizeEvent
from pyvistaqt import QtInteractor
from vtkmodules.vtkRenderingCore import vtkActor, vtkCellPicker

if TYPE_CHECKING:
    from PySide6.QtWidgets import QWidget

_REST_MILLISECONDS = 220
_HOVER_MILLISECONDS = 30
_SMOOTH_SAMPLES = 4
_FAST_SECONDS = 0.006


class Canvas(QtInteractor):  # type: ignore[misc] # pyvistaqt has no types
    """Draws when told to, and as often as Qt paints, never twice for one event.

    Parameters
    ----------
    before_paint : is called before each picture, to bring the scene up to date; must leave widgets
        alone: showing or resizing one lays out the window, which may resize this canvas, and Qt
        then frees the framebuffer and the texture that are being drawn into
    parent : of the widget

    Signals
    -------
    painted : float, the seconds that drawing one picture took; what it calls must leave widgets
        alone too, or be connected queued
    hovered : QPointF in the widget, or None as the pointer leaves; while no button is pressed
    camera_moved : the user has turned, shifted or zoomed
    """

    painted = Signal(float)
    hovered = Signal(object)
    camera_moved = Signal()

    def __init__(self, before_paint: Callable[[], None], parent: QWidget | None = None) -> None:
        # The default for auto_update draws five times a second for ever.
        super().__init__(parent, auto_update=False, multi_samples=0)
        self.setAcceptDrops(False)
        self._before_paint = before_paint
        self._painting = self._settled = self._shut = self._fast = False
        self.n_painted = 0
        self._rest = QTimer(self, singleShot=True, interval=_REST_MILLISECONDS)
        self._rest.timeout.connect(self._on_rest)
        self._hover = QTimer(self, singleShot=True, interval=_HOVER_MILLISECONDS)
        self._hover.timeout.connect(self._on_hover)
        self._pointer: QPointF | None = None
        self._picker = vtkCellPicker()
        self._picker.PickFromListOn()
        self._picker.SetTolerance(0.0)
        self.enable_terrain_style(mouse_wheel_zooms=True, shift_pans=True)
        # The camera's style would draw at once for each motion of the mouse, and Qt then again.
        self._vtk_interactor = self.ren_win.GetInteractor()
        self._vtk_interactor.EnableRenderOff()
        self._observer = self._vtk_interactor.AddObserver("RenderEvent", self._on_render_wanted)

    def redraw(self) -> None:
        """Ask for a rough picture soon, and a smooth one when nothing moves any more."""
        if self._shut:
            return
        self._settled = False
        if not self._fast:
            self.ren_win.SetMultiSamples(0)
            self._rest.start()
        self.update()

    @property
    def is_settled(self) -> bool:
        """Whether the smooth picture of the scene is drawn, and no other is asked for."""
        return self._settled

    def pick_vertex(self, place: QPointF, actor: vtkActor) -> int | None:
        """Return the vertex that is seen at a place.

        Parameters
        ----------
        place : in the widget, in device-independent pixels
        actor : the mesh
        """
        ratio = self.devicePixelRatioF()
        self._picker.InitializePickList()
        self._picker.AddPickList(actor)
        x, y = place.x() * ratio, (self.height() - 1 - place.y()) * ratio
        if not self._picker.Pick(x, y, 0.0, self.renderer) or self._picker.GetCellId() < 0:
            return None
        return int(self._picker.GetPointId())

    def place_of(self, point: npt.NDArray[Any]) -> QPointF:
        """Return where a point of the scene is seen.

        Parameters
        ----------
        point : (3,) array, in the data's unit

        Returns
        -------
        place : in the widget, in device-independent pixels
        """
        ratio = self.devicePixelRatioF()
        self.renderer.SetWorldPoint(*np.asarray(point, dtype=np.float64).tolist(), 1.0)
        self.renderer.WorldToDisplay()
        x, y, _ = self.renderer.GetDisplayPoint()
        return QPointF(x / ratio, self.height() - 1 - y / ratio)

    def shut_down(self) -> None:
        """Stop the timers and free what is on the graphics card; nothing is drawn afterwards."""
        if self._shut:
            return
        self._shut = True
        self._rest.stop()
        self._hover.stop()
        self._vtk_interactor.RemoveObserver(self._observer)
        self._vtk_interactor.EnableRenderOn()
        del self._vtk_interactor
        self._before_paint = lambda: None
        self.close()

    def paintGL(self) -> None:  # noqa: N802 - Qt's name
        """Bring the scene up to date and draw it."""
        if self._shut:
            return
        self._before_paint()
        start = time.perf_counter()
        self._painting = True
        self._vtk_interactor.EnableRenderOn()
        try:
            super().paintGL()
        finally:
            self._vtk_interactor.EnableRenderOff()
            self._painting = False
        seconds = time.perf_counter() - start
        self._settled = self.ren_win.GetMultiSamples() > 0
        # A graphics card draws smooth pictures as fast as rough ones: they need not alternate.
        self._fast = self._settled and seconds < _FAST_SECONDS
        self.n_painted += 1
        self.painted.emit(seconds)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Draw rough pictures while the window is pulled."""
        super().resizeEvent(event)
        self.redraw()

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802 - Qt's name
        """Leave keys to the window: VTK has shortcuts of its own."""
        event.ignore()

    def keyReleaseEvent(self, event: QKeyEvent) -> None:  # noqa: N802 - Qt's name
        """Leave keys to the window."""
        event.ignore()

    def dragEnterEvent(self, event: QDragEnterEvent) -> None:  # noqa: N802 - Qt's name
        """Leave files to the window: pyvistaqt would add any as a mesh."""
        event.ignore()

    def dropEvent(self, event: QDropEvent) -> None:  # noqa: N802 - Qt's name
        """Leave files to the window."""
        event.ignore()

    def mouseMoveEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """Turn the camera while a button is pressed, tell of the pointer otherwise."""
        super().mouseMoveEvent(event)
        if event.buttons() == Qt.MouseButton.NoButton:
            self._pointer = event.position()
            if not self._hover.isActive():
                self._hover.start()

    def leaveEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Tell that the pointer has gone."""
        self._hover.stop()
        self._pointer = None
        if not self._shut:
            super().leaveEvent(event)
            self.hovered.emit(None)

    @Slot()
    def _on_rest(self) -> None:
        self.ren_win.SetMultiSamples(_SMOOTH_SAMPLES)
        self.update()
        if self.underMouse() and self._pointer is not None:
            # Something else may lie beneath the pointer now.
            self._hover.start()

    @Slot()
    def _on_hover(self) -> None:
        self.hovered.emit(self._pointer)

    def _on_render_wanted(self, *_: object) -> None:
        if not self._painting:
            self.redraw()
            self.camera_moved.emit()
