"""What the mouse does in the view: moves the body by its patches and pins, and the camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, QPointF, Qt, Signal, Slot

from app.view.camera import Pixel, View, seen_at, shifted, turn_about, turned, zoomed

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.view.canvas import Canvas
    from app.view.scene import Scene
    from lcollision_core.posing import Grip

FloatArray = npt.NDArray[np.float64]

RADIUS_STEP = 1.25
"""Factor from one patch to the next larger one."""

_ZOOM_PER_NOTCH, _ZOOM_PER_PIXEL = 1.15, 1.006
_ZOOM_SECONDS = 0.5
"""Seconds within which the wheel zooms towards the same point while the pointer stays."""

_DEGREES_PER_PIXEL = 0.4
_TWIST_PER_PIXEL = np.pi / 300.0

_Drag = Callable[[QPointF], None]


class Mouse(QObject):
    """Turns motions of the mouse over one canvas into drags of the body and of the camera.

    Left on the body drags the patch under the pointer in the plane of the picture, with Ctrl it
    twists the body part; left beside it, middle or Alt turn the camera, with Shift they shift it.
    Right, up and down, zooms, as the wheel does.

    Parameters
    ----------
    document : whose pose is dragged
    canvas : has the mouse
    scene : returns what is on the canvas, None before there is anything

    Attributes
    ----------
    vertex : under the pointer, or None
    pin : index of the pin under the pointer, or None

    Signals
    -------
    pointed : QPointF in the canvas where `vertex` or `pin` is new, None beside the body
    camera_moved : View, that the user wants
    redraw_wanted : patch or lines have changed
    """

    pointed = Signal(object)
    camera_moved = Signal(object)
    redraw_wanted = Signal()

    def __init__(
        self,
        document: PoseDocument,
        canvas: Canvas,
        scene: Callable[[], Scene | None],
    ) -> None:
        super().__init__(canvas)
        self._document, self._canvas, self._scene = document, canvas, scene
        self.vertex: int | None = None
        self.pin: int | None = None
        self._last_vertex: int | None = None
        self._keeps = False
        self._drag: _Drag | None = None
        self._grip: Grip | None = None
        self._target: FloatArray | None = None
        self._zoom_anchor: tuple[QPointF, FloatArray, float] | None = None
        canvas.hovered.connect(self._on_hovered)
        canvas.drag_began.connect(self._on_drag_began)
        canvas.dragged.connect(self._on_dragged)
        canvas.drag_ended.connect(self._on_drag_ended)
        canvas.double_clicked.connect(self._on_double_clicked)
        canvas.wheel_turned.connect(self._on_wheel)
        canvas.pinched.connect(lambda place, factor: self._zoom(place, 1.0 / factor))
        document.grip_radius_changed.connect(self._show_patch)
        document.pins_changed.connect(self.redraw_wanted)

    def let_go(self) -> None:
        """Forget what is under the pointer and what is dragged, as of another model."""
        self._drag = self._grip = self._target = None
        self.point_at(None)
        self._last_vertex = None

    def point_at(self, place: QPointF | None) -> None:
        """Find what is under the pointer, and show the patch that a drag would take."""
        self.vertex = self.pin = None
        scene = self._scene()
        if scene is not None and place is not None:
            # Pins may have changed since the last picture.
            self._mark_pins(scene)
            self.pin = scene.marks.pin_at(_pixel(place), scene.view, self._size)
            if self.pin is not None:
                self.vertex = self._document.pins[self.pin].vertex
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
        """Point at the patch that was pointed at last, until `look_again`."""
        self._keeps = True
        if self.vertex is None and self._last_vertex is not None:
            self.vertex = self._last_vertex
            self._show_patch()
            self.pointed.emit(None)

    def look_again(self) -> None:
        """Point soon at what is under the pointer."""
        self._keeps = False
        self._canvas.look_again()

    def toggle_pin(self) -> None:
        """Pin the patch under the pointer, or take its pin away."""
        if self.vertex is not None:
            self._document.toggle_pin(self.vertex)

    def mark(self, scene: Scene, vertices: npt.NDArray[np.float32]) -> None:
        """Bring the marks on the body up to date, just before a picture.

        Parameters
        ----------
        scene : that is drawn
        vertices : (V, 3) array, of the pose that is drawn
        """
        self._mark_pins(scene)
        lines = []
        if self._grip is not None and self._target is not None:
            lines = [[self._grip.position(vertices), self._target]]
        scene.marks.show_lines(np.array(lines).reshape(-1, 2, 3))

    def _mark_pins(self, scene: Scene) -> None:
        document, pins = self._document, self._document.pins
        colours = document.model.domain_colours
        scene.marks.show_pins(
            np.array([pin.position for pin in pins]).reshape(-1, 3),
            [colours[document.domain_of(pin.vertex)] for pin in pins],
        )

    @property
    def _size(self) -> Pixel:
        return float(self._canvas.width()), float(self._canvas.height())

    @Slot()
    def _show_patch(self) -> None:
        """Paint the patch under the pointer, or the one that is dragged."""
        scene = self._scene()
        if scene is None:
            return
        grip = self._grip
        if grip is None and self.vertex is not None and not self._canvas.is_dragging:
            grip = self._document.grip_at(self.vertex)
        if scene.show_grip(grip):
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
            document.set_grip_radius(document.grip_radius * RADIUS_STEP**notches)
        else:
            self._zoom(place, _ZOOM_PER_NOTCH**-notches)

    # Drags.

    @Slot(QPointF, object, object)
    def _on_drag_began(
        self, start: QPointF, button: Qt.MouseButton, keys: Qt.KeyboardModifier
    ) -> None:
        scene = self._scene()
        if scene is None:
            return
        modifier = Qt.KeyboardModifier
        if button is Qt.MouseButton.RightButton:
            self._drag = self._zooming(start)
        elif keys & modifier.ShiftModifier:
            self._drag = self._shifting(start)
        elif button is Qt.MouseButton.LeftButton and not keys & modifier.AltModifier:
            self.point_at(start)
            if self.vertex is None:
                self._drag = self._turning(start)
            elif keys & modifier.ControlModifier and self.pin is None:
                self._drag = self._twisting(scene, start, self.vertex)
            else:
                self._drag = self._moving(scene, start, self.vertex)
        else:
            self._drag = self._turning(start)
        # A patch that is not dragged would be in the way of what is looked at.
        self._show_patch()
        self.pointed.emit(None)

    @Slot(QPointF)
    def _on_dragged(self, place: QPointF) -> None:
        if self._drag is not None:
            self._drag(place)

    @Slot(bool)
    def _on_drag_ended(self, escaped: bool) -> None:
        self._drag = self._grip = self._target = None
        if self._document.dragging:
            if escaped:
                self._document.cancel_drag()
            else:
                self._document.end_drag()
        self.redraw_wanted.emit()

    def _moving(self, scene: Scene, start: QPointF, vertex: int) -> _Drag:
        """Move a patch, or the pin under the pointer, in the plane of the picture."""
        document = self._document
        if self.pin is not None:
            pin = document.pins[self.pin]
            pinned = np.array(pin.position)
            document.begin_pin_drag(self.pin)
            self._grip, home, deep_as = None, pinned, pinned
        else:
            picked = self._canvas.pick(start, scene.body)
            grip = self._grip = document.grip_at(vertex)
            home = grip.position(np.asarray(scene.surface.vertices))
            deep_as = home if picked is None else picked[1]
            document.begin_drag(grip, f"Drag {document.part_name(vertex)}")
        self._canvas.setCursor(Qt.CursorShape.ClosedHandCursor)
        view = scene.view
        taken = seen_at(view, _pixel(start), self._size, deep_as)

        def move(place: QPointF) -> None:
            if not document.dragging:
                # Another action has ended the drag, and the button is still pressed.
                self._grip = self._target = None
                self._show_patch()
                return
            there = seen_at(view, _pixel(place), self._size, deep_as)
            self._target = home + there - taken
            document.drag_to(self._target)
            self.redraw_wanted.emit()

        return move

    def _twisting(self, scene: Scene, start: QPointF, vertex: int) -> _Drag:
        """Twist a body part about its long axis by the motion across it."""
        from lcollision_core.posing import Twist, long_axis

        document, domain = self._document, self._document.domain_of(vertex)
        self._grip = None
        inside = np.asarray(scene.surface.vertices)[
            document.model.pose_space.vertex_domain == domain
        ]
        direction = turn_about(long_axis(inside.astype(np.float64)), scene.view)
        document.begin_drag(Twist(domain), f"Twist {document.part_name(vertex)}")
        self._canvas.setCursor(Qt.CursorShape.SizeHorCursor)

        def twist(place: QPointF) -> None:
            way = place - start
            along = way.x() * direction[0] + way.y() * direction[1]
            document.drag_to(np.array([_TWIST_PER_PIXEL * along]))

        return twist

    # The camera.

    def _turning(self, start: QPointF) -> _Drag:
        view = self._view

        def turn(place: QPointF) -> None:
            way = (place - start) * _DEGREES_PER_PIXEL
            self.camera_moved.emit(turned(view, way.x(), way.y()))

        return turn

    def _shifting(self, start: QPointF) -> _Drag:
        view = self._view

        def shift(place: QPointF) -> None:
            self.camera_moved.emit(shifted(view, _pixel(start), _pixel(place), self._size))

        return shift

    def _zooming(self, start: QPointF) -> _Drag:
        heights = [start.y()]

        def zoom(place: QPointF) -> None:
            heights.append(place.y())
            self._zoom(start, _ZOOM_PER_PIXEL ** (heights[-1] - heights[-2]))

        return zoom

    @property
    def _view(self) -> View:
        scene = self._scene()
        assert scene is not None
        return scene.view

    def _zoom(self, place: QPointF, factor: float) -> None:
        scene = self._scene()
        if scene is None:
            return
        view, now = scene.view, time.monotonic()
        anchor = self._zoom_anchor
        if anchor is None or anchor[0] != place or now - anchor[2] > _ZOOM_SECONDS:
            picked = self._canvas.pick(place, scene.body)
            beside = seen_at(view, _pixel(place), self._size, view.focus)
            point = beside if picked is None else picked[1]
        else:
            point = anchor[1]
        self._zoom_anchor = (place, point, now)
        vertices, body_size = scene.surface.vertices, self._document.model.body_size
        self.camera_moved.emit(zoomed(view, point, factor, vertices, body_size))


def _pixel(place: QPointF) -> Pixel:
    """Return the middle of the pixel under the pointer."""
    return place.x() + 0.5, place.y() + 0.5
