"""Connected components of a mesh are joined, and keep their places in decoded poses."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.features import component_bridges
from lcollision_core.meshes import Topology, body_size
from tests.clothed import sleeved_tube

RADII, MIDDLES = (0.2, 0.1, 0.1, 0.1), (0.0, 0.31, 0.52, 0.73)


def arm() -> tuple[Topology, np.ndarray, np.ndarray]:
    """Return a large ball and three small ones in a row, and the ball of each vertex."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    parts = [
        ball.vertices * radius + [x, 0.0, 0.0] for radius, x in zip(RADII, MIDDLES, strict=True)
    ]
    faces = [ball.faces + number * len(ball.vertices) for number in range(len(parts))]
    of_vertex = np.repeat(np.arange(len(parts)), len(ball.vertices))
    vertices = np.concatenate(parts)
    return Topology(np.concatenate(faces), len(vertices)), vertices, of_vertex


def test_each_component_is_joined_to_its_neighbour() -> None:
    topology, vertices, of_vertex = arm()
    bridges = of_vertex[component_bridges(topology, vertices)]
    pairs = set(map(tuple, np.sort(bridges, axis=1).tolist()))
    assert pairs == {(0, 1), (1, 2), (2, 3)}


def test_shells_that_turn_about_a_joint_keep_their_places() -> None:
    topology, vertices, of_vertex = arm()
    posed = vertices.copy()
    joint = np.array([0.415, 0.0, 0.0])
    turn = Rotation.from_euler("z", 80.0, degrees=True).as_matrix()
    turned = of_vertex >= 2
    posed[turned] = (posed[turned] - joint) @ turn.T + joint
    bridges = component_bridges(topology, vertices)
    codec = AcapCodec(topology, vertices, np.where(of_vertex == 0, 1.0, 0.0), bridges)
    decoded = codec.decode(codec.encode(posed[None]))[0]
    error = np.linalg.norm(decoded - posed, axis=1)
    assert error.max() < 0.02


def test_a_layer_is_joined_where_it_lies_and_not_to_what_faces_it() -> None:
    poses, covered = sleeved_tube()
    rest = poses.vertices[0] / body_size(poses.vertices[0], poses.topology)
    first = poses.topology.n_vertices - len(covered)
    bridges = component_bridges(poses.topology, rest)
    assert len(np.unique(bridges, axis=0)) == len(bridges)
    joined = bridges[bridges[:, 1] >= first]
    assert set(joined[:, 1]) == set(range(first, poses.topology.n_vertices))
    away = np.linalg.norm(rest[joined[:, 0]] - rest[joined[:, 1]], axis=1)
    assert away.max() < 0.03
    # Two facing sheets, like a hand and a coat, are joined by only a few edges.
    sheet = trimesh.creation.box((1.0, 1.0, 0.1)).subdivide().subdivide().subdivide().subdivide()
    vertices = np.concatenate([sheet.vertices, sheet.vertices + [0.0, 0.0, 0.11]])
    faces = np.concatenate([sheet.faces, sheet.faces + len(sheet.vertices)])
    beside = component_bridges(Topology(faces, len(vertices)), vertices)
    assert 0 < len(beside) <= 128


def test_a_layer_keeps_its_distance_in_a_pose_between_others() -> None:
    poses, covered = sleeved_tube()
    size = body_size(poses.vertices[0], poses.topology)
    vertices = poses.vertices / size
    first = poses.topology.n_vertices - len(covered)
    anchors = np.ones(len(vertices[0]))

    def moved(bridges: np.ndarray | None) -> float:
        codec = AcapCodec(poses.topology, vertices[0], anchors, bridges)
        features = codec.encode(vertices[[3, 7, 11]])
        # As in a new pose: the sleeve's features differ a little from those of the covered skin.
        features[:, first:] *= 0.98
        decoded = codec.decode(features)
        away = np.linalg.norm(decoded[:, first:] - decoded[:, covered], axis=2)
        return float(np.abs(away - 0.01).max())

    joined = moved(component_bridges(poses.topology, vertices[0]))
    # 0.5 % of the body size, half the distance; three times that if few edges join them.
    assert joined < 0.005
    assert moved(None) > 2.0 * joined


def test_a_layer_turns_as_what_it_covers_beyond_half_a_turn() -> None:
    poses, covered = sleeved_tube()
    rest = poses.vertices[0] / body_size(poses.vertices[0], poses.topology)
    first = poses.topology.n_vertices - len(covered)
    along = rest[:, 1] - rest[:, 1].min()
    # Twisted by three quarters of a turn from end to end.
    turns = Rotation.from_rotvec(np.outer(4.7 * along, [0.0, 1.0, 0.0]))
    centre = rest.mean(axis=0) * [1.0, 0.0, 1.0]
    wound = turns.apply(rest - centre) + centre
    bridges = component_bridges(poses.topology, rest)
    codec = AcapCodec(poses.topology, rest, np.ones(len(rest)), bridges)
    turn = codec.encode(wound[None])[0, :, 1]
    assert turn[covered].max() > 3.5
    assert np.abs(turn[first:] - turn[covered]).max() < 0.3
