"""A learned model as a torch module: equal values, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from lcollision_core.bodies import LearnedBody
from lcollision_core.errors import ModelFileError, ShapeError
from lcollision_core.predictor import PRESETS, train_predictor
from lcollision_core.predictor.pose_module import PoseModule
from tests.core.predictor_rows import config, made_up_rows


@pytest.fixture(scope="module", params=["paper", "default", "no domains"])
def model(tube_model: LearnedBody, request: pytest.FixtureRequest) -> LearnedBody:
    """Return a model with a briefly trained predictor."""
    chosen = {
        "paper": config(epochs=1),
        "default": replace(PRESETS["default"], epochs=1, batch_rows=64),
        "no domains": config(epochs=1, by_domain=False),
    }[request.param]
    predictor = train_predictor(made_up_rows(tube_model.embedding), tube_model.embedding, chosen)
    return tube_model.with_predictor(predictor)


def _latent(model: LearnedBody, n_poses: int = 3) -> torch.Tensor:
    drawn = model.sample(n_poses, np.random.default_rng(4))
    return torch.tensor(drawn.astype(np.float32).astype(np.float64))


def test_a_module_gives_what_the_model_gives(model: LearnedBody) -> None:
    latent = _latent(model, 20)
    output = model.torch_module()(latent.float())
    assert all(values.dtype == torch.float32 for values in output)
    exact = model.torch_module().double()(latent)
    assert np.array_equal(exact.vertices.numpy(), model.decode(latent.numpy()))
    prediction = model.predict(latent.numpy())
    np.testing.assert_allclose(exact.collision_logit, prediction.collision_logit, atol=1e-4)
    np.testing.assert_allclose(output.collision_logit, prediction.collision_logit, atol=1e-4)
    alone = model.torch_module().logit(latent.float())
    np.testing.assert_allclose(alone, prediction.collision_logit, atol=1e-4)
    np.testing.assert_allclose(
        exact.domain_energy.sum(dim=1), prediction.energy, rtol=1e-3, atol=1e-9
    )
    with pytest.raises(ShapeError, match=r"latent must be of shape \(B, 8\)"):
        model.torch_module()(latent[0])


@pytest.mark.parametrize("part", ["vertices", "energies", "logit", "logit alone"])
def test_derivatives_are_those_of_central_differences(model: LearnedBody, part: str) -> None:
    module = model.torch_module().double()
    latent = _latent(model).requires_grad_()
    weights = torch.tensor(
        np.random.default_rng(5).normal(size=(len(latent), model.topology.n_vertices, 3))
    )
    losses: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "vertices": lambda codes: (weights * module(codes).vertices).sum(),
        # Square roots, for a loss of the magnitude of the step.
        "energies": lambda codes: module(codes).domain_energy.sqrt().sum(),
        "logit": lambda codes: (module(codes).collision_logit ** 2).sum(),
        "logit alone": lambda codes: (module.logit(codes) ** 2).sum(),
    }
    loss = losses[part]
    # Every energy must be above 0, where its root is differentiable.
    assert part != "energies" or float(module(latent).domain_energy.detach().min()) > 0.0
    (gradient,) = torch.autograd.grad(loss(latent), latent)
    assert float(gradient.abs().min()) > 0.0
    # The decoder and the compiled logit use single precision, the network here double.
    steps = {"vertices": 2.0**-6, "logit alone": 2.0**-10}
    step, accuracy = steps.get(part, 2.0**-14), 2e-2 if part in steps else 1e-4
    for row, code in np.ndindex(*latent.shape):
        ends = []
        for way in (step, -step):
            moved = latent.detach().clone()
            moved[row, code] += way
            ends.append(float(loss(moved)))
        expected = (ends[0] - ends[1]) / (2.0 * step)
        tolerance = accuracy * float(gradient.abs().max())
        assert float(gradient[row, code]) == pytest.approx(expected, abs=tolerance)


def test_an_optimiser_of_torch_lowers_the_logit(model: LearnedBody) -> None:
    module = model.torch_module()
    rows = made_up_rows(model.embedding, 200, seed=6)
    before = module.predict(torch.tensor(rows.latent))[1]
    latent = torch.tensor(rows.latent[[int(before.argmax())]], requires_grad=True)
    optimiser = torch.optim.Adam([latent], lr=0.01)
    logits = []
    for _ in range(10):
        optimiser.zero_grad()
        (logit,) = module.logit(latent)
        logit.backward()
        optimiser.step()
        logits.append(float(logit.detach()))
    assert (np.diff(logits) < 0.0).all()
    assert not any(weight.requires_grad for weight in module.parameters())


def test_tensors_with_gradients_are_refused_where_arrays_are_needed(model: LearnedBody) -> None:
    latent = _latent(model).requires_grad_()
    predictor = model.require_predictor()
    for take in (model.decode, model.predict, model.embedding.decode, predictor.predict):
        with pytest.raises(ShapeError, match=r"latent is not an array.* got Tensor;.*torch_module"):
            take(latent)
    with pytest.raises(ShapeError, match="latent is not an array"):
        predictor.logit_and_gradient(latent)
    # Without gradients, results are arrays.
    assert np.array_equal(model.decode(latent.detach()), model.decode(latent.detach().numpy()))


def test_a_model_without_a_predictor_says_so(tube_model: LearnedBody) -> None:
    with pytest.raises(ModelFileError, match="has no predictor"):
        tube_model.torch_module()


def test_a_module_decodes_without_a_model_file(model: LearnedBody) -> None:
    module = PoseModule(model.embedding, model.require_predictor())
    latent = _latent(model)
    expected = model.embedding.decode(latent.numpy())
    assert np.array_equal(module.decode(latent).numpy(), expected)
