"""Poses as mesh files."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes import RigidTransform, write_mesh
from lcollision_core.model.pose_model import PoseModel


def export_mesh(
    path: str | os.PathLike[str],
    model: PoseModel,
    vertices: npt.NDArray[Any],
    placement: RigidTransform | None = None,
) -> None:
    """Write a pose's mesh, upright where the format says which way is up, unless it has a place.

    Parameters
    ----------
    path : see `write_mesh`
    model : of the pose
    vertices : (V, 3) array, in the data's unit, in the place that they are exported to
    placement : what brought them there, for a mesh that came in from somewhere; else None

    Raises
    ------
    MeshFileError, ShapeError : as for `write_mesh`.
    """
    up = np.eye(3)[model.up_axis] if placement is None else None
    write_mesh(path, vertices, model.faces, up=up)
