"""Skinning by dual quaternions, which keeps the volume where joints twist."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.formats.transforms import compose, decompose
from lcollision_core.meshes.topology import FloatArray


def blend_dual_quaternions(
    turns: FloatArray, bone_of: npt.NDArray[np.integer], weights: FloatArray
) -> FloatArray:
    """Return the transform of each vertex between those of its bones.

    Parameters
    ----------
    turns : (B, 4, 4) float64 array, how the bones move the vertices
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
    # All on the side of the bone of most weight: a quaternion and its negative are one rotation.
    main = np.take_along_axis(real, weights.argmax(axis=1)[:, None, None], axis=1)
    shares = weights * np.where((real * main).sum(axis=-1) < 0.0, -1.0, 1.0)
    blended = np.einsum("vi,vik->vk", shares, real)
    blended_dual = np.einsum("vi,vik->vk", shares, dual)
    squared_length = (blended**2).sum(axis=1, keepdims=True)
    conjugate = blended * [-1.0, -1.0, -1.0, 1.0]
    move = 2.0 * _product(blended_dual, conjugate)[:, :3] / squared_length
    return compose(move, blended, np.einsum("vi,vik->vk", weights, scales[bone_of]))


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the product of quaternions x, y, z, w."""
    vectors = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    scalars = a[..., 3:] * b[..., 3:] - (a[..., :3] * b[..., :3]).sum(axis=-1, keepdims=True)
    return np.concatenate([vectors, scalars], axis=-1)
