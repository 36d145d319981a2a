"""Optimise a predictor with torch: losses, labels of patches, several processes."""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.optim.swa_utils import AveragedModel

from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.embedding.training_run import Checkpoint
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.labels import LabelRows
from lcollision_core.meshes import STRICT, ContactRules, FaceGroup
from lcollision_core.model_file import run_key
from lcollision_core.predictor.config import (
    PredictorConfig,
    PredictorStatus,
    RowSplit,
    patches_path,
)
from lcollision_core.predictor.geometric_network import FoldDetector
from lcollision_core.predictor.metrics import error_rates
from lcollision_core.predictor.network_base import PredictorNetwork, SkinCells, Targets
from lcollision_core.predictor.predictor import (
    BATCH_ROWS,
    TrainingFacts,
    network_of,
    runs_as_graph,
)


@dataclass(frozen=True)
class Processes:
    """One of the processes that train together.

    Attributes
    ----------
    rank : its index, from 0; process 0 writes for all
    count : number of processes
    device : that it trains on
    """

    rank: int
    count: int
    device: torch.device

    def share(self, n_rows: int) -> tuple[int, int]:
        """Return the start, which is even, and stop of this process's rows of a batch."""
        each = -(-n_rows // (2 * self.count)) * 2
        start = min(self.rank * each, n_rows)
        return start, min(start + each, n_rows)

    def any_of(self, flag: bool) -> bool:
        """Return, in all processes, whether any of them passes True."""
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
        """Check that all processes begin at the same step.

        Raises
        ------
        LCollisionError : they do not.
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
    """Join the other processes if torchrun started this one.

    Parameters
    ----------
    device : "cpu", "cuda", or "auto" for CUDA if there is such a device

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
    process_device = torch.device(
        backend, local_rank % torch.cuda.device_count() if backend == "cuda" else 0
    )
    if not dist.is_torchelastic_launched():
        yield Processes(0, 1, torch.device(backend))
        return
    if backend == "cuda":
        torch.cuda.set_device(process_device)
    own_group = not dist.is_initialized()
    if own_group:
        dist.init_process_group("nccl" if backend == "cuda" else "gloo")
    try:
        yield Processes(dist.get_rank(), dist.get_world_size(), process_device)
    finally:
        if own_group:
            dist.destroy_process_group()


_ROWS_PER_BLOCK = 32
_PATCH_FRACTION, _FOLD_FRACTION = 0.05, 0.005
"""Typical fractions of a pose's energy in a colliding patch, and in a colliding fold."""

_LEAST_ROOT = 1e-3
"""Least root, which keeps the shallowest contact distinct from none in half precision."""


class PatchLabeller:
    """Find the exact energy of each patch of skin, and of each fold.

    Parameters
    ----------
    embedding : decodes the poses
    rows : labelled poses
    cells : pairs within `FOLD_RADIUS` of each other along the surface belong to folds, if any
    energy_scale : the mean energy of a colliding pose, in normalised length squared
    rules, groups : the contact rules of the labels, and the groups that they name
    """

    def __init__(
        self,
        embedding: Embedding,
        rows: LabelRows,
        cells: SkinCells,
        energy_scale: float,
        rules: ContactRules,
        groups: Sequence[FaceGroup] = (),
    ) -> None:
        self._embedding, self._rows = embedding, rows
        folds = cells.n_patches + cells.fold if cells.n_folds else cells.patch
        self._cell = np.stack([cells.patch, folds]).astype(np.int32)
        self._detector = FoldDetector(embedding, rules, groups)
        fractions = np.repeat([_PATCH_FRACTION, _FOLD_FRACTION], [cells.n_patches, cells.n_folds])
        self._unit = fractions * energy_scale
        _ = embedding.codec, embedding.decoder

    def roots(
        self,
        index: npt.NDArray[np.int64],
        job: Job = UNWATCHED,
    ) -> npt.NDArray[np.float16]:
        """Label the patches of rows, on all cores.

        Poses labelled as free have no energy and are skipped.

        Parameters
        ----------
        index : (n,) indices of the rows
        job : reports colliding rows; polled for every block of rows

        Returns
        -------
        roots : (n, P + S) float16 array: square roots of the sums of PDe, in units in which they
            are about 1 for a colliding patch or fold; 0 without collision

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        roots = np.zeros((len(index), len(self._unit)), dtype=np.float16)
        colliding = np.flatnonzero(self._rows.colliding[index])

        def label(start: int, stop: int) -> None:
            block = colliding[start:stop]
            latent = self._rows.latent[index[block]]
            poses = self._embedding.decode(latent, n_threads=1).astype(np.float32)
            energy = self._detector.energies(poses, self._cell, len(self._unit))
            block_roots = np.sqrt(energy / self._unit)
            roots[block] = np.where(energy > 0.0, np.maximum(block_roots, _LEAST_ROOT), 0.0)

        for_blocks(label, len(colliding), _ROWS_PER_BLOCK, job=job)
        return roots


_RUN_VERSION = 8
"""Raised when training changes, so that no checkpoint of other code is resumed."""

_WATCHED_ROWS = 4000
"""Number of held-out rows whose error rates are shown during training."""

_BUILDING_ROWS = 65_536
"""Number of training rows for building a network: enough for its statistics."""

_SECONDS_BETWEEN_REPORTS = 0.25
_STEPS_BETWEEN_TALKS = 20
"""Interval at which processes agree on whether to stop, which costs a round trip."""

_TIMES_PATCHES_KEPT, _LEAST_PATCHES_KEPT = 20, 4096
"""Number of parts of the training rows after each of which patches are written, and least rows of a
part."""

_STEPS_BETWEEN_CLEARINGS = 100
_TINY_MOMENT = 1e-30
"""Steps between clearings, and the mean that is cleared: falling by 0.9 a step, Adam's means stay
normal numbers in between."""

_STEPS_BETWEEN_AVERAGES = 10
"""Steps between updates of the mean weights: one every step would take a sixth of the time."""

_WARM_UP = 0.2
_LEAST_RATE = 1e-2
"""Start of the one-cycle schedule, relative to its largest rate."""

_PART, _PATCHES = "training", "patches"
_NETWORK, _AVERAGE, _OPTIMISER = "network:", "average:", "optimiser:"


@dataclass(eq=False)
class TrainingLoop:
    """Train a preset's network.

    Parameters
    ----------
    rows : samples 0, 1, 2, ...; the latent codes are read in place and never copied as a whole
    split : the roles of the rows
    embedding, config, facts : see `training.train_predictor`
    device : "auto", "cpu" or "cuda"
    checkpoint : a file, or None
    job, groups : see `training.train_predictor`
    """

    rows: LabelRows
    split: RowSplit
    embedding: Embedding
    config: PredictorConfig
    facts: TrainingFacts
    device: str
    checkpoint: Path | None
    job: Job
    groups: Sequence[FaceGroup] = ()

    def __post_init__(self) -> None:
        # The patches have their own file: it is large, and written before the first step.
        self._patches_path = self.checkpoint and patches_path(self.checkpoint)
        self._rules = STRICT if self.facts.store is None else self.facts.store.rules
        self._training_index = self.split.training
        self._watched = self.rows.taken(self.split.held_out[:_WATCHED_ROWS])
        self._steps_an_epoch = -(-len(self._training_index) // self.config.batch_rows)
        self._epochs = self.config.passes(len(self._training_index))
        self._total = self._epochs * self._steps_an_epoch
        self._losses: list[float] = []
        self._errors: tuple[float | None, float | None] = (None, None)
        self._average: AveragedModel | None = None
        self._averaged_every = min(_STEPS_BETWEEN_AVERAGES, self._steps_an_epoch)
        self._reported = -math.inf
        self._preparing: float | None = None

    def run(self) -> PredictorNetwork:
        """Train, or resume from the checkpoint; return the network on the training device.

        Raises
        ------
        LCollisionError : the checkpoint belongs to another run, there is no such device, or the
            training diverges.
        CancelledError : the job was cancelled; the checkpoint holds the last step.
        """
        with joined_processes(self.device) as processes:
            network = self._run(processes)
        if self._patches_path is not None:
            self._patches_path.unlink(missing_ok=True)
        return self._network_to_score(network)

    def _run(self, processes: Processes) -> PredictorNetwork:
        config = self.config
        key = self._key()
        checkpoint = Checkpoint(self.checkpoint, key)
        some = self.rows.taken(self._training_index[:_BUILDING_ROWS])
        network = network_of(config.architecture).build(
            self.embedding, config, some, self.facts.seed, self._rules, self.groups
        )
        network = network.to(processes.device)
        learnt = [values for values in network.parameters() if values.requires_grad]
        as_graph = processes.count == 1 and runs_as_graph(config, processes.device.type)
        # A graph reads the rate, which changes with every step, from memory.
        rate = torch.tensor(config.rate, device=processes.device) if as_graph else config.rate
        optimiser = torch.optim.Adam(learnt, lr=rate, fused=True, capturable=as_graph)
        if config.average_passes > 0.0:
            averaged_steps = config.average_passes * self._steps_an_epoch
            self._average = _averaged(network, min(self._averaged_every / averaged_steps, 1.0))
        step = self._restore(checkpoint, network, optimiser)
        processes.require_same(step)
        shared: torch.nn.Module = network
        if processes.count > 1:
            shared = DistributedDataParallel(network)
        batches = _Batches(
            self.rows,
            self._training_index,
            config,
            self.facts,
            processes.device,
            self._patch_roots(network, key, processes),
        )
        self._preparing = None
        network.train()
        self._report(step)
        take_step = partial(self._take_step, network, shared, optimiser, processes)
        take_whole_step: Callable[..., Tensor] = take_step
        if as_graph:
            from lcollision_core.predictor.gpu_graph import Replayed

            take_whole_step = Replayed(take_step)
        while step < self._total:
            latent, targets = batches.at(*divmod(step, self._steps_an_epoch))
            for group in optimiser.param_groups:
                _set_rate(group, rate_at(step, self._total, config))
            is_whole = len(latent) == config.batch_rows
            loss = (take_whole_step if is_whole else take_step)(latent, *targets)
            step += 1
            if step % _STEPS_BETWEEN_CLEARINGS == 0:
                _clear_tiny_moments(optimiser)
            if self._average is not None and step % self._averaged_every == 0:
                self._average.update_parameters(network)
            self._losses.append(processes.sum_of(loss))
            if not math.isfinite(self._losses[-1]):
                raise LCollisionError(
                    f"the training diverged in step {step} of {self._total}", "lower the rate"
                )
            self._after_step(step, network, optimiser, checkpoint, processes)
        return network

    def _take_step(
        self,
        network: PredictorNetwork,
        shared: torch.nn.Module,
        optimiser: torch.optim.Optimizer,
        processes: Processes,
        latent: torch.Tensor,
        *targets: torch.Tensor,
    ) -> torch.Tensor:
        """Move the weights by a batch; return this process's share of its loss."""
        part = processes.share(len(latent))
        optimiser.zero_grad(set_to_none=True)
        output = shared(latent[part[0] : part[1]])
        loss = network.loss(output, Targets(*targets), part, self.config, self.facts.margin)
        # Processes average their gradients, but each has a share of the sum; and they wait for
        # the gradient of every parameter, even of those that this loss leaves out.
        outputs = (output.domain_energy, output.logit, *output.auxiliary)
        idle = sum((0.0 * values.sum() for values in outputs), start=0.0 * loss)
        torch.autograd.backward(loss * processes.count + idle)
        optimiser.step()
        return loss.detach()

    def _patch_roots(
        self, network: PredictorNetwork, key: str, processes: Processes
    ) -> npt.NDArray[np.float16]:
        """Label the patches, or resume from the file of an earlier run beside the checkpoint."""
        n_rows = len(self._training_index)
        cells = network.skin_cells(self.embedding)
        if cells is None:
            return np.empty((n_rows, 0), dtype=np.float16)
        checkpoint = Checkpoint(self._patches_path, key)
        roots = np.zeros((n_rows, cells.n_patches + cells.n_folds), dtype=np.float16)
        stored = checkpoint.get(_PATCHES)
        stored_roots = roots[:0] if stored is None else stored.arrays["root"]
        processes.require_same(len(stored_roots))
        if len(stored_roots) == n_rows:
            return stored_roots
        roots[: len(stored_roots)] = stored_roots
        labeller = PatchLabeller(
            self.embedding, self.rows, cells, self.facts.energy_scale, self._rules, self.groups
        )
        step = max(-(-n_rows // _TIMES_PATCHES_KEPT), _LEAST_PATCHES_KEPT)
        for start in range(len(stored_roots), n_rows, step):
            part = roots[start : start + step]
            self._label_patches(labeller, start, part, processes)
            if processes.rank == 0:
                checkpoint.put(_PATCHES, {"root": roots[: start + len(part)]}, {})
        return roots

    def _label_patches(
        self,
        labeller: PatchLabeller,
        start: int,
        part: npt.NDArray[np.float16],
        processes: Processes,
    ) -> None:
        """Fill in the roots of a part of the training rows; each process labels its share."""

        def report(done: int, total: int) -> None:
            self._preparing = (start + len(part) * done / total) / len(self._training_index)
            self._report(0)

        first, end = processes.share(len(part))
        mine = self._training_index[start + first : start + end]
        stopped = False
        try:
            part[first:end] = labeller.roots(mine, self.job.part(report))
        except CancelledError:
            stopped = True
        if processes.any_of(stopped):
            self.job.cancel()
            self.job.check()
        processes.add_up(part)

    def _after_step(
        self,
        step: int,
        network: PredictorNetwork,
        optimiser: torch.optim.Optimizer,
        checkpoint: Checkpoint,
        processes: Processes,
    ) -> None:
        stop, due = self.job.cancelled, checkpoint.due
        if processes.count > 1:
            talk = step % _STEPS_BETWEEN_TALKS == 0
            stop = talk and processes.any_of(stop)
        if step % self._steps_an_epoch == 0:
            self._errors = _error_rates(self._network_to_score(network), self._watched)
        if processes.rank == 0 and (stop or due):
            self._save(step, network, optimiser, checkpoint)
        if stop:
            processes.wait()
            self.job.cancel()
            self.job.check()
        if step % self._steps_an_epoch == 0:
            self._report(step)
            self._losses.clear()
        elif time.monotonic() - self._reported > _SECONDS_BETWEEN_REPORTS:
            self._report(step)

    def _report(self, step: int) -> None:
        self._reported = time.monotonic()
        self.job.report(
            PredictorStatus(
                epoch=step // self._steps_an_epoch,
                epochs=self._epochs,
                done=step,
                total=self._total,
                loss=math.fsum(self._losses) / len(self._losses) if self._losses else None,
                held_out_errors=self._errors,
                preparing=self._preparing,
            )
        )

    def _network_to_score(self, network: PredictorNetwork) -> PredictorNetwork:
        """Return the network to measure and store, with the mean weights if they are kept."""
        return network if self._average is None else cast(PredictorNetwork, self._average.module)

    def _key(self) -> str:
        """Return a digest of everything that determines the result of this run."""
        rows = self.rows
        digest = hashlib.sha256()
        for array in (rows.latent, rows.domain_energy, rows.energy, rows.n_pairs):
            digest.update(np.ascontiguousarray(array).data.cast("B"))
        options = {
            "version": _RUN_VERSION,
            "config": asdict(self.config),
            "seed": self.facts.seed,
            "rows": digest.hexdigest(),
        }
        return run_key({"mask": self.embedding.attention_mask}, options)

    def _save(
        self,
        step: int,
        network: PredictorNetwork,
        optimiser: torch.optim.Optimizer,
        checkpoint: Checkpoint,
    ) -> None:
        average = {} if self._average is None else self._average.state_dict()
        states = ((_NETWORK, network.state_dict()), (_AVERAGE, average))
        state = {
            prefix + name: values.cpu().numpy()
            for prefix, weights in states
            for name, values in weights.items()
        }
        for number, moments in optimiser.state_dict()["state"].items():
            for name, values in moments.items():
                state[f"{_OPTIMISER}{number}:{name}"] = values.cpu().numpy()
        losses = self._losses if step % self._steps_an_epoch else []
        facts = {"step": step, "losses": losses, "errors": self._errors}
        checkpoint.put(_PART, state, facts)

    def _restore(
        self, checkpoint: Checkpoint, network: PredictorNetwork, optimiser: torch.optim.Optimizer
    ) -> int:
        """Load a stored run's state and return the number of steps done."""
        stored = checkpoint.get(_PART)
        if stored is None:
            return 0
        states: dict[str, dict[str, Tensor]] = {_NETWORK: {}, _AVERAGE: {}, _OPTIMISER: {}}
        for name, array in stored.arrays.items():
            prefix, array_name = name.split(":", 1)
            states[f"{prefix}:"][array_name] = torch.tensor(array)
        network.load_state_dict(states[_NETWORK])
        if self._average is not None:
            self._average.load_state_dict(states[_AVERAGE])
        state = optimiser.state_dict()
        for name, values in states[_OPTIMISER].items():
            number, what = name.split(":")
            state["state"].setdefault(int(number), {})[what] = values
        optimiser.load_state_dict(state)
        self._losses = list(stored.metadata["losses"])
        self._errors = tuple(stored.metadata.get("errors", (None, None)))
        return int(stored.metadata["step"])


@dataclass(eq=False)
class _Batches:
    """Divide each epoch's order into batches; the order depends only on seed and epoch."""

    rows: LabelRows
    training_index: npt.NDArray[np.int64]
    config: PredictorConfig
    facts: TrainingFacts
    device: torch.device
    patch_root: npt.NDArray[np.float16]
    epoch: int = -1

    def at(self, epoch: int, number: int) -> tuple[torch.Tensor, Targets]:
        """Return batch `number` of an epoch: codes and targets."""
        if epoch != self.epoch:
            self.epoch = epoch
            rng = np.random.default_rng([self.facts.seed, epoch])
            self._order = rng.permutation(len(self.training_index))
        start = number * self.config.batch_rows
        row = self._order[start : start + self.config.batch_rows]
        index = self.training_index[row]
        rows, scale = self.rows, self.facts.energy_scale
        targets = (
            rows.domain_energy[index] / scale,
            rows.energy[index] / scale,
            rows.n_pairs[index] > 0,
            self.patch_root[row],
        )
        return self._tensor(rows.latent[index]), Targets(*map(self._tensor, targets))

    def _tensor(self, values: npt.NDArray[Any]) -> torch.Tensor:
        tensor = torch.from_numpy(values.astype(np.float32, copy=False))
        return tensor.to(self.device, non_blocking=True)


def _error_rates(network: PredictorNetwork, rows: LabelRows) -> tuple[float | None, float | None]:
    """Return the false positive and false negative rates: see `error_rates`."""
    device = next(network.parameters()).device
    parts = torch.split(torch.from_numpy(rows.latent), BATCH_ROWS)
    network.eval()
    with torch.inference_mode():
        logit = torch.cat([network(part.to(device)).logit for part in parts])
    network.train()
    return error_rates((logit > 0.0).cpu().numpy(), rows.colliding)


def _averaged(network: PredictorNetwork, weight: float) -> AveragedModel:
    """Return a copy for the exponential moving average of the weights; `weight` is the newest's.

    The first few have equal weights.
    """

    def mean(average: Tensor, newest: Tensor, n_averaged: Tensor | int) -> Tensor:
        return average.lerp(newest, max(weight, 1.0 / (int(n_averaged) + 1)))

    return AveragedModel(network, avg_fn=mean)


def _clear_tiny_moments(optimiser: torch.optim.Optimizer) -> None:
    """Set Adam's running means to 0 before they become denormal numbers.

    Weights whose gradient has vanished, two thirds of the paper's network, would have such means,
    with which CPUs are 16 times slower.
    """
    for moments in optimiser.state.values():
        for name in ("exp_avg", "exp_avg_sq"):
            values = moments[name]
            values.masked_fill_(values.abs() < _TINY_MOMENT, 0.0)


def _set_rate(group: dict[str, Any], rate: float) -> None:
    """Set the step size of an optimiser's weights, in place if it is a tensor."""
    if isinstance(group["lr"], torch.Tensor):
        group["lr"].fill_(rate)
    else:
        group["lr"] = rate


def rate_at(step: int, total: int, config: PredictorConfig) -> float:
    """Return Adam's step size for a step of the run, counted from 0."""
    if config.schedule == "constant":
        return config.rate
    peak = _WARM_UP * total
    if step < peak:
        fraction = 0.5 * (1.0 - math.cos(math.pi * (step + 1) / (peak + 1)))
        return config.rate * (_LEAST_RATE + (1.0 - _LEAST_RATE) * fraction)
    return config.rate * 0.5 * (1.0 + math.cos(math.pi * (step - peak) / (total - peak)))
