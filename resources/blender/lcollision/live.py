# SPDX-License-Identifier: GPL-3.0-or-later
"""The check while posing: the newest pose wins, and the interface never waits for the engine."""

from collections.abc import Generator

import bpy
import numpy as np

from . import drawing, link
from .client import EngineError, Request
from .scene import Rigged, SceneError

_EVERY = 0.05
"""Seconds between two looks."""

_is_on = False
_is_newer = False
_asked: Request | None = None
_opening: Generator[Request, None, dict] | None = None
"""What is being asked, and the steps of opening the character if it is one of these."""


def switch(on: bool) -> None:
    """Begin or end looking."""
    global _is_on, _is_newer, _asked, _opening
    if on == _is_on:
        return
    _is_on = _is_newer = on
    _asked = _opening = None
    handlers = bpy.app.handlers.depsgraph_update_post
    if on:
        handlers.append(_on_update)
        bpy.app.timers.register(_look)
    else:
        handlers.remove(_on_update)


def stop() -> None:
    """End looking, as the add-on goes."""
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
        bpy.context.scene.lcollision.verdict = str(error)
    except EngineError as error:
        settings = bpy.context.scene.lcollision
        settings.verdict, settings.live = str(error), False
    return _EVERY


def look() -> bool:
    """Take the answer that has come, and ask about the newest pose if no answer is on its way.

    Returns
    -------
    is_current : whether what is shown is of the newest pose
    """
    global _asked, _opening, _is_newer
    if not link.is_ready() or (_asked is not None and not _asked.is_done):
        return False
    # Objects that an undo took away must not be kept: they are looked up anew.
    rigged = Rigged.of(bpy.context)
    if _opening is not None:
        _asked = next(_opening, None)
        if _asked is not None:
            return False
        _opening = None
    elif _asked is not None:
        answer, _asked = _asked, None
        show(rigged, answer.result())
    if not _is_newer:
        return True
    known = link.known(rigged)
    if known is None:
        _opening = link.opening(rigged, bpy.context.scene.lcollision.chosen_rules())
        _asked = next(_opening)
        return False
    _is_newer = False
    _asked = ask(rigged, known)
    return False


def ask(rigged: Rigged, known: dict) -> Request:
    """Ask about the pose that is shown."""
    return link.engine().send(
        "check",
        character=known["character"],
        transforms=rigged.transforms(),
        vertices=rigged.shown(),
        clearance=link.clearance(rigged, known["character"]),
    )


def show(rigged: Rigged, reply: dict) -> None:
    """Show what a check has found, in the panel and over the mesh."""
    bpy.context.scene.lcollision.show(reply)
    pairs = np.frombuffer(reply["faces"]["data"], reply["faces"]["dtype"])
    chosen, world = np.unique(pairs), rigged.to_world()
    triangles, vertices = rigged.triangles(), rigged.shown()
    corners = triangles[chosen[chosen < len(triangles)]].ravel()
    drawing.show(vertices[corners] @ world[:3, :3].T + world[:3, 3])
