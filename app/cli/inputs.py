"""What commands are given to read: files, folders in the place of the meshes in them, units."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcollision_core.errors import LCollisionError, MeshFileError, WrongScaleError

if TYPE_CHECKING:
    from lcollision_core.meshes import UpGuess


class Axis(StrEnum):
    """An axis of a mesh."""

    X = "x"
    Y = "y"
    Z = "z"

    @property
    def number(self) -> int:
        """0, 1 or 2."""
        return "xyz".index(self.value)


ScaleOption = Annotated[
    float,
    typer.Option(
        "--scale",
        metavar="S",
        help="Brings the meshes into the model's unit: 0.001 from millimetres to metres. What "
        "comes back is in their own.",
    ),
]


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


def cannot_encode(path: Path, error: LCollisionError) -> MeshFileError:
    """Say that a mesh cannot be encoded, and which option helps where it has another unit."""
    advice = f" with --scale {error.factor:.6g}" if isinstance(error, WrongScaleError) else ""
    return MeshFileError(f"{path} cannot be encoded: {error}{advice}")


def up_sentence(guess: UpGuess) -> str:
    """Say which way was taken to be up, and why."""
    return f"{'xyz'[guess.axis]} is {'' if guess.is_sure else 'perhaps '}up: {guess.reason}"
