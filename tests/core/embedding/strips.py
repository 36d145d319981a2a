"""Flat strips, the simplest meshes with a length."""

from __future__ import annotations

import numpy as np

from tests.core.shapes import Mesh


def strip(n_columns: int) -> Mesh:
    """Make a flat strip along x, two vertices wide, one unit per column."""
    vertices = [[float(x), float(y), 0.0] for x in range(n_columns) for y in range(2)]
    faces = []
    for x in range(n_columns - 1):
        a = 2 * x
        faces += [[a, a + 2, a + 1], [a + 1, a + 2, a + 3]]
    return Mesh(np.array(vertices), np.array(faces, dtype=np.int32))
