"""The widget in which VTK draws: one picture at a time, rough while it moves, smooth at rest."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import shiboken6
from PySide6.QtCore import QEvent, QPointF, Qt, QTimer, Signal, Slot
from PySide6.QtGui import (
    QContextMenuEvent,
    QKeyEvent,
    QMouseEvent,
    QNativeGestureEvent,
    QResizeEvent,
    QWheelEvent,
)
from pyvistaqt import QtInteractor
from vtkmodules.vtkRenderingCore import vtkActor, vtkCellPicker

if TYPE_CHECKING:
    from PySide6.QtWidgets import QWidget

_REST_MILLISECONDS = 220
_HOVER_MILLISECONDS = 30
_SMOOTH_SAMPLES = 4
_NOTCH = 120.0  # of a wheel, in eighths of a degree
_CLICK = 4
"""Pixels that the pointer may move in a click."""

_KEYS_OF_DRAGS = {Qt.Key.Key_Escape: 0.0, Qt.Key.Key_PageUp: 1.0, Qt.Key.Key_PageDown: -1.0}
"""Keys that a drag takes before the window, and the notches of the wheel that they stand for."""

_FOR_THE_WINDOW = (
    QEvent.Type.KeyPress,
    QEvent.Type.KeyRelease,
    QEvent.Type.DragEnter,
    QEvent.Type.Drop,
)
"""VTK binds keys itself, and pyvistaqt would add any dropped file as a mesh."""

_SLOW_SECONDS, _FAST_SECONDS = 0.020, 0.012
"""A smooth picture that takes longer makes a drag stutter; one that takes less leaves time for
other work before the next one."""
_SLOW_PICTURES = 3


class Smoothness:
    """Whether pictures are drawn with smooth edges while something moves, by how long they take.

    They are until some in a row are slow, as where no graphics card helps; then rough ones are,
    until a smooth one, as at rest, is fast. Between the two limits nothing changes.
    """

    def __init__(self) -> None:
        self._n_slow = 0

    @property
    def while_moving(self) -> bool:
        """Whether the next picture of a motion is to be smooth."""
        return self._n_slow < _SLOW_PICTURES

    def note(self, seconds: float) -> None:
        """Record how long a smooth picture took."""
        if seconds < _FAST_SECONDS:
            self._n_slow = 0
        elif seconds > _SLOW_SECONDS:
            self._n_slow += 1
        elif self.while_moving:
            self._n_slow = 0


class Canvas(QtInteractor):  # type: ignore[misc] # pyvistaqt has no types
    """Draws on request and whenever Qt paints, once for each event.

    Parameters
    ----------
    before_paint : is called before each picture, to bring the scene up to date; must leave widgets
        alone: showing or resizing one lays out the window, which may resize this canvas, and Qt
        then frees the framebuffer and the texture that are being drawn into
    parent : of the widget

    Attributes
    ----------
    n_painted : how many pictures have been drawn
    is_smooth : whether the next one has smooth edges
    is_settled : whether the smooth picture of the scene is drawn, and no other is asked for
    is_dragging : whether a button is pressed and the pointer has moved since

    Signals
    -------
    painted : float, the seconds that drawing one picture took; what it calls must leave widgets
        alone too, or be connected queued
    hovered : QPointF in the widget, or None as the pointer leaves; while no button is pressed
    drag_began : QPointF where a button was pressed, Qt.MouseButton, and the Qt.KeyboardModifiers;
        once the pointer has moved too far for a click
    dragged : QPointF, where the pointer is now
    drag_ended : bool, whether by Escape
    double_clicked : QPointF
    wheel_turned : QPointF, float, in notches, and Qt.KeyboardModifiers; also by keys in a drag
    pinched : QPointF and float, the factor by which two fingers were spread
    menu_wanted : QPointF in the widget, where it was clicked with the right button
    """

    painted = Signal(float)
    hovered = Signal(object)
    drag_began = Signal(QPointF, object, object)
    dragged = Signal(QPointF)
    drag_ended = Signal(bool)
    double_clicked = Signal(QPointF)
    wheel_turned = Signal(QPointF, float, object)
    pinched = Signal(QPointF, float)
    menu_wanted = Signal(QPointF)

    is_dragging = False

    def __init__(self, before_paint: Callable[[], None], parent: QWidget | None = None) -> None:
        # The default for auto_update draws five times a second for ever.
        super().__init__(parent, auto_update=False, multi_samples=0)
        self.setAcceptDrops(False)
        self.setAccessibleName("View of the body")
        self._before_paint = before_paint
        self._painting = self.is_settled = self._shut = False
        self._smoothness = Smoothness()
        self.is_smooth = False
        self.n_painted = 0
        self._rest = QTimer(self, singleShot=True, interval=_REST_MILLISECONDS)
        self._rest.timeout.connect(self._on_rest)
        self._hover = QTimer(self, singleShot=True, interval=_HOVER_MILLISECONDS)
        self._hover.timeout.connect(self._on_hover)
        self._pointer: QPointF | None = None
        self._press: tuple[QPointF, Qt.MouseButton, Qt.KeyboardModifier] | None = None
        self._picker = vtkCellPicker()
        self._picker.PickFromListOn()
        self._picker.SetTolerance(0.0)
        # VTK would draw at once for each change, and Qt then again.
        self._vtk_interactor = self.ren_win.GetInteractor()
        self._vtk_interactor.EnableRenderOff()
        self._observer = self._vtk_interactor.AddObserver("RenderEvent", self._on_render_wanted)

    def redraw(self) -> None:
        """Request a picture, and a smooth one once nothing moves."""
        if self._shut:
            return
        self.is_settled = False
        self._draw_smooth(self._smoothness.while_moving)
        self._rest.start()
        self.update()

    def look_again(self) -> None:
        """Signal soon what is under the pointer."""
        if not self._shut:
            self._hover.start()

    def pick(
        self, position: QPointF, actor: vtkActor
    ) -> tuple[int, npt.NDArray[np.float64]] | None:
        """Return the vertex that is seen at a position and the point of the surface, (3,).

        Parameters
        ----------
        position : in the widget, in device-independent pixels
        actor : the mesh, which may be hidden by another look of it
        """
        ratio = self.devicePixelRatioF()
        self._picker.InitializePickList()
        self._picker.AddPickList(actor)
        x, y = position.x() * ratio, (self.height() - 1 - position.y()) * ratio
        is_shown = actor.GetVisibility()
        actor.SetVisibility(True)
        is_hit = self._picker.Pick(x, y, 0.0, self.renderer)
        actor.SetVisibility(is_shown)
        if not is_hit or self._picker.GetCellId() < 0:
            return None
        return int(self._picker.GetPointId()), np.array(self._picker.GetPickPosition())

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

    def initializeGL(self) -> None:  # noqa: N802 - Qt's name
        """Let PySide forget the surface of the context when Qt deletes both.

        It counts as a part of the widget, and would pass for what takes its place in memory.
        """
        super().initializeGL()
        context = self.context()
        context.aboutToBeDestroyed.connect(partial(shiboken6.invalidate, context.surface()))

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
        if self.is_smooth:
            # A graphics card is asked to draw and returns before it has.
            self.ren_win.WaitForCompletion()
        seconds = time.perf_counter() - start
        self.is_settled = self.is_smooth
        if self.is_smooth:
            self._smoothness.note(seconds)
        self.n_painted += 1
        self.painted.emit(seconds)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Draw rough pictures while the window is resized."""
        super().resizeEvent(event)
        self.redraw()

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """Begin a click or a drag; a second button changes nothing."""
        if self._press is None:
            self._hover.stop()
            self._press = (event.position(), event.button(), event.modifiers())

    def mouseMoveEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """Drag while a button is pressed, signal the pointer otherwise."""
        self._pointer = event.position()
        if self._press is not None and not event.buttons() & self._press[1]:
            # It was let go over another window.
            self._let_go()
        if self._press is None:
            if event.buttons() == Qt.MouseButton.NoButton and not self._hover.isActive():
                self._hover.start()
            return
        start, button, keys = self._press
        if not self.is_dragging:
            if (event.position() - start).manhattanLength() < _CLICK:
                return
            self.is_dragging = True
            self.drag_began.emit(start, button, keys)
        self.dragged.emit(event.position())

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """End a drag, or ask for the menu where the right button was only clicked."""
        if self._press is None or event.button() is not self._press[1]:
            return
        clicked = None if self.is_dragging else self._press[0]
        self._let_go()
        if clicked is not None and event.button() is Qt.MouseButton.RightButton:
            self.menu_wanted.emit(clicked)

    def mouseDoubleClickEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """Signal a double click."""
        if event.button() is Qt.MouseButton.LeftButton and self._press is None:
            self.double_clicked.emit(event.position())

    def _let_go(self, escaped: bool = False) -> None:
        was_dragging, self.is_dragging, self._press = self.is_dragging, False, None
        if was_dragging:
            self.drag_ended.emit(escaped)
            self._hover.start()

    def contextMenuEvent(self, event: QContextMenuEvent) -> None:  # noqa: N802 - Qt's name
        """Ask for the menu by its key; the right button may yet drag."""
        event.accept()
        if event.reason() is QContextMenuEvent.Reason.Keyboard:
            self.menu_wanted.emit(self._pointer or QPointF(self.rect().center()))

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802 - Qt's name
        """Signal how far the wheel or two fingers have turned; not before a drag has begun."""
        event.accept()
        notches = event.angleDelta().y() / _NOTCH
        if notches and (self._press is None or self.is_dragging):
            self.wheel_turned.emit(event.position(), notches, event.modifiers())

    def event(self, event: QEvent) -> bool:
        """Signal fingers that are spread, and keys in a drag; leave the rest to the window."""
        if self.is_dragging and isinstance(event, QKeyEvent) and event.key() in _KEYS_OF_DRAGS:
            # Before the window's shortcut.
            event.accept()
            if event.type() is QEvent.Type.KeyPress:
                notches = _KEYS_OF_DRAGS[Qt.Key(event.key())]
                if notches and self._pointer is not None:
                    self.wheel_turned.emit(self._pointer, notches, Qt.KeyboardModifier.NoModifier)
                elif not notches:
                    self._let_go(escaped=True)
            return True
        if event.type() in _FOR_THE_WINDOW:
            event.ignore()
            return False
        if (
            isinstance(event, QNativeGestureEvent)
            and event.gestureType() is Qt.NativeGestureType.ZoomNativeGesture
        ):
            self.pinched.emit(event.position(), max(1.0 + event.value(), 0.1))
            return True
        return bool(super().event(event))

    def leaveEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Signal that the pointer has left."""
        self._hover.stop()
        self._pointer = None
        if not self._shut:
            super().leaveEvent(event)
            self.hovered.emit(None)

    def _draw_smooth(self, smooth: bool) -> None:
        if smooth != self.is_smooth:
            self.is_smooth = smooth
            self.ren_win.SetMultiSamples(_SMOOTH_SAMPLES if smooth else 0)

    @Slot()
    def _on_rest(self) -> None:
        if not self.is_settled:
            self._draw_smooth(True)
            self.update()
        if self.underMouse() and self._pointer is not None and self._press is None:
            # Something else may lie beneath the pointer now.
            self._hover.start()

    @Slot()
    def _on_hover(self) -> None:
        self.hovered.emit(self._pointer)

    def _on_render_wanted(self, *_: object) -> None:
        if not self._painting:
            self.redraw()
