"""Explains long first waits: loops are compiled for this computer, which the core logs."""

from __future__ import annotations

import logging
from collections.abc import Callable

from PySide6.QtCore import QObject, Signal

REASON = "First use: preparing, which takes a few seconds"


class Preparing(QObject):
    """Signals in the window's thread when loops are compiled in any, until it is closed.

    Signals
    -------
    begun : str, `REASON`
    """

    begun = Signal(str)

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self._log = logging.getLogger("lcollision_core.compiled")
        self._handler = _Handler(lambda: self.begun.emit(REASON))
        self._log.addHandler(self._handler)

    def close(self) -> None:
        """Stop listening."""
        self._log.removeHandler(self._handler)


class _Handler(logging.Handler):
    """Calls a function for each record, in the record's thread."""

    def __init__(self, tell: Callable[[], None]) -> None:
        super().__init__()
        self._tell = tell

    def emit(self, _: logging.LogRecord) -> None:
        self._tell()
