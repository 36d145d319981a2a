"""The camera: how it moves, eases and measures depth under the pointer."""

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
"""Degrees from the picture's bottom to its top: narrow, so that near limbs do not swell."""

_MARGIN = 1.2
_ALONG_SIGHT = 0.3
"""Sine of the angle to the line of sight below which an axis counts as seen from its end."""
_STEEPEST = 89.0
"""Degrees above or below the horizon to which the camera is turned by hand."""
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
    name: str, vertices: npt.NDArray[Any], up_axis: int, front: FloatArray, aspect: float
) -> View:
    """Look at a whole mesh from a side.

    Parameters
    ----------
    name : one of `CAMERAS`
    vertices : (V, 3) array
    up_axis : 0, 1 or 2
    front : (3,) array of length 1, the direction that the body faces
    aspect : the picture's width over its height

    Raises
    ------
    KeyError : `name` is no preset.
    """
    up = np.eye(3)[up_axis]
    left = np.cross(up, front)
    towards = {
        "Three-quarter": 0.86 * front + 0.44 * left + 0.22 * up,
        "Front": front,
        "Back": -front,
        "Left": left,
        "Right": -left,
        # Straight from above, an upright camera has no defined direction to turn in.
        "Top": up + 0.02 * front,
    }[name]
    return framing(vertices, towards, up, aspect)


def framing(vertices: npt.NDArray[Any], towards: FloatArray, up: FloatArray, aspect: float) -> View:
    """Look at a whole mesh from a direction.

    Parameters
    ----------
    vertices : (V, 3) array
    towards : (3,) array, from the mesh to the camera
    up : (3,) array of length 1, upright in the picture
    aspect : the picture's width over its height
    """
    towards = towards / np.linalg.norm(towards)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    focus = 0.5 * (low + high).astype(np.float64)
    needed, depth = _needed_distances(vertices - focus, towards, up, aspect)
    distance = float((_MARGIN * needed + depth).max())
    return View(focus + distance * towards, focus, up)


def sees_all(view: View, vertices: npt.NDArray[Any], aspect: float) -> bool:
    """Tell whether a whole mesh is inside the picture.

    Parameters
    ----------
    vertices : (V, 3) array
    aspect : the picture's width over its height
    """
    arm = view.position - view.focus
    distance = float(np.linalg.norm(arm))
    needed, depth = _needed_distances(vertices - view.focus, arm / distance, view.up, aspect)
    return bool((needed + depth <= distance).all())


def kept_in_view(
    view: View, before: npt.NDArray[Any], after: npt.NDArray[Any], aspect: float
) -> View | None:
    """Keep the whole mesh in view from the same side, if it was before the pose changed.

    Parameters
    ----------
    before, after : (V, 3) arrays
    aspect : the picture's width over its height

    Returns
    -------
    wanted : None if the view may stay as it is
    """
    if not sees_all(view, before, aspect) or sees_all(view, after, aspect):
        return None
    return framing(after, view.position - view.focus, view.up, aspect)


def followed(
    view: View, before: npt.NDArray[Any], after: npt.NDArray[Any], up_axis: int, aspect: float
) -> View:
    """Move a camera along with a body that moves on, so that it stays where it is in the picture.

    The camera stays level, so that steps and jumps are seen, unless the body would leave the
    picture.

    Parameters
    ----------
    before, after : (V, 3) arrays
    up_axis : 0, 1 or 2
    aspect : the picture's width over its height
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
    """Return how far before the camera each point must lie to be seen, and its own depth."""
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
    """Bring the camera nearer to a point, or away from it; the point stays in its place on screen.

    Parameters
    ----------
    anchor : (3,) array, in the data's unit
    factor : of the distance to it, below 1 to come nearer; limited at both ends
    vertices : (V, 3) array; turning goes round a point of the line of sight that is as deep in the
        scene as they are
    body_size : in the data's unit
    """
    arm = view.position - anchor
    distance = float(np.linalg.norm(arm))
    near, far = _NEAREST * body_size, _FARTHEST * body_size
    # Never past a limit, but one that is beyond it already may stay.
    factor = float(np.clip(factor, min(near / distance, 1.0), max(far / distance, 1.0)))
    position = anchor + factor * arm
    sight = view.focus - view.position
    depth = float(np.linalg.norm(sight))
    sight = sight / depth
    depths = (vertices - position) @ sight
    depth = float(np.clip(factor * depth, depths.min(), depths.max()))
    return View(position, position + max(depth, 0.5 * near) * sight, view.up)


def turned(view: View, across: float, upwards: float) -> View:
    """Turn a camera round its focus; it stays upright.

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
    """Shift a camera so that what is as deep as its focus follows the pointer.

    Parameters
    ----------
    start, end : of the pointer; see `seen_at`
    size : of the picture
    """
    motion = seen_at(view, start, size, view.focus) - seen_at(view, end, size, view.focus)
    return View(view.position + motion, view.focus + motion, view.up)


def turn_about(axis: FloatArray, view: View) -> FloatArray:
    """Return the direction on the picture in which what is before an axis moves as it turns.

    Parameters
    ----------
    axis : (3,) array of length 1; what it turns, turns anticlockwise seen from its tip

    Returns
    -------
    direction : (2,) array of length 1, to the right and down
    """
    right, upward, forward = _axes(view)
    motion = np.cross(axis, -forward)
    across = np.array([motion @ right, -(motion @ upward)])
    length = float(np.linalg.norm(across))
    if length < _ALONG_SIGHT:
        # Seen from its end, where the upper rim goes left as it turns towards the viewer.
        return np.array([np.sign(axis @ forward) or 1.0, 0.0])
    direction: FloatArray = across / length
    return direction


def seen_at(view: View, place: Pixel, size: Pixel, deep_as: FloatArray) -> FloatArray:
    """Return the (3,) point that is seen at a place of the picture, as deep as another point.

    Parameters
    ----------
    place : in pixels from the picture's left and top
    size : width and height of the picture, in the same pixels
    deep_as : (3,) array, in the data's unit
    """
    axes = _axes(view)
    depth = float((deep_as - view.position) @ axes[2])
    pixel = _pixel(depth, size[1])
    away = np.array([place[0] - 0.5 * size[0], 0.5 * size[1] - place[1]]) * pixel
    point: FloatArray = view.position + away @ axes[:2] + depth * axes[2]
    return point


def places_of(view: View, points: npt.NDArray[Any], size: Pixel) -> FloatArray:
    """Return where points are seen: (N, 2), in pixels from the picture's left and top.

    Parameters
    ----------
    points : (N, 3) array, in the data's unit, before the camera
    size : width and height of the picture
    """
    if not len(points):
        # Most pictures have no marks, and there is one after each event.
        return np.empty((0, 2))
    right, upward, depth = _axes(view) @ (points - view.position).T
    pixel = _pixel(np.maximum(depth, 1e-9), size[1])
    return np.stack([0.5 * size[0] + right / pixel, 0.5 * size[1] - upward / pixel], axis=1)


def pixel_length(view: View, point: FloatArray, size: Pixel) -> float:
    """Return how long one pixel of a picture is at a (3,) point, in the data's unit."""
    depth = float((point - view.position) @ _axes(view)[2])
    return float(_pixel(max(depth, 1e-9), size[1]))


def _axes(view: View) -> FloatArray:
    """Return the camera's right, up and forward, each of length 1, as the rows of a matrix."""
    forward = view.focus - view.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, view.up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def _pixel(depth: Any, height: float) -> Any:
    """Return how long one pixel of a picture is at a depth, in the data's unit."""
    return 2.0 * depth * np.tan(np.radians(0.5 * VIEW_ANGLE)) / height


def between(start: View, end: View, fraction: float) -> View:
    """Blend two cameras, on an arc round their focus.

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
        # From front to back the axis is ambiguous: take the upright one.
        axis = end.up
    turn = Rotation.from_rotvec(fraction * angle * axis / np.linalg.norm(axis))
    length = (1.0 - fraction) * lengths[0] + fraction * lengths[1]
    focus = (1.0 - fraction) * start.focus + fraction * end.focus
    return View(focus + length * turn.apply(a), focus, end.up)


_MOST_THICK = 0.12
"""Of the body size: no limb that is held is thicker."""

_CLEAR = 0.01
"""Of the body size: from the surface to what is dragged over it, which would catch on it."""

_WIDE = 0.06
"""Of the body size: half as wide is a hand, which goes round what it would run into."""

_LEAST_SEEN = 0.05
"""The least squared sine of the angle between an axis and the line of sight."""


class DragDepth:
    """Finds the point that is meant by a place of the picture.

    It lies as deep as what was taken hold of, but before the rest of the body where that is nearer,
    as if half an ellipsoid rolled over it: a hand goes round a hip and comes to rest on it instead
    of behind it. Once `shift` is called, it lies only so deep as is wanted.

    Parameters
    ----------
    view, size : of the picture, which stay the same
    taken : (3,) point that was taken hold of
    vertices : (V, 3) as the drag begins
    faces : (F, 3) of the mesh
    moving : (V,) bool array, what follows the pointer, and is never in the way of itself
    body_size : in the data's unit
    """

    def __init__(
        self,
        view: View,
        size: Pixel,
        taken: FloatArray,
        vertices: npt.NDArray[np.floating],
        faces: npt.NDArray[np.integer],
        moving: npt.NDArray[np.bool_],
        body_size: float,
    ) -> None:
        self._view, self._size, self._plane = view, size, taken
        self._snaps = True
        moves = moving[faces]
        self._wide = _WIDE * body_size
        self._corners = vertices[faces[~moves.any(axis=1)]].astype(np.float64)
        places = places_of(view, self._corners.reshape(-1, 3), size).reshape(-1, 3, 2)
        self._low, self._high = places.min(axis=1), places.max(axis=1)
        # Middles of faces too, where a mesh is coarse.
        middles = self._corners.mean(axis=1)
        used = np.unique(faces[~moves.any(axis=1)])
        self._points = np.concatenate([vertices[used].astype(np.float64), middles])
        away = taken - view.position
        distances = _distances(view.position, away, vertices[faces[moves.all(axis=1)]])
        # The far side of what is held rests on the surface.
        behind = distances[distances > 1.0] * np.linalg.norm(away)
        thick = float(behind.min(initial=np.inf) - np.linalg.norm(away))
        self._thickness = (thick if thick < _MOST_THICK * body_size else 0.0) + _CLEAR * body_size

    def point(self, place: Pixel) -> FloatArray:
        """Return the (3,) point that is meant by a place of the picture."""
        view = self._view
        there = seen_at(view, place, self._size, self._plane)
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
        """Move what is meant by a place away from the viewer, and stay so deep from now on."""
        forward = self._view.focus - self._view.position
        self._plane = self.point(place) + by * forward / np.linalg.norm(forward)
        self._snaps = False


def _distances(start: FloatArray, way: FloatArray, corners: npt.NDArray[np.floating]) -> FloatArray:
    """Return where a ray crosses triangles, as shares > 0 of its (3,) way.

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
    """Return how far along an axis the point lies that is nearest to the ray through a place.

    Parameters
    ----------
    origin, axis : (3,) point and unit vector; an axis that points to the viewer is taken to be
        seen a little from the side
    """
    ray = seen_at(view, place, size, origin) - view.position
    ray /= np.linalg.norm(ray)
    offset, slant = view.position - origin, float(axis @ ray)
    return float((axis @ offset - slant * (ray @ offset)) / max(1.0 - slant**2, _LEAST_SEEN))


class Animation(QVariantAnimation):
    """Animates once from one state to another, eased at both ends.

    Parameters
    ----------
    milliseconds : how long it takes
    parent : of the object

    Signals
    -------
    moved : what the function that was given to `begin` returns
    """

    moved = Signal(object)

    def __init__(self, milliseconds: int, parent: QObject) -> None:
        super().__init__(parent, startValue=0.0, endValue=1.0, duration=milliseconds)
        self.setEasingCurve(QEasingCurve.Type.InOutCubic)
        self._at: Callable[[float], object] = lambda _: None

    @property
    def is_running(self) -> bool:
        """Whether it is running."""
        return self.state() is not QAbstractAnimation.State.Stopped

    def begin(self, at: Callable[[float], object]) -> None:
        """Start again; `at` returns the state at a fraction from 0 to 1."""
        self.stop()
        self._at = at
        self.start()

    def updateCurrentValue(self, fraction: float) -> None:  # noqa: N802 - Qt's name
        """Emit the next state."""
        if self.is_running:
            self.moved.emit(self._at(fraction))
