"""The processes that torchrun starts: who shares the work, on which device."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

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
        """Tell all processes whether one of them says yes."""
        if self.count == 1:
            return flag
        flags = torch.tensor(float(flag), device=self.device)
        dist.all_reduce(flags, dist.ReduceOp.MAX)
        return bool(flags)

    def sum_of(self, value: torch.Tensor) -> float:
        """Add up a number over all processes."""
        total = value.detach().clone()
        if self.count > 1:
            dist.all_reduce(total)
        return float(total)

    def add_up(self, values: npt.NDArray[np.float16]) -> None:
        """Put the sum over all processes into the place of an array's values."""
        if self.count == 1:
            return
        total = torch.from_numpy(values.astype(np.float32)).to(self.device)
        dist.all_reduce(total)
        values[...] = total.cpu().numpy()

    def require_same(self, number: int) -> None:
        """Refuse to go on where the processes begin at different places.

        Raises
        ------
        LCollisionError : they do.
        """
        if self.count == 1:
            return
        largest = torch.tensor([number, -number], device=self.device)
        dist.all_reduce(largest, dist.ReduceOp.MAX)
        if int(largest[0]) != -int(largest[1]):
            raise LCollisionError(
                "the processes do not see the same checkpoint",
                "put it into a folder that all machines share, or delete it",
            )

    def wait(self) -> None:
        """Wait until all processes are here."""
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
    kind = "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    chosen = torch.device(kind, local_rank % torch.cuda.device_count() if kind == "cuda" else 0)
    if not dist.is_torchelastic_launched():
        yield Processes(0, 1, torch.device(kind))
        return
    if kind == "cuda":
        torch.cuda.set_device(chosen)
    own_group = not dist.is_initialized()
    if own_group:
        dist.init_process_group("nccl" if kind == "cuda" else "gloo")
    try:
        yield Processes(dist.get_rank(), dist.get_world_size(), chosen)
    finally:
        if own_group:
            dist.destroy_process_group()
