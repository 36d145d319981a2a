"""Bodies by file or name, whatever their pose space."""

from __future__ import annotations

import os
from pathlib import Path

from lcollision_core.meshes.scene_files import SCENE_SUFFIXES
from lcollision_core.model.known_characters import open_character
from lcollision_core.model.posable_body import PosableBody
from lcollision_core.model.pose_model import PoseModel


def open_body(name_or_path: str | os.PathLike[str], up: int | None = None) -> PosableBody:
    """Read a body that can take poses; a character with what the user has chosen for it.

    Parameters
    ----------
    name_or_path : a model's file, the name of a bundled or user model, or the file of a rigged
        character
    up : the up axis, 0, 1 or 2, of a character whose file is wrong about it

    Raises
    ------
    ModelFileError : see `PoseModel.load`.
    MeshFileError : see `read_character`.
    LCollisionError : the character has no rig.
    """
    if Path(name_or_path).suffix.lower() in SCENE_SUFFIXES:
        return open_character(name_or_path, up)
    return PoseModel.load(name_or_path)
