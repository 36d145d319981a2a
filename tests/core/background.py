"""What goes on beside a test, and how much memory a call takes."""

from __future__ import annotations

import threading
import tracemalloc
from collections.abc import Callable


def peak_memory(work: Callable[[], object]) -> int:
    """Return the most bytes that a call held at a time beyond those held before it.

    Where tracing of memory ends while another thread allocates, CPython before 3.12.9 may crash.
    The tables of bodies that earlier tests opened are waited for; while any other thread lives,
    tracing goes on.
    """
    for thread in threading.enumerate():
        if thread.name == "uncounted nodes":
            thread.join()
    if not tracemalloc.is_tracing():
        tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    try:
        work()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        if threading.active_count() == 1:
            tracemalloc.stop()
