"""Inputs of commands: files, folders of meshes, units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from lcollision_core.errors import LCollisionError, MeshFileError, WrongScaleError

if TYPE_CHECKING:
    from lcollision_core.files import PoseSet
    from lcollision_core.meshes import UpGuess


Axis = Literal["x", "y", "z"]

MeshesArgument = Annotated[
    list[Path],
    # readable=False: read_mesh reports the error and the file itself.
    typer.Argument(
        metavar="MESH...",
        readable=False,
        help="OBJ, PLY, OFF, STL, GLB, glTF, VRM or FBX files, or folders of them.",
    ),
]
PoseSetArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET",
        readable=False,
        help="A folder of meshes, an .npz file, a character with animations or a point cache.",
    ),
]
PosesArgument = Annotated[
    Path, typer.Argument(metavar="POSES", readable=False, help="A .json file of poses.")
]
RowsOption = Annotated[
    int | None,
    typer.Option("--rows", min=1, metavar="N", help="Use the first N rows. Default: all."),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(min=1, max=1024, metavar="N", help="Threads. Default: one per core."),
]
ErrorBoundOption = Annotated[
    float,
    typer.Option(
        "--error-bound",
        min=0.0,
        max=0.5,
        metavar="E",
        help="Replace the exact check by the estimate where the predictor is sure, so that at most "
        "this share of all verdicts is wrong, as measured on its latent box; 0.001 is one in a "
        "thousand.",
    ),
]
ScaleOption = Annotated[
    float,
    typer.Option(
        "--scale",
        metavar="S",
        help="Converts the meshes to the model's unit: 0.001 takes millimetres to metres. "
        "Results are in the meshes' own unit.",
    ),
]


def expanded(inputs: Iterable[Path]) -> list[Path]:
    """Replace each folder by its meshes, in natural order.

    Raises
    ------
    MeshFileError : a folder holds no mesh, or cannot be listed.
    """
    from lcollision_core.files import READABLE_SUFFIXES, mesh_files

    files: list[Path] = []
    for path in inputs:
        if not path.is_dir():
            files.append(path)
            continue
        held, _ = mesh_files(path)
        if not held:
            raise MeshFileError(
                "contains no mesh",
                f"name a folder of {', '.join(READABLE_SUFFIXES)} files",
                where=path,
            )
        files += held
    return files


def with_rules_of_character(poses: PoseSet, path: Path) -> PoseSet:
    """Give the frames of a rigged character the contact rules by which it is posed as well."""
    from lcollision_core.bodies import open_body
    from lcollision_core.files.scene_files import open_rigged

    document = open_rigged(path)
    if document is None:
        return poses
    body = open_body(document)
    return replace(poses, rules=body.rules, groups=body.groups)


def cannot_encode(path: Path, error: LCollisionError) -> MeshFileError:
    """Say that a mesh cannot be encoded, and which option helps if it has another unit."""
    next_step = error.next_step
    if isinstance(error, WrongScaleError):
        next_step = f"scale it with --scale {error.factor:.6g}"
    return MeshFileError(f"cannot be encoded: {error.headline}", next_step, where=path)


def up_sentence(guess: UpGuess) -> str:
    """Report which axis was taken as up, and why."""
    return f"{'xyz'[guess.axis]} is {'' if guess.is_sure else 'probably '}up: {guess.reason}"
