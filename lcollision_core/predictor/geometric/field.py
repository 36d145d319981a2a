"""Contact features at the points of the body, in torch: for a GPU, and for derivatives."""

from __future__ import annotations

import torch

from lcollision_core.predictor.inference.field_kernels import (
    BEHIND,
    FADE,
    FULL,
    RADII,
    SOME,
    STEEPNESS,
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
