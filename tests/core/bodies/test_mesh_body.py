"""A mesh file as a body: checked like other bodies, and refused if codes are needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.bodies import Body, MeshBody
from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet
from lcollision_core.meshes import FaceGroup
from lcollision_core.options import RuleOptions
from tests.core.shapes import Mesh, soup


def two_crossed_triangles() -> Mesh:
    return soup([[[0, 0, 0], [2, 0, 0], [0, 2, 0]], [[0.5, 0.5, -1], [0.5, 0.5, 1], [0.6, 0.9, 1]]])


def crossed() -> MeshBody:
    mesh = two_crossed_triangles()
    vertices, topology = mesh.vertices, mesh.topology
    apart = vertices.copy()
    apart[3:] += 10.0
    poses = PoseSet(np.stack([apart, vertices, apart]), topology, ("rest", "a", "b"))
    groups = (FaceGroup("first", np.array([0])), FaceGroup("second", np.array([1])))
    return MeshBody.of_poses(replace(poses, groups=groups))


def test_its_frames_are_checked_by_its_rules() -> None:
    body = crossed()
    crossed_frame = body.vertices_at(0, 0.0)
    assert np.array_equal(crossed_frame, body.frames[0])
    assert body.detector.detect(crossed_frame).n_pairs == 1
    assert body.detector.detect(body.vertices_at(1, 0.5)).n_pairs == 0
    ruled = body.with_options(RuleOptions(ignored=("first:second",)))
    assert ruled.rules == ContactRules(ignored=(("first", "second"),))
    assert ruled.detector.detect(crossed_frame).n_pairs == 0


def test_its_parts_are_components_unless_they_are_labelled() -> None:
    names, owner = crossed().parts
    assert len(names) == 2
    assert owner.tolist() == [0, 0, 0, 1, 1, 1]


def test_a_mesh_may_have_any_size() -> None:
    mesh = two_crossed_triangles()
    vertices, topology = mesh.vertices, mesh.topology
    for size in (1e-30, 1e30):
        body = MeshBody(vertices[None] * size, topology, vertices * size)
        assert body.body_size == CollisionDetector(topology, vertices * size).body_size
        assert body.detector.detect(body.frames[0]).n_pairs == 1


@pytest.mark.parametrize(
    "ask",
    [
        lambda body: body.space,
        lambda body: body.resolver,
        lambda body: body.require_predictor(),
        lambda body: body.encode(body.frames[0]),
        lambda body: body.decode(np.zeros(3)),
    ],
)
def test_what_needs_codes_is_refused(ask: Callable[[Body], object]) -> None:
    body = crossed()
    assert [body.can_resolve, body.has_predictor, body.is_trained] == [False] * 3
    assert body.character is None
    assert body.joints is None
    assert body.own_file is None
    with pytest.raises(LCollisionError, match="the mesh"):
        ask(body)
