"""Background threads of a test, and the memory of a call."""

from __future__ import annotations

import threading
import tracemalloc
from collections.abc import Callable


def peak_memory(work: Callable[[], object]) -> int:
    """Return the peak memory of a call, in bytes, beyond that held before it.

    CPython before 3.12.9 may crash if memory tracing stops while another thread allocates. So wait
    for the tables of bodies that earlier tests opened, and leave tracing on while any other thread
    may allocate. Dask's pool stays when its cluster has closed, but only waits: tracing would make
    all later tests of the process several times slower.
    """
    this = threading.current_thread()
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
        others = [thread for thread in threading.enumerate() if thread is not this]
        if all(thread.name.startswith("Dask-Offload") for thread in others):
            tracemalloc.stop()
