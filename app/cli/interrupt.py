"""Ctrl-C in long work that keeps its finished part."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from app.cli.console import note
from lcollision_core.jobs import Job


@contextmanager
def cancel_on_interrupt() -> Iterator[Job]:
    """Yield a job that the first Ctrl-C or SIGTERM cancels; a second one acts at once."""
    job = Job(note=note)
    previous: dict[signal.Signals, Any] = {}

    def stop(number: int, frame: object) -> None:  # noqa: ARG001
        job.cancel()
        signal.signal(number, previous[signal.Signals(number)])

    for caught in (signal.SIGINT, signal.SIGTERM):
        previous[caught] = signal.signal(caught, stop)
    try:
        yield job
    finally:
        for caught, handler in previous.items():
            signal.signal(caught, handler)
