"""A torch module of a learned model: codes to vertices, energies and a logit, differentiable."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from lcollision_core.acap.codec import BLOCK_POSES
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.errors import ShapeError
from lcollision_core.jobs import for_blocks
from lcollision_core.predictor.predictor import CollisionPredictor


class PoseOutput(NamedTuple):
    """The outputs of a `PoseModule` for B poses, on the codes' device and in their precision.

    Attributes
    ----------
    vertices : (B, V, 3), in the model's unit
    domain_energy : (B, K) S_k >= 0, in normalised length squared; (B, 1) without domains
    collision_logit : (B,) above 0, a pose is called colliding
    """

    vertices: torch.Tensor
    domain_energy: torch.Tensor
    collision_logit: torch.Tensor


class PoseModule(torch.nn.Module):
    """A learned model, differentiable by its latent codes, for use in a loss.

    Vertices are those of `LearnedBody.decode`. The decoder is fixed and solves a sparse system on
    the CPU, to which codes of another device are copied; the predictor runs on the module's device.
    No parameter requires a gradient.

    Parameters
    ----------
    embedding : decodes the codes
    predictor : of the embedding
    unit : a normalised length of 1 in the model's unit

    Examples
    --------
    ``docs/examples/collision_loss.py`` trains with the collision loss::

        module = LearnedBody.load("body").torch_module()
        latent = torch.zeros(8, module.latent_size, requires_grad=True)
        (loss_of(module.decode(latent)) + torch.relu(module.logit(latent)).mean()).backward()
    """

    def __init__(
        self, embedding: Embedding, predictor: CollisionPredictor, unit: float = 1.0
    ) -> None:
        super().__init__()
        self.network = predictor.network()
        self.latent_size = embedding.latent_size
        self._embedding, self._predictor, self._unit = embedding, predictor, unit
        self._energy_scale = predictor.facts.energy_scale
        self._logit_shift = predictor.facts.logit_shift

    def forward(self, latent: torch.Tensor) -> PoseOutput:
        """Decode and predict (B, D) latent codes.

        Raises
        ------
        ShapeError : another shape.
        """
        return PoseOutput(self.decode(latent), *self.predict(latent))

    def decode(self, latent: torch.Tensor) -> torch.Tensor:
        """Return the (B, V, 3) vertices of (B, D) latent codes.

        Raises
        ------
        ShapeError : another shape.
        """
        self._require(latent)
        vertices: torch.Tensor = _Decode.apply(latent, self._embedding)  # type: ignore[no-untyped-call]
        return vertices * self._unit

    def predict(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the energies and the logits of (B, D) latent codes: see `PoseOutput`.

        Raises
        ------
        ShapeError : another shape.
        """
        self._require(latent)
        output = self.network(latent)
        energy = output.domain_energy.clamp_min(0.0) * self._energy_scale
        return energy, output.logit + self._logit_shift

    def logit(self, latent: torch.Tensor) -> torch.Tensor:
        """Return only the (B,) logits of (B, D) latent codes.

        On the CPU, presets with compiled loops take a fraction of torch's time.

        Raises
        ------
        ShapeError : another shape or, on the CPU, a number that is not finite.
        """
        self._require(latent)
        if latent.device.type != "cpu" or self._predictor.needs_torch:
            return self.predict(latent)[1]
        logit: torch.Tensor = _Logit.apply(latent, self._predictor)  # type: ignore[no-untyped-call]
        return logit

    def _require(self, latent: torch.Tensor) -> None:
        if latent.ndim != 2 or latent.shape[1] != self.latent_size:
            expected = f"of shape (B, {self.latent_size})"
            raise ShapeError.must_be("latent", expected, tuple(latent.shape))


class _Decode(torch.autograd.Function):
    """Differentiable `Embedding.decode`."""

    @staticmethod
    def forward(ctx: Any, latent: torch.Tensor, embedding: Embedding) -> torch.Tensor:
        ctx.embedding = embedding
        ctx.save_for_backward(latent)
        return torch.from_numpy(embedding.decode(latent.detach().cpu().numpy())).to(latent)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_vertices: torch.Tensor) -> tuple[torch.Tensor, None]:
        (latent,) = ctx.saved_tensors
        codes, given = latent.detach().cpu().numpy(), grad_vertices.cpu().double().numpy()
        decoder, codec = ctx.embedding.decoder, ctx.embedding.codec
        grad_codes = np.empty(codes.shape)

        def pull(start: int, stop: int) -> None:
            features = decoder.features(codes[start:stop])
            grad_features = codec.decode_vjp(features, given[start:stop], n_threads=1)
            for row in range(start, stop):
                (grad_codes[row],) = decoder.pull_back(
                    codes[row], grad_features[row - start : row - start + 1]
                )

        for_blocks(pull, len(codes), BLOCK_POSES)
        return torch.from_numpy(grad_codes).to(latent), None


class _Logit(torch.autograd.Function):
    """Differentiable logit, by `CollisionPredictor.logit_and_gradient`."""

    @staticmethod
    def forward(ctx: Any, latent: torch.Tensor, predictor: CollisionPredictor) -> torch.Tensor:
        logit, gradient = predictor.logit_and_gradient(latent.detach().numpy())
        ctx.save_for_backward(torch.from_numpy(gradient).to(latent))
        return torch.from_numpy(logit).to(latent)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_logit: torch.Tensor) -> tuple[torch.Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return grad_logit[:, None] * gradient, None
