"""Attention masks and their statistics."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.embedding.seeding import (
    LEAST_SHARE,
    attention_mask,
    judge_masks,
    keep_one_patch,
)
from lcollision_core.errors import ShapeError
from tests.core.embedding.strips import strip
from tests.core.shapes import join


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
    # Norms do not count: a larger norm does not make the last component stronger.
    components[2] *= 0.1
    before = components.copy()
    kept = keep_one_patch(components, mesh.topology, mesh.vertices)
    assert np.array_equal(components, before)
    units = kept / np.linalg.norm(kept.reshape(3, -1), axis=1)[:, None, None]
    mask = attention_mask(units, mesh.topology, mesh.vertices)
    quality = judge_masks(mask, mesh.topology, mesh.vertices)
    assert quality.connected_share.tolist() == [1.0, 1.0, 1.0]
    # Domain 2 cuts two vertices off the end of domain 1, which no other domain touches.
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
    assert quality.domains_per_vertex == 1.0
    mask[:] = 1.0 / 3.0
    assert judge_masks(mask, mesh.topology, mesh.vertices).domains_per_vertex == pytest.approx(3.0)
