"""Bodies by file or name, whatever their pose space."""

from __future__ import annotations

import os
from pathlib import Path

from lcollision_core.bodies.known_characters import open_character
from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.pose_model import PoseModel
from lcollision_core.files import Character
from lcollision_core.files.scene.smpl import SMPL_SUFFIX, refuse_pickle
from lcollision_core.files.scene_files import SCENE_SUFFIXES, SceneDocument


def open_body(
    source: str | os.PathLike[str] | SceneDocument | Character, up: int | None = None
) -> PosableBody:
    """Read a body that can take poses; a character with what the user has chosen for it.

    Parameters
    ----------
    source : a model's file, the name of a bundled or user model, the file of a rigged character or
        of a body model of the SMPL family, or what was read of one: see `open_character`
    up : the up axis, 0, 1 or 2, of a character whose file is wrong about it

    Raises
    ------
    ModelFileError : see `PoseModel.load`.
    MeshFileError : see `read_character`.
    LCollisionError : the character has no rig.
    """
    if isinstance(source, SceneDocument | Character):
        return open_character(source, up)
    refuse_pickle(source)
    if Path(source).suffix.lower() in (*SCENE_SUFFIXES, SMPL_SUFFIX):
        return open_character(source, up)
    return PoseModel.load(source)
