"""Small marks drawn over the body: pins, contacts, the target of a drag and arrows to drag."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkActor2D, vtkPolyDataMapper2D

from app.view.camera import Pixel, View, pixel_length, places_of
from app.view.shading import CONTACT, rgb

if TYPE_CHECKING:
    from vtkmodules.vtkRenderingCore import vtkRenderer

FloatArray = npt.NDArray[np.float64]

PIN_RADIUS = 7.0
"""Of a pin's dot with its rim, in device-independent pixels."""

ARROW_LENGTH = 70.0
"""Of the arrows along the axes, in device-independent pixels."""

AXIS_COLOURS = ("#e5484d", "#46a758", "#3e7bfa")
"""Of the body's left, front and up."""

_CONTACT_RADIUS, _STANDING_RADIUS = 6.0, 4.5
_APART = 16.0
"""Pixels between two marks of contact, as what is nearer shares one."""

_TARGET_RADIUS = 0.018
"""Of the ring round a target, which is smaller far away, and of its shadow: normalised."""

_DARK, _LIGHT = "#14171c", "#ffffff"
_SIDES = 24


class Marks:
    """Draws pins, contacts, what stands, the target of a drag with its shadow, and arrows.

    Parameters
    ----------
    renderer : to draw in
    body_size : in the data's unit
    up : (3,) unit vector
    """

    def __init__(self, renderer: vtkRenderer, body_size: float, up: FloatArray) -> None:
        self._renderer, self._body_size, self._up = renderer, body_size, up
        self.pins = self._contacts = self._standing = np.zeros((0, 3))
        self._line: FloatArray | None = None
        self._arrows: tuple[FloatArray, FloatArray] | None = None
        self._colours: tuple[str, ...] = ()
        self._flat = pv.PolyData()
        mapper = vtkPolyDataMapper2D()
        mapper.SetInputData(self._flat)
        mapper.SetScalarModeToUseCellData()
        self._actor = vtkActor2D()
        self._actor.SetMapper(mapper)
        self._actor.SetVisibility(False)
        renderer.AddViewProp(self._actor)

    def show_pins(self, places: npt.NDArray[Any], colours: Sequence[str]) -> None:
        """Draw dots at (P, 3) points, in colours "#rrggbb"."""
        self.pins, self._colours = np.asarray(places, dtype=np.float64), tuple(colours)

    def show_contacts(self, places: npt.NDArray[Any]) -> None:
        """Draw rings at (C, 3) points, one for those that are near each other on the screen."""
        self._contacts = np.asarray(places, dtype=np.float64)

    def show_standing(self, places: npt.NDArray[Any]) -> None:
        """Draw small rings at (S, 3) points that stay on the ground."""
        self._standing = np.asarray(places, dtype=np.float64)

    def show_target(self, line: FloatArray | None) -> None:
        """Draw the target of a drag and how far it is above the ground, or none.

        Parameters
        ----------
        line : (3, 3) array: what is dragged, its target, and the point on the ground below that
        """
        self._line = line

    def show_arrows(self, origin: FloatArray | None, axes: FloatArray) -> None:
        """Draw arrows from a point along the (3, 3) axes, the rows, or none."""
        self._arrows = None if origin is None else (origin, axes)

    def arrow_at(self, place: Pixel, view: View, size: Pixel) -> int | None:
        """Return the index of the axis whose arrow is at a place of the picture, or None."""
        if self._arrows is None:
            return None
        start, *tips = self._arrow_places(view, size)
        away = []
        for tip in tips:
            along = tip - start
            share = float(np.clip((place - start) @ along / max(along @ along, 1e-9), 0.25, 1.0))
            away.append(float(np.linalg.norm(start + share * along - place)))
        nearest = int(np.argmin(away))
        return nearest if away[nearest] <= PIN_RADIUS else None

    def _arrow_places(self, view: View, size: Pixel) -> FloatArray:
        assert self._arrows is not None
        origin, axes = self._arrows
        length = ARROW_LENGTH * pixel_length(view, origin, size)
        return places_of(view, origin + length * np.concatenate([np.zeros((1, 3)), axes]), size)

    def pin_at(self, place: Pixel, view: View, size: Pixel) -> int | None:
        """Return the index of the pin whose dot is at a place of the picture, or None."""
        if not len(self.pins):
            return None
        away = np.linalg.norm(places_of(view, self.pins, size) - np.array(place), axis=1)
        nearest = int(away.argmin())
        return nearest if away[nearest] <= PIN_RADIUS + 1.0 else None

    def fit(self, view: View, sharpness: float) -> None:
        """Follow the camera, just before a picture.

        Parameters
        ----------
        sharpness : device pixels per device-independent one
        """
        width, height = self._renderer.GetSize()
        size = width / sharpness, height / sharpness
        shapes: list[tuple[FloatArray, str]] = []
        if self._line is not None:
            shapes += self._target_shapes(self._line, view, size)
        if self._arrows is not None:
            start, *tips = self._arrow_places(view, size)
            for tip, colour in zip(tips, AXIS_COLOURS, strict=True):
                shapes += [(_arrow(start, tip, 2.6), _DARK), (_arrow(start, tip, 1.6), colour)]
        for place in places_of(view, self._standing, size):
            for inner, inset, colour in ((1.5, -1.0, _DARK), (2.5, 0.0, _LIGHT)):
                shapes.append((_ring(place, inner, _STANDING_RADIUS - inset), colour))
        for place in _thinned(places_of(view, self._contacts, size)):
            for inner, inset, colour in ((1.8, -1.2, _DARK), (3.0, 0.0, CONTACT)):
                shapes.append((_ring(place, inner, _CONTACT_RADIUS - inset), colour))
        for place, own in zip(places_of(view, self.pins, size), self._colours, strict=True):
            for inset, colour in ((0.0, _DARK), (1.3, _LIGHT), (3.0, own)):
                shapes.append((_ring(place, 0.0, PIN_RADIUS - inset), colour))
        self._actor.SetVisibility(len(shapes) > 0)
        if not shapes:
            return
        corners = np.concatenate([quads for quads, _ in shapes])
        corners[:, :, 1] = size[1] - corners[:, :, 1]
        flat = np.zeros((4 * len(corners), 3), dtype=np.float32)
        flat[:, :2] = corners.reshape(-1, 2) * sharpness
        self._flat.points = flat
        self._flat.SetPolys(pv.CellArray.from_regular_cells(np.arange(len(flat)).reshape(-1, 4)))
        paint = np.repeat([rgb(c) for _, c in shapes], [len(q) for q, _ in shapes], axis=0)
        self._flat.cell_data.set_scalars(paint, "colours")

    def _target_shapes(
        self, line: FloatArray, view: View, size: Pixel
    ) -> list[tuple[FloatArray, str]]:
        start, end, below = places_of(view, line, size)
        shapes: list[tuple[FloatArray, str]] = []
        around = self._body_size * _TARGET_RADIUS
        seen = around / pixel_length(view, line[1], size)
        # The shadow lies flat on the ground.
        aside = np.eye(3)[[axis for axis in range(3) if not self._up[axis]]]
        rim = [
            places_of(view, line[2] + share * around * (_CIRCLE @ aside), size)
            for share in (0.8, 1.0)
        ]
        shadow = np.stack([rim[0][:-1], rim[1][:-1], rim[1][1:], rim[0][1:]], axis=1)
        for half, colour in ((1.2, _DARK), (0.5, _LIGHT)):
            shapes.append((_bar(end, below, half), colour))
        shapes.append((shadow, _DARK))
        for half, colour in ((2.0, _DARK), (0.9, _LIGHT)):
            shapes.append((_bar(start, end, half), colour))
            shapes.append((_ring(end, max(seen - half, 0.0), seen + half), colour))
        return shapes


_ANGLES = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def _arrow(start: FloatArray, tip: FloatArray, half: float) -> FloatArray:
    """Return an arrow with a head, (2, 4, 2)."""
    neck = start + 0.8 * (tip - start)
    along = tip - start
    aside = 3.0 * half * np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    head = np.stack([neck + aside, neck - aside, tip, tip])
    return np.concatenate([_bar(start, neck, half), head[None]])


def _ring(middle: FloatArray, inner: float, outer: float) -> FloatArray:
    """Return a ring, or a disc where its inner radius is 0, as (n, 4, 2) quadrangles."""
    rim, on = _CIRCLE[:-1], _CIRCLE[1:]
    corners = np.stack([inner * rim, outer * rim, outer * on, inner * on])
    quads: FloatArray = middle + corners.transpose(1, 0, 2)
    return quads


def _bar(start: FloatArray, end: FloatArray, half: float) -> FloatArray:
    """Return a line of a width as one quadrangle, (1, 4, 2)."""
    along = end - start
    aside = half * np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    return np.stack([start + aside, start - aside, end - aside, end + aside])[None]


def _thinned(places: FloatArray) -> list[FloatArray]:
    """Leave out places that are near one before them."""
    kept: list[FloatArray] = []
    for place in places:
        if all(np.linalg.norm(place - other) >= _APART for other in kept):
            kept.append(place)
    return kept
