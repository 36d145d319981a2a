"""glTF 2.0, as .glb or .gltf, through trimesh."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import parse_json, quoted
from lcollision_core.meshes.formats.polygons import (
    MAX_FILE_BYTES,
    Polygons,
    read_rest,
    require_plausible_count,
    with_order_of,
)
from lcollision_core.meshes.topology import Topology
from lcollision_core.regular_files import read_regular

_GLB_MAGIC = b"glTF"
_REORDERED = "vertices that had been split were put back into the set's vertex order"


def read(file: BinaryIO, path: Path, topology: Topology | None = None) -> Polygons:
    """Read the one triangle mesh of a scene, placed by its node.

    Parameters
    ----------
    file : open binary file at its start
    path : where it is; a .gltf may name a buffer file beside it
    topology : the connectivity that the triangles are expected to have, in its order of faces;
        programs that split vertices, for normals or texture coordinates, are undone by it

    Returns
    -------
    the triangles, vertices in the file's order, or the topology's

    Raises
    ------
    MeshFileError : the file is damaged, or holds no mesh or several.
    """
    import trimesh
    from trimesh.resolvers import FilePathResolver

    class BuffersBeside(FilePathResolver):  # type: ignore[misc]
        """Reads regular files in the scene's own folder."""

        def get(self, name: str) -> bytes:
            try:
                return read_regular(self.absolute(name), MAX_FILE_BYTES)
            except (OSError, ValueError) as error:
                reason = getattr(error, "strerror", None) or "it is not beside the file"
                raise MeshFileError.unreadable(f"its buffer {quoted(name)}", reason) from error

    # Before a mark trimesh would look for its text elsewhere.
    data = read_rest(file).removeprefix(b"\xef\xbb\xbf")
    _require_one_mesh(data)
    file_type = "glb" if data.startswith(_GLB_MAGIC) else "gltf"
    try:
        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(
                BytesIO(data),
                file_type=file_type,
                resolver=BuffersBeside(path),
                process=False,
                skip_materials=True,
            )
            shown = [scene.graph[node] for node in scene.graph.nodes_geometry]
            meshes = [(transform, scene.geometry[name]) for transform, name in shown]
    except MeshFileError:
        raise
    # On a damaged file trimesh raises whatever its line at hand raises; nothing of ours runs here.
    except Exception as error:
        raise MeshFileError("it is a damaged or unsupported glTF file") from error
    if len(meshes) != 1 or not isinstance(meshes[0][1], trimesh.Trimesh):
        raise MeshFileError(f"it shows {len(meshes)} meshes, one of triangles is needed")
    transform, mesh = meshes[0]
    vertices = np.array(mesh.vertices, dtype=np.float64)
    # A node may move float32 vertices far away, where the product keeps their digits.
    is_placed = not np.array_equal(transform, np.eye(4))
    if is_placed:
        # A coordinate that is not finite is refused with all others.
        with np.errstate(all="ignore"):
            vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
    faces = np.array(mesh.faces, dtype=np.int64)
    in_range = faces.size and faces.min() >= 0 and faces.max() < len(vertices)
    if in_range and topology is not None and len(vertices) != topology.n_vertices:
        joined = with_order_of(vertices[faces.reshape(-1)], topology, _REORDERED, not is_placed)
        if joined is not None:
            return joined
    return Polygons.triangles(vertices, faces, is_single=not is_placed)


def _require_one_mesh(data: bytes) -> None:
    """Look at the description alone, before trimesh takes memory for what it announces."""
    text = data
    if data.startswith(_GLB_MAGIC):
        length = int.from_bytes(data[12:16], "little")
        text = data[20 : 20 + length]
        if len(text) < max(length, 1):
            raise MeshFileError("it is a truncated GLB file")
    try:
        scene = parse_json(text)
        counts = [int(accessor.get("count", 0)) for accessor in scene.get("accessors", [])]
        n_primitives = sum(len(mesh["primitives"]) for mesh in scene.get("meshes", []))
    except (
        ValueError,
        OverflowError,
        AttributeError,
        TypeError,
        KeyError,
    ) as error:
        raise MeshFileError("it holds no readable glTF description") from error
    for count in counts:
        # An accessor of indices counts corners, three a face.
        require_plausible_count(-(-count // 3), "faces")
    if n_primitives != 1:
        raise MeshFileError(f"it holds {n_primitives} meshes or parts, one is needed", "export one")


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
