# SPDX-License-Identifier: GPL-3.0-or-later
"""The engine's process, started when it is first asked."""

import json
import os
import threading
from collections.abc import Generator
from pathlib import Path

import bpy
import numpy as np

from .client import Engine, EngineError, Request
from .scene import Rigged

_engine: Engine | None = None
_opened: dict[str, tuple[tuple, dict]] = {}
"""Of each armature by name: what it was opened as, and the engine's answer."""


_lock = threading.Lock()
_starting: threading.Thread | None = None
_failed: list[EngineError] = []


def is_ready() -> bool:
    """Return whether the engine runs; if it does not, start it beside, without waiting.

    Raises
    ------
    EngineError : it could not be started.
    """
    global _starting
    if _engine is not None and _engine.is_alive:
        return True
    if _failed:
        raise _failed.pop()
    if _starting is None or not _starting.is_alive():
        _starting = threading.Thread(target=_start, name="lcollision starts", daemon=True)
        _starting.start()
    return False


def _start() -> None:
    try:
        engine()
    except EngineError as error:
        _failed.append(error)


def engine() -> Engine:
    """Return the engine; start it if it does not run.

    Raises
    ------
    EngineError : it cannot be started; the sentence says what to do.
    """
    global _engine
    with _lock:
        if _engine is not None and _engine.is_alive:
            return _engine
        stop()
        python = json.loads(Path(__file__).with_name("engine.json").read_text())["python"]
        # Blender's own settings of Python are not the engine's.
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONHOME"}
        try:
            _engine = Engine.start([python, "-P", "-m", "app"], env=environment)
        except EngineError as error:
            raise EngineError(
                f"{error}; is LCollision still installed there? "
                "Else write the add-on again by lcollision blender-addon"
            ) from error
        return _engine


def stop() -> None:
    """End the engine, if it runs."""
    global _engine
    _opened.clear()
    if _engine is not None:
        _engine.close()
        _engine = None


def opened(rigged: Rigged, rules: dict, poses: np.ndarray | None = None) -> dict:
    """Return what the engine knows of a character, opened as it is now: see `opening`."""
    steps = opening(rigged, rules, poses)
    while True:
        try:
            next(steps).result()
        except StopIteration as end:
            return end.value


def opening(
    rigged: Rigged, rules: dict, poses: np.ndarray | None = None
) -> Generator[Request, None, dict]:
    """Open a character as it is now, with these rules; wait for each request before going on.

    Parameters
    ----------
    rules : that differ from the character's own
    poses : (N, J, 4, 4) transforms of the bones in a motion, which says how far they turn

    Raises
    ------
    EngineError : the engine's sentence.
    """
    asked = engine()
    request = asked.send("open_mesh", poses=poses, **rigged.as_character())
    yield request
    answer = request.result()
    character = answer["character"]
    request = asked.send("rules", character=character)
    yield request
    answer["groups"] = request.result()["groups"]
    first = _opened.get(character, (None, answer))[1]
    answer["own_rules"] = own = first.get("own_rules", answer["rules"])
    request = asked.send("set_rules", character=character, rules={**own, **rules})
    yield request
    answer["in_words"] = request.result()["in_words"]
    _opened[character] = (rigged.key(), answer)
    return answer


def clearance(rigged: Rigged, character: str) -> float:
    """Return the panel's clearance, in body sizes of an opened character."""
    size = _opened[character][1]["body_size"] * rigged.world_size()
    return bpy.context.scene.lcollision.clearance / size


def known(rigged: Rigged) -> dict | None:
    """Return what the engine knows of a character that was opened before and has not changed."""
    if _engine is None or not _engine.is_alive:
        return None
    key = rigged.key()
    return next((answer for of, answer in _opened.values() if of == key), None)
