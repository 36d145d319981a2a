# SPDX-License-Identifier: GPL-3.0-or-later
"""LCollision in Blender: find and resolve self-collisions of rigged meshes in poses and actions.

The engine is a separate process that this add-on sends requests to.
"""

from . import actions, cloth, drawing, link, live, operators, panel, results, rules


def register() -> None:
    """Add the panel, its operators and the settings of scenes."""
    panel.register()
    operators.register()
    actions.register()
    cloth.register()
    rules.register()
    drawing.register()
    results.register()
    live.register()


def unregister() -> None:
    """Remove everything, and end the engine."""
    live.unregister()
    results.unregister()
    drawing.unregister()
    rules.unregister()
    cloth.unregister()
    actions.unregister()
    operators.unregister()
    panel.unregister()
    link.stop()
