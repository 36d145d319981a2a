"""The canvas on which VTK draws, and its mouse interaction."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import shiboken6
from PySide6.QtCore import (
    QEvent,
    QObject,
    QPoint,
    QPointF,
    QRect,
    QSize,
    Qt,
    QTimer,
    Signal,
    Slot,
)
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

from app.editing.live_pose import RADIUS_STEP, domain_of, part_name
from app.view.camera import (
    DragTarget,
    Pixel,
    along_axis,
    pixel_length,
    shifted,
    turn_about,
    turned,
    unproject,
    zoomed,
)

if TYPE_CHECKING:
    from PySide6.QtWidgets import QWidget

    from app.editing.document import PoseDocument
    from app.view.scene import Scene
    from lcollision_core.posing import Grip, PoseSpace


_REST_MILLISECONDS = 220
_HOVER_MILLISECONDS = 30
_SMOOTH_SAMPLES = 4
_NOTCH = 120.0  # of a wheel, in eighths of a degree
_CLICK = 4
"""Distance, in pixels, from which a press and move is a drag, not a click."""

_KEYS_OF_DRAGS = {Qt.Key.Key_Escape: 0.0, Qt.Key.Key_PageUp: 1.0, Qt.Key.Key_PageDown: -1.0}
"""Keys that a drag takes before the window, with the wheel notches that they stand for."""

_FOR_THE_WINDOW = (
    QEvent.Type.KeyPress,
    QEvent.Type.KeyRelease,
    QEvent.Type.DragEnter,
    QEvent.Type.Drop,
)
"""Events left to the window: VTK binds keys itself, and pyvistaqt adds any dropped file as a
mesh."""

_SLOW_SECONDS, _FAST_SECONDS = 0.020, 0.012
"""Limits of the render time: a smooth picture above the first makes a drag stutter; one below the
second leaves time for other work."""
_SLOW_PICTURES = 3


class Smoothness:
    """Decide from render times whether to anti-alias pictures while something moves.

    Anti-alias until several pictures in a row are slow, as without a graphics card. From then on
    draw rough pictures while moving, until a smooth one, drawn at rest, is fast. A time between
    the two limits does not switch.
    """

    def __init__(self) -> None:
        self._n_slow = 0

    @property
    def while_moving(self) -> bool:
        """Whether to anti-alias the next picture while something moves."""
        return self._n_slow < _SLOW_PICTURES

    def note(self, seconds: float) -> None:
        """Record the render time of a smooth picture."""
        if seconds < _FAST_SECONDS:
            self._n_slow = 0
        elif seconds > _SLOW_SECONDS:
            self._n_slow += 1
        elif self.while_moving:
            self._n_slow = 0


class Canvas(QtInteractor):  # type: ignore[misc] # pyvistaqt has no types
    """A VTK widget that draws on request and on Qt's paint events, once per event.

    Parameters
    ----------
    before_paint : called before each picture, to update the scene. It must not touch widgets:
        showing or resizing one lays out the window and may resize this canvas, and Qt then frees
        the framebuffer and the texture that are being drawn into
    parent : of the widget

    Attributes
    ----------
    n_painted : number of pictures drawn
    is_smooth : whether the next picture is anti-aliased
    is_settled : whether the current scene is drawn smooth and no other picture is requested
    is_dragging : whether a button is pressed and the pointer has moved since

    Signals
    -------
    painted : float, the seconds that one picture took; its slots must not touch widgets either,
        unless connected queued
    hovered : QPointF in the widget, or None as the pointer leaves; while no button is pressed
    drag_began : QPointF where a button was pressed, Qt.MouseButton, and the Qt.KeyboardModifiers;
        once the pointer has moved too far for a click
    dragged : QPointF, the pointer's position
    drag_ended : bool, whether by Escape
    double_clicked : QPointF
    wheel_turned : QPointF, float, in notches, and Qt.KeyboardModifiers; also by keys in a drag
    pinched : QPointF and float, the scale factor of the gesture
    menu_wanted : QPointF in the widget, the position of the right click
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
        # By default, auto_update draws five times a second forever.
        super().__init__(parent, auto_update=False, multi_samples=0)
        self.setAcceptDrops(False)
        self.setAccessibleName("View of the body")
        self._before_paint = before_paint
        self._painting = self._resizing = self.is_settled = self._shut = False
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
        # Otherwise VTK draws at once for each change, and Qt draws again.
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

    def rehover(self) -> None:
        """Signal the pointer's position again, after a short delay."""
        if not self._shut:
            self._hover.start()

    def pick(
        self, position: QPointF, actor: vtkActor
    ) -> tuple[int, npt.NDArray[np.float64]] | None:
        """Return the vertex picked at a position and the (3,) point of the surface, or None.

        Parameters
        ----------
        position : in the widget, in device-independent pixels
        actor : of the mesh; it may be hidden while the mesh is drawn textured
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
        """Stop the timers and free the graphics memory; nothing is drawn afterwards."""
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
        """Invalidate PySide's wrapper of the context's surface before Qt deletes both.

        PySide keeps the wrapper with the widget, and would return it for any object that Qt later
        allocates at the same address.
        """
        super().initializeGL()
        context = self.context()
        context.aboutToBeDestroyed.connect(partial(shiboken6.invalidate, context.surface()))

    @property
    def _pixels(self) -> QSize:
        """The size of Qt's framebuffer; Qt rounds halves up, pyvistaqt to even numbers."""
        ratio: float = self.devicePixelRatioF()
        return QSize(self.width(), self.height()) * ratio

    def resizeGL(self, width: int, height: int) -> None:  # noqa: N802 - Qt's name
        """Fill Qt's framebuffer: at fractional scales, a row would stay black."""
        super().resizeGL(width, height)
        if not self._shut:
            self._vtk_interactor.UpdateSize(*self._pixels.toTuple())

    def _blit(self, framebuffer: int, _: QRect) -> None:
        super()._blit(framebuffer, QRect(QPoint(0, 0), self._pixels))

    def paintGL(self) -> None:  # noqa: N802 - Qt's name
        """Update the scene and draw it."""
        if self._shut or self._resizing:
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
            # Wait, to measure the time: a graphics card draws asynchronously.
            self.ren_win.WaitForCompletion()
        seconds = time.perf_counter() - start
        self.is_settled = self.is_smooth
        if self.is_smooth:
            self._smoothness.note(seconds)
        self.n_painted += 1
        self.painted.emit(seconds)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Redraw at the new size, once the layout is done: Qt would paint here and then again."""
        self._resizing = True
        super().resizeEvent(event)
        self._resizing = False
        self.redraw()

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """Begin a click or a drag; ignore a second button."""
        if self._press is None:
            self._hover.stop()
            self._press = (event.position(), event.button(), event.modifiers())

    def mouseMoveEvent(self, event: QMouseEvent) -> None:  # noqa: N802 - Qt's name
        """Drag while a button is pressed; otherwise signal the pointer."""
        self._pointer = event.position()
        if self._press is not None and not event.buttons() & self._press[1]:
            # The button was released over another window.
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
        """End a drag, or request the menu if the right button was only clicked."""
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
        """Request the menu for the menu key only; the right button may still start a drag."""
        event.accept()
        if event.reason() is QContextMenuEvent.Reason.Keyboard:
            self.menu_wanted.emit(self._pointer or QPointF(self.rect().center()))

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802 - Qt's name
        """Signal a wheel or two-finger scroll, but not between a press and its drag."""
        event.accept()
        notches = event.angleDelta().y() / _NOTCH
        if notches and (self._press is None or self.is_dragging):
            self.wheel_turned.emit(event.position(), notches, event.modifiers())

    def event(self, event: QEvent) -> bool:
        """Signal pinch gestures, and keys in a drag; leave other keys and drops to the window."""
        if self.is_dragging and isinstance(event, QKeyEvent) and event.key() in _KEYS_OF_DRAGS:
            # Take the key before the window's shortcut does.
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
            # Something else may be under the pointer now.
            self._hover.start()

    @Slot()
    def _on_hover(self) -> None:
        self.hovered.emit(self._pointer)

    def _on_render_wanted(self, *_: object) -> None:
        if not self._painting:
            self.redraw()


FloatArray = npt.NDArray[np.float64]


_ZOOM_PER_NOTCH, _ZOOM_PER_PIXEL = 1.15, 1.006
_ZOOM_SECONDS = 0.5
"""Time, in seconds, for which the wheel zooms towards the same point while the pointer stays."""

_DEGREES_PER_PIXEL = 0.4
_TWIST_PER_PIXEL = np.pi / 300.0
_DEPTH_PER_NOTCH = 0.015
"""Depth by which a wheel notch moves the dragged patch, in normalised length."""

_HINTS = (
    "Wheel or page keys: nearer or farther",
    "P: pin it here",
    "Escape: put it back",
)
"""Hints shown while the body is dragged."""

_WHOLE_BODY_HINT = "Ctrl+Shift-drag: move the whole body"

_Drag = Callable[[QPointF, QPointF], None]

_SMALL, _SMALL_ROOT, _FAR_AWAY = 300.0, 4500.0, 30_000.0
"""Screen areas, in square pixels, of all faces: a body part below the first has a handle. The root
part, which moves the body, has the higher second limit. A whole body below the third has none."""


@dataclass(eq=False)
class Handle:
    """A dot to drag a body part that is small on the screen.

    Attributes
    ----------
    domain : index from 0
    grip : all vertices of the part, with equal weights
    area : of its faces, normalised
    most_pixels : screen area up to which the handle is shown, in square pixels
    is_shown : whether it was in the last picture
    """

    domain: int
    grip: Grip
    area: float
    most_pixels: float
    is_shown: bool = False


def handles_of(space: PoseSpace) -> list[Handle]:
    """Return the handles of a rig's body parts; a learned model has none, as its are large."""
    from lcollision_core.posing import Grip

    limbs, rest, faces = space.limbs, space.rest_vertices, space.topology.faces
    if not limbs.is_relative:
        return []
    sides = np.cross(rest[faces[:, 1]] - rest[faces[:, 0]], rest[faces[:, 2]] - rest[faces[:, 0]])
    areas = np.bincount(
        space.vertex_domain[faces[:, 0]], 0.5 * np.linalg.norm(sides, axis=1), space.n_domains
    )
    handles = []
    for domain in range(space.n_domains):
        inside = np.flatnonzero(space.vertex_domain == domain)
        if not len(inside):
            continue
        middle = rest[inside].mean(axis=0)
        vertex = int(inside[np.linalg.norm(rest[inside] - middle, axis=1).argmin()])
        grip = Grip(vertex, 0.0, inside, np.full(len(inside), 1.0 / len(inside)))
        is_root = limbs.held_segment(grip.vertices, grip.weights) == limbs.root
        most = _SMALL_ROOT if is_root else _SMALL
        handles.append(Handle(domain, grip, float(areas[domain]), most))
    return handles


class Mouse(QObject):
    """Turn mouse events of a canvas into drags of the body and of the camera.

    The left button on the body drags the patch under the pointer in the image plane, or over a
    surface in front of it; the wheel then changes its depth. Ctrl twists the body part, and
    Ctrl+Shift lets the whole body help. An arrow is dragged along its axis. The left button beside
    the body, the middle button or Alt turns the camera; Shift shifts it. The right button, moved
    up or down, zooms like the wheel.

    Parameters
    ----------
    document : whose pose is dragged
    canvas : source of the mouse events

    Attributes
    ----------
    vertex : under the pointer, or None
    pin : index of the pin under the pointer, or None
    handle : the body part whose handle is under the pointer, or None
    arrows : vertex whose patch has arrows to drag, or None
    whole_body_drag : whether the current drag moves the whole body

    Signals
    -------
    pointed : QPointF in the canvas, the pointer, or None; `vertex` or `pin` may have changed
    whole_body_dragged : QPointF in the canvas, the pointer in a drag that moves the whole body
    hinted : str, hint for the current drag; "" as it ends
    camera_moved : View, the requested camera
    redraw_wanted : the patch or the lines have changed
    """

    pointed = Signal(object)
    whole_body_dragged = Signal(object)
    hinted = Signal(str)
    camera_moved = Signal(object)
    redraw_wanted = Signal()

    _scene: Scene

    def __init__(self, document: PoseDocument, canvas: Canvas) -> None:
        super().__init__(canvas)
        self._document, self._canvas = document, canvas
        self.vertex: int | None = None
        self.pin: int | None = None
        self.handle: int | None = None
        self._handles: list[Handle] = []
        self.arrows: int | None = None
        self.whole_body_drag = False
        self._last_vertex: int | None = None
        self._keeps = False
        self._drag: _Drag | None = None
        self._place = QPointF()
        self._grip: Grip | None = None
        self._target: FloatArray | None = None
        self._deepen: Callable[[float], None] | None = None
        self._zoom_anchor: tuple[QPointF, FloatArray, float] | None = None
        canvas.hovered.connect(self._on_hovered)
        canvas.drag_began.connect(self._on_drag_began)
        canvas.dragged.connect(self._on_dragged)
        canvas.drag_ended.connect(self._on_drag_ended)
        canvas.double_clicked.connect(self._on_double_clicked)
        canvas.wheel_turned.connect(self._on_wheel)
        canvas.pinched.connect(lambda place, factor: self._zoom(place, 1.0 / factor))
        document.motion.grip_radius_changed.connect(self._show_patch)
        document.history.pins_changed.connect(self.redraw_wanted)

    def reset(self, scene: Scene) -> None:
        """Begin with another scene; the pointed vertex and the drag belong to the previous one."""
        self._scene = scene
        self._forget_drag()
        self.arrows = None
        self._handles = handles_of(self._document.model.space)
        self.point_at(None)
        self._last_vertex = None

    def _forget_drag(self) -> None:
        self._drag = self._grip = self._target = self._deepen = None
        self.whole_body_drag = False

    def point_at(self, place: QPointF | None) -> None:
        """Find the pin, handle or vertex under the pointer, and show the patch of a drag."""
        self.vertex = self.pin = self.handle = None
        scene = self._scene
        if place is not None:
            # Pins may have changed since the last picture.
            self._mark_pins()
            self.pin = scene.marks.pin_at(_pixel(place), scene.view, self._size)
            handle = scene.marks.handle_at(_pixel(place), scene.view, self._size)
            if self.pin is not None:
                self.vertex = self._document.history.pose.pins[self.pin].vertex
            elif handle is not None:
                pointed = [handle for handle in self._handles if handle.is_shown][handle]
                self.handle, self.vertex = pointed.domain, pointed.grip.vertex
            else:
                picked = self._canvas.pick(place, scene.body)
                self.vertex = None if picked is None else picked[0]
        if self.vertex is not None:
            self._last_vertex = self.vertex
        self._show_patch()
        cursor = Qt.CursorShape.ArrowCursor
        if self.vertex is not None:
            cursor = Qt.CursorShape.OpenHandCursor
        self._canvas.setCursor(cursor)
        self.pointed.emit(place)

    def keep_patch(self) -> None:
        """Keep pointing at the last patch until `rehover`."""
        self._keeps = True
        if self.vertex is None and self._last_vertex is not None:
            self.vertex = self._last_vertex
            self._show_patch()
            self.pointed.emit(None)

    def rehover(self) -> None:
        """Update what is under the pointer, after a short delay."""
        self._keeps = False
        self._canvas.rehover()

    def toggle_pin(self, oriented: bool = False) -> None:
        """Pin the patch under the pointer, optionally with its orientation, or unpin it."""
        if self.vertex is not None:
            self._document.pins.toggle(self.vertex, oriented)

    def toggle_arrows(self) -> None:
        """Show arrows on the patch under the pointer; hide them if they are on that patch."""
        if self.arrows is not None and self.vertex is not None:
            patch = self._document.motion.grip_at(self.vertex).vertices
            self.arrows = None if self.arrows in patch else self.vertex
        else:
            self.arrows = self.vertex
        self.redraw_wanted.emit()

    def mark(self, vertices: npt.NDArray[np.float32]) -> None:
        """Update the marks on the body, just before a picture of (V, 3) vertices."""
        marks, model, line = self._scene.marks, self._document.model, None
        self._mark_pins()
        self._mark_handles(vertices)
        if self._grip is not None and self._target is not None:
            up = np.array(model.up)
            below = self._target + ((vertices @ up).min() - self._target @ up) * up
            line = np.stack([self._grip.position(vertices), self._target, below])
        marks.show_target(line)
        home = None
        if self.arrows is not None:
            home = self._document.motion.grip_at(self.arrows).position(vertices)
        marks.show_arrows(home, self._axes)

    @property
    def _axes(self) -> FloatArray:
        """The body's left, front and up, as rows."""
        up, front = self._document.model.up, self._document.model.front
        return np.stack([np.cross(up, front), front, up])

    def _mark_pins(self) -> None:
        document, pins = self._document, self._document.history.pose.pins
        colours = document.model.card.domain_colours
        self._scene.marks.show_pins(
            np.array([pin.position for pin in pins]).reshape(-1, 3),
            [colours[domain_of(document.model, pin.vertex)] for pin in pins],
        )

    def _mark_handles(self, vertices: npt.NDArray[np.float32]) -> None:
        """Show the handles of the body parts that are too small on the screen to grab."""
        model, view = self._document.model, self._scene.view
        places: list[FloatArray] = []
        whole = sum(handle.area for handle in self._handles)
        for handle in self._handles:
            place = handle.grip.position(vertices)
            pixel = (pixel_length(view, place, self._size) / model.body_size) ** 2
            is_small = handle.area < handle.most_pixels * pixel
            handle.is_shown = is_small and whole > _FAR_AWAY * pixel
            if handle.is_shown:
                places.append(place)
        visible_domains = [handle.domain for handle in self._handles if handle.is_shown]
        self._scene.marks.show_handles(
            np.array(places).reshape(-1, 3),
            [model.card.domain_colours[domain] for domain in visible_domains],
            visible_domains.index(self.handle) if self.handle in visible_domains else None,
        )

    @property
    def _size(self) -> Pixel:
        return float(self._canvas.width()), float(self._canvas.height())

    @Slot()
    def _show_patch(self) -> None:
        """Paint the patch under the pointer, or the dragged one."""
        grip = self._grip
        if grip is None and self.vertex is not None and not self._canvas.is_dragging:
            grip = self._document.motion.grip_at(self.vertex)
        # A handle moves its whole body part, so it has no patch.
        if self._scene.patch.show(grip if self.handle is None else None):
            self.redraw_wanted.emit()

    @Slot(object)
    def _on_hovered(self, place: QPointF | None) -> None:
        if not (self._canvas.is_dragging or self._keeps):
            self.point_at(place)

    @Slot(QPointF)
    def _on_double_clicked(self, place: QPointF) -> None:
        self.point_at(place)
        self.toggle_pin()

    @Slot(QPointF, float, object)
    def _on_wheel(self, place: QPointF, notches: float, keys: Qt.KeyboardModifier) -> None:
        if keys & Qt.KeyboardModifier.ControlModifier:
            document = self._document
            document.motion.set_grip_radius(document.motion.grip_radius * RADIUS_STEP**notches)
        elif self._deepen is not None:
            self._deepen(-notches)
        elif not self._canvas.is_dragging:
            self._zoom(place, _ZOOM_PER_NOTCH**-notches)

    # Drags.

    @Slot(QPointF, object, object)
    def _on_drag_began(
        self, start: QPointF, button: Qt.MouseButton, keys: Qt.KeyboardModifier
    ) -> None:
        scene, self._place, self._drag = self._scene, start, self._turn
        modifier = Qt.KeyboardModifier
        whole_body = bool(keys & modifier.ControlModifier and keys & modifier.ShiftModifier)
        left = button is Qt.MouseButton.LeftButton
        axis = scene.marks.arrow_at(_pixel(start), scene.view, self._size) if left else None
        if button is Qt.MouseButton.RightButton:
            self._drag = partial(self._zoom_by_drag, start)
        elif axis is not None and self.arrows is not None:
            self._drag = self._moving_along(start, self.arrows, self._axes[axis])
        elif keys & modifier.ShiftModifier and not whole_body:
            self._drag = self._shift
        elif left and not keys & modifier.AltModifier:
            self.point_at(start)
            if self.vertex is not None:
                twists = keys & modifier.ControlModifier and not whole_body and self.pin is None
                if twists:
                    self._drag = self._twisting(start, self.vertex)
                else:
                    self._drag = self._moving(start, self.vertex, whole_body)
        # Hide a patch that is not dragged: it would cover what the user looks at.
        self._show_patch()
        self.pointed.emit(None)

    @Slot(QPointF)
    def _on_dragged(self, place: QPointF) -> None:
        before, self._place = self._place, place
        if self._drag is not None:
            self._drag(before, place)
        if self.whole_body_drag and self._document.motion.dragging:
            self.whole_body_dragged.emit(place)

    @Slot(bool)
    def _on_drag_ended(self, escaped: bool) -> None:
        self._forget_drag()
        self.hinted.emit("")
        if escaped:
            self._document.motion.cancel_drag()
        else:
            self._document.motion.end_drag()
        self.redraw_wanted.emit()

    def _moving(self, start: QPointF, vertex: int, whole_body: bool) -> _Drag:
        """Drag a patch, or the pin under the pointer, in a plane or over the body."""
        document, scene = self._document, self._scene
        vertices = np.asarray(scene.surface.vertices)
        grip = document.motion.grip_at(vertex)
        if self.handle is not None:
            (grip,) = (handle.grip for handle in self._handles if handle.domain == self.handle)
        home = grip_position = grip.position(vertices)
        if self.pin is not None:
            home = grip_position = np.array(document.history.pose.pins[self.pin].position)
            document.motion.begin_pin_drag(self.pin, whole_body)
        else:
            picked = None if self.handle is not None else self._canvas.pick(start, scene.body)
            grip_position = grip_position if picked is None else picked[1]
            document.motion.begin_drag(
                grip, f"Drag {part_name(document.model, vertex)}", whole_body
            )
        self._grip = grip
        self.whole_body_drag = whole_body or document.motion.whole_body
        self.hinted.emit(" · ".join((*_HINTS, *(_WHOLE_BODY_HINT,) * (not self.whole_body_drag))))
        self._canvas.setCursor(Qt.CursorShape.ClosedHandCursor)
        limbs = document.model.space.limbs
        moving = limbs.carried(limbs.held_segment(grip.vertices, grip.weights), 2.0 * grip.radius)
        body_size = document.model.body_size
        drag_target = DragTarget(
            scene.view,
            self._size,
            grip_position,
            vertices.copy(),
            document.model.faces,
            moving,
            body_size,
        )
        offset = home - drag_target.target(_pixel(start))

        def move(_: QPointF, place: QPointF) -> None:
            self._aim(lambda: drag_target.target(_pixel(place)) + offset)

        def deepen(notches: float) -> None:
            drag_target.shift(_pixel(self._place), notches * _DEPTH_PER_NOTCH * body_size)
            move(self._place, self._place)

        self._deepen = deepen
        return move

    def _moving_along(self, start: QPointF, vertex: int, axis: FloatArray) -> _Drag:
        """Drag the patch of a vertex, with its pin if it has one, along an axis."""
        document, view = self._document, self._scene.view
        grip = self._grip = document.motion.grip_at(vertex)
        home = grip.position(np.asarray(self._scene.surface.vertices))
        pinned = [
            index for index, pin in enumerate(document.history.pose.pins) if pin.vertex == vertex
        ]
        if pinned:
            document.motion.begin_pin_drag(pinned[0])
        else:
            document.motion.begin_drag(grip, f"Drag {part_name(document.model, vertex)}")
        self._canvas.setCursor(Qt.CursorShape.ClosedHandCursor)
        begun = along_axis(view, _pixel(start), self._size, home, axis)

        def move(_: QPointF, place: QPointF) -> None:
            way = along_axis(view, _pixel(place), self._size, home, axis) - begun
            self._aim(lambda: home + way * axis)

        return move

    def _aim(self, target: Callable[[], FloatArray]) -> None:
        """Continue the drag, unless another action ended it while the button is pressed."""
        if not self._document.motion.dragging:
            self._grip = self._target = self._deepen = None
            self._show_patch()
            return
        self._target = target()
        self._document.motion.drag_to(self._target)
        self.redraw_wanted.emit()

    def _twisting(self, start: QPointF, vertex: int) -> _Drag:
        """Twist a body part about its long axis by pointer motion across the axis."""
        from lcollision_core.posing import Twist, long_axis

        document, domain = self._document, domain_of(self._document.model, vertex)
        scene, self._grip = self._scene, None
        inside = np.asarray(scene.surface.vertices)[document.model.space.vertex_domain == domain]
        direction = turn_about(long_axis(inside.astype(np.float64)), scene.view)
        document.motion.begin_drag(Twist(domain), f"Twist {part_name(document.model, vertex)}")
        self._canvas.setCursor(Qt.CursorShape.SizeHorCursor)

        def twist(_: QPointF, place: QPointF) -> None:
            way = place - start
            along = way.x() * direction[0] + way.y() * direction[1]
            document.motion.drag_to(np.array([_TWIST_PER_PIXEL * along]))

        return twist

    # The camera.

    def _turn(self, before: QPointF, place: QPointF) -> None:
        # Turn the current view: the camera may follow the body meanwhile.
        way = (place - before) * _DEGREES_PER_PIXEL
        self.camera_moved.emit(turned(self._scene.view, way.x(), way.y()))

    def _shift(self, before: QPointF, place: QPointF) -> None:
        view = self._scene.view
        self.camera_moved.emit(shifted(view, _pixel(before), _pixel(place), self._size))

    def _zoom_by_drag(self, start: QPointF, before: QPointF, place: QPointF) -> None:
        self._zoom(start, _ZOOM_PER_PIXEL ** (place.y() - before.y()))

    def _zoom(self, place: QPointF, factor: float) -> None:
        scene = self._scene
        view, now = scene.view, time.monotonic()
        anchor = self._zoom_anchor
        if anchor is None or anchor[0] != place or now - anchor[2] > _ZOOM_SECONDS:
            picked = self._canvas.pick(place, scene.body)
            beside = unproject(view, _pixel(place), self._size, view.focus)
            point = beside if picked is None else picked[1]
        else:
            point = anchor[1]
        self._zoom_anchor = (place, point, now)
        vertices, body_size = scene.surface.vertices, self._document.model.body_size
        self.camera_moved.emit(zoomed(view, point, factor, vertices, body_size))


def _pixel(place: QPointF) -> Pixel:
    """Return the middle of the pixel under the pointer."""
    return place.x() + 0.5, place.y() + 0.5
