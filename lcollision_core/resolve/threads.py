"""One thread for each solve: its batches are too small for more."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

_guard = Lock()
_inside = 0
_before = 1


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Keep torch to the calling thread, and give it its threads back after the last solve.

    A predictor's gradients of a few poses take a millisecond; on a busy machine threads that
    shared them would wait for each other up to fifty times as long.
    """
    global _inside, _before
    torch = sys.modules.get("torch")
    if torch is None:  # a predictor that needs none
        yield
        return
    with _guard:
        if _inside == 0:
            _before = torch.get_num_threads()
        _inside += 1
        # In each calling thread: torch keeps the number thread by thread.
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _guard:
            _inside -= 1
            if _inside == 0:
                torch.set_num_threads(_before)
