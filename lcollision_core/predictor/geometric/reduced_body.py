"""The body reduced to a few hundred points: a decoder of microseconds, differentiable."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from lcollision_core.predictor.geometric.field import Decoding, decode_features, deform
from lcollision_core.predictor.inference.skin_geometry import SkinGeometry

_DAMPING = 1e-8


class ReducedBody(nn.Module):
    """Latent codes to the deformation of the skin, and to where the points of the body are.

    The gradients are those of the embedding. Places are a linear map of those at the points, as the
    body's vertices are of all gradients, fitted to decoded poses.

    Parameters
    ----------
    skin : of the body
    """

    offset: torch.Tensor
    rest_frame: torch.Tensor
    scale: torch.Tensor
    tables: torch.Tensor
    target: torch.Tensor
    points: torch.Tensor
    origin: torch.Tensor

    def __init__(self, skin: SkinGeometry) -> None:
        super().__init__()
        self.n_placed = skin.n_points
        # No buffer: it stays on the CPU.
        self._blocks = torch.tensor(skin.blocks)
        for name in ("tables", "offset", "scale", "rest_frame"):
            kept = torch.tensor(getattr(skin, name), dtype=torch.float32)
            self.register_buffer(name, kept, persistent=False)
        self.register_buffer("target", torch.tensor(skin.target), persistent=False)
        # Of the model file: fitted, not a function of the embedding.
        self.register_buffer("points", torch.zeros(3 * self.n_placed, self.n_placed))
        self.register_buffer("origin", torch.zeros(3, self.n_placed))

    def fit(self, latent: npt.NDArray[np.floating], positions: npt.NDArray[np.floating]) -> None:
        """Fit the places' linear map by ridge regression.

        Parameters
        ----------
        latent : (n, D) array, n of some thousands
        positions : (n, P, 3) array, the places of the decoded poses, in heights
        """
        width = 3 * self.n_placed + 3
        square = np.zeros((width, width))
        product = np.zeros((width, self.n_placed))
        for start in range(0, len(latent), 256):
            part = slice(start, start + 256)
            with torch.no_grad():
                _, gradients, _ = self(torch.tensor(latent[part], dtype=torch.float32))
            rows = gradients[:, :, : width - 3].reshape(-1, width - 3).double().numpy()
            rows = np.concatenate([rows, np.tile(np.eye(3), (len(rows) // 3, 1))], axis=1)
            square += rows.T @ rows
            product += rows.T @ positions[part].transpose(0, 2, 1).reshape(-1, self.n_placed)
        square += _DAMPING * np.trace(square) / width * np.eye(width)
        solution = torch.tensor(np.linalg.solve(square, product), dtype=torch.float32)
        self.points.copy_(solution[:-3])
        self.origin.copy_(solution[-3:])

    def features(self, latent: torch.Tensor) -> torch.Tensor:
        """Return the (B, Q, 9) deformation features at the points, of (B, D) codes."""
        decoding = Decoding(self._blocks, self.tables, self.target, self.offset, self.scale)
        return decode_features(latent, decoding)

    def forward(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return frames (B, N, 3, 3), rows (B, 3, 3 Q) of gradients, and places (B, 3, P).

        Places are in heights.
        """
        frame, rows = deform(self.features(latent), self.rest_frame)
        return frame, rows, rows[:, :, : 3 * self.n_placed] @ self.points + self.origin
