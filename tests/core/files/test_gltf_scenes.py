"""The content of glTF files, against VTK's reader and known results."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.errors import MeshFileError
from lcollision_core.files import read_character, read_mesh, read_pose_set, write_character
from lcollision_core.files.scene.joined import JoinedMesh, join_parts, sample_clip
from lcollision_core.files.scene_files import read_scene
from tests.core.gltf_builder import GltfBuilder, arm, moved, rotation, split_corners, tube
from tests.core.vtk_gltf import vtk_corners

CLIP_TIMES = (0.0, 0.13, 0.41, 0.7, 1.0)


def _joined(path: Path) -> JoinedMesh:
    return join_parts(read_scene(path))


def _difference_from_vtk(path: Path, clip: int | None = None, time: float = 0.0) -> float:
    """Return the largest distance between corresponding corners, relative to the height."""
    scene = read_scene(path)
    mesh = join_parts(scene)
    poses = scene.rest if clip is None else scene.clips[clip].sample(np.array([time]))
    corners = mesh.posed(poses)[0][mesh.topology.faces.reshape(-1)]
    height = float(np.ptp(mesh.posed(scene.rest)[0][:, 1]))
    return float(np.abs(corners - vtk_corners(path, clip, time)).max()) / height


def _plain(builder: GltfBuilder, vertices: np.ndarray, faces: np.ndarray, **extras: Any) -> int:
    """Add a mesh of one primitive."""
    primitive = {
        "attributes": {"POSITION": builder.array(vertices)},
        "indices": builder.array(np.reshape(faces, -1), "u4"),
    }
    return builder.add("meshes", name="Tube", primitives=[primitive | extras])


def test_a_skinned_mesh_agrees_with_vtk(tmp_path: Path) -> None:
    path = arm().write(tmp_path / "arm.glb")
    assert _difference_from_vtk(path) < 1e-6
    for time in CLIP_TIMES:
        assert _difference_from_vtk(path, 0, time) < 1e-6


@pytest.mark.parametrize("interpolation", ["STEP", "LINEAR", "CUBICSPLINE"])
def test_every_interpolation_agrees_with_vtk(tmp_path: Path, interpolation: str) -> None:
    generator = np.random.default_rng(3)
    builder = arm(split=False)
    del builder.description["animations"]
    times = [0.0, 0.4, 1.0]

    def with_tangents(values: np.ndarray) -> np.ndarray:
        if interpolation != "CUBICSPLINE":
            return values
        tangents = 0.2 * generator.normal(size=(2, *values.shape))
        # For each key: in-tangent, value, out-tangent.
        return np.stack([tangents[0], values, tangents[1]], axis=1).reshape(-1, values.shape[1])

    turns = generator.normal(size=(3, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    values = {
        "rotation": turns,
        "translation": generator.normal(size=(3, 3)),
        "scale": generator.uniform(0.5, 1.5, (3, 3)),
    }
    builder.animation(
        "all",
        *(
            {
                "node": node,
                "path": path,
                "times": times,
                "values": with_tangents(value),
                "interpolation": interpolation,
            }
            for node, (path, value) in zip((1, 2, 3), values.items(), strict=True)
        ),
    )
    path = builder.write(tmp_path / "m.glb")
    rest = _difference_from_vtk(path)
    assert rest < 1e-6
    for time in CLIP_TIMES:
        assert _difference_from_vtk(path, 0, time) < 1e-5


def test_quaternions_take_the_shorter_way_at_a_steady_pace(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.add("nodes", mesh=_plain(builder, *tube()))
    start, end = np.array(rotation(1, 0.4)), -np.array(rotation(1, 1.6))
    builder.animation(
        "turn", {"node": 0, "path": "rotation", "times": [0.0, 1.0], "values": [start, end]}
    )
    scene = read_scene(builder.write(tmp_path / "m.glb"))
    for time in (0.0, 0.25, 0.5, 1.0):
        matrix = scene.clips[0].sample(np.array([time])).transforms[0, 0]
        angle = 0.4 + 1.2 * time
        assert matrix[0, 0] == pytest.approx(np.cos(angle), abs=1e-6)
        assert matrix[0, 2] == pytest.approx(np.sin(angle), abs=1e-6)


def test_morph_targets_agree_with_vtk(tmp_path: Path) -> None:
    generator = np.random.default_rng(5)
    builder = GltfBuilder()
    vertices, faces = tube()
    deltas = 0.3 * generator.normal(size=(2, *vertices.shape)).astype(np.float32)
    mesh = _plain(
        builder, vertices, faces, targets=[{"POSITION": builder.array(delta)} for delta in deltas]
    )
    builder.description["meshes"][mesh]["weights"] = [0.5, 0.0]
    builder.add("nodes", mesh=mesh, translation=[1.0, 2.0, 3.0])
    values = [0.0, 0.0, 1.0, 0.25, 0.0, 2.0]
    builder.animation(
        "talk", {"node": 0, "path": "weights", "times": [0.0, 0.5, 1.0], "values": values}
    )
    path = builder.write(tmp_path / "m.glb")
    assert _difference_from_vtk(path) < 1e-6
    for time in CLIP_TIMES:
        assert _difference_from_vtk(path, 0, time) < 1e-6
    frames = _joined(path).posed(sample_clip(read_scene(path), "talk", None)[1])
    expected = vertices + deltas[0] + 0.25 * deltas[1] + [1.0, 2.0, 3.0]
    assert np.abs(frames[1] - expected).max() < 1e-6
    # A node's weights take precedence over the mesh's.
    builder.description["nodes"][0]["weights"] = [0.0, 1.0]
    expected = vertices + deltas[1] + [1.0, 2.0, 3.0]
    path = builder.write(tmp_path / "m.gltf")
    assert np.abs(read_mesh(path).vertices - expected).max() < 1e-6


def test_a_primitive_may_have_fewer_morph_targets_than_the_mesh_has_weights(tmp_path: Path) -> None:
    builder = GltfBuilder()
    vertices, faces = tube()
    deltas = [builder.array(np.full_like(vertices, delta)) for delta in (0.25, 0.5)]
    mesh = _plain(builder, vertices, faces, targets=[{"POSITION": delta} for delta in deltas])
    other = _plain(builder, vertices + 2.0, faces, targets=[{"POSITION": deltas[0]}])
    meshes = builder.description["meshes"]
    meshes[mesh]["primitives"] += meshes.pop(other)["primitives"]
    meshes[mesh]["weights"] = [1.0, 1.0]
    builder.add("nodes", mesh=mesh)
    found = read_mesh(builder.write(tmp_path / "m.glb")).vertices
    assert np.abs(found - np.concatenate([vertices + 0.75, vertices + 2.25])).max() < 1e-6


def test_an_animation_without_a_mesh_is_said(tmp_path: Path) -> None:
    builder = arm()
    builder.description["meshes"] = []
    for node in builder.description["nodes"]:
        node.pop("mesh", None)
    path = builder.write(tmp_path / "walk.glb")
    with pytest.raises(MeshFileError, match="an animation, but no mesh; name or open the char"):
        read_scene(path)


def test_vertices_of_unlike_morphs_or_weights_stay_apart(tmp_path: Path) -> None:
    builder = GltfBuilder()
    vertices, faces = split_corners(*tube())
    deltas = np.zeros_like(vertices)
    deltas[0] = [0.0, 0.0, 0.5]
    mesh = _plain(builder, vertices, faces, targets=[{"POSITION": builder.array(deltas)}])
    builder.add("nodes", mesh=mesh)
    joined = _joined(builder.write(tmp_path / "m.glb"))
    assert joined.topology.n_vertices == len(tube()[0]) + 1
    assert (joined.joined == joined.joined[0]).sum() == 1
    builder = arm()
    weights = builder.description["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]
    view = builder.description["bufferViews"][
        builder.description["accessors"][weights]["bufferView"]
    ]
    blob = bytearray(builder.blob)
    blob[view["byteOffset"] : view["byteOffset"] + 16] = np.array([0.5, 0.5, 0, 0], "<f4").tobytes()
    builder.blob = bytes(blob)
    joined = _joined(builder.write(tmp_path / "m.glb"))
    assert (joined.joined == joined.joined[0]).sum() == 1


def test_nodes_with_matrices_and_several_meshes_agree_with_vtk(tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = _plain(builder, *tube())
    other = _plain(builder, *tube(3, 4, 1.0))
    shear = moved(0.3, -0.2, 5.0)
    shear[0, 1], shear[2, 2] = 0.4, 2.0
    builder.add("nodes", children=[1, 2], matrix=shear.T.reshape(-1).tolist())
    builder.add(
        "nodes", mesh=mesh, translation=[2.0, 0, 0], rotation=rotation(0, 1.0), scale=[1, 2, 3]
    )
    builder.add("nodes", mesh=other, matrix=moved(0.0, 1.0, 0.0).T.reshape(-1).tolist())
    assert _difference_from_vtk(builder.write(tmp_path / "m.glb")) < 1e-6


def test_a_matrix_that_an_animation_turns_keeps_its_place_and_scale(tmp_path: Path) -> None:
    builder = GltfBuilder()
    matrix = moved(1.0, 2.0, 3.0)
    matrix[:3, :3] = np.diag([1.0, -2.0, 3.0])
    builder.add("nodes", mesh=_plain(builder, *tube()), matrix=matrix.T.reshape(-1).tolist())
    builder.animation(
        "grow", {"node": 0, "path": "translation", "times": [0.0], "values": [[5.0, 0.0, 0.0]]}
    )
    scene = read_scene(builder.write(tmp_path / "m.glb"))
    matrix[:3, 3] = 5.0, 0.0, 0.0
    found = scene.clips[0].sample(np.array([0.0])).transforms[0, 0]
    assert np.abs(found - matrix).max() < 1e-12


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = vertices[faces.T]
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0


@pytest.mark.parametrize("is_skinned", [False, True])
def test_mirrored_nodes_keep_the_surface_outside(tmp_path: Path, is_skinned: bool) -> None:
    if is_skinned:
        builder = arm()
        del builder.description["animations"]
    else:
        builder = GltfBuilder()
        builder.add("nodes", mesh=_plain(builder, *tube()))
    plain = read_mesh(builder.write(tmp_path / "plain.glb"))
    builder.description["nodes"][0]["scale"] = [-1.0, 1.0, 1.0]
    mirrored = read_mesh(builder.write(tmp_path / "mirrored.glb"))
    volume = _volume(plain.vertices, plain.faces)
    assert volume > 0.5
    assert _volume(mirrored.vertices, mirrored.faces) == pytest.approx(volume, rel=1e-6)


def test_strips_and_fans_are_triangles(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0, 0]], dtype=np.float32)
    for mode, corners, expected in (
        (5, [0, 1, 2, 3], [[0, 1, 2], [1, 3, 2]]),
        # Two strips, joined by degenerate triangles.
        (5, [0, 1, 2, 2, 1, 1, 4, 3], [[0, 1, 2], [1, 3, 4]]),
        (6, [0, 1, 3, 2], [[1, 3, 0], [3, 2, 0]]),
    ):
        builder = GltfBuilder()
        builder.add("nodes", mesh=_plain(builder, square, np.array(corners), mode=mode))
        assert read_mesh(builder.write(tmp_path / "m.glb")).faces.tolist() == expected


def test_lines_and_points_are_left_out_and_the_notes_say_so(tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = _plain(builder, *tube())
    primitives = builder.description["meshes"][mesh]["primitives"]
    primitives.append(primitives[0] | {"mode": 1})
    builder.add("nodes", mesh=mesh)
    read = read_mesh(builder.write(tmp_path / "m.glb"))
    assert len(read.faces) == len(tube()[1])
    assert read.notes == ("1 part without triangles (points, lines) was left out",)


def test_scenery_about_a_character_is_left_out(tmp_path: Path) -> None:
    builder = arm()
    alone = join_parts(read_scene(builder.write(tmp_path / "alone.glb")))
    vertices, faces = tube()
    floor = _plain(builder, 50.0 * vertices, faces)
    builder.description["meshes"][floor]["name"] = "Floor"
    ring = _plain(builder, 0.1 * vertices, faces)
    nodes = builder.description["nodes"]
    nodes.append({"mesh": floor})
    nodes.append({"mesh": ring})
    nodes[2]["children"].append(len(nodes) - 1)
    # A clip moves the whole skeleton, and a sibling mesh on the same node.
    nodes.append({"mesh": floor, "name": "Carried floor"})
    nodes[0]["children"].append(len(nodes) - 1)
    # Another clip moves a separate part.
    nodes.append({"mesh": ring, "name": "Engine"})
    engine = {"node": len(nodes) - 1, "path": "translation", "times": [0.0, 1.0]}
    builder.animation("hum", engine | {"values": [[0.0, 9.0, 0.0], [0.0, 9.1, 0.0]]})
    path = builder.write(tmp_path / "arm.glb")
    scene = read_scene(path)
    assert [part.mesh for part in scene.parts] == ["Body", "Tube", "Engine"]
    assert scene.notes == ("left out, as no joint carries it: Floor, Carried floor",)
    frames = scene.clips[0].sample(np.array([0.0, 0.5]))
    assert len(frames.weights) == len(scene.rest.weights) == 3
    assert join_parts(scene).posed(frames).shape[0] == 2
    assert len(join_parts(scene).joined) == len(alone.joined) + 2 * len(vertices)
    # Without a skin, everything is shown.
    del nodes[4]["skin"]
    assert len(read_scene(builder.write(tmp_path / "rigid.glb")).parts) == 5


def test_meshes_outside_the_scene_are_not_shown(tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = _plain(builder, *tube())
    for _ in range(3):
        builder.add("nodes", mesh=mesh)
    builder.description |= {"scene": 1, "scenes": [{"nodes": [0]}, {"nodes": [1]}]}
    assert len(read_mesh(builder.write(tmp_path / "m.glb")).vertices) == len(tube()[0])


def test_sparse_values_replace_the_stored_ones(tmp_path: Path) -> None:
    builder = GltfBuilder()
    vertices, faces = tube()
    mesh = _plain(builder, vertices, faces)
    places = np.array([3, 7], dtype="<u2")
    given = np.array([[5, 6, 7], [8, 9, 10]], dtype="<f4")
    sparse = {
        "count": 2,
        "indices": {"bufferView": builder.view(places), "componentType": 5123},
        "values": {"bufferView": builder.view(given)},
    }
    accessor = builder.description["accessors"][0]
    accessor["sparse"] = sparse
    builder.add("nodes", mesh=mesh)
    expected = vertices.copy()
    expected[places] = given
    assert np.array_equal(read_mesh(builder.write(tmp_path / "m.glb")).vertices, expected)
    # Without a buffer view, all other entries are zero.
    del accessor["bufferView"]
    expected[:] = 0.0
    expected[places] = given
    assert np.array_equal(read_mesh(builder.write(tmp_path / "m.glb")).vertices, expected)


@pytest.mark.parametrize(
    ("dtype", "scale"), [("i1", 127.0), ("u1", 255.0), ("i2", 32767.0), ("u2", 65535.0)]
)
def test_normalised_integers_are_shares_of_their_largest(
    tmp_path: Path, dtype: str, scale: float
) -> None:
    generator = np.random.default_rng(2)
    low = -int(scale) - 1 if dtype[0] == "i" else 0
    stored = generator.integers(low, int(scale) + 1, (12, 3))
    stored[0] = low
    builder = GltfBuilder()
    position = builder.array(stored, dtype, normalized=True)
    builder.add("meshes", primitives=[{"attributes": {"POSITION": position}}])
    builder.add("nodes", mesh=0)
    vertices = read_mesh(builder.write(tmp_path / "m.glb")).vertices
    assert np.array_equal(vertices, np.maximum(stored / scale, -1.0))


def test_interleaved_arrays_are_read_at_their_stride(tmp_path: Path) -> None:
    builder = GltfBuilder()
    vertices, faces = tube()
    rows = np.concatenate([np.full((len(vertices), 2), 9.0), vertices], axis=1).astype("<f4")
    mesh = _plain(builder, vertices, faces)
    view = builder.view(rows, byteStride=20)
    builder.description["accessors"][0] |= {"bufferView": view, "byteOffset": 8}
    builder.add("nodes", mesh=mesh)
    assert np.array_equal(read_mesh(builder.write(tmp_path / "m.glb")).vertices, vertices)


def test_eight_influences_move_as_their_sum(tmp_path: Path) -> None:
    four = read_scene(arm(split=False).write(tmp_path / "four.glb"))
    builder = arm(split=False, n_influences=8)
    attributes = builder.description["meshes"][0]["primitives"][0]["attributes"]
    # All weight is in the second set.
    for name in ("JOINTS", "WEIGHTS"):
        attributes[f"{name}_0"], attributes[f"{name}_1"] = (
            attributes[f"{name}_1"],
            attributes[f"{name}_0"],
        )
    eight = read_scene(builder.write(tmp_path / "eight.glb"))
    first, second = join_parts(four), join_parts(eight)
    assert eight.parts[0].weights.shape[1] == 8
    found = second.posed(sample_clip(eight, "wave", 10.0)[1])
    assert np.abs(found - first.posed(sample_clip(four, "wave", 10.0)[1])).max() < 1e-12


def test_weights_that_do_not_sum_to_one_are_scaled(tmp_path: Path) -> None:
    builder = GltfBuilder()
    vertices, faces = tube()
    weights = np.zeros((len(vertices), 4))
    weights[:, :2] = 0.2
    weights[0] = 0.0
    mesh = builder.add(
        "meshes",
        primitives=[
            {
                "attributes": {
                    "POSITION": builder.array(vertices),
                    "JOINTS_0": builder.array(np.tile([0, 1, 9, 9], (len(vertices), 1)), "u2"),
                    "WEIGHTS_0": builder.array(weights),
                },
                "indices": builder.array(faces.reshape(-1), "u4"),
            }
        ],
    )
    builder.add("nodes", mesh=mesh, skin=0, translation=[100.0, 0.0, 0.0])
    builder.add("nodes", translation=[0.0, 2.0, 0.0])
    builder.add("nodes", translation=[0.0, 0.0, 4.0])
    builder.add("skins", joints=[1, 2])
    expected = vertices + [0.0, 1.0, 2.0]
    # Unweighted vertices follow the first joint; the node of a skinned mesh has no effect.
    expected[0] = vertices[0] + [0.0, 2.0, 0.0]
    assert np.abs(read_mesh(builder.write(tmp_path / "m.glb")).vertices - expected).max() < 1e-6


def test_parts_that_share_vertices_are_joined(tmp_path: Path) -> None:
    """Exporters give each material its face indices and the same vertices."""
    builder = GltfBuilder()
    vertices, faces = tube()
    position = builder.array(vertices)
    half = len(faces) // 2
    primitives = [
        {
            "attributes": {"POSITION": position},
            "indices": builder.array(some.reshape(-1), "u4"),
            "material": builder.add("materials", name=name),
        }
        for name, some in (("Shirt", faces[:half]), ("Skin", faces[half:]))
    ]
    builder.add("nodes", mesh=builder.add("meshes", name="Body", primitives=primitives))
    mesh = _joined(builder.write(tmp_path / "m.glb"))
    assert np.array_equal(mesh.topology.faces, faces)
    assert np.array_equal(mesh.joined, np.tile(np.arange(len(vertices)), 2))
    assert [(group.name, len(group.faces)) for group in mesh.groups] == [
        ("Body", len(faces)), ("Shirt", half), ("Skin", len(faces) - half)
    ]  # fmt: skip


def test_faces_that_joining_makes_flat_are_left_out_of_faces_and_groups(tmp_path: Path) -> None:
    builder = GltfBuilder()
    vertices, faces = split_corners(*tube())
    vertices[1] = vertices[0]
    mesh = _plain(builder, vertices, faces, material=builder.add("materials", name="Skin"))
    builder.add("nodes", mesh=mesh)
    joined = _joined(builder.write(tmp_path / "m.glb"))
    assert joined.topology.n_faces == len(faces) - 1
    assert joined.groups[1].faces.tolist() == list(range(len(faces) - 1))
    assert joined.notes[-1] == "1 face without area was left out"


def _changed(kind: str, index: int, **values: Any) -> GltfBuilder:
    builder = arm()
    builder.description[kind][index] |= values
    return builder


def _without_weights() -> GltfBuilder:
    builder = arm()
    del builder.description["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]
    return builder


@pytest.mark.parametrize(
    ("builder", "message"),
    [
        (_without_weights(), "mesh 0 has joints without weights"),
        (_changed("nodes", 3, children=[1]), "node 1 .* has two parents"),
        (_changed("nodes", 3, children=[0]), "node 0 .* is its own ancestor"),
        (_changed("nodes", 3, children=[99]), "child of node 3 must be a whole number from 0 to 4"),
        (_changed("nodes", 4, mesh=7), "mesh of node 4 must be"),
        (_changed("nodes", 4, skin=7), "refers to the skin 7, but has only 1"),
        (_changed("nodes", 2, rotation=[0, 0, 1]), "rotation of node 2 must be 4 finite numbers"),
        (_changed("skins", 0, joints=[1, 2, 77]), "joint of skin 0 must be"),
        (_changed("skins", 0, joints=[1]), "is moved by joints .* expected 0 to 0"),
        (_changed("skins", 0, joints=[1, 2, 3, 4]), "have 3 values, 4 are needed"),
        (_changed("skins", 0, joints=[]), "skin 0 has no joints"),
        (_changed("accessors", 0, count=10**9), "count of positions of mesh 0 must be"),
        (_changed("accessors", 0, count=10**6), "truncated: the positions of mesh 0 need"),
        (_changed("accessors", 0, byteOffset=-1), "offset of the positions .* must be"),
        (_changed("accessors", 0, componentType=7), "type of the positions of mesh 0 must be"),
        (_changed("accessors", 0, type="VEC2"), "positions of mesh 0 must be VEC3, got 'VEC2'"),
        (_changed("accessors", 0, bufferView=99), "buffer view of the positions of mesh 0 99"),
        (_changed("accessors", 1, count=3), "joints 0 of mesh 0 have 3 values"),
        (_changed("bufferViews", 0, byteLength=10**9), "length of the positions"),
        (_changed("bufferViews", 0, buffer=3), "buffer of the positions of mesh 0 must be"),
        (_changed("bufferViews", 0, byteStride=1), "stride of the positions of mesh 0 must be"),
        (_changed("animations", 0, samplers=[]), "refers to a sampler of animation 'wave' 0"),
    ],
)  # fmt: skip
def test_wrong_numbers_are_named(tmp_path: Path, builder: GltfBuilder, message: str) -> None:
    path = builder.write(tmp_path / "m.glb")
    with pytest.raises(MeshFileError, match=message) as caught:
        read_scene(path)
    assert str(caught.value).startswith(f"{path} cannot be read: ")


def test_arrays_named_a_thousand_times_are_refused_before_they_are_read(tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = _plain(builder, *tube(200, 200))
    for _ in range(200):
        builder.add("nodes", mesh=mesh)
    with pytest.raises(MeshFileError, match="it holds 5000250 vertices, at most 5000000"):
        read_scene(builder.write(tmp_path / "m.glb"))


def _zeros(builder: GltfBuilder, like: int) -> int:
    """Add an accessor without data, with as many numbers as another one."""
    accessor = builder.description["accessors"][like]
    kept = ("componentType", "count", "type")
    return builder.add("accessors", **{name: accessor[name] for name in kept})


@pytest.mark.parametrize("n_zero", [0, 1, 2])
def test_morph_targets_that_move_nothing_are_read(tmp_path: Path, n_zero: int) -> None:
    builder = arm()
    primitive = builder.description["meshes"][0]["primitives"][0]
    zeros = _zeros(builder, primitive["attributes"]["POSITION"])
    primitive["targets"] = [{}, {"NORMAL": zeros}, *[{"POSITION": zeros}] * n_zero]
    path = builder.write(tmp_path / "m.glb")
    part = read_scene(path).parts[0]
    assert part.morphs.shape == (2 + n_zero, len(part.points), 3)
    assert not part.morphs.any()
    plain = arm().write(tmp_path / "plain.glb")
    assert np.array_equal(read_mesh(path).vertices, read_mesh(plain).vertices)


def test_accessors_without_data_are_zeros_with_sparse_values_on_top(tmp_path: Path) -> None:
    builder = arm()
    primitive = builder.description["meshes"][0]["primitives"][0]
    attributes = primitive["attributes"]
    target = _zeros(builder, attributes["POSITION"])
    builder.description["accessors"][target]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": builder.view(np.array([1, 5], "u2")), "componentType": 5123},
        "values": {"bufferView": builder.view(np.array([[0, 0.5, 0], [0.25, 0, 0]], "f4"))},
    }
    primitive["targets"] = [{"POSITION": target}]
    builder.description["meshes"][0]["weights"] = [1.0]
    attributes["JOINTS_0"] = _zeros(builder, attributes["JOINTS_0"])
    samplers = builder.description["animations"][0]["samplers"]
    samplers[1]["output"] = _zeros(builder, samplers[1]["output"])
    scene = read_scene(builder.write(tmp_path / "m.glb"))
    (part,) = scene.parts
    assert np.array_equal(np.flatnonzero(part.morphs[0].any(axis=1)), [1, 5])
    assert part.morphs[0, 5].tolist() == [0.25, 0.0, 0.0]
    assert not part.bone_of.any()
    # The root's translation stays at the origin throughout the clip.
    assert not scene.clips[0].sample(np.array([0.0, 0.7])).transforms[:, 0, :3, 3].any()


def test_zeros_as_weights_leave_vertices_to_the_first_joint(tmp_path: Path) -> None:
    builder = arm()
    attributes = builder.description["meshes"][0]["primitives"][0]["attributes"]
    first = builder.description["accessors"][attributes["JOINTS_0"]]
    attributes["WEIGHTS_0"] = _zeros(builder, attributes["WEIGHTS_0"])
    (part,) = read_scene(builder.write(tmp_path / "m.glb")).parts
    assert len(part.points) == first["count"]
    assert not part.bone_of.any()
    assert part.weights.sum() == len(part.points)


def test_a_primitive_without_vertices_shows_nothing(tmp_path: Path) -> None:
    builder = arm()
    nothing = {"componentType": 5126, "count": 0, "type": "VEC3"}
    primitives = builder.description["meshes"][0]["primitives"]
    primitives.append({"attributes": {"POSITION": builder.add("accessors", **nothing)}})
    character = read_character(builder.write(tmp_path / "m.glb"))
    assert "1 part without triangles (points, lines) was left out" in character.notes
    posed = write_character(tmp_path / "posed.glb", character, character.rest_vertices, "morph")
    assert np.allclose(read_mesh(tmp_path / "posed.glb").vertices, posed.vertices, atol=1e-6)


def test_clips_are_read_when_they_are_asked_for(tmp_path: Path) -> None:
    builder = arm()
    channel = {"node": 1, "path": "translation", "values": np.zeros((3, 3))}
    builder.animation("back", channel | {"times": [0.0, 2.0, 1.0]})
    builder.animation("cut", channel | {"times": [0.0, 1.0, 2.0]})
    builder.description["accessors"][-1]["count"] = 1000
    path = builder.write(tmp_path / "m.glb")
    assert read_mesh(path).topology.n_faces == len(tube()[1])
    wave, back, cut = read_scene(path).clips
    assert wave.sample(np.array([0.5])).transforms.shape == (1, 5, 4, 4)
    with pytest.raises(MeshFileError, match="times of animation 'back' must be finite and asc"):
        assert len(back.key_times)
    with pytest.raises(MeshFileError, match="values of animation 'cut' have 1000 values, 3 are"):
        cut.sample(np.array([0.5]))
    with pytest.raises(MeshFileError, match=r"m\.glb cannot be read: the times of .*'back' must"):
        read_pose_set(path)
    character = read_character(path)
    assert list(character.clips) == ["wave", "cut"]
    said = "its clip 'back' is left out: the times of animation 'back' must be"
    assert character.notes[-1].startswith(said)
    assert RigBody.of(character).space.frame_codes.any()
    with pytest.raises(MeshFileError, match=r"m\.glb cannot be read: .* values of .*'cut' have"):
        character.sample("cut", None)


def test_a_null_says_nothing_and_other_kinds_of_values_are_refused(tmp_path: Path) -> None:
    builder = arm()
    builder.description["nodes"][0] |= {"mesh": None, "weights": None, "extras": {"id": None}}
    path = builder.write(tmp_path / "m.gltf")
    assert len(read_scene(path).parts) == 1
    for kind, wrong, said in (
        ("nodes", [{}, 7], "nodes must be a list of objects"),
        (
            "skins",
            [{"joints": [0.5]}],
            "joints of skins 0 must be a list of whole numbers",
        ),
        ("meshes", [{"primitives": [{"attributes": []}]}], "must be an object, got []"),
        ("scenes", {}, "scenes must be a list of objects, got {}"),
        ("nodes", [None], "must be a list of objects, got [None]"),
    ):
        path.write_text(json.dumps(builder.description | {kind: wrong}))
        with pytest.raises(MeshFileError, match=re.escape(said)):
            read_scene(path)


@pytest.mark.parametrize("name", ["mannequin-moves.glb", "xbot-moves.glb"])
def test_frames_of_real_characters_agree_with_vtk(name: str, characters: Path) -> None:
    for clip, time in ((None, 0.0), (0, 0.0), (0, 1.0), (0, 2.05), (0, 89 / 30)):
        assert _difference_from_vtk(characters / name, clip, time) < 1e-5


def test_faces_whose_corners_lie_in_a_line_are_left_out(tmp_path: Path) -> None:
    builder = arm(split=False)
    primitive = builder.description["meshes"][0]["primitives"][0]
    vertices, faces = tube()
    # Across the bottom through its middle, plus a face that is not part of the tube.
    more = np.concatenate([faces, [[len(vertices) - 2, 0, 3], [0, 8, 16]]])
    primitive["indices"] = builder.array(more.reshape(-1), "u2")
    joined = _joined(builder.write(tmp_path / "m.glb"))
    assert joined.topology.n_faces == len(faces) + 1
    assert joined.notes == ("1 face without area was left out",)


def test_equal_weights_in_another_order_are_equal(tmp_path: Path) -> None:
    builder = GltfBuilder()
    vertices, faces = split_corners(*tube())
    generator = np.random.default_rng(4)
    joints, weights = [], []
    share = np.array([23, 51, 77, 94])
    for _ in vertices:
        order = generator.permutation(4)
        joints.append(order)
        weights.append(share[order])
    attributes = {
        "POSITION": builder.array(vertices),
        "JOINTS_0": builder.array(joints, "u1"),
        "WEIGHTS_0": builder.array(weights, "u1", normalized=True),
    }
    indices = builder.array(faces.reshape(-1), "u4")
    mesh = builder.add("meshes", primitives=[{"attributes": attributes, "indices": indices}])
    builder.add("nodes", mesh=mesh, skin=0)
    bones = [builder.add("nodes", translation=[0.1 * n, 0.0, 0.0]) for n in range(4)]
    builder.add("skins", joints=bones)
    assert _joined(builder.write(tmp_path / "m.glb")).topology.n_vertices == len(tube()[0])
