"""Memory allocation of the process."""

from __future__ import annotations

import ctypes
import sys

# As in glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8

_MOST_UNUSED = 32 * 1024 * 1024
"""Qt copies the picture of the whole window, 5 MB at 1440 x 900, whenever it paints: fetching fresh
memory for that from the system each time took longer than the copy."""

_N_ARENAS = 2


def keep_memory_small() -> None:
    """Return freed memory beyond a little, and share memory pools between threads.

    By default each thread gets a pool of its own, and what is freed in a pool stays there. To be
    called before the first thread starts. Does nothing unless the C library is glibc.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _N_ARENAS)
        # Larger blocks are given back on their own.
        mallopt(_M_MMAP_THRESHOLD, _MOST_UNUSED)
        mallopt(_M_TRIM_THRESHOLD, _MOST_UNUSED)
