"""The body reduced to a few hundred points: a decoder of microseconds, differentiable."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.embedding import Embedding
from lcollision_core.predictor.look import deform

_DAMPING = 1e-8


class ReducedBody(nn.Module):
    """Latent codes to some points of the body and their frames.

    The gradients are those of the embedding at the points. The points are a linear map of them,
    as the body's vertices are of all gradients, fitted to decoded poses.

    Parameters
    ----------
    embedding : of the body
    vertex : (P,) integer array, the points
    rest_frame : (P, 3, 3) array, their frames on the reference, as columns
    """

    offset: torch.Tensor
    rest_frame: torch.Tensor
    scale: torch.Tensor
    points: torch.Tensor
    origin: torch.Tensor
    identity: torch.Tensor

    def __init__(
        self,
        embedding: Embedding,
        vertex: npt.NDArray[np.int64],
        rest_frame: npt.NDArray[np.float64],
    ) -> None:
        super().__init__()
        decoder = embedding.decoder
        self.n_points = len(vertex)
        self._codes: list[slice] = []
        start = 0
        for number, group in enumerate(decoder.groups):
            n_codes = len(group.weights)
            _, place, own = np.intersect1d(vertex, group.support, return_indices=True)
            weights = group.weights.reshape(n_codes, -1, N_FEATURES)[:, own]
            self._keep(f"table_{number}", weights.reshape(n_codes, -1))
            self.register_buffer(f"place_{number}", torch.tensor(place), persistent=False)
            self._codes.append(slice(start, start + n_codes))
            start += n_codes
        self._keep("offset", decoder.offset[vertex])
        self._keep("scale", decoder.scale)
        self._keep("rest_frame", rest_frame)
        # Of the model file: fitted, not a function of the embedding.
        self.register_buffer("points", torch.zeros(3 * self.n_points, self.n_points))
        self.register_buffer("origin", torch.zeros(3, self.n_points))

    def _keep(self, name: str, values: npt.NDArray[np.floating]) -> None:
        kept = torch.tensor(np.asarray(values, dtype=np.float32))
        self.register_buffer(name, kept, persistent=False)

    def fit(self, latent: npt.NDArray[np.floating], positions: npt.NDArray[np.floating]) -> None:
        """Fit the points' linear map by ridge regression.

        Parameters
        ----------
        latent : (n, D) array, n of some thousands
        positions : (n, P, 3) array, the points of the decoded poses, in heights
        """
        width = 3 * self.n_points + 3
        square = np.zeros((width, width))
        product = np.zeros((width, self.n_points))
        for start in range(0, len(latent), 256):
            part = slice(start, start + 256)
            with torch.no_grad():
                codes = torch.tensor(latent[part], dtype=torch.float32)
                _, gradients = deform(self.features(codes), self.rest_frame)
            rows = gradients.reshape(-1, width - 3).double().numpy()
            rows = np.concatenate([rows, np.tile(np.eye(3), (len(rows) // 3, 1))], axis=1)
            square += rows.T @ rows
            product += rows.T @ positions[part].transpose(0, 2, 1).reshape(-1, self.n_points)
        square += _DAMPING * np.trace(square) / width * np.eye(width)
        solution = torch.tensor(np.linalg.solve(square, product), dtype=torch.float32)
        self.points.copy_(solution[:-3])
        self.origin.copy_(solution[-3:])

    def features(self, latent: torch.Tensor) -> torch.Tensor:
        """Return the (B, P, 9) deformation features at the points, of (B, D) codes."""
        features = self.offset.expand(len(latent), -1, -1)
        for number, codes in enumerate(self._codes):
            output = torch.tanh(latent[:, codes] @ getattr(self, f"table_{number}"))
            part = output.reshape(len(latent), -1, N_FEATURES) * self.scale
            features = features.index_add(1, getattr(self, f"place_{number}"), part)
        return features

    def forward(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the points' frames (B, P, 3, 3) and places (B, 3, P), in heights."""
        frame, rows = deform(self.features(latent), self.rest_frame)
        return frame, rows @ self.points + self.origin
