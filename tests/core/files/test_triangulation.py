"""Polygons as triangles, against the winding number."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import MeshFileError
from lcollision_core.files import read_character, read_mesh, read_pose_set
from lcollision_core.files.mesh.polygons import Polygons, Triangulation, triangulate
from lcollision_core.files.motion.caches import write_point_cache
from lcollision_core.meshes import Topology
from lcollision_core.tasks.sources import gather_poses, summarise_sources
from tests.app.support import Lcollision

Points = Sequence[tuple[float, float]]

NOTCHED = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
DART = [(0, 0), (4, 0), (1, 1), (0, 4)]
KEYHOLE = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
TOUCHING = [(0, 0), (6, 0), (6, 6), (3, 0), (0, 6)]
CONVEX = [(0, 0), (2, -1), (4, 0), (4, 3), (1, 4)]


def _cut(outline: Points, turn: Rotation | None = None, scale: float = 1.0) -> Triangulation:
    """Triangulate a polygon with corners 0, 1, 2 ... in any plane."""
    points = np.column_stack([np.asarray(outline, dtype=float), np.zeros(len(outline))])
    points = (points if turn is None else turn.apply(points)) * scale
    return triangulate(Polygons(points, np.array([len(points)]), np.arange(len(points))))


def _areas(outline: Points, faces: np.ndarray) -> np.ndarray:
    """Return the areas of triangles, positive if oriented like the outline."""
    a, b, c = np.asarray(outline, dtype=float)[faces.T]
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return areas * np.sign(areas.sum())


def _assert_covers(outline: Points, faces: np.ndarray) -> None:
    """Require n - 2 triangles of one orientation, whose inner edges cancel."""
    n = len(outline)
    assert len(faces) == n - 2
    assert _areas(outline, faces).min() >= -1e-9
    edges = {(a, b) for face in faces.tolist() for a, b in itertools.pairwise([*face, face[0]])}
    rim = {edge for edge in edges if edge[::-1] not in edges}
    assert len(edges) == 3 * (n - 2)
    assert rim == {(corner, (corner + 1) % n) for corner in range(n)}


@pytest.mark.parametrize(
    "outline",
    [
        NOTCHED,
        DART,
        KEYHOLE,
        TOUCHING,
        # Collinear and coincident corners.
        [(0, 0), (1, 0), (2, 0), (4, 0), (1, 1), (0, 4), (0, 2)],
        [(0, 0), (4, 0), (4, 0), (1, 1), (1, 1), (1, 1), (0, 4), (0, 4)],
    ],
)
@pytest.mark.parametrize("is_clockwise", [False, True])
@pytest.mark.parametrize("scale", [1.0, 1e-150, 1e200])
def test_every_start_and_plane_of_a_concave_polygon(
    outline: Points, is_clockwise: bool, scale: float
) -> None:
    outline = outline[::-1] if is_clockwise else outline
    for first in range(len(outline)):
        rolled = [*outline[first:], *outline[:first]]
        cut = _cut(rolled, Rotation.random(random_state=first), scale)
        _assert_covers(rolled, cut.faces)
        assert len(cut.notes) == 1


@st.composite
def simple_polygons(draw: st.DrawFn) -> list[tuple[float, float]]:
    """Draw a star-shaped polygon, with collinear or coincident corners."""
    n = draw(st.integers(4, 20))
    radii = draw(st.lists(st.integers(1, 8), min_size=n, max_size=n))
    angles = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    corners = np.array(radii)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    outline = []
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        shares = range(draw(st.integers(1, 3)))
        outline += [tuple(corner + (following - corner) * share / 4) for share in shares]
        outline += outline[-1:] * draw(st.integers(0, 1))
    return outline


@pytest.mark.slow
@given(simple_polygons())
@settings(deadline=None, max_examples=150)
def test_any_simple_polygon_is_covered(outline: list[tuple[float, float]]) -> None:
    cut = _cut(outline)
    _assert_covers(outline, cut.faces)
    assert len(cut.notes) == 1


@pytest.mark.parametrize("first", range(5))
def test_a_convex_polygon_is_the_fan_round_its_first_corner(first: int) -> None:
    outline = [*CONVEX[first:], *CONVEX[:first]]
    for turn in Rotation.random(20, random_state=0):
        # Decimal rounding makes a collinear corner reflex.
        cut = _cut(
            [
                *outline,
                ((outline[-1][0] + outline[0][0]) / 2 + 1e-8, (outline[-1][1] + outline[0][1]) / 2),
            ],
            turn,
        )
        assert cut.faces.tolist() == [[0, k, k + 1] for k in range(1, 5)]


@pytest.mark.parametrize(
    "outline",
    [
        [(0, 0), (2, 2), (2, 0), (0, 2)],
        [(0, 0), (4, 3), (0, 3), (4, 0), (2, 5)],
        [(0, 0), (3, 0), (3, 2), (1, -1), (0, 2)],
        [(0, 0), (1, 0), (3, 0), (2, 0)],
        [(1, 1), (1, 1), (1, 1), (1, 1)],
    ],
)
def test_what_cannot_be_cut_stays_a_fan_and_is_said(outline: Points) -> None:
    good = np.array(CONVEX[:4], dtype=float)
    points = np.column_stack([[*good, *outline], np.zeros(4 + len(outline))])
    sizes = np.array([4, len(outline)])
    cut = triangulate(Polygons(points, sizes, np.arange(len(points))))
    assert cut.faces.tolist()[2:] == [[4, k, k + 1] for k in range(5, 3 + len(outline))]
    assert cut.cut_of.tolist() == [0, 0] + [1] * (len(outline) - 2)
    assert "1 polygon, face 1 (from 0), crosses itself, has no area or is far" in cut.notes[-1]
    many = triangulate(Polygons(points, np.tile(sizes, 3), np.tile(np.arange(len(points)), 3)))
    assert many.notes[-1].startswith("3 polygons, the first of which is face 1 (from 0), cross")


def test_a_bent_polygon_is_said_and_a_slightly_bent_one_is_not() -> None:
    for height, n_notes in ((0.05, 1), (0.8, 2)):
        points = np.array([[0, 0, 0], [1, 0, height], [1, 1, 0], [0, 1, height]], dtype=float)
        cut = triangulate(Polygons(points, np.array([4]), np.arange(4)))
        assert cut.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
        assert len(cut.notes) == n_notes


def test_a_corner_that_the_next_one_repeats_is_left_out() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    corners = np.array([0, 1, 1, 2, 3, 0, 0, 1, 2])
    cut = triangulate(Polygons(points, np.array([6, 3]), corners))
    assert cut.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert cut.notes == ("2 repeated corners were left out", "1 quad was triangulated")


def test_a_bridge_to_a_hole_names_its_vertices_twice() -> None:
    outline = np.array([*KEYHOLE[:4], *KEYHOLE[5:9]], dtype=float)
    corners = np.array([0, 1, 2, 3, 0, 4, 5, 6, 7, 4])
    points = np.column_stack([outline, np.zeros(8)])
    cut = triangulate(Polygons(points, np.array([10]), corners))
    Topology(cut.faces, 8)
    assert _areas(outline, cut.faces).min() > 0.0
    assert _areas(outline, cut.faces).sum() == pytest.approx(16 - 4)


def test_thousands_of_corners() -> None:
    angles = np.linspace(0.0, 12.0 * np.pi, 2000)
    arms = [
        np.column_stack([np.cos(angles), np.sin(angles)]) * (angles + r)[:, None] for r in (9, 11)
    ]
    outline = np.concatenate([arms[0], arms[1][::-1]]).tolist()
    _assert_covers(outline, _cut(outline).faces)


def test_polygons_that_name_no_vertex_or_are_not_finite_are_refused_by_name(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 4 0 0\nv 1 1 0\nv 0 {} 0\nf 1 2 3 {}\n"
    for y, last, what in (("nan", 4, "vertex 3 .* not finite"), ("4", 9, "names vertices")):
        (tmp_path / "a.obj").write_text(text.format(y, last))
        with pytest.raises(MeshFileError, match=what):
            read_mesh(tmp_path / "a.obj")


# A part with a notch and two concave caps, and a rod in the notch that touches nothing.
_RING = np.array(NOTCHED, dtype=float)
_ROD = np.array([(1.3, 1.8), (1.7, 1.8), (1.7, 2.2), (1.3, 2.2)])
CLAMP = np.concatenate(
    [
        np.column_stack([outline, np.full(len(outline), float(z))])
        for outline, heights in ((_RING, (0, 1)), (_ROD, (-1, 2)))
        for z in heights
    ]
)


def _clamp_polygons() -> list[list[int]]:
    polygons = []
    for first, n in ((0, 8), (16, 4)):
        near, far = np.arange(first, first + n), np.arange(first + n, first + 2 * n)
        polygons += [near[::-1].tolist(), far.tolist()]
        sides = np.stack([near, np.roll(near, -1), np.roll(far, -1), far], axis=1)
        polygons += sides.tolist()
    return polygons


def _write_clamp(path: Path, points: np.ndarray = CLAMP) -> Path:
    polygons = _clamp_polygons()
    rows = [" ".join(map(repr, point)) for point in points.tolist()]
    faces = [" ".join(map(str, [len(one), *one])) for one in polygons]
    counts = f"{len(rows)} {len(faces)}"
    match path.suffix:
        case ".obj":
            lines = [f"v {row}" for row in rows]
            lines += ["f " + " ".join(str(corner + 1) for corner in one) for one in polygons]
        case ".off":
            lines = ["OFF", f"{counts} 0", *rows, *faces]
        case ".ply":
            lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
            lines += [f"property double {axis}" for axis in "xyz"]
            lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
            lines += ["end_header", *rows, *faces]
        case ".fbx":
            ends = [corner for one in polygons for corner in (*one[:-1], ~one[-1])]
            lines = ["; FBX 7.4.0 project file", "FBXHeaderExtension: {", "FBXVersion: 7400", "}"]
            lines += ["Objects: {", 'Geometry: 100, "Geometry::clamp", "Mesh" {']
            lines += [
                f"Vertices: *{points.size} {{ a: {','.join(map(repr, points.ravel().tolist()))} }}"
            ]
            lines += [f"PolygonVertexIndex: *{len(ends)} {{ a: {','.join(map(str, ends))} }}", "}"]
            lines += ['Model: 200, "Model::clamp", "Mesh" {', "}", "}"]
            lines += ["Connections: {", 'C: "OO",100,200', 'C: "OO",200,0', "}"]
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode())
    return path


def _n_pairs(vertices: np.ndarray, topology: Topology) -> int:
    return CollisionDetector(topology, vertices).summarise(vertices).n_pairs


def _closed() -> np.ndarray:
    """Return the clamp with its notch bulging outwards, so that its caps are convex."""
    points = CLAMP.copy()
    points[[3, 4, 5, 6, 11, 12, 13, 14], 1] = [3.2, 3.4, 3.4, 3.2] * 2
    return points


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".fbx"])
@pytest.mark.parametrize("turn", range(3))
def test_a_rod_in_a_notch_collides_with_nothing(tmp_path: Path, suffix: str, turn: int) -> None:
    turned = Rotation.random(random_state=turn).apply(CLAMP)
    mesh = read_mesh(_write_clamp(tmp_path / f"clamp{suffix}", turned))
    assert mesh.topology.is_watertight
    assert _n_pairs(mesh.vertices, mesh.topology) == 0
    # The rod penetrates the bottom of the notch.
    moved = CLAMP.copy()
    moved[16:, 1] -= 1.5
    assert _n_pairs(moved, mesh.topology) > 0


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".fbx"])
def test_the_reference_of_a_set_decides_for_all_its_poses(tmp_path: Path, suffix: str) -> None:
    for shapes in ((CLAMP, _closed()), (_closed(), CLAMP)):
        files = [
            _write_clamp(tmp_path / f"{number}{suffix}", points)
            for number, points in enumerate(shapes)
        ]
        alone = [read_mesh(file).topology for file in files]
        assert alone[0] != alone[1]
        poses = read_pose_set(tmp_path)
        assert poses.topology == alone[0]
        # As a single mesh, for a model of the set.
        again = read_mesh(files[1], topology=poses.topology)
        assert again.topology is poses.topology
        assert np.array_equal(again.vertices, poses.vertices[1])
        if suffix == ".fbx":
            assert read_character(files[1], topology=poses.topology).topology == poses.topology
            assert read_character(files[1]).topology == alone[1]


def test_several_sources_of_one_body_are_cut_alike(tmp_path: Path) -> None:
    for name, shapes in (("a", (CLAMP, _closed())), ("b", (_closed(), CLAMP))):
        (tmp_path / name).mkdir()
        for number, points in enumerate(shapes):
            _write_clamp(tmp_path / name / f"{number}.obj", points)
    _write_clamp(tmp_path / "c.obj", _closed())
    write_point_cache(tmp_path / "c.mdd", np.stack([_closed(), CLAMP]), 24.0)
    sources = [tmp_path / name for name in ("a", "b", "c.mdd")]
    poses = gather_poses(sources, by_rig=0, thin=False)
    assert len(poses) == 7
    assert poses.topology == read_pose_set(tmp_path / "a").topology
    assert poses.topology == summarise_sources(sources).topology


def test_a_cache_is_cut_as_its_mesh(tmp_path: Path) -> None:
    mesh = read_mesh(_write_clamp(tmp_path / "clamp.obj"))
    write_point_cache(tmp_path / "clamp.mdd", np.stack([CLAMP, _closed()]), 24.0)
    assert read_pose_set(tmp_path / "clamp.mdd").topology == mesh.topology


def test_a_pose_is_checked_as_its_rest_pose_is_cut(lcollision: Lcollision, tmp_path: Path) -> None:
    rest = _write_clamp(tmp_path / "rest.obj", _closed())
    pose = _write_clamp(tmp_path / "pose.obj")
    assert lcollision("check", pose).exit_code == 0
    checked = lcollision("check", "--json", pose, "--rest", rest, "--rest-exclusion", "0")
    assert json.loads(checked.stdout)[0]["pairs"] > 0


def test_other_polygons_are_not_cut_alike(tmp_path: Path) -> None:
    mesh = read_mesh(_write_clamp(tmp_path / "a.obj"))
    text = (tmp_path / "a.obj").read_text()
    (tmp_path / "b.obj").write_text(text.replace("f 8 7 6 5", "f 8 7 5 6"))
    assert read_mesh(tmp_path / "b.obj", topology=mesh.topology).topology != mesh.topology


_FLAT = {
    "a.obj": "".join(f"v {x} {y} {z}\n" for x, y, z in CLAMP) + "f 1 2 3\nf 1 1 2\nf 3 2 4\n",
    "a.off": f"OFF\n{len(CLAMP)} 3 0\n"
    + "".join(f"{x} {y} {z}\n" for x, y, z in CLAMP)
    + "3 0 1 2\n3 1 0 1\n3 2 1 3\n",
    "a.ply": "ply\nformat ascii 1.0\n"
    + f"element vertex {len(CLAMP)}\n"
    + "".join(f"property float {axis}\n" for axis in "xyz")
    + "element face 3\nproperty list uchar int vertex_indices\nend_header\n"
    + "".join(f"{x} {y} {z}\n" for x, y, z in CLAMP)
    + "3 0 1 2\n3 1 1 1\n3 2 1 3\n",
    "a.stl": "solid a\n"
    + "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*CLAMP[corner]) for corner in face)
        + "endloop\nendfacet\n"
        for face in ((0, 1, 2), (0, 1, 0), (2, 1, 3))
    )
    + "endsolid a\n",
}


@pytest.mark.parametrize("name", _FLAT)
def test_a_triangle_with_two_equal_corners_is_left_out_and_named(
    tmp_path: Path, lcollision: Lcollision, name: str
) -> None:
    path = tmp_path / name
    path.write_text(_FLAT[name])
    mesh = read_mesh(path)
    corners = mesh.vertices[mesh.topology.faces]
    np.testing.assert_allclose(corners, CLAMP[[[0, 1, 2], [2, 1, 3]]], atol=1e-6)
    assert "face 1 (from 0), which has two equal corners, was left out" in mesh.notes
    # A pose of the same body is triangulated equally.
    assert read_mesh(path, topology=mesh.topology).topology is mesh.topology
    result = lcollision("check", path)
    assert result.exit_code == 0
    assert "was left out" in result.stderr


def test_polygons_that_fold_onto_a_line_leave_no_triangle() -> None:
    sizes, corners = np.array([4, 3, 3]), np.array([0, 1, 0, 1, 0, 1, 2, 2, 2, 2])
    cut = triangulate(Polygons(np.eye(3), sizes, corners))
    assert cut.faces.tolist() == [[0, 1, 2]]
    assert cut.cut_of.tolist() == [1]
    assert "face 2 (from 0), which has two equal corners, was left out" in cut.notes
    assert any(note.startswith("2 triangles with two equal corners") for note in cut.notes)
