"""Building blocks of GPU kernels: functions shared with the CPU, and copies of its arrays.

This module imports numba's CUDA target, so only GPU code may import it. Kernels use only features
that both numba-cuda and its successor, numba-cuda-mlir, compile: no warp operations, no
allocation, arrays and named tuples of arrays as arguments. `NUMBA_ENABLE_CUDASIM=1` runs them on
any machine, thread by thread in Python.
"""
# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from types import FunctionType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from numba import config
from numba import cuda as cuda
from numba.cuda import libdevice

Arrays = TypeVar("Arrays")
DeviceArray = Any
"""An array in the memory of the GPU."""

SIMULATED = bool(config.ENABLE_CUDASIM)
THREADS = 4 if SIMULATED else 128
"""Threads in a block. The simulator starts a Python thread for each."""

GPU_LOCK = threading.RLock()
"""Hold this lock while using the GPU."""

_MOST_BLOCKS = 4096
_MOST_ROWS = 65535


def device_function(
    function: Callable[..., Any], **replacements: Callable[..., Any]
) -> Callable[..., Any]:
    """Compile for the GPU a function that `lcollision_core.compiled` has compiled for the CPU.

    The compiled functions that it calls follow, except those that `replacements` replaces by name.
    """
    source = function.py_func  # type: ignore[attr-defined]
    called = replacements | {
        name: device_function(value)
        for name in source.__code__.co_names
        if name not in replacements and hasattr(value := source.__globals__.get(name), "py_func")
    }
    plain_function = FunctionType(
        source.__code__, {**source.__globals__, **called}, source.__name__
    )
    compiled_function: Callable[..., Any] = (
        plain_function if SIMULATED else cuda.jit(device=True)(plain_function)
    )
    return compiled_function


def _rounded_product(a: Any, b: Any) -> Any:
    return libdevice.fmul_rn(a, b)


def _float32_product(a: Any, b: Any) -> Any:
    return np.float32(a) * np.float32(b)


rounded_product = _float32_product if SIMULATED else cuda.jit(device=True)(_rounded_product)
"""Multiplies two float32 numbers and rounds as the CPU does, without a fused multiply-add."""


def blocks_for(n_threads: int) -> int:
    """Return the number of blocks to launch for so many threads, capped; kernels loop over it."""
    return 1 if SIMULATED else max(1, min(-(-n_threads // THREADS), _MOST_BLOCKS))


def rows_for(n_rows: int) -> int:
    """Return the number of block rows to launch for so many rows, capped; kernels loop over it."""
    return 1 if SIMULATED else min(n_rows, _MOST_ROWS)


def copied(arrays: Arrays) -> Arrays:
    """Copy an array, or a named tuple of arrays and such tuples, to the GPU."""
    if isinstance(arrays, tuple):
        return type(arrays)(*map(copied, arrays))
    on_device: Arrays = cuda.to_device(arrays)
    return on_device


class Buffers:
    """GPU arrays by name, kept between calls because allocating them is slow.

    Hold `GPU_LOCK` from taking an array until it has been read.
    """

    def __init__(self) -> None:
        self._held: dict[str, DeviceArray] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> DeviceArray:
        """Return an uninitialised array that reuses the buffer of this name."""
        size = math.prod(shape)
        if size == 0:
            return cuda.device_array(shape, dtype)
        if name not in self._held or self._held[name].size < size:
            # Free the old buffer before allocating the new one.
            self._held.pop(name, None)
            self._held[name] = cuda.device_array(size, dtype)
        return self._held[name][:size].reshape(shape)

    def zeros(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> DeviceArray:
        """Return an array of zeros that reuses the buffer of this name."""
        buffer = self.take(name, shape, dtype)
        if buffer.size > 0:
            _clear[blocks_for(buffer.size), THREADS](buffer.reshape(buffer.size))
        return buffer


@cuda.jit
def _clear(numbers: DeviceArray) -> None:
    for at in range(cuda.grid(1), numbers.shape[0], cuda.gridsize(1)):
        numbers[at] = 0
