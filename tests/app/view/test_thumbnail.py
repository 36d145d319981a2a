"""Small pictures of meshes: what they show has no holes."""

from __future__ import annotations

import numpy as np

from app.view.camera import View
from app.view.thumbnail import draw_pose
from tests.core.shapes import box


def test_large_triangles_beside_small_ones_are_drawn_without_holes() -> None:
    near, small = box([-1.0, -1.0, 0.0], [1.0, 1.0, 0.1]), box([0.0, 2.0, 0.0], [0.01, 2.01, 0.01])
    vertices = np.concatenate([near.vertices, *[small.vertices] * 50])
    starts = len(near.vertices) + len(small.vertices) * np.arange(50)
    faces = np.concatenate([near.faces, *(small.faces + start for start in starts)])
    view = View(np.array([0.0, 0.0, 8.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    alpha = draw_pose(vertices, faces, view, 64, (200, 200, 200))[..., 3]
    rows, columns = np.nonzero(alpha[24:40, 24:40] < 255)
    assert len(rows) == len(columns) == 0
