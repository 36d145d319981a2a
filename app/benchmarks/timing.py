"""Timing of calls, and the rows of benchmarks."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from typing import Any

Row = dict[str, Any]
"""One row of a benchmark, as printed and as written to JSON."""


def median_seconds(calls: Iterable[Callable[[], object]]) -> float:
    """Return the median duration of some calls, made one after the other."""
    seconds = []
    for call in calls:
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)
