"""Leaving out poses that are nearly the same as others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.pose_set import PoseSet
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.meshes.units import body_size

TOLERANCE = 0.005
"""Of the body size: what a latent space reconstructs no better than. All 71 SCAPE poses are kept,
145 of the 150 frames of the published jump, and 89 of the mannequin's clip and rest pose; with 0.01
it would be 71, 137 and 47, but a head that turns by 35 degrees alone moves the mannequin by 0.0065
and one hand that closes by 0.011."""

_VERTICES = 500
"""By which poses are compared, evenly spaced among all."""


def thinned(poses: PoseSet, tolerance: float = TOLERANCE, job: Job = UNWATCHED) -> PoseSet:
    """Leave out poses that are another one's near-duplicates, wherever they lie.

    Two are when the root mean square distance of their vertices, one moved rigidly onto the other,
    is below the tolerance. Of near-duplicates the first is kept, and so is pose 0.

    Parameters
    ----------
    poses : the set
    tolerance : as a fraction of the body size
    job : polled between poses

    Returns
    -------
    poses : those that are kept, in their order; a note says how many are left out

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    kept = _kept(poses, tolerance, job)
    n_left_out = len(poses) - len(kept)
    if not n_left_out:
        return poses
    what = "1 pose is" if n_left_out == 1 else f"{n_left_out} poses are"
    note = f"{what} left out as nearly the same as others, within {100 * tolerance:g} % of the body"
    return replace(
        poses,
        vertices=poses.vertices[kept],
        names=tuple(poses.names[pose] for pose in kept),
        notes=(*poses.notes, f"{note} size"),
    )


def _kept(poses: PoseSet, tolerance: float, job: Job) -> list[int]:
    used = poses.topology.used_vertices
    chosen = used[np.unique(np.linspace(0, len(used) - 1, _VERTICES).astype(np.int64))]
    size = body_size(poses.vertices[0], poses.topology)
    points = poses.vertices[:, chosen].astype(np.float64) / size
    points -= points.mean(axis=1, keepdims=True)
    # No motion changes the distance of two vertices, and where they move by a and b it changes by
    # at most a + b, so that half the squared changes of disjoint pairs are a lower bound.
    half = len(chosen) // 2
    spans = np.linalg.norm(points[:, :half] - points[:, half : 2 * half], axis=2)
    kept: list[int] = []
    for pose, vertices in enumerate(points):
        job.check()
        least = ((spans[kept] - spans[pose]) ** 2).sum(axis=1) / (2 * len(chosen))
        near = np.array(kept, dtype=np.int64)[least < tolerance**2]
        if (_squared_distances(points[near], vertices) >= tolerance**2).all():
            kept.append(pose)
    return kept


def _squared_distances(poses: FloatArray, vertices: FloatArray) -> FloatArray:
    """Return mean squared distances of (K, n, 3) poses turned onto (n, 3) vertices; all centred.

    The best rotation turns the trace of the covariance into the sum of its singular values, the
    last one negative where a reflection would do better (Kabsch 1976).
    """
    covariance = np.einsum("ni,knj->kij", vertices, poses, optimize=True)
    values = np.linalg.svd(covariance, compute_uv=False)
    values[:, 2] *= np.sign(np.linalg.det(covariance))
    squares = (poses**2).sum(axis=(1, 2)) + (vertices**2).sum()
    distances: FloatArray = (squares - 2.0 * values.sum(axis=1)) / len(vertices)
    return distances
