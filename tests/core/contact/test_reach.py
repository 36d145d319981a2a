"""Lists of near faces, compared with SciPy's shortest paths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csgraph

from lcollision_core.contact.reach import faces_within, surface_of, vertices_after
from lcollision_core.meshes.topology import length_graph
from tests.core.shapes import Mesh, grid, join, soup


def sheet() -> Mesh:
    """Return a crumpled sheet and a loose face, with a zero-length edge."""
    mesh = join(grid(9), soup([[[0, 0, 2], [1, 0, 2], [0, 1, 2]]]))
    vertices = mesh.vertices + np.random.default_rng(5).normal(
        scale=0.04, size=(len(mesh.vertices), 3)
    )
    a, b = mesh.topology.edges[7]
    vertices[a] = vertices[b]
    return Mesh(vertices, mesh.faces)


@pytest.mark.parametrize("distance", [0.0, 0.15, 0.4, 10.0])
def test_faces_within_a_distance_are_those_of_the_shortest_paths(distance: float) -> None:
    mesh = sheet()
    faces = np.array([0, 31, len(mesh.faces) - 1], dtype=np.int32)
    graph = length_graph(mesh.topology.edges, mesh.vertices)
    sizes: list[int] = []

    lists = faces_within(surface_of(mesh.topology, mesh.vertices), faces, distance, sizes.append)

    for place, face in enumerate(faces):
        away = csgraph.dijkstra(graph, directed=False, indices=mesh.faces[face], min_only=True)
        expected = np.flatnonzero((away[mesh.faces] <= distance).any(axis=1))
        found = lists.entry[lists.start[place] : lists.start[place + 1]]
        assert found.tolist() == expected.tolist()
        assert face in found
    assert sizes[-1] == len(lists.entry)


@pytest.mark.parametrize("distance", [0.15, 0.4, 10.0])
def test_later_vertices_are_those_of_the_shortest_paths(distance: float) -> None:
    mesh = sheet()
    graph = length_graph(mesh.topology.edges, mesh.vertices)
    lists = vertices_after(surface_of(mesh.topology, mesh.vertices), distance, lambda _: None)
    away = csgraph.dijkstra(graph, directed=False)
    for vertex in range(len(mesh.vertices)):
        expected = np.flatnonzero(away[vertex] <= distance)
        found = lists.entry[lists.start[vertex] : lists.start[vertex + 1]]
        assert found.tolist() == expected[expected > vertex].tolist()
