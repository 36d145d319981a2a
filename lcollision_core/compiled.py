"""The one way in which loops are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile a loop over plain arrays with numba, cached on disk and free of the interpreter lock.

    The lock is released so that a batch spreads over ordinary threads: numba's own thread pool
    is not safe to enter from two threads at once on every platform, and the editor does that.

    A compiled function calls only those of its own file: the cache is renewed when that file
    changes, and would not see a change elsewhere.
    """
    try:
        dispatcher = numba.njit(nogil=True, cache=True, error_model="numpy")(function)
    except RuntimeError:
        # Neither the installation nor the user's cache folder can be written, as for a service
        # account without a home: slow at every start is better than not at all.
        dispatcher = numba.njit(nogil=True, error_model="numpy")(function)
    return cast(Function, dispatcher)
