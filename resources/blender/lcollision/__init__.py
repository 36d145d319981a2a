# SPDX-License-Identifier: GPL-3.0-or-later
"""LCollision in Blender: where a rigged mesh runs into itself, and poses and actions that do not.

The engine is a process of its own, which this add-on asks.
"""

from . import actions, cloth, drawing, found, link, live, operators, panel, rules


def register() -> None:
    """Add the panel, its operators and the settings of scenes."""
    panel.register()
    operators.register()
    actions.register()
    cloth.register()
    rules.register()
    drawing.register()
    found.register()
    live.register()


def unregister() -> None:
    """Take all of it away, and end the engine."""
    live.unregister()
    found.unregister()
    drawing.unregister()
    rules.unregister()
    cloth.unregister()
    actions.unregister()
    operators.unregister()
    panel.unregister()
    link.stop()
