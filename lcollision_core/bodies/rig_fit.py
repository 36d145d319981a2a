"""The pose of a rig that is nearest to a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.characters import RigPoseSpace
from lcollision_core.embedding.bilevel import LatentFit
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import fit_rigid

FloatArray = npt.NDArray[np.float64]

_FITTED_VERTICES = 3000
_STEPS = 20
_SETTLED = 1e-6
"""Of the squared distance: the gain of a step that is the last."""

_LEAST_VERTICES, _FLAT = 4, 1e-3
"""How many vertices tell how a joint turned, and how far they spread across a line, as a fraction
of how far along it."""

_DAMPING = 1e-4
"""Of the mean diagonal of the normal equations at first: what the mesh leaves open stays."""


def fit_rig(
    space: RigPoseSpace,
    vertices: FloatArray,
    job: Job = UNWATCHED,
    *,
    in_place: bool = False,
) -> LatentFit:
    """Find the codes whose mesh lies nearest to a given one.

    Each joint takes the turn that brings its own vertices nearest; then all codes settle together
    by Levenberg and Marquardt's method.

    Parameters
    ----------
    space : of the poses
    vertices : (V, 3) float64 array, normalised
    job : polled before each step
    in_place : the mesh lies as the reference does; else it is moved onto it first

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    used = space.topology.used_vertices.astype(np.int64)
    rotation, translation = np.eye(3), np.zeros(3)
    if not in_place:
        rotation, translation = fit_rigid(vertices[used], space.rest_vertices[used])
    aligned: FloatArray = vertices @ rotation.T + translation
    chosen = used[:: max(1, len(used) // _FITTED_VERTICES)]
    starts = [space.codes_of_transforms(_turned_joints(space, aligned)), np.zeros_like(space.low)]
    missing = [aligned[chosen] - space.decode(codes[None])[0, chosen] for codes in starts]
    codes, missing_now = min(
        zip(starts, missing, strict=True), key=lambda one: float((one[1] ** 2).sum())
    )
    damping = _DAMPING
    for _ in range(_STEPS):
        job.check()
        by_codes = space.tangents(codes, chosen).reshape(len(codes), -1)
        normal = by_codes @ by_codes.T
        normal[np.diag_indices_from(normal)] += damping * np.trace(normal) / len(normal)
        tried = codes + np.linalg.solve(normal, by_codes @ missing_now.ravel())
        left = aligned[chosen] - space.decode(tried[None])[0, chosen]
        before, after = float((missing_now**2).sum()), float((left**2).sum())
        if after >= before:
            damping *= 10.0
            continue
        codes, missing_now, damping = tried, left, 0.1 * damping
        if before - after <= _SETTLED * before:
            break
    distances = np.linalg.norm(aligned[used] - space.decode(codes[None])[0, used], axis=1)
    return LatentFit(codes, rotation, translation, float(distances.mean()), float(distances.max()))


def _turned_joints(space: RigPoseSpace, vertices: FloatArray) -> FloatArray:
    """Return the (J, 4, 4) transforms that bring each joint's vertices nearest to given ones.

    A joint whose vertices do not tell goes with its parent.
    """
    rig, size = space.rig, space.body_size
    moved = np.broadcast_to(np.eye(4), rig.rest.shape).copy()
    for joint, parent in enumerate(rig.parents):
        vertex, influence = np.nonzero((rig.joint_of == joint) & (rig.weights > 0.5))
        points = rig.points[vertex, influence]
        if len(vertex) >= _LEAST_VERTICES:
            spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
            if spread[1] > _FLAT * spread[0]:
                turn, shift = fit_rigid(points, vertices[vertex] * size)
                moved[joint, :3, :3], moved[joint, :3, 3] = turn, shift
                continue
        if parent >= 0:
            moved[joint] = moved[parent]
    return moved @ rig.rest
