"""Where commands put latent poses and meshes: the output's form decides."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcollision_core.errors import LCollisionError, MeshFileError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from lcollision_core.model import NamedPose, PoseModel


_MAX_FILE_NAME = 100


class MeshFormat(StrEnum):
    """The formats that a folder of meshes may have."""

    OBJ = "obj"
    PLY = "ply"
    OFF = "off"
    STL = "stl"
    GLB = "glb"


def require_output(path: Path, suffix: str) -> None:
    """Refuse an output before the work for it is done.

    Raises
    ------
    LCollisionError : another extension, or the file could not be written.
    """
    from lcollision_core.meshes import require_writable

    if path.suffix.lower() != suffix:
        raise LCollisionError(f"{path} cannot be written: it must be a {suffix} file; rename it")
    require_writable(path)


def write_result(
    output: Path,
    model: PoseModel,
    poses: Sequence[NamedPose],
    mesh_format: MeshFormat,
    vertices: Sequence[npt.NDArray[Any] | None] | None = None,
) -> None:
    """Write poses as a .json file, one pose as a mesh, or each as a mesh of a folder.

    Parameters
    ----------
    output : its extension decides; without one that is known it is a folder, which is made
    model : of the poses
    poses : a pose with a placement returns to it
    mesh_format : of the meshes in a folder
    vertices : of each pose, (V, 3) to write in the place of what it decodes to, or None

    Raises
    ------
    LCollisionError : several poses and one mesh file, an unknown extension, or a file or folder
        cannot be written.
    """
    from lcollision_core.meshes import WRITABLE_SUFFIXES, require_writable, write_mesh
    from lcollision_core.model import write_poses

    suffix = output.suffix.lower()
    if suffix == ".json":
        write_poses(output, model, poses)
        return
    if suffix in WRITABLE_SUFFIXES:
        if len(poses) != 1:
            raise LCollisionError(
                f"{output} is one mesh, but there are {len(poses)} poses; name a folder"
            )
        require_writable(output)
        files = [output]
    elif suffix and not output.is_dir():
        raise LCollisionError(
            f"{output} cannot be written: {suffix} is no format known here; use one of "
            f"{', '.join(WRITABLE_SUFFIXES)}, .json or a folder"
        )
    else:
        files = [output / f"{name}.{mesh_format}" for name in _file_names(poses)]
        try:
            output.mkdir(exist_ok=True)
        except OSError as error:
            raise MeshFileError(
                f"the folder {output} cannot be made: {error.strerror or error}; name another"
            ) from error
    given = [None] * len(poses) if vertices is None else vertices
    for file, pose, mesh in zip(files, poses, given, strict=True):
        if mesh is None:
            mesh = model.decode(pose.latent)
            if pose.placement is not None:
                mesh = pose.placement.apply(mesh)
        write_mesh(file, mesh, model.faces)


def _file_names(poses: Sequence[NamedPose]) -> list[str]:
    from lcollision_core.model import unique_names

    safe = (re.sub(r'[\x00-\x1f<>:"/\\|?*]+', "_", pose.name).strip(" .") for pose in poses)
    return unique_names(name[:_MAX_FILE_NAME] or "pose" for name in safe)
