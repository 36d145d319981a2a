"""Compiles the exact check in a process of its own, at the first start on a computer.

Numba compiles one function at a time in a process, and these take as long as all others that a
first frame needs. ``python -m app.work.compile_ahead`` is that process: it writes a byte once a
check is compiled, and goes on with what measures distances.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import lcollision_core

if TYPE_CHECKING:
    from lcollision_core.contact import CollisionDetector

_CORNER = np.eye(3)

_process: subprocess.Popen[bytes] | None = None


def is_compiled() -> bool:
    """Tell whether the exact check seems to have been compiled on this computer."""
    # Importing Numba to ask it would take a second. Where it keeps what it compiled in yet another
    # place, the process finds it and ends at once.
    kept = os.environ.get("NUMBA_CACHE_DIR")
    beside = Path(lcollision_core.__file__).parent / "contact"
    folder, within = (Path(kept), "contact_*") if kept else (beside, "__pycache__")
    return any(folder.glob(f"{within}/kernels.search_pose-*.nbi"))


def begin() -> None:
    """Begin to compile, where that was not done; to be called once."""
    global _process
    if not is_compiled():
        command = [sys.executable, "-m", __name__]
        nowhere = subprocess.DEVNULL
        _process = subprocess.Popen(command, stdin=nowhere, stdout=subprocess.PIPE, stderr=nowhere)


def wait_for_check() -> None:
    """Wait until a check is compiled; whatever the process did not do is compiled when needed."""
    if _process is not None and _process.stdout is not None:
        _process.stdout.read(1)


def wait_for_all() -> None:
    """Wait until all is compiled."""
    global _process
    if _process is not None:
        _process.communicate()
        _process = None


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


if __name__ == "__main__":
    checked = triangle()
    sys.stdout.write(".")
    sys.stdout.flush()
    measure(checked)
