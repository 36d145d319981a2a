# SPDX-License-Identifier: GPL-3.0-or-later
"""Colliding faces, drawn over the mesh in colours."""

import bpy
import numpy as np

_SHALLOW, _DEEP = np.array([1.0, 0.8, 0.1, 0.6]), np.array([0.85, 0.0, 0.05, 0.8])
_GREY = np.array([0.5, 0.5, 0.5, 0.4])
PROPOSED = np.array([0.1, 0.4, 1.0, 0.6])

_corners = np.empty((0, 3))
"""(3 n, 3) corners of the triangles, in world coordinates."""
_colours = np.empty((0, 4))
"""(n, 4) colours of the triangles."""
_objects: frozenset[str] = frozenset()
"""Names of objects; the triangles are shown while one of them is active."""
_is_grey = False

_handler = None


def by_depth(depths: np.ndarray) -> np.ndarray:
    """Return (n, 4) colours of (n,) depths, from yellow to red for the deepest."""
    share = (depths / max(depths.max(initial=0.0), np.finfo(float).tiny))[:, None]
    return _SHALLOW + share * (_DEEP - _SHALLOW)


def show(corners: np.ndarray, colours: np.ndarray, objects: set[str]) -> None:
    """Show triangles by (3 n, 3) corners in (n, 4) colours, while one of `objects` is active."""
    global _corners, _colours, _objects, _is_grey
    _corners, _colours, _objects, _is_grey = corners, colours, frozenset(objects), False
    _redraw()


def clear() -> None:
    """Show no triangles."""
    show(np.empty((0, 3)), np.empty((0, 4)), set())


def grey(is_grey: bool) -> None:
    """Show the faces in grey or in their own colours."""
    global _is_grey
    _is_grey = is_grey
    _redraw()


def shown() -> np.ndarray:
    """Return the corners that are shown now."""
    active = bpy.context.view_layer.objects.active
    return _corners if active is not None and active.name in _objects else _corners[:0]


def colours() -> np.ndarray:
    """Return the (n, 4) colours of the shown triangles."""
    return np.broadcast_to(_GREY, _colours.shape) if _is_grey else _colours


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _draw() -> None:
    corners = shown()
    if not len(corners):
        return
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("FLAT_COLOR")
    content = {"pos": corners.tolist(), "color": np.repeat(colours(), 3, axis=0).tolist()}
    batch = batch_for_shader(shader, "TRIS", content)
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("NONE")
    batch.draw(shader)
    gpu.state.blend_set("NONE")


def register() -> None:
    """Draw in all 3D views."""
    global _handler
    _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    """Stop drawing."""
    bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
    clear()
