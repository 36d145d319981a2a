"""What each point of the body sees of its partners: compiled on the CPU, torch elsewhere."""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable

from lcollision_core.predictor import look_kernels
from lcollision_core.predictor.look_kernels import (
    REACH,
    SMALLEST_SQUARED_ANGLE,
    SMALLEST_SQUARED_DISTANCE,
)

_SYMMETRIC = [3, 4, 5, 4, 6, 7, 5, 7, 8]
"""Where the features hold the nine entries of S."""


def deform(features: torch.Tensor, rest_frame: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Turn the points' frames, and return their deformation gradients R S.

    Parameters
    ----------
    features : (B, P, 9) unscaled deformation features: log R, then the upper triangle of S
    rest_frame : (P, 3, 3) frames on the reference, as columns

    Returns
    -------
    frame : (B, P, 3, 3) R F
    rows : (B, 3, 3 P) the first, second and third rows of all gradients
    """
    if features.device.type == "cpu":
        frame, rows = _Deform.apply(features, rest_frame)  # type: ignore[no-untyped-call]
        return frame, rows.flatten(2)
    rotation = _rotations(features[..., :3])
    stretch = features[..., _SYMMETRIC].reshape(*features.shape[:-1], 3, 3)
    return rotation @ rest_frame, (rotation @ stretch).transpose(1, 2).flatten(2)


def look(
    frame: torch.Tensor, places: torch.Tensor, partners: torch.Tensor, n_far: int
) -> torch.Tensor:
    """Return where each point's partners lie in its frame.

    Parameters
    ----------
    frame : (B, P, 3, 3) of each point, as columns
    places : (B, 3, P)
    partners : (P, n_far + n_near) int32, points
    n_far : of them, those whose offset is given as direction times closeness exp(-d / `REACH`)

    Returns
    -------
    inputs : (P, B, 4 n_far + 3 n_near): far offsets by axis, closenesses, near offsets by axis
    """
    if frame.device.type == "cpu":
        inputs: torch.Tensor = _Look.apply(frame, places, partners, n_far)  # type: ignore[no-untyped-call]
        return inputs
    columns = partners.long().flatten()
    offset = places[:, :, columns].reshape(*places.shape, -1) - places[..., None]
    local = torch.einsum("bipq,bpij->jbpq", offset, frame)
    far, near = local[..., :n_far], local[..., n_far:]
    distance = (far.square().sum(dim=0) + SMALLEST_SQUARED_DISTANCE).sqrt()
    closeness = torch.exp(distance / -REACH)
    shortened = far * (closeness / distance)
    return torch.cat([*shortened, closeness, *near], dim=-1).transpose(0, 1)


def _rotations(log: torch.Tensor) -> torch.Tensor:
    """Return exp of (..., 3) rotation vectors by Rodrigues' formula, smooth at 0."""
    squared = log.square().sum(dim=-1) + SMALLEST_SQUARED_ANGLE
    angle = squared.sqrt()
    versine = 2.0 * (0.5 * angle).sin().square()
    x, y, z = log.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    cross = cross.reshape(*log.shape[:-1], 3, 3)
    outer = log[..., :, None] * log[..., None, :]
    cosine = (1.0 - versine)[..., None, None] * torch.eye(3).to(log)
    return (
        cosine
        + (angle.sin() / angle)[..., None, None] * cross
        + (versine / squared)[..., None, None] * outer
    )


class _Deform(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: torch.Tensor, rest_frame: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.save_for_backward(features, rest_frame)
        n_rows, n_points, _ = features.shape
        frame = features.new_empty((n_rows, n_points, 3, 3))
        rows = features.new_empty((n_rows, 3, n_points, 3))
        look_kernels.deform(*_arrays(features, rest_frame, frame, rows))
        return frame, rows

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_frame: torch.Tensor, by_rows: torch.Tensor
    ) -> tuple[torch.Tensor, None]:
        features, rest_frame = ctx.saved_tensors
        by_features = torch.empty_like(features, memory_format=torch.contiguous_format)
        look_kernels.deform_backward(*_arrays(features, rest_frame, by_frame, by_rows, by_features))
        return by_features, None


class _Look(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, frame: torch.Tensor, places: torch.Tensor, partners: torch.Tensor, n_far: int
    ) -> torch.Tensor:
        ctx.save_for_backward(frame, places, partners)
        ctx.n_far = n_far
        n_rows, n_points = frame.shape[:2]
        n_inputs = 3 * partners.shape[1] + n_far
        inputs = frame.new_empty((n_points, n_rows, n_inputs))
        seen_frame, seen_places, seen_partners = _arrays(frame, places, partners)
        look_kernels.look(seen_frame, seen_places, seen_partners, n_far, inputs.numpy())
        return inputs

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_inputs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, None, None]:
        frame, places, partners = ctx.saved_tensors
        by_frame, by_places = (
            torch.zeros_like(values, memory_format=torch.contiguous_format)
            for values in (frame, places)
        )
        seen_frame, seen_places, seen_partners = _arrays(frame, places, partners)
        look_kernels.look_backward(
            seen_frame,
            seen_places,
            seen_partners,
            ctx.n_far,
            *_arrays(by_inputs, by_frame, by_places),
        )
        return by_frame, by_places, None, None


def _arrays(*tensors: torch.Tensor) -> list[Any]:
    return [values.detach().contiguous().numpy() for values in tensors]
