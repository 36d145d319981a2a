"""The default network without torch: equal values and derivatives."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from lcollision_core.bodies import LearnedBody
from lcollision_core.predictor.compiled_network import CompiledNetwork
from lcollision_core.predictor.config import PRESETS
from lcollision_core.predictor.geometric_network import GeometricNetwork
from lcollision_core.predictor.stored_network import require_network


@pytest.fixture(scope="module", params=["folds", "no folds"])
def network(
    tube_model: LearnedBody, tube_folds: np.ndarray, request: pytest.FixtureRequest
) -> GeometricNetwork:
    """Return a network without zero weights."""
    sites = tube_folds if request.param == "folds" else tube_folds[:0]
    made = GeometricNetwork(tube_model.embedding, 7, sites)
    latent = tube_model.latent_space.sample(40, np.random.default_rng(1)).astype(np.float32)
    made._fit(tube_model.embedding, latent)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for values in made.parameters():
            values += 0.05 * torch.randn(values.shape, generator=generator)
    return made


def _arrays(network: GeometricNetwork) -> dict[str, np.ndarray]:
    return {name: values.numpy() for name, values in network.state_dict().items()}


@pytest.mark.parametrize(
    "n_poses", [0, 1, 9, 65, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 64, 150))]
)
def test_it_agrees_with_the_torch_network(
    tube_model: LearnedBody, network: GeometricNetwork, n_poses: int
) -> None:
    compiled = CompiledNetwork(tube_model.embedding, _arrays(network))
    latent = tube_model.latent_space.sample(n_poses, np.random.default_rng(2))
    if not n_poses:
        assert compiled.outputs(latent)[1].shape == (0,)
        assert compiled.logit_and_gradient(latent)[1].shape == latent.shape
        return
    codes = torch.tensor(latent, requires_grad=True)
    exact = GeometricNetwork.restore(tube_model.embedding, None, network.state_dict()).double()  # type: ignore[arg-type]
    output = exact(codes)
    (gradient,) = torch.autograd.grad(output.logit.sum(), codes)
    energy, logit = compiled.outputs(latent)
    # Single versus double precision.
    np.testing.assert_allclose(energy, output.domain_energy.detach(), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(logit, output.logit.detach(), rtol=1e-4, atol=1e-4)
    again, slope = compiled.logit_and_gradient(latent)
    np.testing.assert_array_equal(again, logit)
    scale = gradient.abs().max().item()
    assert scale > 1e-3
    np.testing.assert_allclose(slope, gradient, atol=1e-3 * scale)


def test_a_pose_gets_the_same_alone_and_with_others_but_for_rounding(
    tube_model: LearnedBody, network: GeometricNetwork
) -> None:
    compiled = CompiledNetwork(tube_model.embedding, _arrays(network))
    latent = tube_model.latent_space.sample(4, np.random.default_rng(2))
    logit, slope = compiled.logit_and_gradient(latent)
    for row in range(4):
        alone = compiled.logit_and_gradient(latent[row : row + 1])
        np.testing.assert_allclose(alone[0], logit[row : row + 1], rtol=1e-6)
        np.testing.assert_allclose(alone[1][0], slope[row], atol=1e-4 * np.abs(slope[row]).max())


def test_arrays_of_another_network_are_refused(
    tube_model: LearnedBody, network: GeometricNetwork
) -> None:
    embedding, arrays = tube_model.embedding, _arrays(network)
    require_network(arrays, embedding, PRESETS["default"])
    for name in arrays:
        wrong = {**arrays, name: np.concatenate([arrays[name], arrays[name]], axis=-1)}
        if name == "site_vertices":
            wrong[name] = arrays[name] + 10**6
            if not arrays[name].size:
                continue
        with pytest.raises(ValueError, match=rf"array {name}|shape|sites"):
            require_network(wrong, embedding, PRESETS["default"])
        fewer = {key: array for key, array in arrays.items() if key != name}
        with pytest.raises(ValueError, match=name):
            require_network(fewer, embedding, PRESETS["default"])


def test_posing_predicting_and_resolving_need_neither_torch_nor_a_front_end() -> None:
    """Torch would double the memory, and the time until the editor's predictions are ready."""
    code = (
        "import sys, numpy as np\n"
        "from lcollision_core.bodies import LearnedBody, find_model\n"
        "model = LearnedBody.load(find_model('body'))\n"
        "latent = model.latent_space.sample(30, np.random.default_rng(0))\n"
        "logit = np.concatenate([model.predict(one).collision_logit for one in latent])\n"
        "model.encode(model.decode(latent[0]))\n"
        "result = model.resolve(latent[logit.argmax()])\n"
        "print(result.exactly_free, *sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300
    )
    is_free, *loaded = done.stdout.split()
    assert is_free == "True"
    assert "lcollision_core" in loaded
    assert {"torch", "PySide6", "vtkmodules", "pyvista", "typer", "rich"}.isdisjoint(loaded)
