"""Camera geometry: framing, motion and animation of the camera, and the depth of drags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QAbstractAnimation, QEasingCurve, QObject, QVariantAnimation, Signal

FloatArray = npt.NDArray[np.float64]
Pixel = tuple[float, float]

CAMERAS = ("Three-quarter", "Front", "Back", "Left", "Right", "Top")
"""Names of the preset views; left and right are the body's own."""

VIEW_ANGLE = 24.0
"""Vertical field of view in degrees; narrow, so that near limbs do not look swollen."""

_MARGIN = 1.2
_ALONG_SIGHT = 0.3
"""Sine of the angle to the line of sight below which an axis counts as seen end-on."""
_STEEPEST = 89.0
"""Limit, in degrees above or below the horizon, for turning the camera by hand."""
_NEAREST, _FARTHEST = 0.05, 15.0
"""Limits of zooming, in body sizes."""


@dataclass(frozen=True, eq=False)
class View:
    """A perspective camera.

    Attributes
    ----------
    position, focus : (3,) float64 arrays, in the data's unit
    up : (3,) float64 array, of length 1
    """

    position: FloatArray
    focus: FloatArray
    up: FloatArray


def preset_view(
    name: str, vertices: npt.NDArray[Any], up: npt.ArrayLike, front: FloatArray, aspect: float
) -> View:
    """Return a view of a whole mesh from a preset side.

    Parameters
    ----------
    name : one of `CAMERAS`
    vertices : (V, 3) array
    up, front : (3,) unit vectors; the direction that the body faces
    aspect : width over height of the image

    Raises
    ------
    KeyError : `name` is not a preset.
    """
    up = np.asarray(up, np.float64)
    left = np.cross(up, front)
    towards = {
        "Three-quarter": 0.86 * front + 0.44 * left + 0.22 * up,
        "Front": front,
        "Back": -front,
        "Left": left,
        "Right": -left,
        # Tilt slightly: straight from above, the direction of an upright camera is undefined.
        "Top": up + 0.02 * front,
    }[name]
    return framing(vertices, towards, up, aspect)


def framing(vertices: npt.NDArray[Any], towards: FloatArray, up: FloatArray, aspect: float) -> View:
    """Return a view of a whole mesh from a direction.

    Parameters
    ----------
    vertices : (V, 3) array
    towards : (3,) array, from the mesh to the camera
    up : (3,) unit vector, upright in the image
    aspect : width over height of the image
    """
    towards = towards / np.linalg.norm(towards)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    focus = 0.5 * (low + high).astype(np.float64)
    needed, depth = _needed_distances(vertices - focus, towards, up, aspect)
    distance = float((_MARGIN * needed + depth).max())
    return View(focus + distance * towards, focus, up)


def sees_all(view: View, vertices: npt.NDArray[Any], aspect: float) -> bool:
    """Return whether a whole mesh is inside the image.

    Parameters
    ----------
    vertices : (V, 3) array
    aspect : width over height of the image
    """
    arm = view.position - view.focus
    distance = float(np.linalg.norm(arm))
    needed, depth = _needed_distances(vertices - view.focus, arm / distance, view.up, aspect)
    return bool((needed + depth <= distance).all())


def reframed_if_out_of_view(
    view: View, before: npt.NDArray[Any], after: npt.NDArray[Any], aspect: float
) -> View | None:
    """Frame the whole mesh from the same side if a change of pose moved it out of view.

    Parameters
    ----------
    before, after : (V, 3) arrays
    aspect : width over height of the image

    Returns
    -------
    wanted : the new view; None if the view may stay, or did not show the whole mesh before
    """
    if not sees_all(view, before, aspect) or sees_all(view, after, aspect):
        return None
    return framing(after, view.position - view.focus, view.up, aspect)


def followed(
    view: View, before: npt.NDArray[Any], after: npt.NDArray[Any], up_axis: int, aspect: float
) -> View:
    """Move a camera along with a moving body, which keeps its position in the image.

    The camera stays level, so that steps and jumps are visible, unless the body would leave the
    image.

    Parameters
    ----------
    before, after : (V, 3) arrays
    up_axis : 0, 1 or 2
    aspect : width over height of the image
    """
    way = after.mean(axis=0, dtype=np.float64) - before.mean(axis=0, dtype=np.float64)
    level = np.where(np.arange(3) == up_axis, 0.0, way)
    moved = View(view.position + level, view.focus + level, view.up)
    if sees_all(view, before, aspect) and not sees_all(moved, after, aspect):
        return View(view.position + way, view.focus + way, view.up)
    return moved


def _needed_distances(
    offset: npt.NDArray[Any], towards: FloatArray, up: FloatArray, aspect: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least distance at which each point is in view, and its offset to the camera."""
    upward = up - (up @ towards) * towards
    upward /= np.linalg.norm(upward)
    half_height = np.tan(np.radians(0.5 * VIEW_ANGLE))
    needed = np.maximum(
        np.abs(offset @ upward) / half_height,
        np.abs(offset @ np.cross(upward, towards)) / (half_height * aspect),
    )
    return needed, offset @ towards


def zoomed(
    view: View, anchor: FloatArray, factor: float, vertices: npt.NDArray[Any], body_size: float
) -> View:
    """Move the camera towards a point, or away from it; the point stays in place on the screen.

    Parameters
    ----------
    anchor : (3,) array, in the data's unit
    factor : of the distance to the point, below 1 to come nearer; limited at both ends
    vertices : (V, 3) array; the focus, about which the camera turns, stays within their depths
    body_size : in the data's unit
    """
    arm = view.position - anchor
    distance = float(np.linalg.norm(arm))
    near, far = _NEAREST * body_size, _FARTHEST * body_size
    # Do not pass a limit, but let a camera that is already beyond it stay.
    factor = float(np.clip(factor, min(near / distance, 1.0), max(far / distance, 1.0)))
    position = anchor + factor * arm
    sight = view.focus - view.position
    depth = float(np.linalg.norm(sight))
    sight = sight / depth
    depths = (vertices - position) @ sight
    depth = float(np.clip(factor * depth, depths.min(), depths.max()))
    return View(position, position + max(depth, 0.5 * near) * sight, view.up)


def turned(view: View, across: float, upwards: float) -> View:
    """Turn an upright camera round its focus.

    Parameters
    ----------
    across, upwards : degrees by which the scene turns to the right, and its top to the viewer
    """
    from scipy.spatial.transform import Rotation

    arm = view.position - view.focus
    length = float(np.linalg.norm(arm))
    steepness = np.degrees(np.arcsin(np.clip(arm @ view.up / length, -1.0, 1.0)))
    steeper = np.clip(steepness + upwards, -_STEEPEST, _STEEPEST) - steepness
    sideways = np.cross(view.up, arm)
    sideways /= max(float(np.linalg.norm(sideways)), 1e-12)
    turn = Rotation.from_rotvec(np.radians(-across) * view.up)
    tilt = Rotation.from_rotvec(np.radians(-steeper) * sideways)
    return View(view.focus + turn.apply(tilt.apply(arm)), view.focus, view.up)


def shifted(view: View, start: Pixel, end: Pixel, size: Pixel) -> View:
    """Shift a camera so that points at the depth of its focus follow the pointer.

    Parameters
    ----------
    start, end : positions of the pointer; see `unproject`
    size : of the image
    """
    motion = unproject(view, start, size, view.focus) - unproject(view, end, size, view.focus)
    return View(view.position + motion, view.focus + motion, view.up)


def turn_about(axis: FloatArray, view: View) -> FloatArray:
    """Return the image direction in which points before an axis move as they turn about it.

    Parameters
    ----------
    axis : (3,) unit vector; the turn is anticlockwise seen from its tip

    Returns
    -------
    direction : (2,) unit vector, to the right and down
    """
    right, upward, forward = _axes(view)
    motion = np.cross(axis, -forward)
    across = np.array([motion @ right, -(motion @ upward)])
    length = float(np.linalg.norm(across))
    if length < _ALONG_SIGHT:
        # The axis is seen end-on: use the horizontal, in which the upper rim moves.
        return np.array([np.sign(axis @ forward) or 1.0, 0.0])
    direction: FloatArray = across / length
    return direction


def unproject(view: View, place: Pixel, size: Pixel, at_depth_of: FloatArray) -> FloatArray:
    """Return the (3,) point at an image position, at the depth of another point.

    Parameters
    ----------
    place : in pixels from the left and top of the image
    size : width and height of the image, in the same pixels
    at_depth_of : (3,) array, in the data's unit
    """
    axes = _axes(view)
    depth = float((at_depth_of - view.position) @ axes[2])
    pixel = _pixel(depth, size[1])
    away = np.array([place[0] - 0.5 * size[0], 0.5 * size[1] - place[1]]) * pixel
    point: FloatArray = view.position + away @ axes[:2] + depth * axes[2]
    return point


def places_of(view: View, points: npt.NDArray[Any], size: Pixel) -> FloatArray:
    """Project points to (N, 2) image positions, in pixels from the left and top.

    Parameters
    ----------
    points : (N, 3) array, in the data's unit, before the camera
    size : width and height of the image
    """
    if not len(points):
        # A fast path: most pictures have no marks, and each event draws one.
        return np.empty((0, 2))
    right, upward, depth = _axes(view) @ (points - view.position).T
    pixel = _pixel(np.maximum(depth, 1e-9), size[1])
    return np.stack([0.5 * size[0] + right / pixel, 0.5 * size[1] - upward / pixel], axis=1)


def pixel_length(view: View, point: FloatArray, size: Pixel) -> float:
    """Return the size of a pixel at the depth of a (3,) point, in the data's unit."""
    depth = float((point - view.position) @ _axes(view)[2])
    return float(_pixel(max(depth, 1e-9), size[1]))


def _axes(view: View) -> FloatArray:
    """Return the camera's right, up and forward unit vectors as the rows of a matrix."""
    forward = view.focus - view.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, view.up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def _pixel(depth: Any, height: float) -> Any:
    """Return the size of a pixel at a depth, in the data's unit."""
    return 2.0 * depth * np.tan(np.radians(0.5 * VIEW_ANGLE)) / height


def interpolated(start: View, end: View, fraction: float) -> View:
    """Interpolate two cameras on an arc round their focus.

    Parameters
    ----------
    fraction : 0 at the start, 1 at the end
    """
    from scipy.spatial.transform import Rotation

    if fraction >= 1.0:
        return end
    arms = [view.position - view.focus for view in (start, end)]
    lengths = [float(np.linalg.norm(arm)) for arm in arms]
    a, b = (arm / length for arm, length in zip(arms, lengths, strict=True))
    axis = np.cross(a, b)
    angle = np.arctan2(np.linalg.norm(axis), a @ b)
    if np.linalg.norm(axis) < 1e-3:
        # From front to back, or without a turn, the axis is undefined: use the up direction.
        axis = end.up
    turn = Rotation.from_rotvec(fraction * angle * axis / np.linalg.norm(axis))
    length = (1.0 - fraction) * lengths[0] + fraction * lengths[1]
    focus = (1.0 - fraction) * start.focus + fraction * end.focus
    return View(focus + length * turn.apply(a), focus, end.up)


_MOST_THICK = 0.12
"""Largest thickness of a dragged limb, as a fraction of the body size."""

_CLEAR = 0.01
"""Gap between a surface and a patch dragged over it, as a fraction of the body size."""

_WIDE = 0.06
"""Half the width of the rolling ellipsoid, about that of a hand, as a fraction of the body size."""

_LEAST_SEEN = 0.05
"""Lower bound of the squared sine of the angle between an axis and the line of sight."""


class DragTarget:
    """Find the 3D target of a drag from an image position.

    The target is at the depth of the grabbed point, but in front of the rest of the body where
    that is nearer, as if half an ellipsoid rolled over it: a hand goes round a hip and comes to
    rest on it, not behind it. Once `shift` is called, only the chosen depth counts.

    Parameters
    ----------
    view, size : camera and size of the image, fixed during the drag
    grabbed_point : (3,) point that was grabbed
    vertices : (V, 3) array, as the drag begins
    faces : (F, 3) array, of the mesh
    moving_vertices : (V,) bool array, the vertices that follow the pointer and cannot obstruct it
    body_size : in the data's unit
    """

    def __init__(
        self,
        view: View,
        size: Pixel,
        grabbed_point: FloatArray,
        vertices: npt.NDArray[np.floating],
        faces: npt.NDArray[np.integer],
        moving_vertices: npt.NDArray[np.bool_],
        body_size: float,
    ) -> None:
        self._view, self._size, self._plane = view, size, grabbed_point
        self._snaps = True
        moves = moving_vertices[faces]
        self._wide = _WIDE * body_size
        self._corners = vertices[faces[~moves.any(axis=1)]].astype(np.float64)
        places = places_of(view, self._corners.reshape(-1, 3), size).reshape(-1, 3, 2)
        self._low, self._high = places.min(axis=1), places.max(axis=1)
        # Add the centroids of faces, for coarse meshes.
        middles = self._corners.mean(axis=1)
        used = np.unique(faces[~moves.any(axis=1)])
        self._points = np.concatenate([vertices[used].astype(np.float64), middles])
        away = grabbed_point - view.position
        distances = _distances(view.position, away, vertices[faces[moves.all(axis=1)]])
        # The far side of the grabbed limb rests on the surface: find its thickness.
        behind = distances[distances > 1.0] * np.linalg.norm(away)
        thick = float(behind.min(initial=np.inf) - np.linalg.norm(away))
        self._thickness = (thick if thick < _MOST_THICK * body_size else 0.0) + _CLEAR * body_size

    def target(self, place: Pixel) -> FloatArray:
        """Return the (3,) target for an image position."""
        view = self._view
        there = unproject(view, place, self._size, self._plane)
        if not self._snaps:
            return there
        way = there - view.position
        length = float(np.linalg.norm(way))
        ray = way / length
        arms = self._points - view.position
        depths = arms @ ray
        squared = 1.0 - ((arms**2).sum(axis=1) - depths**2) / self._wide**2
        near = squared > 0.0
        rolled = depths[near] - self._thickness * np.sqrt(squared[near])
        at = np.array(place)
        inside = ((self._low <= at) & (at <= self._high)).all(axis=1)
        hit = _distances(view.position, ray, self._corners[inside]) - self._thickness
        depth = min(length, rolled.min(initial=np.inf), hit.min(initial=np.inf))
        point: FloatArray = view.position + depth * ray
        return point

    def shift(self, place: Pixel, by: float) -> None:
        """Move the target at an image position away from the viewer, and keep that depth."""
        forward = self._view.focus - self._view.position
        self._plane = self.target(place) + by * forward / np.linalg.norm(forward)
        self._snaps = False


def _distances(start: FloatArray, way: FloatArray, corners: npt.NDArray[np.floating]) -> FloatArray:
    """Return where a ray hits triangles, as positive multiples of its (3,) direction.

    Parameters
    ----------
    corners : (n, 3, 3)

    Notes
    -----
    Möller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
    """
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(way, second)
    volume = (first * across).sum(axis=1)
    hit = np.abs(volume) > 0.0
    scale = np.where(hit, volume, 1.0)
    offset = start - corners[:, 0]
    a = (offset * across).sum(axis=1) / scale
    turned = np.cross(offset, first)
    b = turned @ way / scale
    far = (second * turned).sum(axis=1) / scale
    hit &= (a >= 0.0) & (b >= 0.0) & (a + b <= 1.0) & (far > 0.0)
    distances: FloatArray = far[hit]
    return distances


def along_axis(
    view: View, place: Pixel, size: Pixel, origin: FloatArray, axis: FloatArray
) -> float:
    """Return the coordinate, along an axis, of the point nearest to the ray of an image position.

    Parameters
    ----------
    origin, axis : (3,) point and unit vector; an axis along the line of sight is treated as if it
        were seen slightly from the side
    """
    ray = unproject(view, place, size, origin) - view.position
    ray /= np.linalg.norm(ray)
    offset, slant = view.position - origin, float(axis @ ray)
    return float((axis @ offset - slant * (ray @ offset)) / max(1.0 - slant**2, _LEAST_SEEN))


class Animation(QVariantAnimation):
    """Animate once from one state to another, with easing at both ends.

    Parameters
    ----------
    milliseconds : duration
    parent : of the object

    Signals
    -------
    moved : the state that the function passed to `begin` returns
    """

    moved = Signal(object)

    def __init__(self, milliseconds: int, parent: QObject) -> None:
        super().__init__(parent, startValue=0.0, endValue=1.0, duration=milliseconds)
        self.setEasingCurve(QEasingCurve.Type.InOutCubic)
        self._at: Callable[[float], object] = lambda _: None

    @property
    def is_running(self) -> bool:
        """Whether the animation is running."""
        return self.state() is not QAbstractAnimation.State.Stopped

    def begin(self, at: Callable[[float], object]) -> None:
        """Restart; `at` returns the state at a fraction from 0 to 1."""
        self.stop()
        self._at = at
        self.start()

    def updateCurrentValue(self, fraction: float) -> None:  # noqa: N802 - Qt's name
        """Emit the next state."""
        if self.is_running:
            self.moved.emit(self._at(fraction))
