"""How long calls take, and the rows that tell of it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from typing import Any

Row = dict[str, Any]
"""One row of a benchmark, as it stands in its JSON and is printed."""


def median_seconds(calls: Iterable[Callable[[], object]]) -> float:
    """Make some calls, one after the other, and return the median of their durations."""
    seconds = []
    for call in calls:
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)
