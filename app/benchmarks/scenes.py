"""Scenes of two copies of a character, or one and a prop, resolved.

The fields of a row:

scene : its name
pairs, pairs_after : colliding pairs by the exact check
foreign, foreign_after : crossing faces of different bodies by VTK, in the same vertices; those that
    the rules let touch count too
mean_change, largest_change : of the vertices, in body sizes
seconds : wall time of Resolve on this machine
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt
import trimesh

from app.benchmarks.measures import Row
from lcollision_core.bodies.remembered import open_character
from lcollision_core.bodies.rig_poses import POSES, PoseTable, starter_poses
from lcollision_core.bodies.scene_body import SceneBody, SceneFile, ScenePart
from lcollision_core.bodies.scene_file import body_of_scene
from lcollision_core.bundled import bundled_table
from lcollision_core.errors import LCollisionError
from lcollision_core.files import write_mesh
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.topology import FloatArray

Posed = tuple[SceneBody, FloatArray]
"""A scene and the codes of its pose."""


class _Actor:
    """A character with poses, measured along left, up and front in heights of its rest pose."""

    def __init__(self, file: Path) -> None:
        self.file, self.body = file, open_character(file)
        self.space = self.body.space
        tables = POSES, bundled_table("scene_poses.toml", PoseTable)
        self.codes: Mapping[str, FloatArray] = {
            pose.name: pose.codes for table in tables for pose in starter_poses(self.space, table)
        }
        if "Embrace" not in self.codes:
            what = "arms and legs are not known by their joints' names"
            raise LCollisionError(what, "set them by `lcollision domains --role`", where=file)
        self.axes = self.space.to_body
        self.height = float(np.ptp(self.space.rest_vertices @ self.space.up))

    def points(self, pose: str, role: Role | None = None, side: Side | None = None) -> FloatArray:
        """Return the (n, 3) vertices of a posed body part, or of all."""
        vertices = self.body.decode(self.codes[pose]).astype(np.float64)
        if role is not None:
            chosen = [
                of_role is role and side in (None, of_side)
                for of_role, of_side in zip(self.space.roles, self.space.sides, strict=True)
            ]
            vertices = vertices[np.array(chosen)[self.space.rig.heaviest]]
        points: FloatArray = vertices @ self.axes.T / self.height
        return points

    def with_box(
        self, folder: Path, pose: str, low: FloatArray, high: FloatArray, holder: str = ""
    ) -> Posed:
        """Return a scene with a box, given in the posed character's heights.

        Parameters
        ----------
        low, high : (3,) corners
        holder : the joint that holds it; a box without one stands still
        """
        mesh = trimesh.creation.box(bounds=[low, high])
        corners = mesh.vertices * self.height @ self.axes
        if holder:
            joint = self.space.rig.joint_names.index(holder)
            moved = self.space.transforms(self.codes[pose])[joint]
            move = self.space.rig.rest[joint] @ np.linalg.inv(moved)
            corners = corners @ move[:3, :3].T + move[:3, 3]
        write_mesh(folder / "box.obj", corners, mesh.faces)
        held_by = self.body.name if holder else ""
        box = ScenePart(str(folder / "box.obj"), fixed=not holder, held_by=held_by, joint=holder)
        scene = body_of_scene(SceneFile((ScenePart(str(self.file), self.body.name), box)))
        return scene, scene.joined_codes([self.codes[pose], None])

    def with_other(self, pose: str, other: str, at: FloatArray, turn: float = 0.0) -> Posed:
        """Return a scene with another copy, moved by `at` in heights and turned by degrees."""
        place = tuple((at * self.height @ self.axes).tolist())
        parts = ScenePart(str(self.file), "one"), ScenePart(str(self.file), "other", place, turn)
        scene = body_of_scene(SceneFile(parts))
        return scene, scene.joined_codes([self.codes[pose], self.codes[other]])


def _embrace(actor: _Actor, _: Path) -> Posed:
    return actor.with_other("Embrace", "Embrace", np.array([0.0, 0.0, 0.17]), 180.0)


def _hand_in_hand(actor: _Actor, _: Path) -> Posed:
    left, right = (
        actor.points("Arms out", Role.HAND, side).mean(axis=0) for side in (Side.LEFT, Side.RIGHT)
    )
    return actor.with_other("Arms out", "Arms out", left - right)


def _fight(actor: _Actor, _: Path) -> Posed:
    """Put a fist 3 % of the height into the other's chest."""
    fist = actor.points("Punch", Role.HAND, Side.RIGHT)
    tip = fist[fist[:, 2].argmax()]
    chest = actor.points("Punch", Role.SPINE)
    at = np.array([tip[0], 0.0, tip[2] + _nearest_level(chest, tip)[:, 2].max() - 0.03])
    return actor.with_other("Punch", "Punch", at, 180.0)


def _sitting(actor: _Actor, folder: Path) -> Posed:
    """Sink a sitting character 2 % of its height into a box."""
    ground = actor.points("Sit")[:, 1].min()
    thighs = actor.points("Sit", Role.THIGH)
    back, front = thighs[:, 2].min(), 0.5 * (thighs[:, 2].min() + thighs[:, 2].max())
    seat = thighs[thighs[:, 2] < front, 1].min() + 0.02
    low, high = np.array([-0.3, ground, back - 0.15]), np.array([0.3, seat, front])
    return actor.with_box(folder, "Sit", low, high)


def _sword(actor: _Actor, folder: Path) -> Posed:
    """Hold a blade that runs through the thigh on its side, level and forward."""
    hand = actor.points("Stand", Role.HAND, Side.RIGHT).mean(axis=0)
    thigh = actor.points("Stand", Role.THIGH, Side.RIGHT)
    thigh = _nearest_level(thigh, hand).mean(axis=0)
    low, high = np.minimum(hand, thigh) - 0.006, np.maximum(hand, thigh) + 0.006
    low[1], high[1] = hand[1] - 0.006, hand[1] + 0.006
    kinds = list(zip(actor.space.roles, actor.space.sides, strict=True))
    holder = actor.space.rig.joint_names[kinds.index((Role.HAND, Side.RIGHT))]
    return actor.with_box(folder, "Stand", low, high, holder)


def _step(actor: _Actor, folder: Path) -> Posed:
    """Put a step of 7 % of the height where the character stands."""
    ground = actor.points("Stand")[:, 1].min()
    low, high = np.array([-0.25, ground - 0.02, -0.25]), np.array([0.25, ground + 0.07, 0.25])
    return actor.with_box(folder, "Stand", low, high)


def _nearest_level(points: FloatArray, place: FloatArray) -> FloatArray:
    """Return the tenth of the points that is nearest to the height of a place."""
    level: FloatArray = points[np.abs(points[:, 1] - place[1]).argsort()[: len(points) // 10]]
    return level


SCENES: Mapping[str, Callable[[_Actor, Path], Posed]] = {
    "embrace": _embrace,
    "hand in hand": _hand_in_hand,
    "fist in chest": _fight,
    "on a box": _sitting,
    "sword in thigh": _sword,
    "feet in a step": _step,
}


def scene_rows(file: Path, job: Job = UNWATCHED) -> list[Row]:
    """Resolve the `SCENES` of a rigged character.

    Raises
    ------
    LCollisionError : the file is no rigged character, or its limbs are not known.
    """
    actor, rows = _Actor(file), list[Row]()
    for number, (name, pose) in enumerate(SCENES.items()):
        job.report(number, len(SCENES))
        with TemporaryDirectory() as folder:
            scene, codes = pose(actor, Path(folder))
            result = scene.resolve(codes, job=job.part())
            rows.append(
                {
                    "scene": name,
                    "pairs": result.pairs_before,
                    "pairs_after": result.pairs_after,
                    "foreign": _crossing_faces(scene, scene.decode(codes)),
                    "foreign_after": _crossing_faces(scene, result.vertices),
                    "mean_change": result.vertex_distance_mean,
                    "largest_change": result.vertex_distance_max,
                    "seconds": result.seconds,
                }
            )
    return rows


def _crossing_faces(scene: SceneBody, vertices: npt.NDArray[np.floating]) -> int:
    """Count crossing faces of different bodies by VTK."""
    import pyvista as pv

    meshes = []
    for member in scene.members:
        rows, faces = scene.vertices_of[member.name], scene.faces_of[member.name]
        own = scene.faces[faces] - rows.start
        meshes.append(pv.PolyData.from_regular_faces(vertices[rows].astype(np.float64), own))
    return sum(one.collision(other)[1] for one, other in combinations(meshes, 2))
