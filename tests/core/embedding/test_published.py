"""Stage 1 on the published SCAPE poses: errors, masks, left and right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from lcollision_core.embedding import Embedding, EmbeddingConfig, judge_masks, train_embedding
from lcollision_core.files import PoseSet


@pytest.fixture(scope="module")
def scape_embedding(scape: PoseSet) -> Iterator[Embedding]:
    # Every second pose, and level 2 trained a tenth as long as by default: the bounds allow it.
    config = replace(EmbeddingConfig(), level2_epochs=6, held_out_stride=0)
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield train_embedding(PoseSet(scape.vertices[::2], scape.topology, scape.names[::2]), config)
    torch.set_num_threads(n_threads)


def test_training_poses_are_rebuilt(scape_embedding: Embedding) -> None:
    metrics = scape_embedding.metrics
    assert metrics is not None
    assert metrics.mean < 0.007
    assert metrics.max < 0.04
    assert metrics.guess_mean < 0.007
    assert metrics.level1_mean < 0.06


def test_masks_are_patches_of_the_body(scape_embedding: Embedding) -> None:
    mask = scape_embedding.attention_mask
    assert np.abs(mask.sum(axis=0) - 1.0).max() < 1e-6
    quality = judge_masks(mask, scape_embedding.topology, scape_embedding.rest_vertices)
    assert (quality.connected_share >= 0.95).all()
    assert quality.domains_per_vertex <= 2.0
    assert (np.bincount(mask.argmax(axis=0), minlength=len(mask)) >= 50).all()


def test_left_and_right_limbs_are_separate(scape_embedding: Embedding) -> None:
    rest = scape_embedding.rest_vertices
    owner = scape_embedding.attention_mask.argmax(axis=0)
    # SCAPE stands along x, with arms spread along z.
    up, across = rest[:, 0], rest[:, 2]
    middle = 0.5 * (across.min() + across.max())
    left, right = np.flatnonzero(across > middle), np.flatnonzero(across < middle)
    hands = across.argmax(), across.argmin()
    feet = left[up[left].argmin()], right[up[right].argmin()]
    assert len({owner[vertex] for vertex in (*hands, *feet)}) == 4
    for vertex in (*hands, *feet):
        limb = across[owner == owner[vertex]]
        assert ((limb > middle) == (across[vertex] > middle)).mean() > 0.98


def test_box_is_not_all_collisions(scape_embedding: Embedding) -> None:
    from lcollision_core.contact import CollisionDetector

    rng = np.random.default_rng(0)
    low, high = scape_embedding.box.low, scape_embedding.box.high
    decoded = scape_embedding.decode(rng.uniform(low, high, (100, scape_embedding.latent_size)))
    detector = CollisionDetector(scape_embedding.topology, scape_embedding.rest_vertices)
    assert 0.1 < np.mean(detector.are_colliding(decoded)) < 0.9
