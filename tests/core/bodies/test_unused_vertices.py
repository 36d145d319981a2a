"""Unused vertices affect neither the training of a model nor its encoding of a mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.embedding.training import train_embedding
from lcollision_core.embedding.training_run import EmbeddingConfig
from lcollision_core.files import PoseSet
from lcollision_core.meshes import Topology, body_size, up_axis
from tests.bending_tube import LENGTH_IN_FILES

FAR = np.array([[4e5, -2e6, 0.0], [0.0, 3e5, 9e5]])
CONFIG = EmbeddingConfig(
    n_domains=2, n_domain_codes=3, level1_epochs=60, level2_epochs=20, held_out_stride=0
)


def with_strays(poses: PoseSet) -> PoseSet:
    """Add a vertex before and one after all others, at different positions in each pose."""
    n_poses, n_vertices = poses.vertices.shape[:2]
    share = np.linspace(1.0, 2.0, n_poses)[:, None, None]
    first, last = share * FAR[:1], share * FAR[1:]
    return replace(
        poses,
        vertices=np.concatenate([first, poses.vertices, last], axis=1),
        topology=Topology(poses.topology.faces + 1, n_vertices + 2),
        vertex_labels=None,
    )


@pytest.fixture(scope="module")
def stray_model(tube_poses: PoseSet) -> LearnedBody:
    poses = with_strays(tube_poses)
    return LearnedBody.from_training("strays", train_embedding(poses, CONFIG), poses)


def test_height_and_up_are_of_the_vertices_in_use(tube_poses: PoseSet) -> None:
    poses = with_strays(tube_poses)
    assert body_size(poses.vertices[0], poses.topology) == body_size(tube_poses.vertices[0])
    assert up_axis(poses.vertices[0], poses.topology) == up_axis(tube_poses.vertices[0]) == 1


def test_training_and_encoding_take_no_notice_of_strays(
    stray_model: LearnedBody, tube_model: LearnedBody, tube_poses: PoseSet
) -> None:
    assert stray_model.body_size == tube_model.body_size
    assert stray_model.embedding.metrics is not None
    assert tube_model.embedding.metrics is not None
    assert stray_model.embedding.metrics.mean == pytest.approx(
        tube_model.embedding.metrics.mean, rel=0.2
    )
    assert stray_model.detector.body_size == stray_model.body_size
    mesh = with_strays(tube_poses).vertices[5].copy()
    encoded = stray_model.encode(mesh)
    mesh[[0, -1]] *= -3.0
    again = stray_model.encode(mesh)
    assert np.array_equal(again.latent, encoded.latent)
    assert again.fit_error_max == encoded.fit_error_max < 0.01
    placed = again.placement.apply(stray_model.decode(again.latent))
    distance = np.linalg.norm(placed - mesh, axis=1)[1:-1].max()
    assert distance == pytest.approx(again.fit_error_max * LENGTH_IN_FILES, rel=1e-6)


def test_what_is_decoded_has_no_strays(stray_model: LearnedBody) -> None:
    decoded = stray_model.decode(stray_model.known_poses)
    assert np.ptp(decoded, axis=1).max() < 1.1 * LENGTH_IN_FILES
    assert np.ptp(stray_model.reference, axis=0).max() < 1.1 * LENGTH_IN_FILES
