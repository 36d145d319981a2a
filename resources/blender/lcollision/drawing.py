# SPDX-License-Identifier: GPL-3.0-or-later
"""The faces that collide, drawn over the mesh in red."""

import bpy
import numpy as np

_COLOUR = (0.9, 0.1, 0.1, 0.6)

_corners = np.empty((0, 3))
"""(3 n, 3) corners of the triangles, in the world."""

_handler = None


def show(corners: np.ndarray) -> None:
    """Show (3 n, 3) corners of triangles from now on."""
    global _corners
    _corners = corners
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def clear() -> None:
    """Show nothing."""
    show(np.empty((0, 3)))


def shown() -> np.ndarray:
    """Return what is shown."""
    return _corners


def _draw() -> None:
    if not len(_corners):
        return
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "TRIS", {"pos": _corners.tolist()})
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("NONE")
    shader.bind()
    shader.uniform_float("color", _COLOUR)
    batch.draw(shader)
    gpu.state.blend_set("NONE")


def register() -> None:
    """Draw in all 3D views."""
    global _handler
    _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    """Draw no more."""
    bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
    clear()
