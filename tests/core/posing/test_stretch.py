"""The stretch of edges, against NumPy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.dragger import excess_stretch, largest_stretch
from tests.core.shapes import Mesh, sphere


@pytest.fixture
def mesh() -> Mesh:
    return sphere(n=12)


@pytest.fixture
def longest(mesh: Mesh) -> FloatArray:
    """Return lengths that some edges of the sphere exceed, but most do not."""
    lengths = mesh.topology.edge_lengths(mesh.vertices)
    return lengths * np.random.default_rng(0).uniform(0.9, 1.3, len(lengths))


def test_stretch_is_that_of_all_edges(mesh: Mesh, longest: FloatArray) -> None:
    ratio = mesh.topology.edge_lengths(mesh.vertices) / longest
    assert 0.1 < np.mean(ratio > 1.0) < 0.5
    edges, slope = mesh.topology.edges, np.empty_like(mesh.vertices)
    assert largest_stretch(mesh.vertices, edges, longest) == pytest.approx(ratio.max(), rel=1e-14)
    excess = excess_stretch(mesh.vertices, edges, longest, slope)
    expected = np.linalg.norm(np.maximum(ratio - 1.0, 0.0))
    assert excess == pytest.approx(expected, rel=1e-12)


def test_slope_of_stretch_is_that_of_differences(mesh: Mesh, longest: FloatArray) -> None:
    edges, slope = mesh.topology.edges, np.empty_like(mesh.vertices)
    excess_stretch(mesh.vertices, edges, longest, slope)
    generator, unused = np.random.default_rng(2), np.empty_like(slope)
    for _ in range(5):
        way = generator.normal(size=slope.shape)
        more, less = (
            excess_stretch(mesh.vertices + step * way, edges, longest, unused)
            for step in (1e-6, -1e-6)
        )
        assert (slope * way).sum() == pytest.approx((more - less) / 2e-6, rel=1e-4)
        assert abs(more - less) > 1e-8


def test_nothing_is_pulled_where_no_edge_is_stretched(mesh: Mesh, longest: FloatArray) -> None:
    edges, slope = mesh.topology.edges, np.full_like(mesh.vertices, np.nan)
    assert excess_stretch(0.5 * mesh.vertices, edges, longest, slope) == 0.0
    assert (slope == 0.0).all()
