"""Mesh files as latent poses, and the detail that encoding loses."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.pose_file import NamedPose, name_of_file
from lcollision_core.files import Mesh, read_mesh
from lcollision_core.jobs import UNWATCHED, Job

if TYPE_CHECKING:
    from lcollision_core.resolve import ResolveResult


def read_model_mesh(path: str | os.PathLike[str], model: PosableBody) -> Mesh:
    """Read a mesh file and refuse it where its topology is not the model's.

    Raises
    ------
    MeshFileError : the file cannot be read.
    PoseSetError : another topology.
    """
    mesh = read_mesh(path, topology=model.topology)
    model.require_topology(mesh.topology, str(path))
    return mesh


def encode_mesh(
    mesh: Mesh, model: PosableBody, scale: float = 1.0, job: Job = UNWATCHED
) -> NamedPose:
    """Find the latent pose nearest to a mesh, and name it after the mesh's file.

    Parameters
    ----------
    mesh : of the model's topology, by `read_model_mesh`
    model, scale, job : see `PosableBody.encode`, which raises the same errors
    """
    encoded = model.encode(mesh.vertices, job, scale)
    return NamedPose(
        name_of_file(mesh.source),
        encoded.latent,
        encoded.placement,
        encoded.fit_error_mean,
        encoded.fit_error_max,
    )


def with_detail(
    model: PosableBody,
    mesh: npt.NDArray[np.float64],
    pose: NamedPose,
    result: ResolveResult,
    clearance: float = 0.0,
) -> npt.NDArray[np.float64] | None:
    """Move a mesh by the displacement that Resolve gave its encoded pose, to keep its detail.

    Parameters
    ----------
    model : of the pose
    mesh : (V, 3) float64 array, the vertices that were encoded
    pose : that they were encoded as
    result : of its Resolve
    clearance : that this kept, normalised

    Returns
    -------
    vertices : (V, 3) float64 array that the exact check found free; None if the moved mesh
        would collide
    """
    # Where the pose did not move, the mesh is unchanged to the bit.
    moved: npt.NDArray[np.float64] = mesh + (
        result.vertices - model.exported_vertices(pose.latent, pose.placement)
    )
    check = model.exact_check(pose.placement, clearance=clearance)
    return moved if check.is_free_mesh(moved) else None
