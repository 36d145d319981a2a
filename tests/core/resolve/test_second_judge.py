"""Resolved poses, checked by another library, if it is installed."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies import open_body

N_POSES = 24


def test_ipctk_agrees_with_the_detector_before_and_after_resolve() -> None:
    ipctk = pytest.importorskip("ipctk")
    body = open_body("body")
    assert body.rules.exclude_nothing
    mesh = ipctk.CollisionMesh(body.reference, body.topology.edges, body.faces)
    poses = body.sample(N_POSES, np.random.default_rng(4))
    vertices = body.decode(poses).astype(np.float32)
    ours = body.detector.are_colliding(vertices)
    theirs = [ipctk.has_intersections(mesh, pose.astype(np.float64)) for pose in vertices]
    assert ours.tolist() == theirs
    assert 5 < ours.sum() < N_POSES - 5
    for pose in poses[ours][:6]:
        resolved = body.resolve(pose)
        assert resolved.exactly_free
        assert not ipctk.has_intersections(mesh, resolved.vertices.astype(np.float64))
