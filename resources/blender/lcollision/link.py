# SPDX-License-Identifier: GPL-3.0-or-later
"""The engine's process, started on the first request."""

import json
import os
import threading
from collections.abc import Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from .client import Engine, EngineError, ProgressCallback, Request
from .results import Shown
from .scene import Rigged, SceneError

Steps = Iterator[str]
"""Yields a text before each step; it starts with "\\0" if the step only waits."""


@dataclass(frozen=True)
class OpenCharacter:
    """A character that is open in an engine.

    Attributes
    ----------
    engine : the engine
    key : its `Rigged.key` when it was opened
    rules : that differ from its own
    n_vertices : of each mesh at rest, by name
    answer : the engine's, to `open_mesh`
    """

    engine: Engine
    key: tuple
    rules: dict
    n_vertices: dict[str, int]
    answer: dict

    def send(
        self, kind: str, progress: ProgressCallback | None = None, **values: object
    ) -> Request:
        """Send a request about the character without waiting: see `Engine.send`."""
        return self.engine.send(kind, progress, character=self.answer["character"], **values)

    def check(
        self,
        rigged: Rigged,
        clearance: float,
        shown: Shown | None = None,
        before: Shown | None = None,
        counted_only: bool = False,
    ) -> Request:
        """Request a check of a pose, by default the shown one, and of the linear path to it."""
        shown = shown or Shown.of(rigged)
        self.require_same_meshes(rigged, len(shown.vertices))
        return self.send(
            "check",
            transforms=shown.transforms,
            vertices=shown.vertices,
            before=None if before is None else before.vertices,
            clearance=clearance,
            counted_only=counted_only,
        )

    def require_same_meshes(self, rigged: Rigged, n_vertices: int) -> None:
        """Require that the meshes are shown with as many vertices as at rest.

        Raises
        ------
        SceneError : a modifier changes the mesh from pose to pose.
        """
        if n_vertices == self.answer["vertices"]:
            return
        graph = bpy.context.evaluated_depsgraph_get()
        for item in rigged.meshes:
            n, at_rest = len(item.evaluated_get(graph).data.vertices), self.n_vertices[item.name]
            if n != at_rest:
                raise SceneError(
                    f"{item.name} is shown with {n} vertices and has {at_rest} in the rest pose: "
                    "a modifier such as Decimate, or Merge of a Mirror, makes another mesh of each "
                    "pose. Apply it, or turn it off in the viewport"
                )
        raise SceneError(f"The meshes of {rigged.armature.name} have changed; try again")

    def clearance(self, rigged: Rigged, length: float | None = None) -> float:
        """Convert a length of the scene, by default the panel's clearance, to body sizes."""
        size = self.answer["body_size"] * rigged.world_size()
        return (bpy.context.scene.lcollision.clearance if length is None else length) / size


_engine: Engine | None = None
_opened: dict[str, OpenCharacter] = {}
"""The last opened character of each armature, by name."""
_own_rules: dict[str, dict] = {}
"""The original rules of each character open in the engine, by its hash."""
n_going_on = 0
"""Number of running modal operators: characters are not closed meanwhile."""


_lock = threading.Lock()
_n_stops = 0
_starting: threading.Thread | None = None
_failed: list[EngineError] = []


def is_ready() -> bool:
    """Return whether the engine runs; if not, start it in a thread without waiting.

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
        n_stops = _n_stops
        python = _engine_python()
        # Blender's PYTHONHOME does not apply to the engine.
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONHOME"}
        try:
            started = Engine.start([python, "-P", "-m", "app"], env=environment)
        except EngineError as error:
            raise EngineError(
                f"{error}; is LCollision still installed there? "
                "If not, recreate the add-on: lcollision blender-addon"
            ) from error
        if _n_stops != n_stops:
            started.close(0.0)
            raise EngineError("the engine was ended")
        _engine = started
        return started


def _engine_python() -> str:
    """Return the path of the Python interpreter that has the engine."""
    path = Path(__file__).with_name("engine.json")
    try:
        python = json.loads(path.read_text(encoding="utf-8"))["python"]
    except (OSError, ValueError, LookupError, TypeError):
        python = None
    if not isinstance(python, str) or not python:
        raise EngineError(
            f"{path} does not say where LCollision is installed; "
            "recreate the add-on: lcollision blender-addon"
        )
    return python


def stop() -> None:
    """End the engine, if it runs, without waiting; it has nothing to save."""
    global _engine, _n_stops
    _n_stops += 1
    forget()
    _own_rules.clear()
    if _engine is not None:
        _engine.close(0.0)
        _engine = None


def forget() -> None:
    """Forget all opened characters."""
    _opened.clear()


def wait_for(
    engine: Engine, request: Request, text: str, progress: list | None = None
) -> Generator[str, None, dict]:
    """Wait for an answer step by step, and return it; cancel the request if the steps are closed.

    Parameters
    ----------
    engine : that the request was sent to
    progress : list whose last two entries are the done and the total amount
    """
    try:
        while not request.is_done:
            share = f" {progress[-2]} of {progress[-1]}" if progress else ""
            yield f"\0{text}{share}"
    except GeneratorExit:
        with suppress(EngineError):
            engine.cancel(request)
        raise
    return request.result()


def open_steps(
    rigged: Rigged, rules: dict, poses: np.ndarray | None = None
) -> Generator[str, None, OpenCharacter]:
    """Start the engine if it does not run, and open the present character with these rules.

    It replaces the armature's earlier character, which the engine then closes.

    Parameters
    ----------
    rules : added to the character's own
    poses : (N, J, 4, 4) transforms of the bones in a motion, which show how far they turn

    Raises
    ------
    EngineError : the engine's sentence.
    """
    while not is_ready():
        yield "\0Starting the engine"
    asked, name, key = engine(), rigged.armature.name, rigged.key()
    character = rigged.as_character()
    n_vertices = {part["name"]: len(part["vertices"]) for part in character["parts"]}
    request = asked.send("open_mesh", poses=poses, **character)
    answer = yield from wait_for(asked, request, "Opening the character")
    found = OpenCharacter(asked, key, rules, n_vertices, answer)
    own = _own_rules.setdefault(answer["character"], answer["rules"])
    reply = yield from wait_for(asked, found.send("rules"), "Reading the rules")
    answer["groups"] = reply["groups"]
    lists = {name: [*own[name], *rules.get(name, [])] for name in ("ignored", "touching")}
    request = found.send("set_rules", rules={**own, **rules, **lists})
    reply = yield from wait_for(asked, request, "Setting the rules")
    answer["in_words"] = reply["in_words"]
    _opened[name] = found
    if not n_going_on:
        used = {one.answer["character"] for one in _opened.values()}
        for character in set(_own_rules) - used:
            asked.send("close", character=character)
            del _own_rules[character]
    return found


def known(rigged: Rigged, rules: dict) -> OpenCharacter | None:
    """Return the opened character if it has not changed and has these rules, else None."""
    found = _opened.get(rigged.armature.name)
    if found is None or not found.engine.is_alive:
        return None
    return found if (found.key, found.rules) == (rigged.key(), rules) else None
