"""One solid from a mesh of many layers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold

from app.benchmarks.printing import column_volume
from lcollision_core.contact import CollisionDetector, solids
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import UNWATCHED
from lcollision_core.meshes import Topology
from tests.core.shapes import Mesh, box, figure_eight, grid, join, sphere

HEIGHT, WALL = 100.0, 2.0


def where(point: np.ndarray) -> str:
    return f"near x = {point[0]:.0f}"


def solid_of(mesh: Mesh, open_layers: str = "auto") -> tuple[Manifold, float, list[str]]:
    layers = solids.split_layers(mesh.vertices, mesh.faces, WALL, open_layers, where)
    solid, filled = solids.join_layers(layers, HEIGHT, WALL, where, UNWATCHED)
    return solid, filled, [layer.kind for layer in layers]


def require_printable(solid: Manifold, dtype: type = np.float32) -> None:
    vertices, faces = solids.stored(solid, HEIGHT, dtype, where)
    assert vertices.dtype == dtype
    assert trimesh.Trimesh(vertices, faces, process=False).is_volume
    detector = CollisionDetector(Topology(faces, len(vertices)), vertices)
    assert not detector.detect(vertices).colliding


def test_boxes_that_cross_become_one_volume() -> None:
    solid, filled, kinds = solid_of(
        join(box([0, 0, 0], [60, 60, 100]), box([30, 30, 20], [90, 90, 70]))
    )
    assert kinds == ["closed", "closed"]
    assert len(solid.decompose()) == 1
    assert solid.volume() == pytest.approx(60 * 60 * 100 + 60 * 60 * 50 - 30 * 30 * 50)
    assert filled == pytest.approx(0.0, abs=1e-6)
    require_printable(solid)
    require_printable(solid, np.float64)


def test_a_layer_that_crosses_itself_becomes_what_is_seen_from_outside() -> None:
    tube = figure_eight(0.2, 0.15)
    tube = Mesh(tube.vertices * (HEIGHT / np.ptp(tube.vertices[:, 0])), tube.faces)
    detector = CollisionDetector(tube.topology, tube.vertices)
    assert detector.detect(tube.vertices).colliding
    solid, _, kinds = solid_of(tube)
    assert kinds == ["closed"]
    parts = [(tube.vertices, tube.faces)]
    assert solid.volume() == pytest.approx(column_volume(parts), rel=2e-3)
    # The intersection of both loops counts once.
    assert solid.volume() < 0.998 * trimesh.Trimesh(*tube).volume
    require_printable(solid)


def test_columns_measure_a_sphere_and_a_union() -> None:
    ball = sphere(10.0)
    ball = Mesh(ball.vertices, ball.faces[:, ::-1])
    volume = trimesh.Trimesh(*ball).volume
    assert column_volume([tuple(ball)]) == pytest.approx(volume, rel=1e-3)
    twice = [tuple(ball), tuple(ball.moved([0.0, 0.0, 0.1])), tuple(ball.moved([40.0, 0.0, 0.0]))]
    assert column_volume(twice) == pytest.approx(2.0 * volume, rel=1e-2)


def without(mesh: Mesh, faces: Sequence[int]) -> Mesh:
    return Mesh(mesh.vertices, np.delete(mesh.faces, faces, axis=0))


def holed_box() -> Mesh:
    """Return a box of 40 x 40 x 100 without its top."""
    closed = box([0, 0, 0], [40, 40, 100])
    top = np.flatnonzero((closed.vertices[closed.faces][:, :, 2] == 100.0).all(axis=1))
    return without(closed, top)


def test_the_hole_of_a_hull_is_closed() -> None:
    solid, _, kinds = solid_of(holed_box())
    assert kinds == ["capped"]
    assert solid.volume() == pytest.approx(40 * 40 * 100)
    require_printable(solid)


def test_an_open_layer_gets_the_least_wall() -> None:
    cloth = Mesh(grid(4).vertices * 50.0, grid(4).faces)
    solid, _, kinds = solid_of(cloth)
    assert kinds == ["thickened"]
    assert solid.volume() == pytest.approx(50.0 * 50.0 * WALL)
    assert np.ptp(solids._mesh_of(solid)[0][:, 2]) == pytest.approx(WALL)
    require_printable(solid)
    _, walls = solids.measured_walls(solid, 2.0 * WALL)
    assert np.median(walls) == pytest.approx(WALL, rel=1e-4)


def test_a_hull_is_thickened_if_all_are_to_be() -> None:
    solid, _, kinds = solid_of(holed_box(), "thicken")
    assert kinds == ["thickened"]
    assert solid.volume() < 0.5 * 40 * 40 * 100
    require_printable(solid)


def test_a_sheet_that_is_to_be_closed_is_refused_with_its_place() -> None:
    cloth = Mesh(grid(4).vertices * 50.0, grid(4).faces)
    with pytest.raises(LCollisionError, match=r"near x = 25 has no volume .* thicken"):
        solid_of(join(box([0, 0, 0], [40, 40, 100]), cloth), "close")


def test_sheets_back_to_back_and_edges_of_three_faces_are_thickened() -> None:
    cloth = grid(2)
    fin = Mesh(cloth.vertices[:, [2, 1, 0]], cloth.faces)  # on the edge x = 0 of the cloth
    both_sides = np.concatenate([cloth.faces, cloth.faces[:, ::-1], fin.faces + 9])
    points = np.concatenate([cloth.vertices, fin.vertices]) * 50.0
    corner = {tuple(point): n for n, point in reversed(list(enumerate(points)))}
    named = np.array([corner[tuple(point)] for point in points])[both_sides]
    solid, _, kinds = solid_of(Mesh(points, named))
    assert set(kinds) == {"thickened"}
    assert len(solid.decompose()) == 1
    require_printable(solid)


def test_what_lies_enclosed_is_filled() -> None:
    inner = box([10, 10, 10], [30, 30, 30])
    shell = join(box([0, 0, 0], [40, 40, 40]), Mesh(inner.vertices, inner.faces[:, ::-1]))
    walls = [box([0, 0, 0], [40, 40, 5]), box([0, 0, 35], [40, 40, 40])]
    walls += [box([0, 0, 0], [40, 5, 40]), box([0, 35, 0], [40, 40, 40])]
    walls += [box([0, 0, 0], [5, 40, 40]), box([35, 0, 0], [40, 40, 40])]
    assert solid_of(shell)[0].volume() == pytest.approx(40**3)
    solid, filled, _ = solid_of(join(*walls))
    assert solid.volume() == pytest.approx(40**3)
    assert filled == pytest.approx(30**3)


def test_a_loose_part_is_joined_where_it_is_near_and_refused_where_not() -> None:
    solid, _, _ = solid_of(join(box([0, 0, 0], [40, 40, 100]), box([43, 0, 0], [60, 40, 50])))
    joined, pins = solids.pinned(solid, 4.0, WALL / 2.0, where)
    assert len(pins) == 1
    assert np.linalg.norm(pins[0][1] - pins[0][0]) == pytest.approx(3.0, rel=0.1)
    assert len(joined.decompose()) == 1
    require_printable(joined)
    with pytest.raises(LCollisionError, match=r"near x = 43 is loose: 3\.0 mm from the rest"):
        solids.pinned(solid, 2.0, WALL / 2.0, where)
