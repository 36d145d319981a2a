"""glTF 2.0, as .glb, .gltf or .vrm."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.formats.gltf_document import GltfDocument
from lcollision_core.meshes.formats.gltf_scene import read_shown
from lcollision_core.meshes.formats.polygons import read_rest
from lcollision_core.meshes.formats.scene import Scene


def read_scene(file: BinaryIO, path: Path) -> Scene:
    """Read what the file shows.

    Parameters
    ----------
    file : open binary file at its start
    path : where it is; a .gltf may name buffer files beside it

    Raises
    ------
    MeshFileError : the file is damaged or compressed, or shows no triangles.
    """
    return read_shown(GltfDocument(read_rest(file), path))


def has_skin(file: BinaryIO, path: Path) -> bool:
    """Whether a node of the file shows a mesh that a skin moves; for the rest as `read_scene`."""
    nodes = GltfDocument(read_rest(file), path).objects("nodes")
    return any("skin" in node and "mesh" in node for node in nodes)


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32]) -> bytes:
    """Write triangles as GLB, float32, with smooth normals.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array; glTF keeps float32 only
    faces : (F, 3) int32 array, indices from 0
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    return bytes(trimesh.Scene(mesh).export(file_type="glb", include_normals=True))
