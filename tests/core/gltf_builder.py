"""Builds small glTF files, valid or not, from arrays."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

_CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class GltfBuilder:
    """Collects the description and the binary part of a file."""

    def __init__(self) -> None:
        self.blob = b""
        self.description: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "meshes": [],
            "nodes": [],
        }

    def add(self, kind: str, **values: Any) -> int:
        """Append an object to a list of the description and return its index."""
        self.description.setdefault(kind, []).append(values)
        return len(self.description[kind]) - 1

    def view(self, array: np.ndarray, **extras: Any) -> int:
        """Store the bytes of an array."""
        self.blob += b"\0" * (-len(self.blob) % 4)
        data = np.ascontiguousarray(array).tobytes()
        start = len(self.blob)
        self.blob += data
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data), **extras)

    def array(self, values: Any, dtype: str = "f4", **extras: Any) -> int:
        """Store an (n,) or (n, k) array and return its accessor."""
        array = np.asarray(values, dtype=f"<{dtype}")
        rows = array.reshape(len(array), -1)
        extras = {"bufferView": self.view(rows)} | extras
        if dtype == "f4" and rows.shape[1] == 3 and len(rows):
            extras |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        if dtype == "f4" and rows.shape[1] == 1 and len(rows):
            extras |= {"min": [float(rows.min())], "max": [float(rows.max())]}
        return self.add(
            "accessors",
            componentType=_CODES[dtype],
            count=len(rows),
            type=_TYPES[rows.shape[1]],
            **extras,
        )

    def matrices(self, values: np.ndarray) -> int:
        """Store (n, 4, 4) matrices in column-major order."""
        return self.array(np.asarray(values).transpose(0, 2, 1).reshape(-1, 16))

    def animation(self, name: str, *channels: dict[str, Any]) -> None:
        """Add an animation with channels of node, path, times, values and maybe interpolation."""
        samplers = [
            {
                "input": self.array(channel["times"]),
                "output": self.array(channel["values"]),
                "interpolation": channel.get("interpolation", "LINEAR"),
            }
            for channel in channels
        ]
        targets = [
            {"sampler": i, "target": {"node": channel["node"], "path": channel["path"]}}
            for i, channel in enumerate(channels)
        ]
        self.add("animations", name=name, samplers=samplers, channels=targets)

    def write(self, path: Path) -> Path:
        """Write a .glb, or a .gltf with embedded data."""
        described = self.description | {"buffers": [{"byteLength": len(self.blob)}]}
        if "scenes" not in described:
            children = {c for node in described["nodes"] for c in node.get("children", ())}
            roots = [i for i in range(len(described["nodes"])) if i not in children]
            described |= {"scene": 0, "scenes": [{"nodes": roots}]}
        if path.suffix == ".gltf":
            encoded = base64.b64encode(self.blob).decode()
            described["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{encoded}"
            path.write_text(json.dumps(described))
            return path
        text = json.dumps(described).encode()
        text += b" " * (-len(text) % 4)
        chunks = b"".join(
            len(data).to_bytes(4, "little") + kind + data
            for kind, data in (
                (b"JSON", text),
                (b"BIN\0", self.blob + b"\0" * (-len(self.blob) % 4)),
            )
        )
        header = b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little")
        path.write_bytes(header + chunks)
        return path


def tube(n_rings: int = 7, n_sides: int = 6, height: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the (V, 3) vertices and (F, 3) faces of a closed tube along y, oriented outwards."""
    angle = 2.0 * np.pi * np.arange(n_sides) / n_sides
    rings = [
        np.stack([np.sin(angle) * 0.4, np.full(n_sides, y), np.cos(angle) * 0.4], axis=1)
        for y in np.linspace(0.0, height, n_rings)
    ]
    vertices = np.concatenate([*rings, [[0.0, 0.0, 0.0], [0.0, height, 0.0]]])
    faces = []
    side = np.arange(n_sides)
    after = (side + 1) % n_sides
    for ring in range(n_rings - 1):
        low, high = ring * n_sides, (ring + 1) * n_sides
        faces += [[low + a, low + b, high + b] for a, b in zip(side, after, strict=True)]
        faces += [[low + a, high + b, high + a] for a, b in zip(side, after, strict=True)]
    bottom, top = n_rings * n_sides, n_rings * n_sides + 1
    faces += [[bottom, b, a] for a, b in zip(side, after, strict=True)]
    last = (n_rings - 1) * n_sides
    faces += [[top, last + a, last + b] for a, b in zip(side, after, strict=True)]
    return vertices.astype(np.float32), np.array(faces)


def split_corners(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give every triangle its own vertices."""
    return vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)


def rotation(axis: int, angle: float) -> list[float]:
    """Return the quaternion (x, y, z, w) of a rotation about an axis."""
    result = [0.0, 0.0, 0.0, float(np.cos(angle / 2.0))]
    result[axis] = float(np.sin(angle / 2.0))
    return result


def moved(*offset: float) -> np.ndarray:
    """Return a (4, 4) translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def arm(split: bool = True, n_influences: int = 4) -> GltfBuilder:
    """Build a tube of three joints, LeftArm, LeftForeArm and LeftHand, with the clip "wave".

    Its vertices are split at every edge, its bind pose is straight, its rest pose is bent.
    """
    builder = GltfBuilder()
    vertices, faces = tube()
    if split:
        vertices, faces = split_corners(vertices, faces)
    joints = np.zeros((len(vertices), n_influences), dtype=int)
    weights = np.zeros((len(vertices), n_influences))
    share = np.clip(vertices[:, 1] - 0.5, 0.0, 2.0)
    low = np.minimum(share.astype(int), 1)
    joints[:, 0], joints[:, 1] = low, low + 1
    weights[:, 0], weights[:, 1] = 1.0 - (share - low), share - low
    attributes = {"POSITION": builder.array(vertices)}
    for first in range(0, n_influences, 4):
        columns = slice(first, first + 4)
        attributes[f"JOINTS_{first // 4}"] = builder.array(joints[:, columns], "u1")
        attributes[f"WEIGHTS_{first // 4}"] = builder.array(weights[:, columns])
    indices = builder.array(faces.reshape(-1), "u2")
    material = builder.add("materials", name="Skin")
    mesh = builder.add(
        "meshes",
        name="Arm",
        primitives=[{"attributes": attributes, "indices": indices, "material": material}],
    )
    bind = np.stack([moved(0.0, -y, 0.0) for y in (0.5, 1.5, 2.5)])
    builder.add("nodes", name="Rig", children=[1, 4], translation=[0.5, 0.0, -1.0])
    builder.add("nodes", name="rig:LeftArm", children=[2], translation=[0.0, 0.5, 0.0])
    builder.add(
        "nodes",
        name="rig:LeftForeArm",
        children=[3],
        translation=[0.0, 1.0, 0.0],
        rotation=rotation(2, 0.3),
    )
    builder.add("nodes", name="rig:LeftHand", translation=[0.0, 1.0, 0.0])
    builder.add("nodes", name="Body", mesh=mesh, skin=0)
    builder.add("skins", joints=[1, 2, 3], inverseBindMatrices=builder.matrices(bind))
    times = [0.0, 0.4, 1.0]
    builder.animation(
        "wave",
        {
            "node": 2,
            "path": "rotation",
            "times": times,
            "values": [rotation(0, 0.0), rotation(0, 1.2), rotation(0, -0.5)],
        },
        {
            "node": 0,
            "path": "translation",
            "times": times,
            "values": [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]],
        },
    )
    return builder
