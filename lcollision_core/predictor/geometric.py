"""The default preset's network: it looks at the body's shape instead of the latent codes.

A latent code is a poor coordinate for collision: whether a hand touches a thigh depends on where
both are, and that on every joint between. So the codes are decoded to a few hundred points of the
skin first (`ReducedBody`), and for each point a small network of its own is shown where some
others lie in its frame: points of other parts that come near, and the skin about it, that may
fold. It says whether the patch of skin round its point is hit, and how deeply, and is taught that
by the exact energies of the patch, which are worth hundreds of labels a pose. What follows joins
the patches to the domains' energies and the logit.

What was tried, on SCAPE (110 codes, 66.2 % of the box collides) at M = 50 000, CLASSIFY in per cent
of the 15 000 samples held out, one seed each:

===============================================================  ========
the paper's preset                                               79.2
300 points, 24 far partners and no near ones                     89.0
the same with 10 near partners: folds of skin show               91.3
the same with the exact places of the points, not the reduced    91.0
the same with a head of 64, dropout 0.25 and weight decay 0.5    89.9
200 points, 16 far and 8 near partners: half the time; the one   90.2
===============================================================  ========

The rows set the limit, not the points: the built-in body has 94.6 at M = 50 000 and 96.0 at
300 000.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, silu, smooth_l1_loss

from lcollision_core.errors import LCollisionError
from lcollision_core.predictor.body_points import FAR_PARTNERS, NEAR_PARTNERS, BodyPoints
from lcollision_core.predictor.look import look
from lcollision_core.predictor.losses import rank_loss
from lcollision_core.predictor.networks import (
    NetworkOutput,
    PredictorNetwork,
    SeededLinear,
    StackedLinear,
    Targets,
)
from lcollision_core.predictor.reduced_body import ReducedBody

if TYPE_CHECKING:
    from lcollision_core.embedding import Embedding
    from lcollision_core.labels import LabelRows
    from lcollision_core.predictor.config import PredictorConfig

PATCH_WIDTH = 32
HEAD_SIZES = (256, 64)

_N_INPUTS = 4 * FAR_PARTNERS + 3 * NEAR_PARTNERS
_PATCH_WEIGHT, _DEPTH_WEIGHT = 20.0, 5.0
"""Of the patches' cross entropy and depth, which are means over hundreds of mostly free patches."""

_FITTED_POSES = 4000
_MEASURED_POSES = 2000
_LEAST_DEVIATION = 1e-3
_ROWS_AT_ONCE = 32
"""Rows whose intermediate arrays stay in the caches."""


class _Auxiliary(NamedTuple):
    """What the loss needs beside energies and logit.

    Attributes
    ----------
    patch_logit : (B, P) of each patch being hit
    patch_root : (B, P) square roots of the patches' energies
    root_energy : (B, K + 1) square roots of the domains' energies and of their sum
    """

    patch_logit: torch.Tensor
    patch_root: torch.Tensor
    root_energy: torch.Tensor


class GeometricNetwork(PredictorNetwork):
    """Patches of skin that watch what comes near.

    Parameters
    ----------
    embedding : of the body
    seed : of the initial weights
    """

    partners: torch.Tensor
    input_mean: torch.Tensor
    input_deviation: torch.Tensor

    def __init__(self, embedding: Embedding, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self._points = BodyPoints.of(embedding)
        n_points, n_domains = len(self._points.vertex), embedding.n_domains
        self.body = ReducedBody(embedding, self._points.vertex, self._points.frame)
        self.register_buffer("partners", torch.zeros(n_points, FAR_PARTNERS + NEAR_PARTNERS).int())
        self.register_buffer("input_mean", torch.zeros(n_points, 1, _N_INPUTS))
        self.register_buffer("input_deviation", torch.ones(n_points, 1, _N_INPUTS))
        self.patch_in = StackedLinear(n_points, _N_INPUTS, PATCH_WIDTH, generator)
        self.patch_out = StackedLinear(n_points, PATCH_WIDTH, 2, generator)
        with torch.no_grad():
            # Most patches are free in most poses.
            self.patch_out.bias[:, :, 0] = -3.0
        sizes = (2 * n_points, *HEAD_SIZES)
        self.head = nn.ModuleList(
            SeededLinear(n_in, n_out, generator)
            for n_in, n_out in zip(sizes, (*HEAD_SIZES, n_domains + 2), strict=True)
        )
        self.any_hit = nn.Parameter(torch.tensor([1.0, 0.0]))

    @classmethod
    def build(
        cls,
        embedding: Embedding,
        config: PredictorConfig,
        rows: LabelRows | None = None,
        seed: int = 0,
    ) -> PredictorNetwork:
        """Make the network of an embedding, its points and inputs fitted to the rows' poses.

        Raises
        ------
        LCollisionError : a network without domains is asked for.
        """
        if not config.by_domain:
            raise LCollisionError(
                "only the preset paper has a network without domains; add --preset paper"
            )
        network = cls(embedding, seed)
        if rows is not None:
            network._fit(embedding, rows.latent)
        return network

    def _fit(self, embedding: Embedding, latent: npt.NDArray[np.floating]) -> None:
        vertex = self._points.vertex
        fitted = latent[:_FITTED_POSES]
        positions = np.concatenate(
            [
                embedding.decode(fitted[start : start + 256])[:, vertex]
                for start in range(0, len(fitted), 256)
            ]
        )
        self.body.fit(fitted, positions)
        chosen = self._points.partners(positions[:_MEASURED_POSES])
        self.partners.copy_(torch.tensor(chosen))
        with torch.no_grad():
            some = torch.tensor(fitted[:_MEASURED_POSES], dtype=torch.float32)
            total = torch.zeros_like(self.input_mean, dtype=torch.float64)
            square = total.clone()
            for part in _parts(some):
                inputs = self._raw_inputs(part).double()
                total += inputs.sum(dim=1, keepdim=True)
                square += inputs.square().sum(dim=1, keepdim=True)
            mean = total / len(some)
            variance = (square / len(some) - mean * mean).clamp_min(0.0)
            self.input_mean.copy_(mean)
            self.input_deviation.copy_(variance.sqrt() + _LEAST_DEVIATION)

    @property
    def patch(self) -> npt.NDArray[np.int64]:
        """(V,) the patch of each vertex, whose exact energies the loss wants."""
        return self._points.patch

    def _raw_inputs(self, latent: torch.Tensor) -> torch.Tensor:
        """Return (P, B, n) places of the partners in each point's frame."""
        frame, places = self.body(latent)
        return look(frame, places, self.partners, FAR_PARTNERS)

    def forward(self, latent: torch.Tensor) -> NetworkOutput:
        """Predict from (B, D) latent codes."""
        if len(latent) <= _ROWS_AT_ONCE or latent.device.type != "cpu":
            return self._forward(latent)
        parts = [self._forward(part) for part in _parts(latent)]
        auxiliary = zip(*(part.auxiliary for part in parts), strict=True)
        return NetworkOutput(
            torch.cat([part.domain_energy for part in parts]),
            torch.cat([part.logit for part in parts]),
            tuple(torch.cat(values) for values in auxiliary),
        )

    def _forward(self, latent: torch.Tensor) -> NetworkOutput:
        inputs = (self._raw_inputs(latent) - self.input_mean) / self.input_deviation
        patches = self.patch_out(silu(self.patch_in(inputs)))
        patch_logit, patch_root = patches[..., 0].T, patches[..., 1].T
        values = torch.cat([torch.tanh(patch_logit / 4.0), patch_root], dim=1)
        for layer in self.head[:-1]:
            values = silu(layer(values))
        values = self.head[-1](values)
        hit = torch.logsumexp(patch_logit, dim=1) * self.any_hit[0] + self.any_hit[1]
        root = values[:, 1:]
        # Energies are taught as square roots: their tail is long.
        energy = root[:, :-1].clamp_min(0.0).square()
        return NetworkOutput(energy, values[:, 0] + hit, _Auxiliary(patch_logit, patch_root, root))

    def loss(
        self,
        output: NetworkOutput,
        batch: Targets,
        part: tuple[int, int],
        config: PredictorConfig,
        margin: float,
    ) -> torch.Tensor:
        """Sum up this process's share of the batch's mean loss, patches included."""
        own = batch.part(*part)
        share = len(own.energy) / len(batch.energy)
        patch_logit, patch_root, root = output.auxiliary
        total = config.entropy_weight * binary_cross_entropy_with_logits(
            output.logit, own.colliding
        )
        hit = (own.patch_root > 0.0).to(patch_logit)
        total = total + _PATCH_WEIGHT * binary_cross_entropy_with_logits(patch_logit, hit)
        total = total + _DEPTH_WEIGHT * smooth_l1_loss(patch_root, own.patch_root)
        truth = torch.cat([own.domain_energy, own.energy[:, None]], dim=1).sqrt()
        total = total + config.depth_weight * smooth_l1_loss(root, truth)
        if config.rank_weight:
            losses = rank_loss(root[:, -1], own.energy.sqrt(), margin)
            total = total + config.rank_weight * losses.mean()
        return share * total


def _parts(rows: torch.Tensor) -> list[torch.Tensor]:
    return [rows[start : start + _ROWS_AT_ONCE] for start in range(0, len(rows), _ROWS_AT_ONCE)]
