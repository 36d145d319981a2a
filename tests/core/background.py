"""Background threads of a test, and the memory of a call."""

from __future__ import annotations

import threading
import tracemalloc
from collections.abc import Callable


def peak_memory(work: Callable[[], object]) -> int:
    """Return the peak memory of a call, in bytes, beyond that held before it.

    CPython before 3.12.9 may crash if memory tracing stops while another thread allocates. So wait
    for the tables of bodies that earlier tests opened, and leave tracing on while any other thread
    is alive.
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
