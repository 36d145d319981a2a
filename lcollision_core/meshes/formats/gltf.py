"""Meshes as glTF 2.0 in its binary form, .glb."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


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
