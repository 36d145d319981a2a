"""Numba's simulator of a GPU, with a main thread that leaves the interpreter to the others."""

from __future__ import annotations

import time
from threading import Thread

import pytest
from numba.cuda.simulator.kernel import BlockThread


def _is_alive(thread: Thread) -> bool:
    # The main thread asks this in a loop, which would take as long as the kernel itself.
    time.sleep(0)
    return Thread.is_alive(thread)


def poll_politely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the threads of a block run while the simulator waits for them."""
    monkeypatch.setattr(BlockThread, "is_alive", _is_alive)
