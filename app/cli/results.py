"""Where commands put latent poses and meshes: the output's form decides."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.console import note
from app.wording import counted
from lcollision_core.errors import LCollisionError, MeshFileError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
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


class OutputForm(Enum):
    """What an output is to be."""

    POSES = auto()
    MESH = auto()
    FOLDER = auto()


@dataclass(frozen=True)
class WrittenPoses:
    """Where poses went.

    Attributes
    ----------
    output : as it was named
    files : of each pose; one file may have several
    n_replaced : how many of the files were there before
    """

    output: Path
    files: tuple[Path, ...]
    n_replaced: int

    def note(self) -> None:
        """Say so on standard error."""
        told = f"wrote {counted(len(self.files), 'pose')} to {self.output}"
        if self.n_replaced:
            replaced = counted(self.n_replaced, "file of the same name", "files of the same names")
            told += f", in place of {replaced}"
        note(told)


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


def note_near_exclusion(model: PoseModel) -> None:
    """Say which pairs of faces the figures beside this leave out, where there are any."""
    if model.near_exclusion:
        note(
            f"pairs of faces within {model.near_exclusion:g} heights along the surface are folds "
            f"of the skin, which are no collisions"
        )


def output_form(output: Path) -> OutputForm:
    """Say what an output is to be, before the work for it is done.

    An existing folder is one whatever it is called; else the extension decides, and a name without
    one is a folder that is yet to be made.

    Raises
    ------
    LCollisionError : an unknown extension, or the file or folder could not be written.
    """
    from lcollision_core.meshes import WRITABLE_SUFFIXES, require_writable

    suffix = output.suffix.lower()
    if output.is_dir():
        require_writable(output / f"pose.{MeshFormat.OBJ}")
        return OutputForm.FOLDER
    if suffix not in {"", ".json", *WRITABLE_SUFFIXES}:
        raise LCollisionError(
            f"{output} cannot be written: {suffix} is no format known here; use one of "
            f"{', '.join(WRITABLE_SUFFIXES)}, .json or a folder"
        )
    require_writable(output)
    if suffix:
        return OutputForm.POSES if suffix == ".json" else OutputForm.MESH
    if output.exists():
        raise MeshFileError(f"the folder {output} cannot be made: it is a file; name another")
    return OutputForm.FOLDER


def require_one_mesh(output: Path, form: OutputForm, n_poses: int) -> None:
    """Refuse to write any other number of poses than one as one mesh.

    Raises
    ------
    LCollisionError : they are not one.
    """
    if form is OutputForm.MESH and n_poses != 1:
        raise LCollisionError(f"{output} is one mesh, but there are {n_poses} poses; name a folder")


def write_result(
    output: Path,
    form: OutputForm,
    model: PoseModel,
    poses: Sequence[NamedPose],
    mesh_format: MeshFormat = MeshFormat.OBJ,
    vertices: Sequence[npt.NDArray[np.float32] | None] | None = None,
) -> WrittenPoses:
    """Write poses as a .json file, one pose as a mesh, or each as a mesh of a folder.

    Parameters
    ----------
    output : a folder is made where there is none
    form : of `output`, by `output_form`
    model : of the poses
    poses : a pose with a placement returns to it
    mesh_format : of the meshes in a folder
    vertices : of each pose, (V, 3) to write in the place of what it decodes to, or None

    Raises
    ------
    LCollisionError : several poses and one mesh file, or a file or folder cannot be written.
    """
    from lcollision_core.model import export_mesh, write_poses
    from lcollision_core.resolve import exported_vertices

    if form is OutputForm.POSES:
        written = WrittenPoses(output, (output,) * len(poses), int(output.exists()))
        write_poses(output, model, poses)
        return written
    require_one_mesh(output, form, len(poses))
    files = [output]
    if form is OutputForm.FOLDER:
        files = [output / f"{name}.{mesh_format}" for name in _file_names(poses)]
        try:
            output.mkdir(exist_ok=True)
        except OSError as error:
            raise MeshFileError(
                f"the folder {output} cannot be made: {error.strerror or error}; name another"
            ) from error
    n_replaced = sum(file.exists() for file in files)
    given = [None] * len(poses) if vertices is None else vertices
    for file, pose, mesh in zip(files, poses, given, strict=True):
        if mesh is None:
            mesh = exported_vertices(model.decode(pose.latent), pose.placement)
        # OBJ and OFF would get float32's short decimals, which float64 readers take for others.
        export_mesh(file, model, mesh.astype(float), pose.placement)
    return WrittenPoses(output, tuple(files), n_replaced)


def _file_names(poses: Sequence[NamedPose]) -> list[str]:
    from lcollision_core.model import unique_names

    safe = (re.sub(r'[\x00-\x1f<>:"/\\|?*]+', "_", pose.name).strip(" .") for pose in poses)
    return unique_names(name[:_MAX_FILE_NAME] or "pose" for name in safe)
