"""Compiles the exact check in a separate process, at the first start on a computer.

Numba compiles one function at a time per process, and the exact check takes as long as everything
else that a first frame needs. Run as a program, this module is that process: it writes a byte once
the check is compiled, then compiles the distance measure. Anything left is compiled on demand.
"""

from __future__ import annotations

import atexit
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
    from lcollision_core.bodies import Body
    from lcollision_core.contact import CollisionDetector

_log = logging.getLogger(__name__)

_PATIENCE = 60.0
"""Maximum time to wait for the process, in seconds."""

_CORNER = np.eye(3)
_PROGRAM = """
import runpy, sys
sys.path[:] = {path!r}
runpy.run_module({name!r}, run_name="__main__")
"""


class CompileAhead:
    """The compiling process, which need not have started; safe to share between threads."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._checked, self._ended = Event(), Event()
        for event in (self._checked, self._ended):
            event.set()

    def begin(self) -> None:
        """Start compiling if that was not done before; call it once."""
        if is_compiled() or not sys.executable or getattr(sys, "frozen", False):
            return
        # Use the modules of this process, whatever its working folder.
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
        """Wait until the exact check is compiled.

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        _wait(self._checked, job)

    def wait_for_all(self, job: Job = UNWATCHED) -> None:
        """Wait until everything is compiled.

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
    """Return whether the function that is compiled last seems to be compiled on this computer."""
    # Importing Numba to ask it would take a second. If its cache is elsewhere, the process finds
    # it and ends at once.
    folder = Path(lcollision_core.__file__).parent / "contact"
    newest = (folder / "kernels.py").stat().st_mtime
    cache_folder = environ.get("NUMBA_CACHE_DIR")
    places = Path(cache_folder).glob("contact_*") if cache_folder else [folder / "__pycache__"]
    name = f"kernels.test_pairs-*.py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return any(file.stat().st_mtime >= newest for place in places for file in place.glob(name))


def begin_compiling_check() -> None:
    """Begin to compile the exact check in another process, which ends with this one."""
    atexit.register(AHEAD.end)
    AHEAD.begin()


def wait_for_compiled_check(body: Body) -> None:
    """Compile how a body is decoded, and wait until the other process has compiled the check."""
    body.decode(np.zeros(body.latent_size))
    AHEAD.wait_for_check()


def triangle() -> CollisionDetector:
    """Return the detector of one triangle after using it once."""
    from lcollision_core.contact import CollisionDetector
    from lcollision_core.meshes import Topology

    detector = CollisionDetector(Topology(np.arange(3)[None], 3), _CORNER)
    detector.detect(_CORNER)
    return detector


def measure(detector: CollisionDetector) -> None:
    """Measure the least distance, and test a pose as Resolve does."""
    detector.least_distance(_CORNER, 0.1)
    detector.are_colliding(_CORNER[None], workers=1)


AHEAD = CompileAhead()
"""The compiling process of the editor or of a command."""


def _run() -> None:
    from lcollision_core.contact.kernels import search_pose

    # Without a cache, everything would be compiled twice.
    if search_pose.stats.cache_path is not None:  # type: ignore[attr-defined]  # Numba's
        checked = triangle()
        sys.stdout.write(".")
        sys.stdout.flush()
        measure(checked)


if __name__ == "__main__":
    _run()
