"""OBJ files of characters: texture coordinates, normals, meshes and materials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from lcollision_core.bodies import RigBody, export_mesh, open_body
from lcollision_core.files import read_mesh
from lcollision_core.meshes import FaceGroup
from lcollision_core.meshes.normals import corner_normals
from tests.core.gltf_builder import GltfBuilder
from tests.core.textured_cube import RED, cube, png, textured_cube


@pytest.fixture
def body(tmp_path: Path) -> RigBody:
    """Return a cube with a texture whose material has a name of several words."""
    builder = GltfBuilder()
    view = builder.view(png(np.full((2, 2, 3), RED)))
    builder.add("images", bufferView=view, mimeType="image/png")
    builder.add("textures", source=0)
    material = {"name": "Paint #2 red", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    body = open_body(textured_cube(material, builder).write(tmp_path / "cube.glb"))
    assert isinstance(body, RigBody)
    return body


def corners(*columns: np.ndarray) -> set[tuple[float, ...]]:
    return set(map(tuple, np.round(np.column_stack(columns), 6).tolist()))


def test_texture_coordinates_normals_and_names_arrive(body: RigBody, tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    vertices = body.exported_vertices(body.known_poses[0])
    written = export_mesh(path, body, vertices)
    # The vertices and the order of the faces are the body's own.
    np.testing.assert_array_equal(read_mesh(path, topology=body.topology).vertices, written)
    read = trimesh.load(path, process=False)
    places, faces, uv = cube()
    normals = np.cross(
        places[faces[:, 1]] - places[faces[:, 0]], places[faces[:, 2]] - places[faces[:, 0]]
    )
    normals = np.repeat(normals / 4.0, 3, axis=0)
    shown = faces.ravel()
    # The UV origin is the image's lower left corner in OBJ, and the upper left one in glTF.
    expected = corners(places[shown], uv[shown] * [1.0, -1.0] + [0.0, 1.0], normals)
    found = read.faces.ravel()
    told = corners(read.vertices[found], read.visual.uv[found], read.vertex_normals[found])
    assert told == expected
    assert len(told) == 24
    lines = path.read_text().splitlines()
    assert [line for line in lines if line.startswith(("g ", "usemtl "))] == [
        "g Body",
        "usemtl Paint_2_red",
    ]


def test_each_mesh_is_a_group_and_each_face_keeps_its_number(body: RigBody, tmp_path: Path) -> None:

    own = tuple(group for group in body.character.groups if group.is_material)
    groups = (FaceGroup("Left half", np.arange(6)), FaceGroup("Lid", np.arange(8, 12)), *own)
    body = RigBody.of(replace(body.character, groups=groups))
    path = tmp_path / "cube.obj"
    export_mesh(path, body, body.exported_vertices(body.known_poses[0]))
    lines = path.read_text().splitlines()
    told = [line if line[0] in "gu" else "f" for line in lines if line[0] in "guf"]
    assert told == ["g Left_half", "usemtl Paint_2_red", *"f" * 6, "g", *"f" * 2, "g Lid", *"f" * 4]
    np.testing.assert_array_equal(read_mesh(path).topology.faces, body.faces)


def test_only_edges_that_are_sharp_at_rest_part_normals() -> None:
    ball = trimesh.creation.icosphere(2)
    normals, of_corner = corner_normals(ball.vertices, ball.faces, ball.vertices)
    assert len(normals) == len(ball.vertices)
    np.testing.assert_allclose(normals[of_corner], ball.vertices[ball.faces], atol=0.05)
    # Shading stays smooth even if a pose bends an edge sharply.
    flat = ball.vertices * [1.0, 1.0, 0.01]
    bent, same = corner_normals(flat, ball.faces, ball.vertices)
    np.testing.assert_array_equal(same, of_corner)
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1.0)
    box = trimesh.creation.box()
    normals, of_corner = corner_normals(box.vertices, box.faces, box.vertices)
    assert len(normals) == 24
    np.testing.assert_allclose(normals[of_corner[:, 0]], box.face_normals, atol=1e-12)
