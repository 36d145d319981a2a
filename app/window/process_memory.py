"""Memory allocation of the process."""

from __future__ import annotations

import ctypes
import sys

# As in glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_ARENA_MAX = -8

_MOST_UNUSED = 128 * 1024
_N_ARENAS = 2


def keep_memory_small() -> None:
    """Return freed memory at once, and share memory pools between threads.

    By default each thread gets a pool of its own, and what is freed in a pool stays there. To be
    called before the first thread starts. Does nothing unless the C library is glibc.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _N_ARENAS)
        # This also keeps glibc from raising the size from which blocks are given back on their own.
        mallopt(_M_TRIM_THRESHOLD, _MOST_UNUSED)
