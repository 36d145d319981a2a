"""Motion parts, attention masks, the networks and the tables made of them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy import sparse

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.scaling import FeatureScaling
from lcollision_core.embedding.autoencoders import (
    AutoencoderWeights,
    build_decoder,
    run_encoders,
)
from lcollision_core.embedding.decoder import DecoderGroup, FeatureDecoder
from lcollision_core.embedding.masks import LEAST_SHARE, attention_mask, judge_masks, keep_one_patch
from lcollision_core.embedding.network import TiedAutoencoder, decode_features, ring_mean
from lcollision_core.embedding.seeding import (
    bridged_edges,
    locality_weights,
    moving_parts,
    part_distances,
    principal_components,
    radius_of_overlap,
    ring_average,
    vertex_areas,
)
from lcollision_core.errors import PoseSetError, ShapeError
from lcollision_core.meshes import Topology
from tests.core.shapes import Mesh, join, sphere

FloatArray = npt.NDArray[np.float64]


def strip(n_columns: int) -> Mesh:
    """Make a flat strip along x, two vertices wide, one unit a column."""
    vertices = [[float(x), float(y), 0.0] for x in range(n_columns) for y in range(2)]
    faces = []
    for x in range(n_columns - 1):
        a = 2 * x
        faces += [[a, a + 2, a + 1], [a + 1, a + 2, a + 3]]
    return Mesh(np.array(vertices), np.array(faces, dtype=np.int32))


def turning_in_blocks(blocks: list[int], n_poses: int = 6) -> FloatArray:
    """Features of a strip whose blocks of columns turn each by its own angles."""
    rng = np.random.default_rng(0)
    features = np.zeros((n_poses, 2 * sum(blocks), 9))
    features[..., [3, 6, 8]] = 1.0
    start = 0
    for columns in blocks:
        angles = rng.uniform(-2.0, 2.0, (n_poses, 1, 3))
        features[:, 2 * start : 2 * (start + columns), :3] = angles
        start += columns
    return features


def test_parts_are_the_blocks_that_turn_as_one() -> None:
    blocks = [9, 4, 7]
    mesh = strip(20)
    part = moving_parts(turning_in_blocks(blocks), mesh.topology, mesh.vertices / 19.0, 3)
    # Part 0 is the one farthest along the longest side.
    expected = np.repeat([2, 1, 0], [2 * columns for columns in blocks])
    assert part.tolist() == expected.tolist()


def test_parts_that_turn_alike_but_lie_apart_stay_apart() -> None:
    mesh = strip(20)
    features = turning_in_blocks([6, 8, 6])
    features[:, 28:] = features[:, :12]
    part = moving_parts(features, mesh.topology, mesh.vertices / 19.0, 3)
    assert part.tolist() == np.repeat([2, 1, 0], [12, 16, 12]).tolist()


def test_loose_parts_and_lone_vertices_join_the_body() -> None:
    far = strip(3).moved([0.0, 5.0, 0.0])
    mesh = join(strip(8), far)
    vertices = np.concatenate([mesh.vertices, [[20.0, 0.0, 0.0]]])
    topology = Topology(mesh.faces, len(vertices))
    edges = bridged_edges(topology, vertices)
    assert len(edges) == len(topology.edges) + 2
    matrix = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    assert sparse.csgraph.connected_components(matrix, directed=False)[0] == 1
    features = np.zeros((3, len(vertices), 9))
    part = moving_parts(features, topology, vertices / 20.0, 2)
    assert sorted(set(part.tolist())) == [0, 1]
    assert (vertex_areas(topology, vertices) > 0.0).all()


def test_impossible_numbers_of_parts_are_refused() -> None:
    mesh = strip(3)
    features = turning_in_blocks([3])
    for n_parts in (0, 7):
        with pytest.raises(PoseSetError, match=f"cannot have {n_parts} domains"):
            moving_parts(features, mesh.topology, mesh.vertices, n_parts)
    assert sorted(moving_parts(features, mesh.topology, mesh.vertices, 6).tolist()) == list(
        range(6)
    )
    with pytest.raises(ShapeError, match="features"):
        moving_parts(features[:, :-1], mesh.topology, mesh.vertices, 2)


def test_locality_rises_with_the_distance_from_the_part() -> None:
    mesh = strip(11)
    part = np.zeros(22, dtype=np.int32)
    part[:2] = 1
    distances = part_distances(part, mesh.topology, mesh.vertices)
    weights = locality_weights(distances, (0.1, 0.5))
    assert (weights[0, 2:] == 0.0).all()
    assert (weights[1, :2] == 0.0).all()
    columns = weights[1, ::2]
    assert all(later >= earlier for earlier, later in pairwise(columns))
    # Along edges the farthest vertices are 11 apart: 10 columns and once across.
    assert columns[3] == pytest.approx((3 / 11 - 0.1) / 0.4)
    assert columns[[1, 6, 10]].tolist() == [0.0, 1.0, 1.0]


def test_reach_gives_the_overlap_asked_for() -> None:
    mesh = strip(40)
    part = np.repeat(np.arange(4, dtype=np.int32), 20)
    distances = part_distances(part, mesh.topology, mesh.vertices)
    for overlap in (1.3, 2.0):
        radius = radius_of_overlap(distances, overlap)
        squared = np.clip(1.0 - distances / radius, 0.0, 1.0) ** 2
        shares = squared / squared.sum(axis=0)
        assert (1.0 / (shares**2).sum(axis=0)).mean() == pytest.approx(overlap, abs=1e-3)
    assert radius_of_overlap(distances, 9.0) == radius_of_overlap(distances, 2.5)
    alone = part_distances(np.zeros(80, dtype=np.int32), mesh.topology, mesh.vertices)
    assert radius_of_overlap(alone, 3.0) > 0.0


def test_principal_components_are_orthonormal_and_ordered() -> None:
    rng = np.random.default_rng(1)
    axes = np.linalg.qr(rng.standard_normal((12, 3)))[0].T
    rows = rng.standard_normal((40, 3)) * [5.0, 2.0, 0.5] @ axes
    found = principal_components(rows, 5)
    assert found @ found.T == pytest.approx(np.eye(5), abs=1e-12)
    assert np.abs(np.linalg.svd(rows)[2][:3] @ found[:3].T) == pytest.approx(np.eye(3), abs=1e-9)
    assert (found[np.arange(5), np.abs(found).argmax(axis=1)] > 0.0).all()


def test_mask_shares_by_squared_weight() -> None:
    mesh = strip(3)
    components = np.zeros((2, 6, 9))
    components[0, :, 0] = 1.0
    components[1, :, 1:4] = [0.0, 2.0, 0.0]
    components[1, 0] = 0.0
    mask = attention_mask(components, mesh.topology, mesh.vertices)
    assert mask.dtype == np.float32
    assert mask[:, 0].tolist() == [1.0, 0.0]
    assert mask[:, 1:] == pytest.approx(np.repeat([[0.2], [0.8]], 5, axis=1))


def test_masks_sum_to_one_and_have_an_edge() -> None:
    rng = np.random.default_rng(0)
    mesh = strip(32)
    n_vertices = mesh.topology.n_vertices
    components = (
        rng.standard_normal((5, n_vertices, 9)) * rng.uniform(0, 1, (5, n_vertices, 1)) ** 6
    )
    mask = attention_mask(components, mesh.topology, mesh.vertices)
    assert mask.sum(axis=0) == pytest.approx(np.ones(n_vertices), abs=1e-6)
    assert ((mask == 0.0) | (mask >= LEAST_SHARE)).all()
    assert (mask == 0.0).any()


def test_untouched_vertices_take_their_nearest_owners_mask() -> None:
    body, loose = strip(6), strip(2).moved([7.0, 0.0, 0.0])
    mesh = join(body, loose)
    components = np.zeros((2, mesh.topology.n_vertices, 9))
    components[0, :2, 0] = 1.0
    components[1, 10:12, 0] = 1.0
    mask = attention_mask(components, mesh.topology, mesh.vertices)
    assert mask[0, :6].tolist() == [1.0] * 6
    assert mask[1, 6:].tolist() == [1.0] * 10
    assert np.isfinite(mask).all()
    with pytest.raises(ShapeError, match="all weights"):
        attention_mask(np.zeros_like(components), mesh.topology, mesh.vertices)


def test_islands_go_to_the_next_strongest_component() -> None:
    mesh = strip(12)
    components = np.zeros((3, 24, 9), dtype=np.float32)
    components[0, :16, 0] = 2.0
    components[1, 12:, 1] = 3.0
    components[1, 4:6, 1] = 3.0
    components[2, 10:12, 2] = 1.0
    components[2, 20:22, 2] = 4.0
    # The norms do not count, so that the last is no stronger for being longer.
    components[2] *= 0.1
    before = components.copy()
    kept = keep_one_patch(components, mesh.topology, mesh.vertices)
    assert np.array_equal(components, before)
    units = kept / np.linalg.norm(kept.reshape(3, -1), axis=1)[:, None, None]
    mask = attention_mask(units, mesh.topology, mesh.vertices)
    quality = judge_masks(mask, mesh.topology, mesh.vertices)
    assert quality.connected_share.tolist() == [1.0, 1.0, 1.0]
    # Domain 2 cuts two vertices off the end of domain 1, which nobody else touches.
    assert mask.argmax(axis=0).tolist() == [0] * 12 + [1] * 8 + [2] * 4
    assert (kept[1, 4:6] == 0.0).all()
    assert (kept[1, 22:] == 0.0).all()
    assert np.array_equal(kept[2], components[2])


def test_mask_quality_counts_patches_and_overlap() -> None:
    mesh = strip(10)
    mask = np.zeros((3, 20))
    mask[0, :16] = 1.0
    mask[1, 16:] = 1.0
    mask[:2, 4:8] = [[0.0], [1.0]]
    quality = judge_masks(mask, mesh.topology, mesh.vertices)
    assert quality.connected_share.tolist() == [8 / 12, 0.5, 0.0]
    assert quality.n_owned.tolist() == [12, 8, 0]
    assert quality.domains_per_vertex == 1.0
    mask[:] = 1.0 / 3.0
    assert judge_masks(mask, mesh.topology, mesh.vertices).domains_per_vertex == pytest.approx(3.0)
    assert judge_masks(mask, mesh.topology, mesh.vertices).undivided_share == 0.0


def small_network(n_codes: int, seed: int, mesh: Mesh) -> TiedAutoencoder:
    """Make an autoencoder in float64 with nothing left at its start values."""
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
    around = ring_mean(features, network.ring)

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
    around = ring_mean(features, network.ring)
    before = network(features, around).detach().numpy()
    with torch.no_grad():
        network.components[0] *= 7.0
    assert network(features, around).detach().numpy() == pytest.approx(before, abs=1e-12)
    norms = network.unit_components().flatten(1).norm(dim=1).detach().numpy()
    assert norms == pytest.approx([1.0, 1.0])


def test_ring_mean_is_the_mean_over_neighbours() -> None:
    mesh = strip(3)
    values = np.random.default_rng(0).standard_normal((2, 6, 9))
    found = ring_mean(torch.tensor(values), ring_average(mesh.topology)).numpy()
    # Vertex 1 of the strip touches 0, 2 and 3.
    assert found[:, 1] == pytest.approx(values[:, [0, 2, 3]].mean(axis=1), abs=1e-12)


def bilevel_weights(
    mesh: Mesh,
) -> tuple[AutoencoderWeights, tuple[AutoencoderWeights, ...], npt.NDArray[np.float32]]:
    """Random weights of both levels; the two masks overlap in part."""
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
            code = network.encode(inputs, ring_mean(inputs, network.ring))
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
        # Codes are single precision when they are decoded.
        step = np.float32(2**-8) * np.eye(8, dtype=np.float32)[code]
        ahead, behind = (decoder.features((latent + sign * step)[None])[0] for sign in (1, -1))
        slope = (ahead - behind) / 2**-7
        assert tangents[code] == pytest.approx(slope, abs=1e-4)
        assert np.abs(tangents[code]).max() > 0.1
