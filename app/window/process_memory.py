"""Memory allocation of the process."""

from __future__ import annotations

import ctypes
import sys

# As in glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8

_MOST_UNUSED = 32 * 1024 * 1024
"""Freed memory to keep, in bytes. Each paint copies the image of the window, 5 MB at 1440 x 900:
fetching that memory from the system each time took longer than the copy."""

_N_ARENAS = 2


def keep_memory_small() -> None:
    """Return most freed memory to the system, and share memory arenas between threads.

    By default each thread gets its own arena, and memory freed in an arena stays there. Call this
    before the first thread starts. It does nothing unless the C library is glibc.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _N_ARENAS)
        # Blocks above this size are mapped separately and returned when freed.
        mallopt(_M_MMAP_THRESHOLD, _MOST_UNUSED)
        mallopt(_M_TRIM_THRESHOLD, _MOST_UNUSED)
