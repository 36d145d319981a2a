"""Work on a GPU as a CUDA graph: a replay is launched at once, instead of hundreds of kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.on_gpu import GPU_LOCK
from lcollision_core.predictor.network_base import PredictorNetwork

_WARM_UPS = 3


class Replayed:
    """A function of tensors whose work is recorded once and then replayed.

    The first calls only run the function, which compiles its kernels and allocates what it keeps.

    Parameters
    ----------
    function : always does the same work on tensors of the same shapes, on the current stream, and
        reads no number from the GPU; what changes between calls must be in tensors
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._warm_ups = function, _WARM_UPS
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, *arguments: torch.Tensor) -> Any:
        """Return the function's results, which the next call overwrites."""
        if self._warm_ups:
            self._warm_ups -= 1
            return self._on_side_stream(arguments)
        if self._graph is None:
            self._arguments = [values.clone() for values in arguments]
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._results = self._function(*self._arguments)
        for values, given in zip(self._arguments, arguments, strict=True):
            values.copy_(given)
        self._graph.replay()
        return self._results

    def _on_side_stream(self, arguments: tuple[torch.Tensor, ...]) -> Any:
        """Run the function as a graph is recorded: autograd remembers the streams of weights."""
        before = torch.cuda.current_stream()
        side = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        side.wait_stream(before)
        with torch.cuda.stream(side):
            results = self._function(*arguments)
        before.wait_stream(side)
        return results


class ReplayedNetwork:
    """Predict codes on a GPU in batches of one size.

    Parameters
    ----------
    network : on the GPU, with fixed weights
    batch_rows : codes of a batch; the last one is filled up with any codes
    """

    def __init__(self, network: PredictorNetwork, batch_rows: int) -> None:
        self._predict, self._batch_rows = Replayed(network), batch_rows
        self._device = next(network.parameters()).device

    def outputs(self, codes: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Return (B, K) scaled energies of the domains and (B,) logits of (B, D) codes."""
        parts = []
        with GPU_LOCK, torch.inference_mode():
            batch = torch.zeros((self._batch_rows, codes.shape[1]), device=self._device)
            for start in range(0, max(len(codes), 1), self._batch_rows):
                part = torch.from_numpy(codes[start : start + self._batch_rows])
                batch[: len(part)] = part
                output = self._predict(batch)
                # A copy, before the next batch overwrites the results.
                both = torch.cat([output.domain_energy, output.logit[:, None]], dim=1)
                parts.append(both[: len(part)])
            numbers: FloatArray = torch.cat(parts).double().cpu().numpy()
        return numbers[:, :-1], numbers[:, -1]
