"""Ctrl-C in long work that keeps what it has done."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from lcollision_core.jobs import Job


@contextmanager
def cancel_on_interrupt() -> Iterator[Job]:
    """Yield a token that the first Ctrl-C or SIGTERM sets; a second Ctrl-C interrupts at once."""
    token = Job()
    previous: dict[signal.Signals, Any] = {}

    def stop(number: int, frame: object) -> None:  # noqa: ARG001
        token.cancel()
        signal.signal(number, previous[signal.Signals(number)])

    for caught in (signal.SIGINT, signal.SIGTERM):
        previous[caught] = signal.signal(caught, stop)
    try:
        yield token
    finally:
        for caught, handler in previous.items():
            signal.signal(caught, handler)
