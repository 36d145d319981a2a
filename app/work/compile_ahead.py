"""Compiles the exact check in a process of its own, at the first start on a computer.

Numba compiles one function at a time in a process, and the exact check takes as long as all else
that a first frame needs. This module run as a program is that process: it writes a byte once a
check is compiled, and goes on with what measures distances. Whatever it does not do is compiled
when it is needed.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from os import environ
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING

import numpy as np

import lcollision_core
from lcollision_core.jobs import UNWATCHED, Job

if TYPE_CHECKING:
    from lcollision_core.contact import CollisionDetector

_log = logging.getLogger(__name__)

_PATIENCE = 60.0
"""Seconds after which a process that does nothing is waited for no more."""

_CORNER = np.eye(3)
_PROGRAM = """
import runpy, sys
sys.path[:] = {path!r}
runpy.run_module({name!r}, run_name="__main__")
"""


class CompileAhead:
    """That process, which need not have begun; safe to share between threads."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._checked, self._ended = Event(), Event()
        for event in (self._checked, self._ended):
            event.set()

    def begin(self) -> None:
        """Begin to compile, where that was not done; to be called once."""
        if is_compiled() or not sys.executable or getattr(sys, "frozen", False):
            return
        # With the modules of this process, whatever the folder it runs in.
        program = _PROGRAM.format(path=sys.path, name=__name__)
        nowhere, hidden = subprocess.DEVNULL, getattr(subprocess, "CREATE_NO_WINDOW", 0)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=nowhere,
                stdout=subprocess.PIPE,
                stderr=nowhere,
                creationflags=hidden,
            )
        except OSError as error:
            _log.warning("nothing is compiled ahead: %s", error)
            return
        self._checked.clear()
        self._ended.clear()
        Thread(target=self._follow, args=(self._process,), daemon=True).start()

    def _follow(self, process: subprocess.Popen[bytes]) -> None:
        with process:
            assert process.stdout is not None
            process.stdout.read(1)
            self._checked.set()
        self._ended.set()

    def wait_for_check(self, job: Job = UNWATCHED) -> None:
        """Wait until a check is compiled.

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        _wait(self._checked, job)

    def wait_for_all(self, job: Job = UNWATCHED) -> None:
        """Wait until all is compiled.

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        _wait(self._ended, job)

    def end(self) -> None:
        """Stop compiling."""
        if self._process is not None:
            self._process.terminate()


def _wait(event: Event, job: Job) -> None:
    deadline = time.monotonic() + _PATIENCE
    while not event.wait(0.05) and time.monotonic() < deadline:
        job.check()


def is_compiled() -> bool:
    """Tell whether what the process compiles last seems to be compiled on this computer."""
    # Importing Numba to ask it would take a second. Where it keeps what it compiled in yet another
    # place, the process finds it and ends at once.
    folder = Path(lcollision_core.__file__).parent / "contact"
    newest = (folder / "kernels.py").stat().st_mtime
    kept = environ.get("NUMBA_CACHE_DIR")
    places = Path(kept).glob("contact_*") if kept else [folder / "__pycache__"]
    name = f"kernels.look_again-*.py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return any(file.stat().st_mtime >= newest for place in places for file in place.glob(name))


def triangle() -> CollisionDetector:
    """Return the exact check of a triangle, and check it."""
    from lcollision_core.contact import CollisionDetector
    from lcollision_core.meshes import Topology

    detector = CollisionDetector(Topology(np.arange(3)[None], 3), _CORNER)
    detector.detect(_CORNER)
    return detector


def measure(detector: CollisionDetector) -> None:
    """Measure the triangle, and ask whether it is free, as Resolve does."""
    detector.least_distance(_CORNER, 0.1)
    detector.are_colliding(_CORNER[None], workers=1)


AHEAD = CompileAhead()
"""That of the editor."""


def _run() -> None:
    from lcollision_core.contact.kernels import search_pose

    # Where nothing can be kept, all of it would be compiled twice.
    if search_pose.stats.cache_path is not None:  # type: ignore[attr-defined]  # Numba's
        checked = triangle()
        sys.stdout.write(".")
        sys.stdout.flush()
        measure(checked)


if __name__ == "__main__":
    _run()
