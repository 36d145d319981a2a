"""A cube of two joints whose faces have their own vertices, for tests of appearance."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image

from tests.core.gltf_builder import GltfBuilder, moved

RED, GREEN, BLUE, YELLOW = (230, 20, 20), (20, 200, 20), (20, 20, 230), (230, 210, 20)

_SIDES = ((2, 1.0), (2, -1.0), (0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0))
"""Axis and sign of each face's normal; the first is the front."""


def cube() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (24, 3) vertices from -1 to 1, (12, 3) faces outwards, and their (24, 2) UVs.

    On each face, the UVs run from the upper left corner, seen from outside, to the lower
    right one.
    """
    vertices, faces = [], []
    for number, (axis, sign) in enumerate(_SIDES):
        up = np.eye(3)[1] if axis != 1 else -sign * np.eye(3)[2]
        normal = sign * np.eye(3)[axis]
        right = np.cross(up, normal)
        vertices += [normal + y * up + x * right for y in (1.0, -1.0) for x in (-1.0, 1.0)]
        faces += [[4 * number + corner for corner in face] for face in ((0, 2, 1), (1, 2, 3))]
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], (6, 1))
    return np.array(vertices), np.array(faces), uv


def png(pixels: Any, kind: str = "PNG", **options: Any) -> bytes:
    """Return the bytes of an image file of (H, W, 3) or (H, W, 4) pixels."""
    out = io.BytesIO()
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(out, format=kind, **options)
    return out.getvalue()


def textured_cube(
    material: dict[str, Any] | None = None,
    builder: GltfBuilder | None = None,
    **attributes: int,
) -> GltfBuilder:
    """Build the cube; its upper vertices follow the joint "Head", the others "Hips".

    Parameters
    ----------
    material : of the file; None for none
    builder : contains what the material and the attributes refer to; None for a new one
    attributes : accessors by name, as TEXCOORD_1=3
    """
    builder = GltfBuilder() if builder is None else builder
    vertices, faces, uv = cube()
    joints = np.zeros((24, 4), dtype=int)
    joints[:, 0] = vertices[:, 1] > 0.0
    weights = np.tile([1.0, 0.0, 0.0, 0.0], (24, 1))
    primitive: dict[str, Any] = {
        "attributes": {
            "POSITION": builder.array(vertices),
            "TEXCOORD_0": builder.array(uv),
            "JOINTS_0": builder.array(joints, "u1"),
            "WEIGHTS_0": builder.array(weights),
            **attributes,
        },
        "indices": builder.array(faces.reshape(-1), "u2"),
    }
    if material is not None:
        primitive["material"] = builder.add("materials", **material)
    mesh = builder.add("meshes", name="Cube", primitives=[primitive])
    builder.add("nodes", name="Hips", children=[1])
    builder.add("nodes", name="Head")
    builder.add("nodes", name="Body", mesh=mesh, skin=0)
    bind = builder.matrices(np.stack([moved(0.0, 0.0, 0.0)] * 2))
    builder.add("skins", joints=[0, 1], inverseBindMatrices=bind)
    return builder


def add_texture(builder: GltfBuilder, image: bytes, sampler: dict[str, int] | None = None) -> int:
    """Add an embedded image, and return its texture."""
    view = builder.view(np.frombuffer(image, dtype=np.uint8))
    texture = {"source": builder.add("images", bufferView=view, mimeType="image/png")}
    if sampler is not None:
        texture["sampler"] = builder.add("samplers", **sampler)
    return builder.add("textures", **texture)


def coloured(**base: Any) -> dict[str, Any]:
    """Return an unlit material with a base colour."""
    extensions: dict[str, Any] = {"KHR_materials_unlit": {}}
    return {"name": "Skin", "pbrMetallicRoughness": base, "extensions": extensions}
