"""Encoding as a torch function, and its derivatives against central differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.features import IDENTITY_FEATURE
from lcollision_core.acap.torch_encode import pull_features
from lcollision_core.meshes import Topology
from tests.core.shapes import random_rotation, torus

STEP = 1e-6


@pytest.fixture(scope="module")
def codec() -> AcapCodec:
    mesh = torus(1.0, 0.4, 14, 9)
    vertices = mesh.vertices / np.ptp(mesh.vertices, axis=0).max()
    return AcapCodec(Topology(mesh.faces, len(vertices)), vertices)


@pytest.fixture(scope="module")
def poses(codec: AcapCodec) -> np.ndarray:
    """Two poses of the torus: turned, stretched and rippled, the second far more."""
    rng = np.random.default_rng(5)
    rest = codec.rest_vertices
    mild = rest * [1.1, 0.9, 1.05] + 0.01 * np.sin(7 * rest[:, [1, 2, 0]])
    strong = (rest * [1.3, 0.8, 1.2] + 0.03 * np.sin(6 * rest[:, [2, 0, 1]])) @ random_rotation(rng)
    return np.stack([mild, strong])


def test_tensors_encode_as_arrays(codec: AcapCodec, poses: np.ndarray) -> None:
    features = codec.encode_torch(torch.tensor(poses).reshape(1, 2, -1, 3))
    assert features.shape == (1, 2, codec.topology.n_vertices, 9)
    assert np.array_equal(features[0].numpy(), codec.encode(poses).features)
    single = codec.encode_torch(torch.tensor(poses, dtype=torch.float32))
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), features[0].numpy(), atol=1e-4)


@pytest.mark.parametrize("pose", [0, 1])
def test_gradient_is_the_central_difference(codec: AcapCodec, poses: np.ndarray, pose: int) -> None:
    rng = np.random.default_rng(pose)
    probe = torch.tensor(rng.normal(size=(codec.topology.n_vertices, 9)))
    vertices = torch.tensor(poses[pose], requires_grad=True)
    (codec.encode_torch(vertices) * probe).sum().backward()
    assert vertices.grad is not None
    gradient = vertices.grad.numpy()
    for _ in range(5):
        along = rng.normal(size=poses[pose].shape)
        ahead, behind = codec.encode(
            np.stack([poses[pose] + STEP * along, poses[pose] - STEP * along])
        ).features
        expected = ((ahead - behind) * probe.numpy()).sum() / (2 * STEP)
        assert abs(expected) > 1.0
        assert (gradient * along).sum() == pytest.approx(expected, rel=1e-5)


def test_gradient_is_finite_at_rest(codec: AcapCodec) -> None:
    vertices = torch.tensor(codec.rest_vertices, requires_grad=True)
    codec.encode_torch(vertices)[..., :3].square().sum().backward()
    assert vertices.grad is not None
    np.testing.assert_allclose(vertices.grad.numpy(), 0.0, atol=1e-9)
    vertices.grad = None
    codec.encode_torch(vertices).sum().backward()
    assert np.isfinite(vertices.grad.numpy()).all()
    assert np.abs(vertices.grad.numpy()).max() > 1e-2


def test_gradient_is_finite_where_a_ring_is_crushed_to_a_point(codec: AcapCodec) -> None:
    crushed = codec.rest_vertices.copy()
    ring = codec.topology.adjacency[0].indices
    crushed[ring] = crushed[0]
    vertices = torch.tensor(crushed, requires_grad=True)
    codec.encode_torch(vertices).sum().backward()
    assert vertices.grad is not None
    assert np.isfinite(vertices.grad.numpy()).all()


def test_a_pose_can_be_found_by_descent_on_its_features(
    codec: AcapCodec, poses: np.ndarray
) -> None:
    wanted = torch.tensor(codec.encode(poses[:1]).features[0])
    vertices = torch.tensor(codec.rest_vertices, requires_grad=True)
    optimiser = torch.optim.LBFGS([vertices], max_iter=60, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        value = (codec.encode_torch(vertices) - wanted).square().sum()
        value.backward()
        return value

    before = loss().item()
    optimiser.step(loss)
    assert loss().item() < 1e-4 * before


def test_a_stretch_of_nothing_takes_the_derivative_of_least_norm() -> None:
    features = np.zeros((3, 9))
    features[1:] = IDENTITY_FEATURE
    pulled = pull_features(features, np.ones((3, 9)))
    # T = exp(log R) S: without S the rotation moves nothing, and the triangle of S is T's.
    np.testing.assert_allclose(pulled[0], [[1, 0.5, 0.5], [0.5, 1, 0.5], [0.5, 0.5, 1]], atol=1e-12)
    np.testing.assert_allclose(pulled[1], pulled[2])
