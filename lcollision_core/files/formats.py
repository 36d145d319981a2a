"""The file formats by extension: their content, reader, writer and label.

It is the only such list: to add a format, add an entry to `FILES`, and a module with the functions
that it names. The motions of skeletons are read in `bodies/retargeting.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Flag, auto
from importlib import import_module
from pathlib import Path
from typing import Any


class Holds(Flag):
    """Possible content of files with an extension."""

    MESH = auto()
    """Triangles, read by `read_mesh`."""
    SCENE = auto()
    """Nodes, skins and clips, read by `read_scene`."""
    GLTF = auto()
    """A scene as glTF, which exports keep except for what a pose changes."""
    POINTS = auto()
    """The vertices of a mesh, frame by frame, without its faces."""
    SKELETON = auto()
    """Joints in motion, without a mesh."""
    SMPL = auto()
    """A body model of the SMPL family, or its motion."""
    POSE_SET = auto()
    """Poses of one body as arrays."""
    POSES = auto()
    """Named poses of a body, as codes."""
    MODEL = auto()
    """A learned model."""
    PRINT = auto()
    """A solid for 3D printing, in millimetres."""


@dataclass(frozen=True)
class FileKind:
    """One entry of the table.

    Attributes
    ----------
    label : name of the format for users
    holds : possible content of its files
    reader, writer : "module:function" of `lcollision_core`; empty if there is none
    is_single : whether its meshes store float32 coordinates only; others store either precision
    is_offered : whether the editor offers to write it
    keeps_order : whether its meshes keep the vertices of the program that wrote them, unsplit
    """

    label: str
    holds: Holds
    reader: str = ""
    writer: str = ""
    is_single: bool = False
    is_offered: bool = True
    keeps_order: bool = False


_GLTF = Holds.MESH | Holds.SCENE | Holds.GLTF
_READ_GLTF = "files.gltf.schema:GltfDocument"
_CACHE = ("files.motion.caches:read_point_cache", "files.motion.caches:write_point_cache")

FILES = {
    ".obj": FileKind(
        "OBJ", Holds.MESH, "files.mesh.obj:read", "files.mesh.obj:encode", keeps_order=True
    ),
    ".ply": FileKind(
        "PLY", Holds.MESH, "files.mesh.ply:read", "files.mesh.ply:encode", keeps_order=True
    ),
    ".off": FileKind(
        *("OFF", Holds.MESH, "files.mesh.off:read", "files.mesh.off:encode"),
        is_offered=False,
        keeps_order=True,
    ),
    ".stl": FileKind(
        "STL",
        Holds.MESH | Holds.PRINT,
        "files.mesh.stl:read",
        "files.mesh.stl:encode",
        is_single=True,
    ),
    ".3mf": FileKind("3MF", Holds.PRINT, writer="files.mesh.threemf:encode"),
    ".glb": FileKind("GLB", _GLTF, _READ_GLTF, "files.gltf.write:encode", is_single=True),
    ".gltf": FileKind("glTF", _GLTF, _READ_GLTF, is_single=True),
    ".vrm": FileKind("VRM", _GLTF, _READ_GLTF, is_single=True),
    ".fbx": FileKind("FBX", Holds.MESH | Holds.SCENE, "files.scene.fbx:FbxDocument"),
    ".pc2": FileKind("PC2", Holds.POINTS, *_CACHE, is_single=True),
    ".mdd": FileKind("MDD", Holds.POINTS, *_CACHE, is_single=True),
    ".bvh": FileKind(
        "BVH", Holds.SKELETON, "files.motion.bvh:read_bvh", "files.motion.bvh:bvh_bytes"
    ),
    ".vrma": FileKind(
        "VRMA", Holds.SKELETON, "files.motion.vrma:read_vrma", "files.motion.vrma:vrma_bytes"
    ),
    ".npz": FileKind(
        *("NumPy arrays", Holds.SMPL | Holds.POSE_SET),
        *("files.pose_set_reading:read_pose_set", "files.pose_set:write_pose_set"),
    ),
    ".json": FileKind("Poses", Holds.POSES, "bodies:read_poses", "bodies:write_poses"),
    ".safetensors": FileKind(
        "Model", Holds.MODEL, "model_file:read_model_file", "model_file:write_model_file"
    ),
}


def suffixes_of(holds: Holds, *, written: bool = False) -> tuple[str, ...]:
    """Return the lower-case extensions with any of this content; if `written`, with a writer."""
    return tuple(
        suffix
        for suffix, kind in FILES.items()
        if kind.holds & holds and (not written or kind.writer)
    )


def function_of(name: str) -> Any:
    """Import a reader or writer by its name in the table."""
    module, function = name.split(":")
    return getattr(import_module(f"lcollision_core.{module}"), function)


READABLE_SUFFIXES = suffixes_of(Holds.MESH)
"""Files that `read_mesh` reads."""

WRITABLE_SUFFIXES = suffixes_of(Holds.MESH, written=True)
"""Files that `write_mesh` writes."""

PRINT_SUFFIXES = suffixes_of(Holds.PRINT, written=True)
"""Files that `print_pose` writes."""

SCENE_SUFFIXES = suffixes_of(Holds.SCENE)
"""Files that `read_scene` reads, and that exports write with a pose, FBX as GLB."""

GLTF_SUFFIXES = suffixes_of(Holds.GLTF)
POINT_CACHE_SUFFIXES = suffixes_of(Holds.POINTS)
SKELETON_SUFFIXES = suffixes_of(Holds.SKELETON)
CHARACTER_SUFFIXES = suffixes_of(Holds.SCENE | Holds.SMPL)

ANIMATED_SUFFIXES = suffixes_of(Holds.SCENE | Holds.POINTS)
"""Files that `read_animated` reads."""

MOTION_SUFFIXES = suffixes_of(Holds.SCENE | Holds.POINTS | Holds.SKELETON | Holds.SMPL)

OWN_SUFFIXES = (".bvh", ".npz")
"""Files of one motion that can be written with the motion changed and all else kept."""

LEARNED_FROM = suffixes_of(Holds.POINTS | Holds.POSE_SET)
"""Files with poses of one body, not to open but to learn a model from."""

(SMPL_SUFFIX,) = suffixes_of(Holds.SMPL)
(POSES_SUFFIX,) = suffixes_of(Holds.POSES)
(MODEL_SUFFIX,) = suffixes_of(Holds.MODEL)
BVH_SUFFIX, VRMA_SUFFIX = ".bvh", ".vrma"


def is_model(source: str | Path) -> bool:
    """Whether a source names a learned model: by its file, or by its name alone."""
    return Path(source).suffix.lower() in ("", MODEL_SUFFIX)
