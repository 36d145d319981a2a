"""Give a posed character back in its own file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy.typing as npt

from lcollision_core.characters.character import Character
from lcollision_core.characters.posed_gltf import (
    CharacterForm,
    PosedFile,
    animated_gltf,
    posed_gltf,
)
from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.atomic import atomic_write
from lcollision_core.meshes.contact_rules import STRICT, ContactRules
from lcollision_core.meshes.topology import FloatArray

PATCHED_SUFFIXES = (".glb", ".gltf", ".vrm")
"""Extensions of files that `write_character` gives back with a pose in them, in lower case."""

_WRITTEN_SUFFIXES = (".glb", ".vrm")


def write_character(
    path: str | os.PathLike[str],
    character: Character,
    vertices: npt.NDArray[Any],
    form: CharacterForm | str,
    transforms: FloatArray | None = None,
    rules: ContactRules = STRICT,
) -> PosedFile:
    """Write a character's file with a pose in it, whole or not at all: see `posed_gltf`.

    Parameters
    ----------
    path : a .glb file, or a .vrm file for a character of one
    character, vertices, form, transforms, rules : as of `posed_gltf`

    Returns
    -------
    what was written; its `vertices` are those to check

    Raises
    ------
    MeshFileError : the format of the source or of `path` cannot be written, or as of `posed_gltf`.
    ShapeError : as of `posed_gltf`.
    """
    _require_written(path, character)
    posed = posed_gltf(character, vertices, CharacterForm(form), transforms, rules)
    with atomic_write(path) as out:
        out.write(posed.data)
    return posed


def write_character_clip(
    path: str | os.PathLike[str],
    character: Character,
    vertices: npt.NDArray[Any],
    transforms: FloatArray,
    fps: float = 30.0,
    rules: ContactRules = STRICT,
) -> tuple[PosedFile, ...]:
    """Write a character's file with a clip of N poses, whole or not at all: see `animated_gltf`.

    Parameters
    ----------
    path : as of `write_character`
    character, vertices, transforms, fps, rules : as of `animated_gltf`

    Returns
    -------
    what was written, for each frame; the `vertices` are those to check

    Raises
    ------
    MeshFileError, ShapeError : as of `write_character`.
    """
    _require_written(path, character)
    frames = animated_gltf(character, vertices, transforms, fps, rules)
    with atomic_write(path) as file:
        file.write(frames[0].data)
    return frames


def _require_written(path: str | os.PathLike[str], character: Character) -> None:
    suffix, target = Path(character.source).suffix.lower(), Path(path).suffix.lower()
    if suffix not in PATCHED_SUFFIXES:
        raise MeshFileError.unwritable(
            path,
            f"the character is from {suffix}, whose skin and textures can't be written",
            "write .obj, .pc2 or .mdd",
        )
    if target not in _WRITTEN_SUFFIXES or (target == ".vrm" and suffix != ".vrm"):
        raise MeshFileError.unwritable(
            path, f"the character of a {suffix} file is written as .glb", "rename it"
        )
