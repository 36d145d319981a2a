"""How far from the viewer a drag leads: in a plane, or on the body where that is in the way."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from app.view.camera import Pixel, View, places_of, seen_at

FloatArray = npt.NDArray[np.float64]

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
        found = _distances(view.position, away, vertices[faces[moves.all(axis=1)]])
        # The far side of what is held rests on the surface.
        behind = found[found > 1.0] * np.linalg.norm(away)
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
