"""Affine transforms of nodes, their hierarchies, and dual quaternion skinning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.meshes.topology import FloatArray

_NEARLY_PARALLEL = 1.0 - 1e-9
"""Cosine above which the arc between two quaternions is approximated by its chord."""


def compose(translation: FloatArray, rotation: FloatArray, scale: FloatArray) -> FloatArray:
    """Return the matrices that scale, then rotate, then translate.

    Parameters
    ----------
    translation, scale : (..., 3) arrays
    rotation : (..., 4) array, quaternions x, y, z, w of any length; length 0 is the identity

    Returns
    -------
    (..., 4, 4) float64 array
    """
    x, y, z, w = np.moveaxis(unit_quaternions(rotation), -1, 0)
    result = np.zeros((*translation.shape[:-1], 4, 4))
    result[..., 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    result[..., 0, 1] = 2.0 * (x * y - z * w)
    result[..., 0, 2] = 2.0 * (x * z + y * w)
    result[..., 1, 0] = 2.0 * (x * y + z * w)
    result[..., 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    result[..., 1, 2] = 2.0 * (y * z - x * w)
    result[..., 2, 0] = 2.0 * (x * z - y * w)
    result[..., 2, 1] = 2.0 * (y * z + x * w)
    result[..., 2, 2] = 1.0 - 2.0 * (x * x + y * y)
    result[..., :3, :3] *= scale[..., None, :]
    result[..., :3, 3] = translation
    result[..., 3, 3] = 1.0
    return result


def unit_quaternions(rotation: FloatArray) -> FloatArray:
    """Normalise (..., 4) quaternions x, y, z, w; one of length 0 becomes the identity."""
    length = np.linalg.norm(rotation, axis=-1, keepdims=True)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    return np.where(length > 0.0, rotation / np.where(length > 0.0, length, 1.0), identity)


def from_rotation_vectors(vectors: npt.ArrayLike) -> FloatArray:
    """Return the rotation matrices (..., 3, 3) of (..., 3) rotation vectors in radians."""
    matrices: FloatArray = scipy.spatial.transform.Rotation.from_rotvec(vectors).as_matrix()
    return matrices


def rotation_vectors(matrices: FloatArray) -> FloatArray:
    """Return the (..., 3) rotation vectors in radians of (..., 3, 3) rotation matrices."""
    vectors: FloatArray = scipy.spatial.transform.Rotation.from_matrix(matrices).as_rotvec()
    return vectors


def decompose(matrix: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the translation, rotation (x, y, z, w) and scale of (..., 4, 4) affine matrices.

    A reflection goes to the scale of x, shear is lost, and a matrix with zero scale along an axis
    has no rotation.
    """
    linear = matrix[..., :3, :3]
    scale = np.linalg.norm(linear, axis=-2)
    scale[..., 0] *= np.where(np.linalg.det(linear) < 0.0, -1.0, 1.0)
    is_flat = ~scale.all(axis=-1)[..., None, None]
    turns = np.where(is_flat, np.eye(3), linear / np.where(is_flat, 1.0, scale[..., None, :]))
    rotation = scipy.spatial.transform.Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat()
    return matrix[..., :3, 3].copy(), rotation.reshape(*scale.shape[:-1], 4), scale


def is_regular(transform: FloatArray) -> bool:
    """Whether a (4, 4) transform can be inverted: its columns span a volume."""
    return bool(are_regular(transform))


def are_regular(transforms: FloatArray) -> npt.NDArray[np.bool_]:
    """Apply `is_regular` to (..., 4, 4) transforms, (...)."""
    columns = transforms[..., :3, :3]
    lengths = np.linalg.norm(columns, axis=-2)
    spans: npt.NDArray[np.bool_] = np.abs(np.linalg.det(columns)) > 1e-9 * lengths.prod(axis=-1)
    return spans


def slerp(start: FloatArray, end: FloatArray, share: FloatArray) -> FloatArray:
    """Interpolate (..., 4) unit quaternions along the shorter arc by (...) fractions of it."""
    cosine = np.einsum("...i,...i->...", start, end)
    end = np.where(cosine[..., None] < 0.0, -end, end)
    cosine = np.minimum(np.abs(cosine), 1.0)
    angle = np.arccos(cosine)
    is_chord = cosine > _NEARLY_PARALLEL
    sine = np.where(is_chord, 1.0, np.sin(angle))
    at_start = np.where(is_chord, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    at_end = np.where(is_chord, share, np.sin(share * angle) / sine)
    result: FloatArray = at_start[..., None] * start + at_end[..., None] * end
    return result


def signs_on_one_side(rotations: FloatArray) -> FloatArray:
    """Return the signs that make successive quaternions take the shorter arc; the first is 1.

    Parameters
    ----------
    rotations : (T, ..., 4) quaternions

    Returns
    -------
    (T, ...) array of 1 and -1
    """
    flips = np.einsum("t...i,t...i->t...", rotations[1:], rotations[:-1]) < 0.0
    signs = np.ones(rotations.shape[:-1])
    signs[1:][np.cumsum(flips, axis=0) % 2 == 1] = -1.0
    return signs


def nearest_winding(turns: FloatArray, near: FloatArray) -> FloatArray:
    """Return the (..., 3) rotation vectors equivalent to `turns` that are nearest to `near`.

    Vectors that are nearest already stay exactly equal.
    """
    angle = np.linalg.norm(turns, axis=-1, keepdims=True)
    direction = np.divide(turns, angle, out=np.zeros_like(turns), where=angle > 0.0)
    along = (direction * near).sum(axis=-1, keepdims=True)
    wound: FloatArray = turns + 2.0 * np.pi * np.round((along - angle) / (2.0 * np.pi)) * direction
    return wound


def global_transforms(
    local: FloatArray, parents: npt.NDArray[np.int64], order: Sequence[int]
) -> FloatArray:
    """Chain (N, n, 4, 4) local transforms of n nodes; `order` has parents before children."""
    result = local.copy()
    # Numbers that are too large are refused with the vertices.
    with np.errstate(over="ignore", invalid="ignore"):
        for node in order:
            if parents[node] >= 0:
                result[:, node] = result[:, parents[node]] @ local[:, node]
    return result


def blend_dual_quaternions(
    turns: FloatArray, bone_of: npt.NDArray[np.integer], weights: FloatArray
) -> FloatArray:
    """Blend the transforms of each vertex's bones.

    Parameters
    ----------
    turns : (B, 4, 4) float64 array, transforms of the bones
    bone_of, weights : (V, I) arrays, each row of weights sums to 1

    Returns
    -------
    (V, 4, 4) float64 array; scales are blended linearly, as ufbx does

    Notes
    -----
    Kavan et al., Geometric Skinning with Approximate Dual Quaternion Blending, ACM Transactions on
    Graphics 27(4), 2008, section 4: the dual part of a motion is half its translation times its
    rotation, and the blend is divided by the length of its real part.
    """
    parts = [decompose(turn) for turn in turns]
    moves, rotations, scales = (np.stack(some) for some in zip(*parts, strict=True))
    real = rotations[bone_of]
    dual = 0.5 * _product(np.pad(moves, ((0, 0), (0, 1)))[bone_of], real)
    # q and -q are the same rotation: take the sign nearest to the bone of most weight.
    main = np.take_along_axis(real, weights.argmax(axis=1)[:, None, None], axis=1)
    shares = weights * np.where((real * main).sum(axis=-1) < 0.0, -1.0, 1.0)
    blended = np.einsum("vi,vik->vk", shares, real)
    blended_dual = np.einsum("vi,vik->vk", shares, dual)
    squared_length = (blended**2).sum(axis=1, keepdims=True)
    conjugate = blended * [-1.0, -1.0, -1.0, 1.0]
    move = 2.0 * _product(blended_dual, conjugate)[:, :3] / squared_length
    return compose(move, blended, np.einsum("vi,vik->vk", weights, scales[bone_of]))


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products of quaternions x, y, z, w."""
    vectors = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    scalars = a[..., 3:] * b[..., 3:] - (a[..., :3] * b[..., :3]).sum(axis=-1, keepdims=True)
    return np.concatenate([vectors, scalars], axis=-1)
