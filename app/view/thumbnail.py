"""Small pictures of meshes, drawn without OpenGL.

A second OpenGL context beside the viewport's would switch contexts for each picture, which crashes
software drivers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtGui import QImage, QPixmap

from app.view.camera import VIEW_ANGLE, View
from app.view.theme import current_theme

_SKIN = {False: (232, 227, 219), True: (214, 210, 205)}
"""Colour of the mesh, by whether the theme is dark."""

_FINENESS = 2
"""Dots per pixel along each axis, averaged to smooth the edges."""

_AMBIENT = 0.42


def draw_pose(
    vertices: npt.NDArray[Any],
    faces: npt.NDArray[np.int32],
    view: View,
    side: int,
    colour: tuple[int, int, int],
) -> npt.NDArray[np.uint8]:
    """Draw a mesh as dots, the nearest last.

    Parameters
    ----------
    vertices : (V, 3) array, in the data's unit
    faces : (F, 3) array
    view : camera, used without perspective
    side : of the picture, in pixels
    colour : red, green and blue of the lit mesh, from 0 to 255

    Returns
    -------
    pixels : (side, side, 4) uint8 array, red, green, blue and alpha, which is 0 beside the mesh
    """
    # Import late: it loads the compiler, which must wait until the window is on the screen.
    from lcollision_core.meshes.normals import vertex_normals

    arm = view.position - view.focus
    distance = float(np.linalg.norm(arm))
    towards = arm / distance
    axes = np.stack([np.cross(view.up, towards), view.up, towards])
    points = (np.asarray(vertices, dtype=np.float64) - view.focus) @ axes.T
    n_dots = side * _FINENESS
    points *= 0.5 * n_dots / (distance * math.tan(math.radians(0.5 * VIEW_ANGLE)))
    lamp = np.array([-0.35, 0.5, 0.8])
    lit = vertex_normals(vertices, faces) @ axes.T @ (lamp / np.linalg.norm(lamp))
    light = np.clip(lit, 0.0, 1.0)
    a, b, c = (points[corner] for corner in faces.T)
    turned = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] > 0.0
    visible_faces = faces[turned]
    edges = np.abs(points[visible_faces] - points[np.roll(visible_faces, 1, axis=1)])[..., :2]
    # Round up to powers of two, so that few sizes of triangles are drawn.
    cuts = 2 ** np.ceil(np.log2(edges.max(axis=(1, 2)).clip(1.0, n_dots))).astype(np.intp)
    parts = [np.zeros((0, 4))]
    for count in np.unique(cuts):
        of_size = visible_faces[cuts == count]
        values = np.concatenate([points[of_size], light[of_size][..., None]], axis=2)
        parts.append(np.einsum("wk,fkd->fwd", _barycentric(count), values).reshape(-1, 4))
    dots, shade = np.split(np.concatenate(parts), [3], axis=1)
    order = np.argsort(dots[:, 2], kind="stable")
    columns = np.floor(0.5 * n_dots + dots[order, 0]).astype(np.intp)
    rows = np.floor(0.5 * n_dots - dots[order, 1]).astype(np.intp)
    inside = (columns >= 0) & (columns < n_dots) & (rows >= 0) & (rows < n_dots)
    # If several dots fall on one pixel, the last one written, the nearest, stays.
    picture = np.zeros((n_dots, n_dots, 4))
    strength = (_AMBIENT + (1.0 - _AMBIENT) * shade[order])[inside]
    picture[rows[inside], columns[inside], :3] = strength * np.array(colour)
    picture[rows[inside], columns[inside], 3] = 255.0
    blocks = picture.reshape(side, _FINENESS, side, _FINENESS, 4).sum(axis=(1, 3))
    counts = np.maximum(blocks[..., 3:] / 255.0, 1.0)
    blocks[..., :3] /= counts
    blocks[..., 3] /= _FINENESS**2
    return np.ascontiguousarray(blocks.round().astype(np.uint8))


def thumbnail_pixmap(
    vertices: npt.NDArray[Any],
    faces: npt.NDArray[np.int32],
    view: View,
    side: int,
    device_pixel_ratio: float,
) -> QPixmap:
    """Draw a mesh in the theme's skin colour, in device-independent pixels; see `draw_pose`."""
    n_pixels = round(side * device_pixel_ratio)
    pixels = draw_pose(vertices, faces, view, n_pixels, _SKIN[current_theme().is_dark])
    image = QImage(pixels.data, n_pixels, n_pixels, QImage.Format.Format_RGBA8888)
    image.setDevicePixelRatio(device_pixel_ratio)
    return QPixmap.fromImage(image)


def _barycentric(cuts: int) -> npt.NDArray[np.float64]:
    """Return barycentric coordinates of evenly spaced points of a triangle, (W, 3)."""
    counts = [(i, j, cuts - i - j) for i in range(cuts + 1) for j in range(cuts + 1 - i)]
    return np.array(counts) / cuts
