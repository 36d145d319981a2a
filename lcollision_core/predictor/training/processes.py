"""The processes that torchrun starts: rank, device and communication."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.distributed as dist

from lcollision_core.errors import LCollisionError


@dataclass(frozen=True)
class Processes:
    """One process among those that train together.

    Attributes
    ----------
    rank : its number from 0; the first writes for all
    count : of the processes, 1 for one alone
    device : it trains on
    """

    rank: int
    count: int
    device: torch.device

    def share(self, n_rows: int) -> tuple[int, int]:
        """Return which rows of a batch, first and last + 1, are this process's: an even first."""
        each = -(-n_rows // (2 * self.count)) * 2
        start = min(self.rank * each, n_rows)
        return start, min(start + each, n_rows)

    def any_of(self, flag: bool) -> bool:
        """Return whether any process passes True, to all of them."""
        return bool(self._reduced(torch.tensor(float(flag)), dist.ReduceOp.MAX))

    def sum_of(self, value: torch.Tensor) -> float:
        """Sum a number over all processes."""
        return float(self._reduced(value.detach().clone()))

    def add_up(self, values: npt.NDArray[np.float16]) -> None:
        """Replace an array's values by their sums over all processes."""
        if self.count > 1:
            total = self._reduced(torch.from_numpy(values.astype(np.float32)))
            values[...] = total.cpu().numpy()

    def require_same(self, number: int) -> None:
        """Refuse to continue if the processes begin at different steps.

        Raises
        ------
        LCollisionError : they do.
        """
        least, largest = self._reduced(torch.tensor([-number, number]), dist.ReduceOp.MAX).tolist()
        if -least != largest:
            raise LCollisionError(
                "the processes do not see the same checkpoint",
                "put it into a folder that all machines share, or delete it",
            )

    def _reduced(self, values: torch.Tensor, operation: Any = dist.ReduceOp.SUM) -> torch.Tensor:
        """Reduce values over all processes."""
        if self.count > 1:
            values = values.to(self.device)
            dist.all_reduce(values, operation)
        return values

    def wait(self) -> None:
        """Wait for all processes."""
        if self.count > 1:
            dist.barrier()


@contextmanager
def joined_processes(device: str) -> Iterator[Processes]:
    """Join the other processes that torchrun started, if it did.

    Parameters
    ----------
    device : "cpu", "cuda", or "auto" for CUDA where there is one

    Raises
    ------
    LCollisionError : there is no such device.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise LCollisionError(f"unknown device {device!r}", "use auto, cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise LCollisionError(
            "this machine has no CUDA device that torch can use", "use auto or cpu"
        )
    backend = "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    chosen = torch.device(
        backend, local_rank % torch.cuda.device_count() if backend == "cuda" else 0
    )
    if not dist.is_torchelastic_launched():
        yield Processes(0, 1, torch.device(backend))
        return
    if backend == "cuda":
        torch.cuda.set_device(chosen)
    own_group = not dist.is_initialized()
    if own_group:
        dist.init_process_group("nccl" if backend == "cuda" else "gloo")
    try:
        yield Processes(dist.get_rank(), dist.get_world_size(), chosen)
    finally:
        if own_group:
            dist.destroy_process_group()
