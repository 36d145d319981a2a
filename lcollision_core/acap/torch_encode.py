"""Encoding with gradients: the codec as a torch function."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from lcollision_core.acap.features import N_FEATURES, push_forward
from lcollision_core.acap.gradients import NORMAL_LENGTH, RingFit
from lcollision_core.meshes.topology import FloatArray, IntArray

if TYPE_CHECKING:
    from lcollision_core.acap.codec import AcapCodec


class _Encode(torch.autograd.Function):
    """Forward: the codec. Backward: the implicit function theorem at each vertex.

    A feature f is given by T = exp(log R) S, so that df = J^-1 dT with the nine by nine J that
    decoding has anyway; T depends on the vertices through its one-ring. Whole turns and flipped
    axes are locally constant. All runs in float64 on the CPU.
    """

    @staticmethod
    def forward(ctx: Any, vertices: torch.Tensor, codec: AcapCodec) -> torch.Tensor:
        ctx.codec = codec
        features = codec.encode(vertices.detach().cpu().numpy()).features
        ctx.save_for_backward(vertices, torch.from_numpy(features))
        return torch.from_numpy(features).to(vertices)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_features: torch.Tensor) -> tuple[torch.Tensor, None]:
        vertices, features = ctx.saved_tensors
        poses = vertices.detach().cpu().to(torch.float64).numpy()
        given = by_features.detach().cpu().to(torch.float64).numpy()
        pulled = np.empty_like(poses)
        for pose, (at, by_pose) in enumerate(zip(features.numpy(), given, strict=True)):
            pulled[pose] = ctx.codec.encode_vjp(poses[pose], at, by_pose)
        return torch.from_numpy(pulled).to(vertices), None


def encode_torch(codec: AcapCodec, vertices: torch.Tensor) -> torch.Tensor:
    """Compute deformation features differentiably.

    Parameters
    ----------
    codec : the reference's codec
    vertices : (..., V, 3) float32 or float64 tensor, aligned to the reference, in heights

    Returns
    -------
    features : (..., V, 9) tensor of the same dtype and device, as `AcapCodec.encode` gives

    Raises
    ------
    ShapeError : V differs, or a vertex is not finite.

    Notes
    -----
    First derivatives only. Where there is none, as at a one-ring crushed to a line or a rotation by
    exactly a whole turn other than none, the one of least norm stands in.
    """
    batch = vertices.reshape(-1, *vertices.shape[-2:])
    features: torch.Tensor = _Encode.apply(batch, codec)  # type: ignore[no-untyped-call]
    return features.reshape(*vertices.shape[:-1], N_FEATURES)


def pull_features(features: FloatArray, by_features: FloatArray) -> FloatArray:
    """Turn a loss's derivative by the features of one pose into the one by T.

    Parameters
    ----------
    features : (V, 9) float64 array, where
    by_features : (V, 9) float64 array

    Returns
    -------
    by_gradients : (V, 3, 3) float64 array
    """
    n_vertices = len(features)
    unit_changes = np.repeat(np.eye(N_FEATURES)[:, None], n_vertices, axis=1)
    moved = np.empty((N_FEATURES, n_vertices, 3, 3))
    push_forward(features, unit_changes, moved)
    # Row by row the derivatives of T along each feature: the transpose of J.
    jacobian_transposed = moved.reshape(N_FEATURES, n_vertices, 9).transpose(1, 0, 2)
    try:
        solved = np.linalg.solve(jacobian_transposed, by_features[:, :, None])
    except np.linalg.LinAlgError:
        solved = np.linalg.pinv(jacobian_transposed) @ by_features[:, :, None]
    by_gradients: FloatArray = np.asarray(solved, dtype=np.float64).reshape(n_vertices, 3, 3)
    return by_gradients


def pull_ring_gradients(
    vertices: FloatArray, faces: IntArray, fit: RingFit, by_gradients: FloatArray
) -> FloatArray:
    """Turn a loss's derivative by T into the one by the vertices that T was taken from.

    Parameters
    ----------
    vertices : (V, 3) float64 array, where
    faces : (F, 3) int32 array
    fit : of the reference's one-rings
    by_gradients : (V, 3, 3) float64 array

    Returns
    -------
    by_vertices : (V, 3) float64 array
    """
    with torch.enable_grad():  # it is off within another function's backward
        points = torch.tensor(vertices, requires_grad=True)
        gradients = _ring_gradients(points, faces, fit)
        (pulled,) = torch.autograd.grad(gradients, points, torch.from_numpy(by_gradients))
    by_vertices: FloatArray = pulled.numpy()
    return by_vertices


def _ring_gradients(points: torch.Tensor, faces: IntArray, fit: RingFit) -> torch.Tensor:
    """Return what `gradients.deformation_gradients` writes, (V, 3, 3), less the constant part."""
    owner = torch.from_numpy(np.repeat(np.arange(len(points)), np.diff(fit.ring_start)))
    spokes = points[owner] - points[torch.from_numpy(fit.ring.astype(np.int64))]
    normals = _scaled_normals(points, torch.from_numpy(faces.astype(np.int64)), owner, spokes)
    of_spokes = spokes[:, :, None] * torch.from_numpy(fit.ring_solution)[:, None, :]
    of_normals = normals[:, :, None] * torch.from_numpy(fit.normal_solution)[:, None, :]
    return of_normals.index_add(0, owner, of_spokes)


def _scaled_normals(
    points: torch.Tensor, faces: torch.Tensor, owner: torch.Tensor, spokes: torch.Tensor
) -> torch.Tensor:
    """Return what `gradients.scaled_normals` writes, (V, 3)."""
    corner, second, third = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    of_face = torch.linalg.cross(second - corner, third - corner)
    none = torch.zeros_like(points)
    normals = none.index_add(0, faces.reshape(-1), of_face.repeat_interleave(3, dim=0))
    lengths = normals.norm(dim=1)
    has_normal = lengths > 0.0
    edge_sums = none[:, 0].index_add(0, owner, spokes.norm(dim=1))
    degrees = none[:, 0].index_add(0, owner, torch.ones_like(owner, dtype=points.dtype))
    scale = NORMAL_LENGTH * edge_sums[has_normal] / degrees[has_normal] / lengths[has_normal]
    return none.index_put((has_normal,), normals[has_normal] * scale[:, None])
