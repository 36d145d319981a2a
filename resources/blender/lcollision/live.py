# SPDX-License-Identifier: GPL-3.0-or-later
"""The live check: the newest pose wins, and the interface never waits for the engine."""

import bpy
from bpy.app.handlers import persistent

from . import drawing, link, results
from .client import EngineError, Request
from .scene import Rigged, SceneError

_EVERY = 0.05
"""Seconds between two polls."""

_is_on = False
_is_newer = False
_asked: Request | None = None
_shown: results.Shown | None = None
_opening: link.Steps | None = None
"""The pending check and the character it applies to, or the steps of opening the character."""


def is_on() -> bool:
    """Return whether the live check is on."""
    return _is_on


def switch(on: bool) -> None:
    """Turn the live check on or off."""
    global _is_on, _is_newer, _asked, _opening
    if on == _is_on:
        return
    _is_on = _is_newer = on
    _asked = _opening = None
    handlers = bpy.app.handlers.depsgraph_update_post
    if on:
        handlers.append(_on_update)
        if not bpy.app.timers.is_registered(_look):
            bpy.app.timers.register(_look)
        return
    drawing.clear()
    # Blender removes the handler itself when a file is loaded.
    if _on_update in handlers:
        handlers.remove(_on_update)


@persistent
def _on_load(*_: object) -> None:
    """Forget the previous file's scene, and turn the check on if the new scene has it on."""
    switch(False)
    link.forget()
    switch(bpy.context.scene.lcollision.looks)


def register() -> None:
    """Follow loaded files, and resume the check if it was on when the add-on was disabled."""
    bpy.app.handlers.load_post.append(_on_load)
    # Scenes cannot be read during registration.
    bpy.app.timers.register(_on_load, first_interval=0.0)


def unregister() -> None:
    """Remove the handlers, and turn the live check off."""
    bpy.app.handlers.load_post.remove(_on_load)
    if bpy.app.timers.is_registered(_on_load):
        bpy.app.timers.unregister(_on_load)
    switch(False)


def _on_update(*_: object) -> None:
    global _is_newer
    _is_newer = True


def _look() -> float | None:
    if not _is_on:
        return None
    try:
        look()
    except SceneError as error:
        results.clear()
        bpy.context.scene.lcollision.verdict = str(error)
    except EngineError as error:
        results.clear()
        settings = bpy.context.scene.lcollision
        settings.live, settings.verdict = False, str(error)
    return _EVERY


def look() -> bool:
    """Show a received answer, and request a check of the newest pose if none is pending.

    Returns
    -------
    is_current : whether the shown result is that of the newest pose
    """
    global _asked, _shown, _opening, _is_newer
    if not link.is_ready() or (_asked is not None and not _asked.is_done):
        return False
    # Undo invalidates references to objects: look them up anew.
    rigged = Rigged.of(bpy.context)
    rules = bpy.context.scene.lcollision.chosen_rules(rigged)
    known = link.known(rigged, rules)
    if _opening is not None:
        # An operator may have opened it meanwhile.
        if known is None and next(_opening, None) is not None:
            return False
        _opening, known = None, link.known(rigged, rules)
    elif _asked is not None:
        answer, _asked = _asked, None
        results.show(rigged, answer.result(), _shown)
    if known is not None and not _is_newer:
        return True
    if known is None:
        _opening = link.open_steps(rigged, rules)
        return False
    _is_newer = False
    _shown = results.Shown.of(rigged)
    _asked = known.check(rigged, known.clearance(rigged), _shown)
    return False
