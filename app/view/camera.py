"""Cameras: presets, framing, zooming and blending."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

CAMERAS = ("Three-quarter", "Front", "Back", "Left", "Right", "Top")
"""Names of the preset views; left and right are the body's own."""

VIEW_ANGLE = 24.0
"""Degrees from the picture's bottom to its top: narrow, so that near limbs do not swell."""

_MARGIN = 1.2
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
