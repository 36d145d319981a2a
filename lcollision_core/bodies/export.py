"""Poses as mesh files: axes, unit, and what exactly is written."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.files import as_stored, write_mesh
from lcollision_core.files.mesh.obj import ObjDetail
from lcollision_core.meshes import FaceGroup, RigidTransform
from lcollision_core.meshes.face_groups import GROUP_KINDS
from lcollision_core.meshes.normals import corner_normals
from lcollision_core.options import ExportAxes

_AXES = np.eye(3)
_X, _Y, _Z = _AXES


_UNITS_IN_A_METRE = {
    ExportAxes.BLENDER: 1.0,
    ExportAxes.MAYA: 100.0,
    ExportAxes.UNREAL: 100.0,
}

_ALREADY_FIXED = (".glb", ".vrm")
"""glTF's own axes and unit are y up, z forward and the metre."""


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
) -> RigidTransform:
    """Return what brings a mesh into the axes, by right angles, and the unit that its file gets.

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
        return RigidTransform(
            np.eye(3), np.zeros(3), model.card.metres if placement is None else 1.0
        )
    factor = export_scale(model, axes) if scale is None else scale
    if chosen is ExportAxes.MODEL:
        return RigidTransform(np.eye(3), np.zeros(3), factor)
    up, front = _Y, _Z
    if chosen is ExportAxes.UNREAL:
        up, front = _Z, _X
    elif chosen is ExportAxes.BLENDER and suffix != ".obj":
        up, front = _Z, -_Y
    own_up, own_front = _AXES[model.up_axis], model.front
    own = np.stack([own_up, own_front, np.cross(own_up, own_front)])
    turn = np.stack([up, front, np.cross(up, front)]).T @ own
    # Adding 0 leaves no -0 behind.
    return RigidTransform(turn + 0.0, np.zeros(3), factor)


def export_mesh(
    path: str | os.PathLike[str],
    model: PosableBody,
    vertices: npt.NDArray[Any],
    placement: RigidTransform | None = None,
    frame: RigidTransform | None = None,
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
    is_obj = Path(path).suffix.lower() == ".obj"
    detail = _detail(model, written) if is_obj else None
    write_mesh(path, written, model.faces, up=up, detail=detail)
    return written


def _detail(model: PosableBody, vertices: npt.NDArray[Any]) -> ObjDetail | None:
    """Return what an OBJ file holds of a body from a file; None of one that has no more to say.

    Its groups are the body's meshes, else its body parts.
    """
    own, parts = (model.groups_by_kind[kind] for kind in GROUP_KINDS[:2])
    uv, uv_faces = _texture_coordinates(model)
    if not own and not len(uv):
        return None
    materials = [group for group in own if group.is_material]
    meshes = [group for group in own if not group.is_material] or list(parts)
    normals, normal_faces = corner_normals(vertices, model.faces, model.reference)
    return ObjDetail(
        normals,
        normal_faces,
        uv,
        uv_faces,
        tuple(group.name for group in meshes),
        _first_group(meshes, len(model.faces)),
        tuple(group.name for group in materials),
        _first_group(materials, len(model.faces)),
    )


def _first_group(groups: Sequence[FaceGroup], n_faces: int) -> npt.NDArray[np.int64]:
    """Return each face's first group by number, -1 for none."""
    numbers = np.full(n_faces, -1)
    for number, group in reversed(list(enumerate(groups))):
        numbers[group.faces] = number
    return numbers


def _texture_coordinates(
    model: PosableBody,
) -> tuple[npt.NDArray[np.floating[Any]], npt.NDArray[np.int64]]:
    """Return (T, 2) texture coordinates and which the (F, 3) corners have; no rows for none."""
    look = model.appearance
    none = np.empty((0, 2)), np.empty((0, 3), dtype=np.int64)
    if look is None or not look.uv.any():
        return none
    # Without the faces that the body leaves out.
    numbered = enumerate(map(tuple, look.vertices[look.faces].tolist()))
    rows = [
        next((row for row, corners in numbered if corners == wanted), -1)
        for wanted in map(tuple, model.faces.tolist())
    ]
    if -1 in rows:
        return none
    of_corner = look.uv[look.faces[rows]].reshape(-1, 2)
    uv, uv_faces = np.unique(of_corner, axis=0, return_inverse=True)
    # Pictures of glTF begin at the top.
    return uv * [1.0, -1.0] + [0.0, 1.0], uv_faces.reshape(-1, 3)
