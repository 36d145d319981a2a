"""Domains that move rigidly, and the windows and components that start from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import sparse

from lcollision_core.embedding.seeding import (
    bridged_edges,
    domain_distances,
    moving_domains,
    principal_components,
    radius_of_overlap,
    vertex_areas,
)
from lcollision_core.errors import PoseSetError
from lcollision_core.meshes import Topology
from tests.core.embedding.strips import strip
from tests.core.shapes import join

FloatArray = npt.NDArray[np.float64]


def turning_in_blocks(blocks: list[int], n_poses: int = 6) -> FloatArray:
    """Features of a strip whose blocks of columns each turn by their own angles."""
    rng = np.random.default_rng(0)
    features = np.zeros((n_poses, 2 * sum(blocks), 9))
    features[..., [3, 6, 8]] = 1.0
    start = 0
    for columns in blocks:
        angles = rng.uniform(-2.0, 2.0, (n_poses, 1, 3))
        features[:, 2 * start : 2 * (start + columns), :3] = angles
        start += columns
    return features


def test_domains_are_the_blocks_that_turn_as_one() -> None:
    blocks = [9, 4, 7]
    mesh = strip(20)
    domain_of = moving_domains(turning_in_blocks(blocks), mesh.topology, mesh.vertices / 19.0, 3)
    # Domain 0 is the one farthest along the longest side.
    expected = np.repeat([2, 1, 0], [2 * columns for columns in blocks])
    assert domain_of.tolist() == expected.tolist()


def test_domains_that_turn_alike_but_lie_apart_stay_apart() -> None:
    mesh = strip(20)
    features = turning_in_blocks([6, 8, 6])
    features[:, 28:] = features[:, :12]
    domain_of = moving_domains(features, mesh.topology, mesh.vertices / 19.0, 3)
    assert domain_of.tolist() == np.repeat([2, 1, 0], [12, 16, 12]).tolist()


def test_loose_components_and_lone_vertices_join_the_body() -> None:
    far = strip(3).moved([0.0, 5.0, 0.0])
    mesh = join(strip(8), far)
    vertices = np.concatenate([mesh.vertices, [[20.0, 0.0, 0.0]]])
    topology = Topology(mesh.faces, len(vertices))
    edges = bridged_edges(topology, vertices)
    assert len(edges) == len(topology.edges) + 2
    matrix = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    assert sparse.csgraph.connected_components(matrix, directed=False)[0] == 1
    features = np.zeros((3, len(vertices), 9))
    domain_of = moving_domains(features, topology, vertices / 20.0, 2)
    assert sorted(set(domain_of.tolist())) == [0, 1]
    assert (vertex_areas(topology, vertices) > 0.0).all()


def test_impossible_numbers_of_domains_are_refused() -> None:
    mesh = strip(3)
    features = turning_in_blocks([3])
    for n_domains in (0, 7):
        with pytest.raises(PoseSetError, match=f"cannot have {n_domains} domains"):
            moving_domains(features, mesh.topology, mesh.vertices, n_domains)
    assert sorted(moving_domains(features, mesh.topology, mesh.vertices, 6).tolist()) == list(
        range(6)
    )


def test_distances_run_along_the_edges_from_each_domain() -> None:
    mesh = strip(11)
    domain_of = np.zeros(22, dtype=np.int32)
    domain_of[:2] = 1
    distances = domain_distances(domain_of, mesh.topology, mesh.vertices)
    assert (distances[0, 2:] == 0.0).all()
    # Along edges, the farthest vertices are 11 apart: 10 columns and once across.
    assert distances[1, ::2] == pytest.approx(np.arange(11) / 11)
    assert distances[1, 1::2] == pytest.approx(np.arange(11) / 11)


def test_radius_gives_the_overlap_asked_for() -> None:
    mesh = strip(40)
    domain_of = np.repeat(np.arange(4, dtype=np.int32), 20)
    distances = domain_distances(domain_of, mesh.topology, mesh.vertices)
    for overlap in (1.3, 2.0):
        radius = radius_of_overlap(distances, overlap)
        squared = np.clip(1.0 - distances / radius, 0.0, 1.0) ** 2
        shares = squared / squared.sum(axis=0)
        assert (1.0 / (shares**2).sum(axis=0)).mean() == pytest.approx(overlap, abs=1e-3)
    assert radius_of_overlap(distances, 9.0) == radius_of_overlap(distances, 2.5)
    alone = domain_distances(np.zeros(80, dtype=np.int32), mesh.topology, mesh.vertices)
    assert radius_of_overlap(alone, 3.0) > 0.0


def test_principal_components_are_orthonormal_and_ordered() -> None:
    rng = np.random.default_rng(1)
    axes = np.linalg.qr(rng.standard_normal((12, 3)))[0].T
    rows = rng.standard_normal((40, 3)) * [5.0, 2.0, 0.5] @ axes
    found = principal_components(rows, 5)
    assert found @ found.T == pytest.approx(np.eye(5), abs=1e-12)
    assert np.abs(np.linalg.svd(rows)[2][:3] @ found[:3].T) == pytest.approx(np.eye(3), abs=1e-9)
    assert (found[np.arange(5), np.abs(found).argmax(axis=1)] > 0.0).all()
