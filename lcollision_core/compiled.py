"""Decorators that compile loops with numba, which is imported when the first one is called."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from functools import cache, cached_property
from typing import Any, TypeVar, cast

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


def inlined(function: Callable[..., object]) -> Any:
    """Write the loop of a small function into each compiled one that calls it."""
    return _Loop(function, cache=False, inline="always", error_model="numpy")


def _compiled(
    function: Function, fastmath: bool | set[str], no_cpython_wrapper: bool = False
) -> Function:
    loop = _Loop(
        function,
        cache=True,
        nogil=True,
        error_model="numpy",
        fastmath=fastmath,
        no_cpython_wrapper=no_cpython_wrapper,
        # Nothing calls these functions from C.
        no_cfunc_wrapper=True,
    )
    return cast(Function, loop)


class _Loop:
    """A function that numba compiles when it is first called.

    Importing numba takes half a second, which commands that only read and print are spared.
    """

    def __init__(self, function: Callable[..., object], cache: bool, **options: object) -> None:
        self.py_func = function
        self._cache, self._options = cache, options

    @cached_property
    def _made(self) -> Any:
        with _making:
            try:
                made = _numba().njit(cache=self._cache, **self._options)(self.py_func)
                if self._cache:
                    _forget_unreadable(made._cache)
                return made
            except (RuntimeError, OSError):
                # Neither the installation nor the user's cache folder is writable, as for a service
                # account without a home. Start slowly every time rather than not at all.
                return _numba().njit(**self._options)(self.py_func)

    def __call__(self, *args: object) -> object:
        return self._made(*args)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the compiled function, for other loops that call it."""
        return getattr(self._made, name)


def _forget_unreadable(cache: Any) -> None:
    """Empty a cache of another release, if it names classes that are gone.

    Numba unpickles an index before it compares the date of the source.
    """
    try:
        cache._cache_file._load_index()
    except (AttributeError, ImportError):
        cache.flush()


_making = threading.Lock()


@cache
def _numba() -> Any:
    import numba
    from numba.core import event

    event.Listener.register(_Compilations)
    event.register("numba:compile", _compilations)
    return numba


class _Compilations:
    """Logs that compiling begins, after a pause again, and adds up how long it takes.

    Loading from the cache does not count. Numba compiles one function at a time, with its callees
    nested in it.
    """

    def __init__(self) -> None:
        self._seconds, self._depth = 0.0, 0
        self._last, self._started = -math.inf, 0.0

    def notify(self, event: Any) -> None:
        now = time.perf_counter()
        if event.is_end:
            self._depth, self._last = self._depth - 1, now
            if self._depth == 0:
                self._seconds += now - self._started
            return
        if now - self._last > _PAUSE_SECONDS:
            _log.info("compiling for this processor, which takes a few seconds the first time")
        if self._depth == 0:
            self._started = now
        self._depth, self._last = self._depth + 1, now

    def working_seconds(self) -> float:
        now = self._started if self._depth > 0 else time.perf_counter()
        return now - self._seconds


_compilations = _Compilations()


def working_seconds() -> float:
    """Return the seconds of a clock that stands still while this process compiles.

    Work that is timed by it takes as long at the first start on a computer as at any other.
    """
    return _compilations.working_seconds()
