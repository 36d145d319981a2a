"""The body reduced to a few hundred points: a decoder of microseconds, differentiable."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from lcollision_core.predictor.inference.skin_geometry import SkinGeometry
from lcollision_core.predictor.inference.skin_kernels import SMALLEST_SQUARED_ANGLE

_DAMPING = 1e-8

_SYMMETRIC = [3, 4, 5, 4, 6, 7, 5, 7, 8]
"""Indices of the nine entries of S in the features."""


class ReducedBody(nn.Module):
    """Latent codes to the deformation of the skin and the positions of the points of the body.

    The gradients are those of the embedding. Positions are a linear map of those at the points, as
    the body's vertices are of all gradients, fitted to decoded poses.

    Parameters
    ----------
    skin : of the body
    """

    offset: torch.Tensor
    rest_frame: torch.Tensor
    scale: torch.Tensor
    target: torch.Tensor
    members: torch.Tensor
    points: torch.Tensor
    origin: torch.Tensor

    def __init__(self, skin: SkinGeometry) -> None:
        super().__init__()
        self.n_points = skin.n_points
        self._codes = [group.codes for group in skin.groups]
        fixed = {f"table{number}": group.table for number, group in enumerate(skin.groups)}
        for name in ("offset", "scale", "rest_frame", "target", "members"):
            fixed[name] = getattr(skin, name)
        for name, values in fixed.items():
            self.register_buffer(name, torch.tensor(values), persistent=False)
        # Of the model file: fitted, not a function of the embedding.
        self.register_buffer("points", torch.zeros(3 * self.n_points, self.n_points))
        self.register_buffer("origin", torch.zeros(3, self.n_points))

    def fit(self, latent: npt.NDArray[np.floating], positions: npt.NDArray[np.floating]) -> None:
        """Fit the positions' linear map by ridge regression.

        Parameters
        ----------
        latent : (n, D) array, n of some thousands
        positions : (n, P, 3) array, the points of the decoded poses, in normalised length
        """
        width = 3 * self.n_points + 3
        square = np.zeros((width, width))
        product = np.zeros((width, self.n_points))
        for start in range(0, len(latent), 256):
            part = slice(start, start + 256)
            with torch.no_grad():
                _, gradients, _ = self(torch.tensor(latent[part], dtype=torch.float32))
            rows = gradients[:, :, : self.n_points].reshape(-1, width - 3).double().numpy()
            rows = np.concatenate([rows, np.tile(np.eye(3), (len(rows) // 3, 1))], axis=1)
            square += rows.T @ rows
            product += rows.T @ positions[part].transpose(0, 2, 1).reshape(-1, self.n_points)
        square += _DAMPING * np.trace(square) / width * np.eye(width)
        solution = torch.tensor(np.linalg.solve(square, product), dtype=torch.float32)
        self.points.copy_(solution[:-3])
        self.origin.copy_(solution[-3:])

    def features(self, latent: torch.Tensor) -> torch.Tensor:
        """Return the (B, Q, 9) deformation features of the skin, of (B, D) codes."""
        products = [
            latent[:, codes] @ self.get_buffer(f"table{number}")
            for number, codes in enumerate(self._codes)
        ]
        n_rows, n_features = len(latent), self.offset.shape[1]
        outputs = torch.cat(products, dim=1).tanh().view(n_rows, len(self.target), n_features)
        offset = self.offset.repeat(n_rows, 1, 1)
        features: torch.Tensor = offset.index_add(1, self.target, outputs * self.scale)
        return features

    def forward(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the skin posed by (B, D) codes.

        Returns
        -------
        frame : (B, N, 3, 3) of the first points, R F with their frames F on the reference
        gradients : (B, 3, Q, 3) rows of the deformation gradients R S
        positions : (B, 3, P) of the points of the body, in normalised length
        """
        features = self.features(latent)
        rotation = _rotations(features[..., :3])
        stretch = features[..., _SYMMETRIC].view(*features.shape[:2], 3, 3)
        frame = rotation[:, : len(self.rest_frame)] @ self.rest_frame
        gradients = (rotation @ stretch).transpose(1, 2)
        positions = gradients[:, :, : self.n_points].flatten(2) @ self.points + self.origin
        return frame, gradients, positions

    def fold_view(self, frame: torch.Tensor, gradients: torch.Tensor) -> torch.Tensor:
        """Return how the skin is deformed about the fold sites, however the body is turned.

        Returns
        -------
        inputs : (S, B, 9 M) the members' gradients R S in the frame of each site's first member
        """
        (n_sites, n_members), n_rows = self.members.shape, len(frame)
        own = frame.index_select(1, self.members[:, 0]).transpose(2, 3).flatten(0, 1)
        taken = gradients.index_select(2, self.members.flatten())
        taken = taken.view(n_rows, 3, n_sites, 3 * n_members).transpose(1, 2).flatten(0, 1)
        local = (own @ taken).view(n_rows, n_sites, 3, n_members, 3)
        inputs: torch.Tensor = local.permute(1, 0, 3, 2, 4).flatten(2)
        return inputs


def _rotations(log: torch.Tensor) -> torch.Tensor:
    """Return exp of (..., 3) rotation vectors by Rodrigues' formula, smooth at 0."""
    squared = log.square().sum(dim=-1) + SMALLEST_SQUARED_ANGLE
    angle = squared.sqrt()
    versine = 2.0 * (0.5 * angle).sin().square()
    x, y, z = log.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    cross = cross.view(*log.shape, 3)
    outer = log[..., :, None] * log[..., None, :]
    cosine = (1.0 - versine)[..., None, None] * torch.eye(3).to(log)
    return (
        cosine
        + (angle.sin() / angle)[..., None, None] * cross
        + (versine / squared)[..., None, None] * outer
    )
