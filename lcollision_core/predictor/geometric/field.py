"""Contact features at the points of the body, in torch; the sums themselves compiled on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from lcollision_core.predictor.inference import field_kernels
from lcollision_core.predictor.inference.field_kernels import (
    BEHIND,
    FADE,
    FULL,
    RADII,
    SOME,
    STEEPNESS,
    UNITS,
)
from lcollision_core.predictor.inference.skin_geometry import SkinGeometry


class ContactField(torch.nn.Module):
    """Sums at each point over distant parts of the skin that come near it.

    Implicit moving least squares (Kolluri 2008): another point at distance d weighs
    (1 - d^2 / radius^2)^3, and less as it falls behind the tangent plane. Whichever points they
    are, so there is no list of who may meet whom; smooth, and exactly 0 where nothing is near.

    Parameters
    ----------
    skin : of the body
    """

    geodesic_neighbours: torch.Tensor

    def __init__(self, skin: SkinGeometry) -> None:
        super().__init__()
        self._order, self._blocks = skin.order, skin.neighbour_blocks
        near = torch.tensor(skin.geodesic_neighbours)
        self.register_buffer("geodesic_neighbours", near, persistent=False)

    def forward(self, frame: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
        """Return the contact features.

        Parameters
        ----------
        frame : (B, N, 3, 3) of each of the first points, as columns, the outer normal first
        positions : (B, 3, P)

        Returns
        -------
        field : (P, B, 2, 8) for each radius: how much is near, from 0 to 1; and weighted means of
            the point's heights above the others' tangent planes, of the offsets to them (3) and of
            their normals (3), in the point's frame, heights and offsets in radii
        """
        if frame.device.type == "cpu":
            field: torch.Tensor = _CompiledField.apply(frame, positions, self._order, self._blocks)  # type: ignore[no-untyped-call]
            return field
        return self.by_torch(frame, positions)

    def by_torch(self, frame: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
        """Return what `forward` does, on any device."""
        frame = frame[:, : positions.shape[2]]
        offset = positions[:, :, None] - positions[..., None]
        squared = offset.square().sum(dim=1) + self.geodesic_neighbours
        normal = frame[..., 0]
        step = ((torch.einsum("bipq,bpi->bpq", offset, normal) + BEHIND) / FADE).clamp(0.0, 1.0)
        facing = step.square() * (3.0 - 2.0 * step)
        above = -torch.einsum("bipq,bqi->bpq", offset, normal)
        parts = []
        for steepness, radius in zip(STEEPNESS, RADII, strict=True):
            weight = facing * (1.0 - squared * steepness).clamp_min(0.0).pow(3)
            total = weight.sum(dim=2, keepdim=True)
            height = (weight * above).sum(dim=2, keepdim=True)
            offsets = torch.einsum("bpq,bipq,bpij->bpj", weight, offset, frame)
            normals = torch.einsum("bpq,bqi,bpij->bpj", weight, normal, frame)
            sums = torch.cat([height / radius, offsets / radius, normals], dim=2)
            parts.append(torch.cat([total / (total + FULL), sums / (total + SOME)], dim=2))
        return torch.stack(parts, dim=2).transpose(0, 1)


class _CompiledField(torch.autograd.Function):
    """The compiled loops: in torch, a step of training on the CPU takes thirty times as long."""

    @staticmethod
    def forward(
        ctx: Any, frame: torch.Tensor, positions: torch.Tensor, order: Any, blocks: Any
    ) -> torch.Tensor:
        frames, points = _arrays(frame, positions)
        ctx.order, ctx.blocks = order, blocks.astype(frames.dtype, copy=False)
        field = np.empty((positions.shape[2], len(frame), *UNITS.shape), dtype=frames.dtype)
        field_kernels.contact_field(frames, points, ctx.order, ctx.blocks, field)
        result = torch.from_numpy(field)
        ctx.save_for_backward(frame, positions, result)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_field: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        frame, positions, field, grad = _arrays(*ctx.saved_tensors, grad_field)
        gradients = np.zeros_like(frame), np.zeros_like(positions)
        field_kernels.contact_field_backward(
            frame, positions, ctx.order, ctx.blocks, field, grad, *gradients
        )
        return *map(torch.from_numpy, gradients), None, None


def _arrays(*tensors: torch.Tensor) -> list[Any]:
    return [values.detach().contiguous().numpy() for values in tensors]
