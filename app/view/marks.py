"""Small marks of a constant size on the screen, drawn over the body: pins and contacts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkActor2D, vtkPolyDataMapper2D

from app.view.camera import Pixel, View, places_of
from app.view.shading import CONTACT, rgb

if TYPE_CHECKING:
    from vtkmodules.vtkRenderingCore import vtkRenderer

FloatArray = npt.NDArray[np.float64]

PIN_RADIUS = 7.0
"""Of a pin's dot with its rim, in device-independent pixels."""

_CONTACT_RADIUS = 6.0
_APART = 16.0
"""Pixels between two marks of contact, as what is nearer shares one; of the shortest line."""

_DARK, _LIGHT = "#14171c", "#ffffff"
_SIDES = 24


class Marks:
    """Draws dots where pins are, rings where contact holds, and lines from grips to their targets.

    Parameters
    ----------
    renderer : to draw in
    """

    def __init__(self, renderer: vtkRenderer) -> None:
        self._renderer = renderer
        self.pins = self._contacts = np.zeros((0, 3))
        self._lines = np.zeros((0, 2, 3))
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

    def show_lines(self, ends: npt.NDArray[Any]) -> None:
        """Draw (L, 2, 3) lines."""
        self._lines = np.asarray(ends, dtype=np.float64)

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
        for ends in self._lines:
            start, end = places_of(view, ends, size)
            if np.linalg.norm(end - start) < _APART:
                continue
            for half, colour in ((2.0, _DARK), (0.9, _LIGHT)):
                shapes += [(_bar(start, end, half), colour), (_ring(end, 0.0, 2.2 * half), colour)]
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


def _ring(middle: FloatArray, inner: float, outer: float) -> FloatArray:
    """Return a ring, or a disc where its inner radius is 0, as (n, 4, 2) quadrangles."""
    angles = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    rim = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = np.stack([inner * rim[:-1], outer * rim[:-1], outer * rim[1:], inner * rim[1:]])
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
