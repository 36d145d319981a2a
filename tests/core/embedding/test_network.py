"""The networks of both levels, and the decoding tables made from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import torch

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.features import FeatureScaling
from lcollision_core.embedding.decoder import (
    AutoencoderWeights,
    DecoderGroup,
    FeatureDecoder,
    build_decoder,
    ring_average,
    run_encoders,
)
from lcollision_core.embedding.stages import (
    TiedAutoencoder,
    decode_features,
    differentiable_ring_mean,
)
from tests.core.embedding.strips import strip
from tests.core.shapes import Mesh, sphere


def small_network(n_codes: int, seed: int, mesh: Mesh) -> TiedAutoencoder:
    """Make an autoencoder in float64 without initial values left."""
    rng = np.random.default_rng(seed)
    torch.set_default_dtype(torch.float64)
    try:
        network = TiedAutoencoder(
            rng.standard_normal((n_codes, mesh.topology.n_vertices, 9)),
            ring_average(mesh.topology),
        )
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.no_grad():
        network.self_weight += torch.tensor(0.3 * rng.standard_normal((9, 9)))
        network.ring_weight += torch.tensor(0.3 * rng.standard_normal((9, 9)))
    return network


def test_gradients_of_the_network_match_finite_differences() -> None:
    mesh = strip(4)
    network = small_network(3, 0, mesh)
    features = torch.tensor(0.5 * np.random.default_rng(1).standard_normal((2, 8, 9)))
    around = differentiable_ring_mean(features, network.ring)

    def loss() -> torch.Tensor:
        return ((network(features, around) - features) ** 3).sum()

    loss().backward()
    rng = np.random.default_rng(2)
    for parameter in network.parameters():
        assert parameter.grad is not None
        flat, gradient = parameter.data.view(-1), parameter.grad.view(-1)
        assert float(gradient.norm()) > 1e-3
        for index in rng.choice(len(flat), 12, replace=False):
            kept, step = float(flat[index]), 1e-5
            slopes = []
            with torch.no_grad():
                for sign in (1.0, -1.0):
                    flat[index] = kept + sign * step
                    slopes.append(float(loss()))
                flat[index] = kept
            slope = (slopes[0] - slopes[1]) / (2 * step)
            assert float(gradient[index]) == pytest.approx(slope, rel=1e-6, abs=1e-8)


def test_gradient_through_decoding_is_the_central_difference() -> None:
    mesh = sphere(n=10)
    codec = AcapCodec(mesh.topology, mesh.vertices, np.ones(len(mesh.vertices)))
    rng = np.random.default_rng(2)
    features = codec.encode(mesh.vertices[None]) + 0.3 * rng.normal(size=(3, len(mesh.vertices), 9))
    target = torch.from_numpy(rng.normal(size=(3, len(mesh.vertices), 3)))
    tangent = rng.normal(size=features.shape)

    def loss(fields: torch.Tensor) -> torch.Tensor:
        return ((decode_features(fields, codec) - target) ** 2).sum()

    for dtype, tolerance in ((torch.float64, 1e-6), (torch.float32, 1e-4)):
        variable = torch.tensor(features, dtype=dtype, requires_grad=True)
        assert decode_features(variable, codec).dtype == dtype
        loss(variable).backward()
        assert variable.grad is not None
        along = float((variable.grad * torch.from_numpy(tangent)).sum())
        ahead, behind = (
            float(loss(torch.from_numpy(features + sign * 1e-5 * tangent))) for sign in (1, -1)
        )
        assert along == pytest.approx((ahead - behind) / 2e-5, rel=tolerance)
        assert abs(along) > 1.0


def test_scaling_a_code_changes_nothing() -> None:
    network = small_network(2, 3, strip(4))
    features = torch.tensor(np.random.default_rng(1).standard_normal((2, 8, 9)))
    around = differentiable_ring_mean(features, network.ring)
    before = network(features, around).detach().numpy()
    with torch.no_grad():
        network.components[0] *= 7.0
    assert network(features, around).detach().numpy() == pytest.approx(before, abs=1e-12)
    norms = network.unit_components().flatten(1).norm(dim=1).detach().numpy()
    assert norms == pytest.approx([1.0, 1.0])


def test_ring_mean_is_the_mean_over_neighbours() -> None:
    mesh = strip(3)
    values = np.random.default_rng(0).standard_normal((2, 6, 9))
    found = differentiable_ring_mean(torch.tensor(values), ring_average(mesh.topology)).numpy()
    # Vertex 1 of the strip touches 0, 2 and 3.
    assert found[:, 1] == pytest.approx(values[:, [0, 2, 3]].mean(axis=1), abs=1e-12)


def bilevel_weights(
    mesh: Mesh,
) -> tuple[AutoencoderWeights, tuple[AutoencoderWeights, ...], npt.NDArray[np.float32]]:
    """Random weights of both levels; the two masks overlap partly."""
    rng = np.random.default_rng(4)
    n_vertices = mesh.topology.n_vertices
    mask = np.zeros((2, n_vertices), dtype=np.float32)
    mask[0] = np.clip(1.5 - 2.0 * np.arange(n_vertices) / n_vertices, 0.0, 1.0)
    mask[1] = 1.0 - mask[0]

    def weights(n_codes: int, support: npt.NDArray[np.intp]) -> AutoencoderWeights:
        components = rng.standard_normal((n_codes, len(support), 9))
        components /= np.linalg.norm(components.reshape(n_codes, -1), axis=1)[:, None, None]
        convolutions = 0.3 * rng.standard_normal((2, 9, 9)) + [np.eye(9), np.zeros((9, 9))]
        return AutoencoderWeights(
            components.astype(np.float32),
            *convolutions.astype(np.float32),
            support=support.astype(np.int32),
        )

    level1 = weights(2, np.arange(n_vertices))
    return level1, tuple(weights(3, np.flatnonzero(share)) for share in mask), mask


SCALING = FeatureScaling(0.1, 0.5, 1.2, 0.8)


def test_level_2_on_its_support_equals_dense_level_2() -> None:
    mesh = strip(12)
    level1, level2, _ = bilevel_weights(mesh)
    mean = np.random.default_rng(0).standard_normal((24, 9)).astype(np.float32)
    decoder = build_decoder((level1, *level2), SCALING, mean, mesh.topology)
    latent = np.random.default_rng(1).standard_normal((3, 8))
    ring = ring_average(mesh.topology).toarray()
    scaled = np.repeat(mean[None].astype(np.float64), 3, axis=0)
    start = 0
    for part in (level1, *level2):
        inside = np.zeros(24)
        inside[part.support] = 1.0
        dense = np.zeros((len(part.components), 24, 9))
        dense[:, part.support] = part.components
        around = np.einsum("vw,kwj->kvj", ring, dense)
        table = dense @ part.self_weight.T + around @ part.ring_weight.T
        codes = latent[:, start : start + len(dense)]
        start += len(dense)
        output = np.tanh(np.einsum("bk,kvj->bvj", codes, table)) * inside[:, None]
        scaled += output / 0.5
    expected = SCALING.invert(scaled)
    assert decoder.features(latent) == pytest.approx(expected, abs=3e-6)


def test_encoders_agree_with_the_network() -> None:
    mesh = strip(12)
    level1, level2, mask = bilevel_weights(mesh)
    centred = 0.5 * np.random.default_rng(3).standard_normal((4, 24, 9)).astype(np.float32)
    found = run_encoders(centred, level1, level2, mask, mesh.topology)
    residual = torch.from_numpy(centred)
    codes = []
    for domain, part in enumerate((level1, *level2), start=-1):
        ring = ring_average(mesh.topology)[part.support][:, part.support]
        network = TiedAutoencoder(part.components, ring)
        with torch.no_grad():
            network.self_weight.copy_(torch.from_numpy(part.self_weight))
            network.ring_weight.copy_(torch.from_numpy(part.ring_weight))
            inputs = residual[:, part.support.astype(np.int64)]
            if domain >= 0:
                inputs = inputs * torch.from_numpy(mask[domain, part.support])[:, None]
            code = network.encode(inputs, differentiable_ring_mean(inputs, network.ring))
            codes.append(code.numpy())
            if domain < 0:
                residual = residual - network.decode(code)
    assert found == pytest.approx(np.concatenate(codes, axis=1), abs=1e-5)


def test_tanh_of_the_decoder_is_accurate_everywhere() -> None:
    values = np.concatenate([np.linspace(-30, 30, 4001), [0.0, 1e-30, -1e-6, 1e-6, 3.0e4, -3.0e4]])
    values = np.resize(values, (len(values) // 9 * 9,))
    n_vertices = len(values) // 9
    decoder = FeatureDecoder(
        (DecoderGroup(values.astype(np.float32)[None], np.arange(n_vertices, dtype=np.int32)),),
        np.zeros((n_vertices, 9)),
        np.ones(9),
    )
    found = decoder.features(np.ones((1, 1)))[0].ravel()
    assert np.abs(found - np.tanh(values.astype(np.float32).astype(np.float64))).max() < 3e-7
    assert np.abs(found).max() <= 1.0 + 1e-6


def test_tangents_of_the_decoder_match_finite_differences() -> None:
    mesh = strip(12)
    level1, level2, _ = bilevel_weights(mesh)
    mean = np.zeros((24, 9), dtype=np.float32)
    decoder = build_decoder((level1, *level2), SCALING, mean, mesh.topology)
    latent = np.random.default_rng(5).standard_normal(8).astype(np.float32)
    tangents = decoder.tangents(latent)
    for code in range(8):
        # Decoding uses codes in single precision.
        step = np.float32(2**-8) * np.eye(8, dtype=np.float32)[code]
        ahead, behind = (decoder.features((latent + sign * step)[None])[0] for sign in (1, -1))
        slope = (ahead - behind) / 2**-7
        assert tangents[code] == pytest.approx(slope, abs=1e-4)
        assert np.abs(tangents[code]).max() > 0.1
