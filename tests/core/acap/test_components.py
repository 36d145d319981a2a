"""How the connected components of a mesh are joined, and keep their places in decoded poses."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.components import component_bridges
from lcollision_core.meshes import Topology

RADII, MIDDLES = (0.2, 0.1, 0.1, 0.1), (0.0, 0.31, 0.52, 0.73)


def arm() -> tuple[Topology, np.ndarray, np.ndarray]:
    """Return a large ball and three small ones in a row, and which ball each vertex is of."""
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
    codec = AcapCodec(topology, vertices, np.where(of_vertex == 0, 1.0, 0.0))
    decoded = codec.decode(codec.encode(posed[None]))[0]
    error = np.linalg.norm(decoded - posed, axis=1)
    assert error.max() < 0.02
