"""Find defects of a mesh or a pose set, described in plain sentences."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.files.mesh.polygons import first_at_each_position
from lcollision_core.files.pose_set import PoseSetInspection, collect_poses
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.degenerate import degenerate_faces
from lcollision_core.meshes.topology import Topology


def audit_mesh(topology: Topology, vertices: npt.NDArray[Any]) -> tuple[str, ...]:
    """Find the defects that make a collision check, or a deformation, unreliable.

    Parameters
    ----------
    topology : the faces
    vertices : (V, 3) array, one pose

    Returns
    -------
    problems : a sentence for each kind of defect; having several components is no defect

    Raises
    ------
    ShapeError : `vertices` does not fit `topology`.
    """
    points = np.asarray(vertices)
    if points.shape != (topology.n_vertices, 3):
        raise ShapeError.must_be("vertices", f"({topology.n_vertices}, 3)", points.shape)
    first = first_at_each_position(points)
    duplicates = np.flatnonzero(first != np.arange(len(first)))
    open_edges, crowded_edges = topology.boundary_edges, topology.non_manifold_edges
    defects: tuple[tuple[npt.NDArray[np.integer], str, str, str], ...] = (
        (open_edges, "edge has", "edges have", "the mesh is open: {} one face"),
        (
            crowded_edges,
            "edge has",
            "edges have",
            "the mesh is not manifold: {} more than two faces, the first between vertices {}",
        ),
        (
            topology.pinched_vertices,
            "vertex joins",
            "vertices join",
            "the mesh is not manifold: {} parts of the surface that share no edge there, the first "
            "is vertex {}",
        ),
        (
            topology.unused_vertices,
            "vertex is",
            "vertices are",
            "{} in no face, the first is vertex {}",
        ),
        (
            degenerate_faces(topology, points),
            "face has",
            "faces have",
            "{} no area, the first is face {}",
        ),
        (
            duplicates,
            "vertex lies",
            "vertices lie",
            "{} exactly on an earlier vertex, the first is vertex {}",
        ),
    )
    problems = [
        sentence.format(
            f"{len(defect)} {one if len(defect) == 1 else several}",
            " and ".join(map(str, np.atleast_1d(defect[0]))),
        )
        for defect, one, several, sentence in defects
        if len(defect)
    ]
    if not (topology.is_watertight or len(open_edges) or len(crowded_edges)):
        problems.append("the mesh has neighbouring faces that are wound in opposite senses")
    return tuple(problems)


def inspect_pose_set(
    path: str | os.PathLike[str],
    job: Job = UNWATCHED,
) -> PoseSetInspection:
    """Read the usable poses of a pose set and list every defect instead of raising the first.

    Parameters
    ----------
    path : see `read_pose_set`
    job : reports (poses done, all poses)

    Returns
    -------
    the usable poses and the defects
    """
    defects: list[LCollisionError] = []
    poses = collect_poses(Path(path), defects.append, job)
    problems = [str(defect) for defect in defects]
    if poses.pose_set is not None:
        where = f"pose 0 ({poses.pose_set.names[0]})"
        reference = audit_mesh(poses.pose_set.topology, poses.pose_set.vertices[0])
        problems += [f"{where}: {problem}" for problem in reference]
    return replace(poses, defects=tuple(defects), problems=tuple(problems))
