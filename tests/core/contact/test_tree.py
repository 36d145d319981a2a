"""The tree contains every face once, its leaves are full, and it misses no pair."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact.search import build_tree
from tests.core.contact.detector_checks import check_mesh
from tests.core.shapes import Mesh, box, interlocked_tori, join, soup


@pytest.mark.parametrize(
    "mesh",
    [
        interlocked_tori(0.6),
        soup(np.random.default_rng(8).random((333, 3, 3))),
        # All centroids are equal along two axes, and sorted along the third.
        join(*(box([0, 0, z], [1, 1, z + 1.5]) for z in range(40))),
        soup(np.tile(np.random.default_rng(8).random((1, 3, 3)), (100, 1, 1))),
    ],
    ids=["tori", "soup", "tower", "one place"],
)
def test_a_tree_holds_every_face_once(mesh: Mesh) -> None:
    check_mesh(mesh)
    built = build_tree(mesh.vertices, mesh.topology.faces, mesh.topology.vertex_components[1])
    slots = built.slot_face[built.slot_face >= 0]
    assert sorted(slots.tolist()) == list(range(mesh.topology.n_faces))
    inner = built.leaf < 0
    below = built.size[built.left[inner]] + built.size[built.right[inner]]
    assert np.array_equal(built.size[inner], below)
    assert sorted(built.leaf[~inner].tolist()) == list(range(len(built.slot_face) // 8))
