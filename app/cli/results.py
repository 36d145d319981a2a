"""Output of latent poses and meshes, by the form of the output path."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from app.cli.console import note
from app.wording import counted
from lcollision_core.errors import LCollisionError, MeshFileError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt

    from lcollision_core.meshes import FileStamp
    from lcollision_core.model import NamedPose, PosableBody


MeshFormat = Literal["obj", "ply", "off", "stl", "glb"]
MeshAxes = Literal["model", "y-up", "blender", "maya", "unreal"]
"""The axes that a mesh may be written in: `ExportAxes`, which takes long to import."""

PosesOutput = Annotated[
    Path, typer.Option("--output", "-o", metavar="POSES", help="The .json file to write.")
]
FormOutput = Annotated[
    str,
    typer.Option(
        "--output",
        "-o",
        metavar="OUT",
        help="A mesh file for one pose, a folder for several, or a .json file.",
    ),
]
FormatOption = Annotated[MeshFormat, typer.Option("--format", help="Of the meshes in a folder.")]


@dataclass(frozen=True)
class Output:
    """The output of a command for poses or meshes.

    Attributes
    ----------
    path : as it was named
    form : of the output
    before : what was there when the command began, by `file_stamp`
    """

    path: Path
    form: Literal["poses", "mesh", "folder"]
    before: FileStamp | None


def require_output(path: Path, suffix: str) -> Output:
    """Refuse an output that is not one file of a format, before the work for it is done.

    Raises
    ------
    LCollisionError : another extension, or the file could not be written.
    """
    from lcollision_core.meshes import file_stamp, require_writable

    if path.suffix.lower() != suffix:
        raise LCollisionError.unwritable(path, f"it must be a {suffix} file", "rename it")
    require_writable(path)
    return Output(path, "poses", file_stamp(path))


def output_named(name: str) -> Output:
    """Determine the form of an output, before the work for it is done.

    An existing folder and what ends in a slash are folders whatever they are called; else the
    extension decides. A name without one, or with what is no kind of file, as in "results_v0.9",
    is a folder to be created.

    Raises
    ------
    LCollisionError : the extension is of files that are not written here, or the file or folder
        could not be written.
    """
    from lcollision_core.meshes import (
        WRITABLE_SUFFIXES,
        file_stamp,
        has_known_suffix,
        require_writable,
    )

    path = Path(name)
    suffix = path.suffix.lower()
    if os.path.isdir(name):  # noqa: PTH112 - a name that is too long is none, and no error
        require_writable(path / "pose.obj")
        return Output(path, "folder", None)
    must_be_folder = name.endswith(("/", os.sep))
    if not must_be_folder and suffix in {".json", *WRITABLE_SUFFIXES}:
        require_writable(path)
        return Output(path, "poses" if suffix == ".json" else "mesh", file_stamp(path))
    if not must_be_folder and has_known_suffix(path):
        raise LCollisionError.unwritable(
            path,
            f"{suffix} is not a known format",
            f"use one of {', '.join(WRITABLE_SUFFIXES)}, .json or a folder",
        )
    require_writable(path)
    if path.exists():
        raise MeshFileError(
            "cannot be made: it is a file", "name another", where=f"the folder {path}"
        )
    return Output(path, "folder", None)


def require_one_mesh(output: Output, n_poses: int) -> None:
    """Refuse to write any other number of poses than one as one mesh.

    Raises
    ------
    LCollisionError : they are not one.
    """
    if output.form == "mesh" and n_poses != 1:
        raise LCollisionError(
            f"is one mesh, but there are {n_poses} poses", "name a folder", where=output.path
        )


def require_format_holds(
    output: Output,
    model: PosableBody,
    poses: Sequence[NamedPose],
    mesh_format: MeshFormat = "obj",
) -> None:
    """Refuse a format that cannot hold a pose at its location, before the work for it is done.

    Raises
    ------
    MeshFileError : its rounding steps there exceed a small fraction of an edge.
    """
    from lcollision_core.meshes import as_stored

    if output.form == "poses":
        return
    for pose in poses:
        if pose.placement is not None:
            name = f"{pose.name}.{mesh_format}"
            path = output.path / name if output.form == "folder" else output.path
            as_stored(path, pose.placement.apply(model.reference), model.topology)


def write_result(
    output: Output,
    model: PosableBody,
    poses: Sequence[NamedPose],
    mesh_format: MeshFormat = "obj",
    vertices: Sequence[npt.NDArray[np.floating]] | None = None,
    axes: str = "model",
    scale: float | None = None,
) -> list[Path]:
    """Write poses as a .json file, one pose as a mesh, or each as a mesh of a folder, and say so.

    All of them come into a folder, or none. A file that others have written since the command
    began stays, and the poses go beside it.

    Parameters
    ----------
    output : a folder is made where there is none
    model : of the poses
    poses : a pose with a placement returns to it
    mesh_format : of the meshes in a folder
    vertices : of each pose, (V, 3) to write; what the poses decode to where None
    axes, scale : of meshes, see `export_frame`

    Returns
    -------
    files : of each pose; one file may have several

    Raises
    ------
    LCollisionError : several poses and one mesh file, or a file or folder cannot be written.
    """
    from lcollision_core.meshes import atomic_files, file_stamp, file_stems, locked, unused_name
    from lcollision_core.model import export_frame, export_mesh, write_poses

    require_one_mesh(output, len(poses))
    decoded = (model.exported_vertices(pose.latent, pose.placement) for pose in poses)

    def write(files: Sequence[Path]) -> None:
        for file, pose, mesh in zip(files, poses, vertices or decoded, strict=True):
            # OBJ and OFF would get short decimals of float32, which are other numbers in float64.
            frame = export_frame(model, axes, file, scale)
            export_mesh(file, model, mesh.astype(float), pose.placement, frame)

    path = output.path
    if output.form == "folder":
        names = [f"{stem}.{mesh_format}" for stem in file_stems(pose.name for pose in poses)]
        n_replaced = sum((path / name).exists() for name in names)
        with atomic_files(path) as unfinished:
            write([unfinished / name for name in names])
        _tell_written(path, len(poses), n_replaced)
        return [path / name for name in names]
    with locked(path):
        n_replaced = int(path.exists())
        if n_replaced and file_stamp(path) != output.before:
            path, n_replaced = unused_name(path), 0
            note(
                f"{output.path} was changed by another command meanwhile and stays as it is; the "
                f"result goes to {path}"
            )
        if output.form == "poses":
            write_poses(path, model, poses)
        else:
            write([path])
    _tell_written(path, len(poses), n_replaced)
    return [path] * len(poses)


def _tell_written(output: Path, n_poses: int, n_replaced: int) -> None:
    told = f"wrote {counted(n_poses, 'pose')} to {output}"
    if n_replaced:
        replaced = counted(n_replaced, "file of the same name", "files of the same names")
        told += f", in place of {replaced}"
    note(told)
