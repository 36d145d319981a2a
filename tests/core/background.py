"""What goes on beside a test."""

from __future__ import annotations

import threading


def wait_for_tables() -> None:
    """Wait for the tables of bodies that earlier tests opened.

    Where tracing of memory ends while compiled code allocates in another thread, CPython before
    3.12.9 may crash.
    """
    for thread in threading.enumerate():
        if thread.name == "uncounted nodes":
            thread.join()
