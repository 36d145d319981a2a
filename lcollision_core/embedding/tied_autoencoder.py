"""One autoencoder of either level: a graph convolution and a fully connected layer, tied.

Encoding is z = C tanh(conv(x)); decoding runs the same weights backwards, x̂ = tanh(convᵀ(Cᵀ z)).
With conv(x)_i = x_i W_self + mean(x_j, j in N(i)) W_ring and convᵀ(y)_i = y_i W_selfᵀ +
mean(y_j) W_ringᵀ, the decoder is tanh of one linear map of z, which `decoder_map` returns: that is
what the decoder stores.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from torch.autograd.function import once_differentiable

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.embedding import autoencoders


class _RingMean(torch.autograd.Function):
    """`autoencoders.ring_mean`; torch's own sparse product warns and differs by thread count."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, ring: sparse.csr_matrix) -> torch.Tensor:
        ctx.ring = ring
        return torch.from_numpy(autoencoders.ring_mean(values.detach().numpy(), ring))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_mean: torch.Tensor) -> tuple[torch.Tensor, None]:
        return torch.from_numpy(autoencoders.ring_mean(grad_mean.numpy(), ctx.ring.T)), None


def ring_mean(values: torch.Tensor, ring: sparse.csr_matrix) -> torch.Tensor:
    """Average (m, n, 9) values over the one-rings, differentiably; `ring` is (n, n)."""
    mean: torch.Tensor = _RingMean.apply(values, ring)  # type: ignore[no-untyped-call]
    return mean


class TiedAutoencoder(torch.nn.Module):
    """Features on n vertices to m codes and back.

    Parameters
    ----------
    components : (m, n, 9) array, the fully connected layer C; kept at unit norm per code, so that
        codes are bounded by the features' norm and a penalty on C cannot be escaped by scaling
    ring : (n, n) sparse matrix that averages over one-rings

    Notes
    -----
    The convolution starts as the identity: W_self = I, W_ring = 0. Its two (9, 9) matrices are
    shared over the vertices, as in the paper; there is no bias.
    """

    def __init__(self, components: npt.NDArray[np.floating], ring: sparse.csr_matrix) -> None:
        super().__init__()
        weights = torch.tensor(components, dtype=torch.get_default_dtype())
        width = weights.shape[2]
        self.components = torch.nn.Parameter(weights)
        self.self_weight = torch.nn.Parameter(torch.eye(width))
        self.ring_weight = torch.nn.Parameter(torch.zeros(width, width))
        self.ring = ring.astype(np.float64 if weights.dtype == torch.float64 else np.float32)

    def unit_components(self) -> torch.Tensor:
        """Return C, (m, n, 9), each code's weights of norm 1."""
        norms = self.components.flatten(1).norm(dim=1)
        unit: torch.Tensor = self.components / norms[:, None, None]
        return unit

    def encode(self, features: torch.Tensor, ring_features: torch.Tensor) -> torch.Tensor:
        """Return the (B, m) codes of (B, n, 9) features, given their means over one-rings too."""
        hidden = torch.tanh(features @ self.self_weight + ring_features @ self.ring_weight)
        codes: torch.Tensor = hidden.flatten(1) @ self.unit_components().flatten(1).T
        return codes

    def decoder_map(self) -> torch.Tensor:
        """Return convᵀ(Cᵀ), (m, n, 9): decoding is tanh of its combination by the codes."""
        components = self.unit_components()
        around = ring_mean(components, self.ring)
        return components @ self.self_weight.T + around @ self.ring_weight.T

    def decode(self, codes: torch.Tensor) -> torch.Tensor:
        """Return the (B, n, 9) features of (B, m) codes."""
        weights = self.decoder_map()
        return torch.tanh(codes @ weights.flatten(1)).reshape(len(codes), *weights.shape[1:])

    def forward(self, features: torch.Tensor, ring_features: torch.Tensor) -> torch.Tensor:
        """Encode and decode."""
        return self.decode(self.encode(features, ring_features))


class _Decode(torch.autograd.Function):
    """`AcapCodec.decode`, in float64 on the CPU, where the factor lies."""

    @staticmethod
    def forward(ctx: Any, features: torch.Tensor, codec: AcapCodec) -> torch.Tensor:
        ctx.codec = codec
        ctx.save_for_backward(features)
        return torch.from_numpy(codec.decode(features.detach().numpy())).to(features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_vertices: torch.Tensor) -> tuple[torch.Tensor, None]:
        (features,) = ctx.saved_tensors
        grad_features = ctx.codec.decode_vjp(features.detach().numpy(), grad_vertices.numpy())
        return torch.from_numpy(grad_features).to(features), None


def decode_features(features: torch.Tensor, codec: AcapCodec) -> torch.Tensor:
    """Rebuild the (B, V, 3) poses of (B, V, 9) unscaled features, with first derivatives."""
    vertices: torch.Tensor = _Decode.apply(features, codec)  # type: ignore[no-untyped-call]
    return vertices
