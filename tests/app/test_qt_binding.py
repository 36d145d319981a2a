"""The editor's Qt binding, tested for bugs that made releases of it unusable."""

from __future__ import annotations

import sys

import pytest
from PySide6.QtCore import QObject, QTimer


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="None is immortal from Python 3.12 on")
def test_a_call_that_returns_nothing_keeps_its_reference_to_none() -> None:
    """PySide6 6.12.0 drops one per call on Python 3.11, which aborts the program after seconds."""
    thing, timer = QObject(), QTimer()
    before = sys.getrefcount(None)
    for _ in range(1000):
        thing.setObjectName("pose")
        thing.blockSignals(False)
        timer.setInterval(5)
    after = sys.getrefcount(None)
    assert abs(after - before) < 100
