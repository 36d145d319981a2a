"""Defects of a mesh or a pose set, in plain sentences."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes.formats.polygons import first_at_each_position
from lcollision_core.meshes.pose_set import PoseSet, collect_poses, degenerate_faces
from lcollision_core.meshes.topology import Topology


@dataclass(frozen=True, eq=False)
class MeshAudit:
    """The state of one mesh.

    Attributes
    ----------
    watertight : every edge has two faces that run along it in opposite directions
    degenerate_faces : indices of the faces without area, int32
    problems : a sentence for each kind of defect; several parts are no defect
    """

    watertight: bool
    degenerate_faces: npt.NDArray[np.int32]
    problems: tuple[str, ...]


def audit_mesh(topology: Topology, vertices: npt.NDArray[Any]) -> MeshAudit:
    """Find the defects that make a collision check, or a deformation, unreliable.

    Parameters
    ----------
    topology : the faces
    vertices : (V, 3) array, one pose

    Returns
    -------
    the counts and the sentences

    Raises
    ------
    ShapeError : `vertices` does not fit `topology`.
    """
    points = np.asarray(vertices)
    if points.shape != (topology.n_vertices, 3):
        raise ShapeError.must_be("vertices", f"({topology.n_vertices}, 3)", points.shape)
    degenerate = degenerate_faces(topology, points)
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
        (degenerate, "face has", "faces have", "{} no area, the first is face {}"),
        (
            duplicates,
            "vertex lies",
            "vertices lie",
            "{} exactly on an earlier vertex, the first is vertex {}",
        ),
    )
    problems = [
        sentence.format(
            f"{len(found)} {one if len(found) == 1 else several}",
            " and ".join(map(str, np.atleast_1d(found[0]))),
        )
        for found, one, several, sentence in defects
        if len(found)
    ]
    if not (topology.is_watertight or len(open_edges) or len(crowded_edges)):
        problems.append("the mesh has neighbouring faces that are wound in opposite senses")
    return MeshAudit(topology.is_watertight, degenerate, tuple(problems))


@dataclass(frozen=True, eq=False)
class PoseSetInspection:
    """Result of reading a path that should hold a pose set.

    Attributes
    ----------
    pose_set : the poses that agree with the first readable one; None if none can be used
    n_found : the poses that are there, usable or not
    same_topology : whether all readable poses share their vertex count and faces
    audit : the state of the reference, pose 0; None without poses
    defects : of the set and its poses, in the order found
    """

    pose_set: PoseSet | None
    n_found: int
    same_topology: bool
    audit: MeshAudit | None
    defects: tuple[LCollisionError, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        """A sentence for each defect, those of the reference among them."""
        found = [str(defect) for defect in self.defects]
        if self.pose_set is not None and self.audit is not None:
            name = self.pose_set.names[0]
            found += [f"pose 0 ({name}): {problem}" for problem in self.audit.problems]
        return tuple(found)


def inspect_pose_set(
    path: str | os.PathLike[str],
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> PoseSetInspection:
    """Read what can be read of a pose set and list every defect instead of refusing at the first.

    Parameters
    ----------
    path : a folder of meshes or an .npz file, as for `read_pose_set`
    progress : called with (poses done, poses in all)
    cancel : polled between poses

    Returns
    -------
    the usable poses and the defects

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    defects: list[LCollisionError] = []
    collected = collect_poses(Path(path), defects.append, progress, cancel)
    pose_set = collected.pose_set
    audit = None if pose_set is None else audit_mesh(pose_set.topology, pose_set.vertices[0])
    return PoseSetInspection(
        pose_set, collected.n_found, collected.same_topology, audit, tuple(defects)
    )
