"""The formats of single meshes that are written: a line here, and a module of `files.mesh`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshFormat:
    """What the files of a format hold.

    Attributes
    ----------
    is_single : float32 coordinates only; the others hold either precision
    is_offered : whether the editor offers it
    module : in `files`, where it is not called as the format, in `files.mesh`
    """

    is_single: bool = False
    is_offered: bool = True
    module: str = ""


MESH_FORMATS = {
    "obj": MeshFormat(),
    "ply": MeshFormat(),
    "off": MeshFormat(is_offered=False),
    "stl": MeshFormat(is_single=True),
    "glb": MeshFormat(is_single=True, module="gltf.write"),
}
