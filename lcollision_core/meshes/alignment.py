"""Rigid alignment of poses to a reference, weighted towards the parts that move least.

The convention is `aligned = R @ p + t`, so that `p = R.T @ (aligned - t)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.topology import FloatArray

_MAX_ROUNDS = 100
_WEIGHT_TOLERANCE = 1e-4
# Fraction of the median motion: small enough to follow the torso of a body whose limbs all move,
# large enough that the weights of neighbouring vertices stay similar.
_CALM = 0.5


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """A similarity transform, `aligned = scale * rotation @ p + translation`.

    Attributes
    ----------
    rotation : (3, 3) float64 array, determinant +1
    translation : (3,) float64 array, in the target's unit
    scale : > 0, target units per source unit; 1 unless a mesh is in another unit than the model
    """

    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0

    def apply(self, vertices: npt.NDArray[Any]) -> FloatArray:
        """Transform (..., 3) points to the reference's coordinates."""
        turned: FloatArray = np.asarray(vertices, np.float64) @ self.rotation.T
        return self.scale * turned + self.translation

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) the transform of homogeneous points."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    def inverse(self) -> RigidTransform:
        """Return the inverse transform."""
        back = 1.0 / self.scale
        return RigidTransform(self.rotation.T, -back * (self.rotation.T @ self.translation), back)


@dataclass(frozen=True, eq=False)
class Alignment:
    """Poses in the reference's coordinates, and the transforms that led there.

    Attributes
    ----------
    vertices : (N, V, 3) float64 array, the aligned poses
    rotations : (N, 3, 3) float64 array, determinants +1
    translations : (N, 3) float64 array, `vertices[n] = original[n] @ rotations[n].T +
        translations[n]`
    weights : (V,) float64 array in [0, 1], largest 1, of the vertices in the fit; pass them to
        `fit_rigid` to align a further pose in the same way
    """

    vertices: FloatArray
    rotations: FloatArray
    translations: FloatArray
    weights: FloatArray


def fit_rigid(
    vertices: npt.NDArray[Any],
    reference: npt.NDArray[Any],
    weights: npt.NDArray[Any] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Fit the rotations and translations that align poses to a reference.

    Minimises Σ_i w_i ‖R p_i + t - q_i‖² over rotations R, never reflections, and translations t,
    without scale.

    Parameters
    ----------
    vertices : (..., V, 3) finite array, the poses p
    reference : (V, 3) finite array, q
    weights : (V,) array w, non-negative with a positive sum; uniform if None

    Returns
    -------
    rotations : (..., 3, 3) float64 array, determinants +1
    translations : (..., 3) float64 array

    Raises
    ------
    ShapeError : the shapes do not match, or the weights are negative or all zero.

    Notes
    -----
    Kabsch 1976, with the sign of Umeyama 1991. If the points lie on a line, the rotation about it
    is undetermined and one of the best rotations is returned.
    """
    poses = np.asarray(vertices, dtype=np.float64)
    target = np.asarray(reference, dtype=np.float64)
    if target.ndim != 2 or target.shape[1] != 3 or len(target) == 0:
        raise ShapeError.must_be("reference", "a (V, 3) array with V > 0", target.shape)
    if poses.shape[-2:] != target.shape:
        raise ShapeError.must_be("vertices", f"(..., {len(target)}, 3)", poses.shape)
    weight = np.ones(len(target)) if weights is None else np.asarray(weights, dtype=np.float64)
    if weight.shape != (len(target),) or not (weight >= 0.0).all() or not weight.sum() > 0.0:
        raise ShapeError.must_be(
            "weights", f"({len(target)},), non-negative and not all zero", weight.shape
        )
    weight = weight / weight.sum()
    pose_centres = weight @ poses
    target_centre = weight @ target
    weighted = weight[:, None] * (target - target_centre)
    # (3, V) @ (V, 3) per pose: the cross-covariance, reference by pose.
    covariance = weighted.T @ (poses - pose_centres[..., None, :])
    left, _, right = np.linalg.svd(covariance)
    signs = np.ones(covariance.shape[:-1])
    signs[..., 2] = np.sign(np.linalg.det(left @ right))
    rotations: FloatArray = (left * signs[..., None, :]) @ right
    translations: FloatArray = target_centre - np.einsum(
        "...ij,...j->...i", rotations, pose_centres
    )
    return rotations, translations


def align_rigid(
    vertices: npt.NDArray[Any],
    reference: npt.NDArray[Any],
    job: Job = UNWATCHED,
) -> Alignment:
    """Align all poses of a set to a reference, led by the parts that move least.

    Starts from plain Kabsch and reweights: a vertex has weight 1 / (1 + (m / s)²), where m is its
    root mean square distance to the reference over all poses and s half the median of m. All
    poses share the weights, so that the same part of the body leads throughout: with individual
    weights, some poses would follow the legs and others the torso.

    Parameters
    ----------
    vertices : (N, V, 3) finite array, the poses, in the files' unit
    reference : (V, 3) finite array, usually pose 0
    job : polled between rounds

    Returns
    -------
    the aligned poses, the transforms and the weights

    Raises
    ------
    ShapeError : the shapes do not match.
    CancelledError : the job was cancelled.

    Notes
    -----
    Iteratively reweighted least squares with Cauchy's weight function. Compared with plain Kabsch,
    the calmest tenth of the vertices deviates 2.6 times less on SCAPE and 1.2 times less on the
    jumping sequence, for 5 and 3 % more error of ten principal components; individual weights per
    pose made that error another 15 to 41 % worse.
    """
    poses = np.asarray(vertices, dtype=np.float64)
    if poses.ndim != 3 or len(poses) == 0:
        raise ShapeError.must_be("vertices", "(N, V, 3) with N > 0", poses.shape)
    target = np.asarray(reference, dtype=np.float64)
    rotations, translations = fit_rigid(poses, target)
    # Smaller motions are rounding errors, which must not determine the weights.
    least_motion = 1e-14 * body_size(target) + np.finfo(np.float64).tiny
    weights = np.ones(len(target))
    for _ in range(_MAX_ROUNDS):
        job.check()
        motion = _mean_motion(poses, target, rotations, translations)
        calm = max(_CALM * float(np.median(motion)), least_motion)
        previous, weights = weights, 1.0 / (1.0 + (motion / calm) ** 2)
        weights /= weights.max()
        rotations, translations = fit_rigid(poses, target, weights)
        if np.abs(weights - previous).max() < _WEIGHT_TOLERANCE:
            break
    aligned = poses @ rotations.transpose(0, 2, 1) + translations[:, None]
    return Alignment(aligned, rotations, translations, weights)


def _mean_motion(
    poses: FloatArray, target: FloatArray, rotations: FloatArray, translations: FloatArray
) -> FloatArray:
    """Return each vertex's root mean square distance to the reference over the poses, (V,)."""
    squared_sum = np.zeros(len(target))
    # One pose at a time, so that temporaries stay in the cache: four times faster than all at once.
    for pose, rotation, translation in zip(poses, rotations, translations, strict=True):
        offset = pose @ rotation.T + (translation - target)
        squared_sum += np.einsum("ij,ij->i", offset, offset)
    motion: FloatArray = np.sqrt(squared_sum / len(poses))
    return motion
