"""The predictor on a GPU against the CPU; `contact/test_gpu` runs it with a simulated GPU.

Numba's simulator runs the kernels, on torch's arrays of the CPU, and `SimulatedGraph` stands in for
CUDA's graphs.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lcollision_core.bodies import LearnedBody
from lcollision_core.labels import LabelRows
from lcollision_core.on_gpu import SIMULATED
from lcollision_core.predictor import (
    PRESETS,
    CollisionPredictor,
    geometric_network,
    gpu_inputs,
    predictor,
    train_predictor,
    training_loop,
)
from lcollision_core.predictor.geometric_network import GeometricNetwork, NetworkSizes
from lcollision_core.predictor.gpu_graph import Replayed
from lcollision_core.predictor.predictor import TrainingFacts, runs_as_graph
from tests.core.labelled import labeller_of
from tests.core.predictor_rows import colliding_latent, weights_of
from tests.core.simulator import poll_politely

_launch = gpu_inputs.launch
_aten = torch.ops.aten


class SimulatedGraph(TorchDispatchMode):
    """Records what torch and our kernels do, and does it again on the same memory.

    As on a GPU, recording changes nothing that existed before, and numbers can neither be read nor
    brought to the GPU.
    """

    recording: SimulatedGraph | None = None

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], Any]] = []
        self._before: list[tuple[torch.Tensor, torch.Tensor]] = []

    def __enter__(self) -> SimulatedGraph:
        SimulatedGraph.recording = self
        super().__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        super().__exit__(*exception)
        SimulatedGraph.recording = None
        with torch.no_grad():
            for values, before in reversed(self._before):
                values.copy_(before)

    def __torch_dispatch__(
        self, function: Any, _: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        assert function not in (_aten._local_scalar_dense.default, _aten.lift_fresh.default)
        for argument, value in zip(function._schema.arguments, arguments, strict=False):
            if argument.alias_info is not None and argument.alias_info.is_write:
                self._before += [(values, values.clone()) for values in tree_leaves(value)]
        results = function(*arguments, **(options or {}))
        self.steps.append((function, arguments, options or {}, results))
        return results

    @torch.no_grad()
    def replay(self) -> None:
        for function, arguments, options, results in self.steps:
            again = function(*arguments, **options)
            for old, new in zip(tree_leaves(results), tree_leaves(again), strict=True):
                if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


def _recorded_launch(*arguments: Any) -> None:
    _launch(*arguments)
    if SimulatedGraph.recording is not None:
        SimulatedGraph.recording.steps.append((_launch, arguments, {}, None))


@pytest.fixture(autouse=True)
def _gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    assert SIMULATED
    poll_politely(monkeypatch)
    stream = SimpleNamespace(wait_stream=lambda _: None)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", SimulatedGraph)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph: graph)
    monkeypatch.setattr(torch.cuda, "Stream", lambda: stream)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda _: nullcontext())
    monkeypatch.setattr(gpu_inputs, "launch", _recorded_launch)


@pytest.fixture
def _inputs_on_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let networks on the CPU use the kernels."""
    monkeypatch.setattr(GeometricNetwork, "_inputs", GeometricNetwork._gpu_inputs)


def _network(
    model: LearnedBody, sites: np.ndarray, n_points: int = 24
) -> tuple[GeometricNetwork, np.ndarray]:
    """Return a network without zero weights, and poses of which some are far out of the box."""
    network = GeometricNetwork(model.embedding, 7, sites, n_points, width=8)
    latent = colliding_latent(model, 20)
    network._fit(model.embedding, latent)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for values in network.parameters():
            values += 0.2 * torch.randn(values.shape, generator=generator)
    return network.requires_grad_(False), latent


@pytest.mark.parametrize("n_sites", [3, 0])
def test_inputs_are_the_processors(
    tube_model: LearnedBody, tube_folds: np.ndarray, n_sites: int
) -> None:
    network, latent = _network(tube_model, tube_folds[:n_sites])
    codes = torch.from_numpy(latent[:4])
    on_gpu = network._gpu_inputs(codes)
    expected = network._inputs(codes)
    exact = network.double()._inputs(codes.double())
    assert float((exact[0] != 0.0).double().mean()) > 0.3
    for ours, processors, doubles in zip(on_gpu, expected, exact, strict=True):
        assert ours.shape == processors.shape
        if ours.numel():
            # Sums of another order, and fused products, are as far from double precision as the
            # processor's.
            rounding = float((processors - doubles).abs().max())
            assert float((ours - doubles).abs().max()) < 3.0 * rounding < 1e-4
    assert network.float()._gpu_inputs(codes[:0])[0].shape == (24, 0, 16)


@pytest.mark.usefixtures("_inputs_on_gpu")
def test_replayed_predictions_are_the_processors(
    tube_model: LearnedBody, tube_folds: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, latent = _network(tube_model, tube_folds[:3], n_points=10)
    state = {name: values.numpy() for name, values in network.state_dict().items()}
    facts = TrainingFacts(2, 1, 0.5, 0, 1.0, 0.0, None)
    on_cpu = CollisionPredictor(tube_model.embedding, state, PRESETS["default"], facts)
    expected = on_cpu.predict(latent)
    on_gpu = replace(on_cpu, device="cuda")
    monkeypatch.setattr(GeometricNetwork, "to", lambda network, _: network)
    monkeypatch.setattr(predictor, "BATCH_ROWS", 3)
    limit = np.median(expected.collision_logit)
    # Batches before, while and after the graph is recorded, whole and in part.
    for part in (slice(0, 14), slice(14, 15), slice(0, 0), slice(15, 20)):
        predicted, logit = on_gpu.predict(latent[part]), expected.collision_logit[part]
        energy = expected.domain_energy[part]
        np.testing.assert_allclose(predicted.domain_energy, energy, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(predicted.collision_logit, logit, rtol=1e-4, atol=1e-4)
        assert np.array_equal(predicted.collision_logit > limit, logit > limit)
    assert "_replayed" in vars(on_gpu)
    assert "_replayed" not in on_gpu.__getstate__()


def test_graphs_need_the_extra_and_our_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    assert runs_as_graph(PRESETS["default"], "cuda")
    assert not runs_as_graph(PRESETS["default"], "cpu")
    assert not runs_as_graph(PRESETS["paper"], "cuda")
    monkeypatch.setattr("lcollision_core.devices._has_extra", lambda: False)
    assert not runs_as_graph(PRESETS["default"], "cuda")


def _trained(model: LearnedBody, rows: LabelRows) -> bytes:
    config = replace(PRESETS["default"], batch_rows=8, epochs=4, average_passes=1.0, balanced=False)
    return weights_of(dict(train_predictor(rows, model.embedding, config, device="cpu").arrays))


@pytest.mark.usefixtures("_inputs_on_gpu")
def test_replayed_steps_train_as_steps_one_by_one(
    tube_model: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole batches are replayed, each with its own rate; the last of each pass is smaller."""
    monkeypatch.setitem(geometric_network.SIZES, "default", NetworkSizes(8, 2, 8))
    latent = colliding_latent(tube_model, 30)
    latent[::2] *= 0.1
    rows = labeller_of(tube_model).label(latent)
    expected = np.frombuffer(_trained(tube_model, rows), dtype=np.float32)
    replays: list[int] = []
    monkeypatch.setattr(training_loop, "runs_as_graph", lambda *_: True)
    replay = SimulatedGraph.replay
    monkeypatch.setattr(
        SimulatedGraph, "replay", lambda graph: (replays.append(len(graph.steps)), replay(graph))
    )
    trained = np.frombuffer(_trained(tube_model, rows), dtype=np.float32)
    # 21 rows train; the first three whole batches come before the graph.
    assert len(replays) == 4 * 2 - 3
    np.testing.assert_allclose(trained, expected, rtol=1e-4, atol=1e-5)


def test_a_graph_that_reads_a_number_is_refused() -> None:
    replayed = Replayed(lambda values: values * float(values[0]))
    for _ in range(3):
        replayed(torch.ones(2))
    with pytest.raises(AssertionError):
        replayed(torch.ones(2))
