"""Poses as mesh files: axes, unit, and what exactly is written."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes import RigidTransform, as_stored, write_mesh
from lcollision_core.model.posable_body import PosableBody

_AXES = np.eye(3)
_X, _Y, _Z = _AXES


class ExportAxes(StrEnum):
    """For which program a mesh is written: its axes, and its unit.

    Each is what the program's own importer, with its default settings, puts upright and facing
    its front: Blender's turns an OBJ file from y up to z up and leaves PLY and STL unchanged;
    Maya takes y up and centimetres; Unreal takes centimetres and z up, x forward, and itself
    turns y round, as its axes are left-handed.
    """

    MODEL = "model"
    Y_UP = "y-up"
    BLENDER = "blender"
    MAYA = "maya"
    UNREAL = "unreal"


_UNITS_IN_A_METRE = {
    ExportAxes.BLENDER: 1.0,
    ExportAxes.MAYA: 100.0,
    ExportAxes.UNREAL: 100.0,
}

_ALREADY_FIXED = (".glb", ".vrm")
"""glTF's own axes and unit are y up, z forward and the metre."""


@dataclass(frozen=True, eq=False)
class ExportFrame:
    """Axes and unit of a file, relative to those of the model.

    Attributes
    ----------
    turn : (3, 3) float64 array, by right angles
    scale : the file's units in one of the model's
    """

    turn: npt.NDArray[np.float64]
    scale: float

    def apply(self, vertices: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Bring (..., 3) vertices into the file's axes and unit.

        A scale of few digits is exact for float32 vertices.
        """
        turned: npt.NDArray[np.float64] = np.asarray(vertices, np.float64) @ self.turn.T
        return turned * self.scale


def export_scale(model: PosableBody, axes: str) -> float:
    """Return the units that a program counts in one of a model's, 1 for the model's own."""
    units = _UNITS_IN_A_METRE.get(ExportAxes(axes))
    return 1.0 if units is None else units * model.card.metres


def export_frame(
    model: PosableBody,
    axes: str,
    path: str | os.PathLike[str],
    scale: float | None = None,
    placement: RigidTransform | None = None,
) -> ExportFrame:
    """Return the axes and the unit that a file gets.

    Parameters
    ----------
    model : of the poses
    axes : one of `ExportAxes`
    path : its extension says the format: a GLB file is in metres, and turned by `write_mesh`
    scale : the file's units in one of the model's; `export_scale` if None
    placement : of an imported mesh, which has brought its unit along
    """
    chosen = ExportAxes(axes)
    suffix = Path(path).suffix.lower()
    if suffix in _ALREADY_FIXED:
        return ExportFrame(np.eye(3), model.card.metres if placement is None else 1.0)
    factor = export_scale(model, axes) if scale is None else scale
    if chosen is ExportAxes.MODEL:
        return ExportFrame(np.eye(3), factor)
    up, front = _Y, _Z
    if chosen is ExportAxes.UNREAL:
        up, front = _Z, _X
    elif chosen is ExportAxes.BLENDER and suffix != ".obj":
        up, front = _Z, -_Y
    own_up, own_front = _AXES[model.up_axis], model.front
    own = np.stack([own_up, own_front, np.cross(own_up, own_front)])
    turn = np.stack([up, front, np.cross(up, front)]).T @ own
    # Adding 0 leaves no -0 behind.
    return ExportFrame(turn + 0.0, factor)


def export_mesh(
    path: str | os.PathLike[str],
    model: PosableBody,
    vertices: npt.NDArray[Any],
    placement: RigidTransform | None = None,
    frame: ExportFrame | None = None,
) -> npt.NDArray[Any]:
    """Write a pose's mesh, upright where the format says which way is up, unless it has a place.

    Parameters
    ----------
    path : see `write_mesh`
    model : of the pose
    vertices : (V, 3) array, in the data's unit, placed for export
    placement : that was applied to them, for an imported mesh; else None
    frame : the file's axes and unit, by `export_frame`; the model's if None. A mesh that has a
        place is turned like all others.

    Returns
    -------
    written : (V, 3) array as the file holds it, except the rotation of a GLB file, which is exact

    Raises
    ------
    MeshFileError, ShapeError : as for `write_mesh`.
    """
    written = vertices if frame is None else frame.apply(vertices)
    written = as_stored(path, written, model.topology)
    up = np.eye(3)[model.up_axis] if placement is None else None
    write_mesh(path, written, model.faces, up=up)
    return written
