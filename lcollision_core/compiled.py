"""Decorators that compile loops with numba."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from typing import TypeVar, cast

import numba
from numba.core import event

Function = TypeVar("Function", bound=Callable[..., object])

_log = logging.getLogger(__name__)

_PAUSE_SECONDS = 1.0
"""Seconds without compiling after which the next compilation is logged again."""


def compiled(function: Function) -> Function:
    """Compile a loop over plain arrays with numba, cached on disk and without the interpreter lock.

    The lock is released so that a batch spreads over ordinary threads. Numba's own thread pool
    is not safe on every platform when two threads enter it at once, as they do in the editor.

    A compiled function may call only those of its own file: the cache is renewed when that file
    changes, but not when another one does.
    """
    return _compiled(function, fastmath=False)


def compiled_part(function: Function) -> Function:
    """Compile, as `compiled` does, a function that only compiled functions call.

    It gets no wrapper for calls from Python, which can take as long to compile as the loop.
    """
    return _compiled(function, fastmath=False, no_cpython_wrapper=True)


def compiled_sums(function: Function) -> Function:
    """Compile as `compiled` does, and let sums be reordered, so that they are vectorised.

    The order of the terms, and so the rounding, depends on the processor.
    """
    return _compiled(function, fastmath={"reassoc", "contract", "nsz"})


def _compiled(
    function: Function, fastmath: bool | set[str], no_cpython_wrapper: bool = False
) -> Function:
    options = {
        "nogil": True,
        "error_model": "numpy",
        "fastmath": fastmath,
        "no_cpython_wrapper": no_cpython_wrapper,
        # Nothing calls these functions from C.
        "no_cfunc_wrapper": True,
    }
    try:
        dispatcher = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        # Neither the installation nor the user's cache folder is writable, as for a service
        # account without a home. Start slowly every time rather than not at all.
        dispatcher = numba.njit(**options)(function)
    return cast(Function, dispatcher)


class _Compilations(event.Listener):  # type: ignore[misc]  # numba has no types
    """Logs when compiling begins, again after a pause, and adds up the time that it takes.

    Loading from the cache does not count. Numba compiles one function at a time, with its callees
    nested in it.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._last, self._started, self._depth = -math.inf, 0.0, 0

    def on_start(self, _: object) -> None:
        now = time.monotonic()
        if now - self._last > _PAUSE_SECONDS:
            _log.info("compiling for this processor, which takes some seconds once")
        if self._depth == 0:
            self._started = now
        self._depth, self._last = self._depth + 1, now

    def on_end(self, _: object) -> None:
        self._depth, self._last = self._depth - 1, time.monotonic()
        if self._depth == 0:
            self.seconds += self._last - self._started


_compilations = _Compilations()
event.register("numba:compile", _compilations)


def seconds_compiling() -> float:
    """Return the seconds that this process has spent on compiling so far."""
    return _compilations.seconds
