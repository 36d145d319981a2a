"""The default network without torch: the same numbers, and the same derivatives."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from lcollision_core.model import PoseModel
from lcollision_core.predictor.compiled_network import CompiledNetwork
from lcollision_core.predictor.geometric import GeometricNetwork


@pytest.fixture(scope="module", params=["folds", "no folds"])
def network(
    tube_model: PoseModel, tube_folds: np.ndarray, request: pytest.FixtureRequest
) -> GeometricNetwork:
    """Return a network with weights that are not zero anywhere."""
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


@pytest.mark.parametrize("n_poses", [0, 1, 5])
def test_it_says_what_the_torch_network_says(
    tube_model: PoseModel, network: GeometricNetwork, n_poses: int
) -> None:
    few = CompiledNetwork(tube_model.embedding, _arrays(network))
    latent = tube_model.latent_space.sample(n_poses, np.random.default_rng(2))
    codes = torch.tensor(latent, requires_grad=True)
    exact = GeometricNetwork.restore(tube_model.embedding, None, network.state_dict()).double()  # type: ignore[arg-type]
    if not n_poses:
        assert few.logit_and_gradient(latent)[1].shape == latent.shape
        return
    output = exact(codes)
    (gradient,) = torch.autograd.grad(output.logit.sum(), codes)
    energy, logit = few.outputs(latent)
    # Its reaches, frames and offsets are rounded to single precision.
    np.testing.assert_allclose(energy, output.domain_energy.detach(), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(logit, output.logit.detach(), rtol=1e-6, atol=1e-6)
    again, slope = few.logit_and_gradient(latent)
    np.testing.assert_array_equal(again, logit)
    scale = gradient.abs().max().item()
    assert scale > 1e-3
    np.testing.assert_allclose(slope, gradient, atol=1e-5 * scale)


@pytest.mark.parametrize("n_poses", [0, 1, 9, 64, 65, 150])
def test_single_precision_says_nearly_the_same(
    tube_model: PoseModel, network: GeometricNetwork, n_poses: int
) -> None:
    many = CompiledNetwork(tube_model.embedding, _arrays(network), np.float32)
    exact = CompiledNetwork(tube_model.embedding, _arrays(network), skin=many.skin)
    latent = tube_model.latent_space.sample(n_poses, np.random.default_rng(4))
    for found, known in zip(many.outputs(latent), exact.outputs(latent), strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-3, atol=1e-3)
    with torch.no_grad():
        output = network(torch.tensor(latent, dtype=torch.float32))
    np.testing.assert_allclose(many.outputs(latent)[1], output.logit, rtol=1e-3, atol=1e-3)


def test_single_precision_takes_no_derivatives(
    tube_model: PoseModel, network: GeometricNetwork
) -> None:
    many = CompiledNetwork(tube_model.embedding, _arrays(network), np.float32)
    with pytest.raises(TypeError, match="double precision"):
        many.logit_and_gradient(np.zeros((1, tube_model.latent_size)))


def test_a_pose_gets_the_same_numbers_alone_and_with_others(
    tube_model: PoseModel, network: GeometricNetwork
) -> None:
    few = CompiledNetwork(tube_model.embedding, _arrays(network))
    latent = tube_model.latent_space.sample(4, np.random.default_rng(2))
    logit, slope = few.logit_and_gradient(latent)
    for row in range(4):
        alone = few.logit_and_gradient(latent[row : row + 1])
        np.testing.assert_array_equal(alone[0], logit[row : row + 1])
        np.testing.assert_array_equal(alone[1], slope[row : row + 1])


def test_arrays_of_another_network_are_refused(
    tube_model: PoseModel, network: GeometricNetwork
) -> None:
    arrays = _arrays(network)
    for name in arrays:
        wrong = {**arrays, name: np.concatenate([arrays[name], arrays[name]], axis=-1)}
        if name == "site_vertices":
            wrong[name] = arrays[name] + 10**6
            if not arrays[name].size:
                continue
        with pytest.raises(ValueError, match=r"."):
            CompiledNetwork(tube_model.embedding, wrong)
        with pytest.raises((KeyError, ValueError)):
            CompiledNetwork(
                tube_model.embedding, {key: array for key, array in arrays.items() if key != name}
            )


def test_sites_without_vertices_are_refused(
    tube_model: PoseModel, network: GeometricNetwork
) -> None:
    arrays = {**_arrays(network), "site_vertices": np.zeros((3, 0), dtype=np.int32)}
    with pytest.raises(ValueError, match="fold sites"):
        CompiledNetwork(tube_model.embedding, arrays)


def test_predicting_and_resolving_a_pose_need_no_torch() -> None:
    """It would double the memory and the time until the editor's predictions are there."""
    code = (
        "import sys, numpy as np\n"
        "from lcollision_core.model import PoseModel, find_model\n"
        "model = PoseModel.load(find_model('body'))\n"
        "latent = model.latent_space.sample(30, np.random.default_rng(0))\n"
        "logit = np.concatenate([model.predict(one).collision_logit for one in latent])\n"
        "result = model.resolve(latent[logit.argmax()])\n"
        "print(result.exactly_free, 'torch' in sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300
    )
    assert done.stdout.split() == ["True", "False"]
