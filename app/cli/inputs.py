"""What commands are given to read: files, and folders in the place of the meshes in them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lcollision_core.errors import MeshFileError


def expanded(inputs: Iterable[Path]) -> list[Path]:
    """Put the meshes of each folder, in natural order, in its place.

    Raises
    ------
    MeshFileError : a folder holds no mesh, or cannot be listed.
    """
    from lcollision_core.meshes import READABLE_SUFFIXES, mesh_files

    files: list[Path] = []
    for path in inputs:
        if not path.is_dir():
            files.append(path)
            continue
        held, _ = mesh_files(path)
        if not held:
            raise MeshFileError(
                f"{path} holds no mesh; name a folder of {', '.join(READABLE_SUFFIXES)} files"
            )
        files += held
    return files
