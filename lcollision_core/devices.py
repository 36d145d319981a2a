"""The device that checks batches of poses: the CPU, or a GPU with CUDA.

Importing this module imports nothing of CUDA. The choice is global to the process.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from enum import StrEnum
from functools import cache
from importlib.util import find_spec

from lcollision_core.errors import LCollisionError, MissingExtraError


class Device(StrEnum):
    """The user's choice of device."""

    AUTO = "auto"
    CPU = "cpu"
    CUDA = "cuda"


_FEWEST_POSES, _MOST_POSES, _MOST_FACES = 32, 2048, 1 << 23
"""Limits of a block that is sent to a GPU: the fewest and most poses, and the most faces of all
its poses; the fewest poses win over the most faces."""

_LEAST_POSES = 16
"""Smaller batches stay on the CPU, which finishes them before a GPU would start."""

_WORTHWHILE = 50_000_000
"""Fewest faces, over all poses of a batch, that make up for the seconds in which the GPU kernels
compile: 10 000 poses of 5000 faces take one core 9 s."""


class _Choice:
    device = Device.CPU
    note: Callable[[str], None] = staticmethod(lambda _: None)
    in_use = False


def choose_device(device: Device, note: Callable[[str], None] = _Choice.note) -> None:
    """Choose the device on which this process checks batches of poses; the default is the CPU.

    Parameters
    ----------
    device : `AUTO` uses a GPU if there is one and the batch is large enough
    note : called with a sentence when `AUTO` first uses a GPU

    Raises
    ------
    LCollisionError : `device` is CUDA, and the extra or a GPU is missing.
    """
    if device is Device.CUDA:
        _require_cuda()
    _Choice.device, _Choice.note, _Choice.in_use = device, note, device is Device.CUDA


def uses_gpu(n_poses: int, n_faces: int) -> bool:
    """Whether a batch of this size is checked on a GPU."""
    if _Choice.device is Device.CPU or n_poses < _LEAST_POSES:
        return False
    if not _Choice.in_use and n_poses * n_faces >= _WORTHWHILE and has_gpu_kernels():
        _Choice.in_use = True
        _Choice.note("checking batches of poses on the GPU; use --device cpu to avoid it")
    return _Choice.in_use


def block_size(n_poses: int, n_faces: int, otherwise: int) -> int:
    """Return how many poses a loop should check at a time: `otherwise` unless on a GPU."""
    if not uses_gpu(n_poses, n_faces):
        return otherwise
    return max(_FEWEST_POSES, min(_MOST_POSES, _MOST_FACES // n_faces))


def has_gpu_kernels() -> bool:
    """Whether compiled kernels run on a GPU: there is one, and the extra is installed."""
    return _has_extra() and _has_gpu()


def _require_cuda() -> None:
    if not _has_extra():
        raise MissingExtraError(
            "checking on a GPU needs numba-cuda", "install it with: pip install 'lcollision[gpu]'"
        )
    if not _has_gpu():
        raise LCollisionError(
            "this machine has no CUDA device that numba can use", "use --device auto or cpu"
        )


@cache
def _has_extra() -> bool:
    return find_spec("numba_cuda") is not None or os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"


@cache
def _has_gpu() -> bool:
    from lcollision_core.on_gpu import cuda

    return bool(cuda.is_available())
