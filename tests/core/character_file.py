"""A small character's file with everything that exports must keep."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.core.gltf_builder import GltfBuilder, rotation, split_corners, tube


def _picture() -> bytes:
    file = BytesIO()
    Image.new("RGB", (2, 2), "red").save(file, "png")
    return file.getvalue()


PNG = _picture()


def figure() -> GltfBuilder:
    """Build a skinned tube with seams, one of two parts inside it, a hat, a camera and textures.

    As in Mixamo's characters from Blender, meshes and joints hang on an armature of scale 0.01.
    """
    builder = GltfBuilder()
    builder.view(np.arange(5, dtype=np.uint8))
    vertices, faces = split_corners(*tube())
    inner, inner_faces = tube(n_rings=4)
    inner = inner * np.array([0.5, 1.0, 0.5], dtype=np.float32)
    image = builder.add("images", bufferView=builder.view(np.frombuffer(PNG, np.uint8)))
    builder.description["images"][image]["mimeType"] = "image/png"
    builder.add("textures", source=image)
    skin = builder.add(
        "materials",
        name="Häut",
        pbrMetallicRoughness={"baseColorTexture": {"index": 0}},
        extensions={"KHR_materials_unlit": {}},
        extras={"author": [1, 2.5, None]},
    )
    meshes = [
        builder.add("meshes", name="Body", primitives=[_primitive(builder, vertices, faces, skin)]),
        builder.add(
            "meshes",
            name="Core",
            primitives=[
                _primitive(builder, inner, inner_faces[:20], skin),
                _primitive(builder, inner, inner_faces[20:], skin),
            ],
        ),
    ]
    hat, hat_faces = tube(n_rings=2, height=0.3)
    hat_mesh = builder.add(
        "meshes",
        name="Hat",
        primitives=[
            {
                "attributes": {
                    "POSITION": builder.array(hat),
                    "NORMAL": builder.array(outward_normals(hat)),
                },
                "indices": builder.array(hat_faces.reshape(-1), "u2"),
            }
        ],
    )
    builder.add("nodes", name="Armature", children=[1, 4, 5], scale=[0.01] * 3)
    builder.description["nodes"][0]["rotation"] = rotation(0, np.pi / 2)
    # In the armature's coordinates, the tube extends along -z.
    builder.add("nodes", name="LeftArm", children=[2], translation=[0.0, 0.0, -50.0])
    builder.add(
        "nodes",
        name="LeftForeArm",
        children=[3],
        translation=[0.0, 0.0, -100.0],
        rotation=rotation(1, 0.0),
        extras={"kept": True},
    )
    builder.add("nodes", name="LeftHand", children=[6], translation=[0.0, 0.0, -100.0])
    builder.add("nodes", name="Body", mesh=meshes[0], skin=0, extras={"a": 1})
    builder.add("nodes", name="Core", mesh=meshes[1], skin=0)
    builder.add("nodes", name="Hat", mesh=hat_mesh, scale=[80.0, 80.0, 120.0])
    builder.description["nodes"][6]["translation"] = [0.0, 20.0, -30.0]
    builder.add("nodes", name="Camera", camera=builder.add("cameras", type="perspective"))
    builder.description["cameras"][0]["perspective"] = {"yfov": 1.0, "znear": 0.1}
    bind = []
    for height in (0.5, 1.5, 2.5):
        place = np.eye(4)
        place[:3, :3] = [[0.01, 0, 0], [0, 0, -0.01], [0, 0.01, 0]]
        place[:3, 3] = [0.0, height, 0.0]
        bind.append(np.linalg.inv(place))
    builder.add("skins", joints=[1, 2, 3], inverseBindMatrices=builder.matrices(np.array(bind)))
    times = [0.0, 1.0]
    turns = [rotation(0, 0.0), rotation(0, 1.0)]
    builder.animation("wave", {"node": 2, "path": "rotation", "times": times, "values": turns})
    shifts = [[0.0] * 3, [1.0] * 3]
    builder.animation("walk", {"node": 0, "path": "translation", "times": times, "values": shifts})
    builder.animation("orbit", {"node": 7, "path": "rotation", "times": times, "values": turns})
    builder.description["extensionsUsed"] = ["KHR_materials_unlit"]
    builder.description["extensions"] = {"OTHER_unknown": {"humanoid": [1, 2, 3]}}
    return builder


def outward_normals(vertices: np.ndarray) -> np.ndarray:
    radial = vertices * [1.0, 0.0, 1.0] + [0.0, 1e-3, 0.0]
    return radial / np.linalg.norm(radial, axis=1, keepdims=True)


def _primitive(
    builder: GltfBuilder, vertices: np.ndarray, faces: np.ndarray, material: int
) -> dict[str, Any]:
    share = np.clip(vertices[:, 1] - 0.5, 0.0, 2.0)
    low = np.minimum(share.astype(int), 1)
    joints, weights = np.zeros((len(vertices), 4), int), np.zeros((len(vertices), 4))
    joints[:, 0], joints[:, 1] = low, low + 1
    weights[:, 0], weights[:, 1] = 1.0 - (share - low), share - low
    attributes = {
        "POSITION": builder.array(vertices),
        "NORMAL": builder.array(outward_normals(vertices)),
        "TANGENT": builder.array(np.tile([1.0, 0.0, 0.0, 1.0], (len(vertices), 1))),
        "TEXCOORD_0": builder.array(np.random.default_rng(0).random((len(vertices), 2))),
        "JOINTS_0": builder.array(joints, "u1"),
        "WEIGHTS_0": builder.array(weights),
    }
    indices = builder.array(faces.reshape(-1), "u2")
    return {"attributes": attributes, "indices": indices, "material": material}


def described(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length]), data[20 + length + 8 :]


def array(path: Path, accessor: int) -> bytes:
    description, binary = described(path)
    view = description["bufferViews"][description["accessors"][accessor]["bufferView"]]
    return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def vectors(path: Path, accessor: int) -> np.ndarray:
    return np.frombuffer(array(path, accessor), "<f4").reshape(-1, 3).astype(float)
