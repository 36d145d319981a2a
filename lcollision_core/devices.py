"""The device that checks batches of poses: the processor, or a GPU by CUDA.

Importing it imports nothing of CUDA. The choice holds for the process, as one has one GPU.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from enum import StrEnum
from functools import cache
from importlib.util import find_spec

from lcollision_core.errors import LCollisionError, MissingExtraError


class Device(StrEnum):
    """What people choose."""

    AUTO = "auto"
    CPU = "cpu"
    CUDA = "cuda"


_FEWEST_POSES, _MOST_POSES, _MOST_FACES = 32, 2048, 1 << 23
"""Poses, and faces of all of them, that a loop hands over to a GPU at a time: by the faces, but
within these numbers of poses."""

_LEAST_POSES = 16
"""Fewer are no batch: a processor has checked them before a GPU begins."""

_WORTHWHILE = 50_000_000
"""Faces of all poses of a batch that are worth the seconds in which a GPU's kernels compile: 10 000
poses of 5000 faces take one core 9 s."""


class _Choice:
    device = Device.CPU
    note: Callable[[str], None] = staticmethod(lambda _: None)
    in_use = False


def choose_device(device: Device, note: Callable[[str], None] = _Choice.note) -> None:
    """Let the process check batches of poses on a device; without this it is the processor.

    Parameters
    ----------
    device : with `AUTO`, a GPU where there is one and a batch is worth it
    note : called with a sentence once a GPU is taken by itself

    Raises
    ------
    LCollisionError : CUDA is asked for, and the extra, or a GPU, is missing.
    """
    if device is Device.CUDA:
        _require_cuda()
    _Choice.device, _Choice.note, _Choice.in_use = device, note, device is Device.CUDA


def takes_gpu(n_poses: int, n_faces: int) -> bool:
    """Whether a GPU checks a batch of poses of a mesh."""
    if _Choice.device is Device.CPU or n_poses < _LEAST_POSES:
        return False
    if not _Choice.in_use and n_poses * n_faces >= _WORTHWHILE and _has_extra() and _has_gpu():
        _Choice.in_use = True
        _Choice.note("checking batches of poses on the GPU; --device cpu leaves it alone")
    return _Choice.in_use


def block_size(n_poses: int, n_faces: int, otherwise: int) -> int:
    """Return how many poses a loop should take at a time: many for a GPU."""
    if not takes_gpu(n_poses, n_faces):
        return otherwise
    return max(_FEWEST_POSES, min(_MOST_POSES, _MOST_FACES // n_faces))


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
    return find_spec("numba_cuda") is not None or _is_simulated()


@cache
def _has_gpu() -> bool:
    from lcollision_core.on_gpu import cuda

    return bool(cuda.is_available())


def _is_simulated() -> bool:
    return os.environ.get("NUMBA_ENABLE_CUDASIM", "0") == "1"
