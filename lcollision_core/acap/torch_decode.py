"""Decoding with gradients: the codec as a torch function."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

if TYPE_CHECKING:
    from lcollision_core.acap.codec import AcapCodec


class _Decode(torch.autograd.Function):
    """Forward: exponential map and substitution. Backward: one more substitution, then its pull.

    Both run in float64 on the CPU, where the factor lives, whatever the tensor's dtype and device.
    """

    @staticmethod
    def forward(ctx: Any, features: torch.Tensor, codec: AcapCodec) -> torch.Tensor:
        ctx.codec = codec
        ctx.save_for_backward(features)
        vertices = codec.decode(features.detach().cpu().numpy())
        return torch.from_numpy(vertices).to(features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_vertices: torch.Tensor) -> tuple[torch.Tensor, None]:
        (features,) = ctx.saved_tensors
        by_features = ctx.codec.decode_vjp(
            features.detach().cpu().numpy(), by_vertices.detach().cpu().numpy()
        )
        return torch.from_numpy(by_features).to(features), None


def decode_torch(codec: AcapCodec, features: torch.Tensor) -> torch.Tensor:
    """Rebuild poses differentiably.

    Parameters
    ----------
    codec : the reference's codec
    features : (..., V, 9) float32 or float64 tensor, unscaled

    Returns
    -------
    vertices : (..., V, 3) tensor of the same dtype and device, as `AcapCodec.decode` gives

    Raises
    ------
    ShapeError : V differs.

    Notes
    -----
    First derivatives only. They are exact and finite everywhere, at theta = 0 too.
    """
    batch = features.reshape(-1, *features.shape[-2:])
    vertices: torch.Tensor = _Decode.apply(batch, codec)  # type: ignore[no-untyped-call]
    return vertices.reshape(*features.shape[:-1], 3)
