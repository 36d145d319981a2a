"""Vertex normals against values by hand and the definition."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.meshes.normals import vertex_normals


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_normals_are_the_faces_means_by_area(kind: type[np.floating]) -> None:
    """A corner where a triangle of area 2 in z = 0 meets one of area 1 in y = 0."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, -1], [9, 9, 9]], dtype=kind)
    faces = np.array([[0, 1, 2], [0, 1, 3]], dtype=np.int32)
    normals = vertex_normals(vertices, faces)
    assert normals.dtype == kind
    both = np.array([0.0, 1.0, 2.0]) / np.sqrt(5.0)
    expected = [both, both, [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(normals, expected, atol=1e-6)


def test_a_vertex_whose_faces_have_no_area_has_no_normal() -> None:
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    assert not vertex_normals(vertices, np.array([[0, 1, 2]])).any()
