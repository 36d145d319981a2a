"""The transforms of a glTF file's nodes, as it stores them."""

from __future__ import annotations

from typing import Any

from lcollision_core.meshes.formats.gltf_document import numbers
from lcollision_core.meshes.formats.transforms import compose, decompose
from lcollision_core.meshes.topology import FloatArray

PARTS: dict[str, tuple[float, ...]] = {
    "translation": (0.0, 0.0, 0.0),
    "rotation": (0.0, 0.0, 0.0, 1.0),
    "scale": (1.0, 1.0, 1.0),
}
"""What the transform of a node consists of, and each where the file does not say it."""


def stored_parts(
    node: dict[str, Any], where: str = "a node"
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the translation, rotation (x, y, z, w) and scale of a node of a file.

    Raises
    ------
    MeshFileError : one of them is damaged; `where` says what the node is called.
    """
    if "matrix" in node:
        return decompose(local_transform(node, where))
    moved, turned, scaled = (
        numbers(node.get(name, default), f"the {name} of {where}", len(default))
        for name, default in PARTS.items()
    )
    return moved, turned, scaled


def local_transform(node: dict[str, Any], where: str = "a node") -> FloatArray:
    """Return the (4, 4) local transform of a node of a file; it raises as `stored_parts` does."""
    if "matrix" not in node:
        return compose(*stored_parts(node, where))
    # Column by column.
    matrix = numbers(node["matrix"], f"the matrix of {where}", 16).reshape(4, 4).T
    matrix[3] = 0.0, 0.0, 0.0, 1.0
    return matrix
