"""The default network: its points, what they see, and the patches that it is taught."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import CancelToken
from lcollision_core.model import PoseModel
from lcollision_core.predictor import PRESETS
from lcollision_core.predictor.body_points import FAR_PARTNERS, NEAR_PARTNERS, BodyPoints
from lcollision_core.predictor.geometric import GeometricNetwork
from lcollision_core.predictor.look import deform, look
from lcollision_core.predictor.patch_labels import patch_roots
from tests.core.predictor_rows import made_up_rows


@pytest.fixture(scope="module")
def network(tube_model: PoseModel) -> GeometricNetwork:
    rows = made_up_rows(tube_model.embedding)
    built = GeometricNetwork.build(tube_model.embedding, PRESETS["default"], rows)
    assert isinstance(built, GeometricNetwork)
    return built


def _some_latent(model: PoseModel, n_poses: int) -> np.ndarray:
    return model.latent_space.sample(n_poses, np.random.default_rng(3))


def test_points_are_spread_and_every_vertex_belongs_to_the_nearest(tube_model: PoseModel) -> None:
    embedding = tube_model.embedding
    points = BodyPoints.of(embedding, 20)
    assert len(np.unique(points.vertex)) == 20
    assert np.array_equal(points.patch[points.vertex], np.arange(20))
    places = embedding.rest_vertices[points.vertex]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.eye(20)
    covered = np.linalg.norm(embedding.rest_vertices[:, None] - places[None], axis=2).min(axis=1)
    # Farthest-point sampling: no vertex is farther from the points than they are from each other.
    assert covered.max() <= apart.min() + 1e-12


def test_frames_are_rotations_whose_first_axis_points_out(tube_model: PoseModel) -> None:
    points = BodyPoints.of(tube_model.embedding, 30)
    assert points.frame.transpose(0, 2, 1) @ points.frame == pytest.approx(
        np.broadcast_to(np.eye(3), (30, 3, 3)), abs=1e-12
    )
    assert np.linalg.det(points.frame) == pytest.approx(np.ones(30))
    rest = tube_model.embedding.rest_vertices
    middle = rest.mean(axis=0)
    outward = ((rest[points.vertex] - middle) * points.frame[:, :, 0]).sum(axis=1)
    assert (outward > 0.0).mean() > 0.9


def test_far_partners_are_far_along_the_skin_and_near_ones_near(
    tube_model: PoseModel, network: GeometricNetwork
) -> None:
    between = BodyPoints.of(tube_model.embedding).distance[:, network._points.vertex]
    partners = network.partners.numpy()
    assert partners.shape[1] == FAR_PARTNERS + NEAR_PARTNERS
    rows = np.arange(len(partners))[:, None]
    assert between[rows, partners[:, :4]].min() >= 0.12
    assert between[rows, partners[:, FAR_PARTNERS : FAR_PARTNERS + 2]].max() < 0.16


def test_reduced_body_lies_where_the_decoder_puts_it(
    tube_model: PoseModel, network: GeometricNetwork
) -> None:
    latent = _some_latent(tube_model, 20)
    with torch.no_grad():
        _, places = network.body(torch.tensor(latent, dtype=torch.float32))
    truth = tube_model.embedding.decode(latent)[:, network._points.vertex]
    errors = np.linalg.norm(places.numpy().transpose(0, 2, 1) - truth, axis=2)
    assert errors.mean() < 2e-3
    moved = truth - truth[:1]
    assert np.abs(moved).max() > 0.05


def test_points_see_partners_where_the_mesh_has_them(
    tube_model: PoseModel, network: GeometricNetwork
) -> None:
    """By hand for one point: offset in its turned frame, shortened to its closeness."""
    latent = torch.tensor(_some_latent(tube_model, 1), dtype=torch.float64)
    exact = GeometricNetwork(tube_model.embedding, 0)
    exact.load_state_dict(network.state_dict())
    exact = exact.double()
    with torch.no_grad():
        frame, places = exact.body(latent)
        inputs = look(frame, places, exact.partners, FAR_PARTNERS)[5, 0].numpy()
    place = places[0].numpy()
    partner = int(network.partners[5, 2])
    local = frame[0, 5].numpy().T @ (place[:, partner] - place[:, 5])
    distance = np.linalg.norm(local)
    closeness = np.exp(-distance / 0.1)
    assert inputs[[2, FAR_PARTNERS + 2, 2 * FAR_PARTNERS + 2]] == pytest.approx(
        local / distance * closeness, rel=1e-4
    )
    assert inputs[3 * FAR_PARTNERS + 2] == pytest.approx(closeness, rel=1e-4)
    near = int(network.partners[5, FAR_PARTNERS])
    local = frame[0, 5].numpy().T @ (place[:, near] - place[:, 5])
    assert inputs[4 * FAR_PARTNERS] == pytest.approx(local[0], rel=1e-9)


@pytest.fixture
def made_up() -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    features = normal(2, 5, 9)
    features[0, 0, :3] = 0.0
    partners = torch.tensor([[(p + q + 1) % 5 for q in range(4)] for p in range(5)])
    return features, torch.linalg.qr(normal(5, 3, 3))[0], 0.1 * normal(2, 3, 5), partners.int()


def test_compiled_and_torch_paths_agree(made_up: tuple[torch.Tensor, ...]) -> None:
    """On a GPU torch does what the compiled loops do on the CPU; `meta` hides where it runs."""
    features, rest_frame, places, partners = made_up
    frame, rows = deform(features, rest_frame)
    hidden = _Elsewhere(features)
    frame_torch, rows_torch = deform(hidden, rest_frame)  # type: ignore[arg-type]
    assert torch.allclose(frame, frame_torch, atol=1e-12)
    assert torch.allclose(rows, rows_torch, atol=1e-12)
    inputs = look(frame, places, partners, 3)
    inputs_torch = look(_Elsewhere(frame), places, partners, 3)  # type: ignore[arg-type]
    assert torch.allclose(inputs, inputs_torch, atol=1e-12)
    assert inputs.abs().max() > 0.1


class _Elsewhere(torch.Tensor):
    """A tensor that says it is on another device, so that the torch path is taken."""

    @staticmethod
    def __new__(cls, values: torch.Tensor) -> _Elsewhere:
        return torch.Tensor._make_subclass(cls, values)

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return torch.device("meta")

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        return super().__torch_function__(func, types, args, kwargs or {})


def test_derivatives_are_those_of_finite_differences(made_up: tuple[torch.Tensor, ...]) -> None:
    features, rest_frame, places, partners = made_up
    moving = features.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda values: deform(values, rest_frame), moving)
    frame = deform(features, rest_frame)[0].requires_grad_()
    assert torch.autograd.gradcheck(
        lambda turned, placed: look(turned, placed, partners, 3),
        (frame, places.requires_grad_()),
    )


def test_a_batch_is_its_poses(tube_model: PoseModel, network: GeometricNetwork) -> None:
    latent = torch.tensor(_some_latent(tube_model, 70), dtype=torch.float32)
    with torch.no_grad():
        together = network(latent)
        alone = [network(row[None]) for row in latent]
    assert torch.allclose(together.logit, torch.cat([one.logit for one in alone]), atol=1e-4)
    assert together.logit.std() > 0.0
    assert (together.domain_energy >= 0.0).all()


def test_patches_share_out_the_exact_energy(tube_model: PoseModel) -> None:
    embedding = tube_model.embedding
    latent = (2.5 * _some_latent(tube_model, 60)).astype(np.float32)
    patch = BodyPoints.of(embedding, 25).patch
    index = np.arange(0, 60, 2)
    roots = patch_roots(embedding, latent, index, patch, 0.0, energy_scale=1e-4)
    detector = CollisionDetector(embedding.topology, embedding.rest_vertices)
    vertices = embedding.decode(latent[index]).astype(np.float32)
    energy = detector.detect_batch(vertices).vertex_energy.sum(axis=1)
    assert (energy > 0.0).sum() >= 5
    assert ((roots > 0.0).any(axis=1) == (energy > 0.0)).all()
    shared = (roots.astype(np.float64) ** 2).sum(axis=1) * 0.05 * 1e-4
    assert shared == pytest.approx(energy, rel=5e-3, abs=1e-9)


def test_labelling_patches_can_be_cancelled(tube_model: PoseModel) -> None:
    cancel = CancelToken()
    cancel.cancel()
    patch = np.zeros(tube_model.n_vertices, dtype=np.int64)
    with pytest.raises(CancelledError):
        patch_roots(
            tube_model.embedding,
            _some_latent(tube_model, 4).astype(np.float32),
            np.arange(4),
            patch,
            0.0,
            1.0,
            cancel=cancel,
        )


def test_a_network_without_domains_is_the_paper_s_alone(tube_model: PoseModel) -> None:
    config = replace(PRESETS["default"], by_domain=False)
    with pytest.raises(LCollisionError, match="--preset paper"):
        GeometricNetwork.build(tube_model.embedding, config)
