"""The network and the losses of the paper, with torch.

Each loss returns a value for every row or pair, not averaged: processes that share a batch divide
their sums by the whole batch's count. Energies are scaled: divided by the mean PDe-sum of the
colliding training rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.labels import LabelRows
from lcollision_core.meshes import STRICT, ContactRules, FaceGroup
from lcollision_core.predictor.config import PredictorConfig
from lcollision_core.predictor.network_base import (
    NetworkOutput,
    PredictorNetwork,
    SeededLinear,
    StackedLinear,
    Targets,
)
from lcollision_core.predictor.stored_network import (
    CLASSIFIER_SIZE,
    ENCODER_SIZES,
    PREDICTOR_SIZES,
    UNDIVIDED_SIZE,
)


def depth_loss(
    predicted: torch.Tensor, domain_energy: torch.Tensor, energy: torch.Tensor
) -> torch.Tensor:
    """Return L_PD: the squared error of each domain's energy plus the absolute error of their sum.

    Parameters
    ----------
    predicted : (B, K) S_k; K is 1 without domains
    domain_energy : (B, K) mask-weighted sums of PDe, or (B, 0) to leave out the first term (ND)
    energy : (B,) PDe-sum

    Returns
    -------
    losses : (B,)
    """
    of_sum = (predicted.sum(dim=1) - energy).abs()
    if domain_energy.shape[1] == 0:
        return of_sum
    return (predicted - domain_energy).square().sum(dim=1) + of_sum


def rank_loss(predicted_energy: torch.Tensor, energy: torch.Tensor, margin: float) -> torch.Tensor:
    """Return L_rank: the shortfall of two rows' predicted energies from their correct order.

    Rows 0 and 1, 2 and 3 and so on form pairs; the rows are shuffled.

    Parameters
    ----------
    predicted_energy : (B,) S_sum
    energy : (B,) PDe-sum
    margin : alpha, by which the larger one should lead

    Returns
    -------
    losses : (B // 2,), 0 for pairs of equal energy, for which the paper defines none
    """
    n_pairs = len(energy) // 2
    true_lead = energy[1 : 2 * n_pairs : 2] - energy[0 : 2 * n_pairs : 2]
    lead = predicted_energy[1 : 2 * n_pairs : 2] - predicted_energy[0 : 2 * n_pairs : 2]
    shortfall = (margin - true_lead.sign() * lead).clamp_min(0.0)
    return torch.where(true_lead == 0.0, torch.zeros_like(shortfall), shortfall)


def ranked_pairs(energy: torch.Tensor) -> int:
    """Count the pairs of `rank_loss` whose energies differ."""
    n_pairs = len(energy) // 2
    return int((energy[1 : 2 * n_pairs : 2] != energy[0 : 2 * n_pairs : 2]).sum())


class PaperNetwork(PredictorNetwork):
    """CSE, one CP for each domain and the classifier, in the paper's sizes, with ReLU.

    S_0 = CSE(Z_all); S_k = CP_k(S_0, Z_k); logit = MLP(S_1, ..., S_K). Without domains (ND) one
    head on S_0 gives S_sum, the only input of the classifier. Tan et al. 2021, sections "Collision
    Detection Architecture" and "Evaluation".

    Parameters
    ----------
    group_sizes : (|Z_0|, |Z_1|, ..., |Z_K|)
    by_domain : False for ND
    seed : of the initial weights
    """

    activation: type[nn.Module] = nn.ReLU

    def __init__(self, group_sizes: Sequence[int], by_domain: bool, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.act = self.activation()
        sizes = (sum(group_sizes), *ENCODER_SIZES)
        self.encoder = nn.Sequential(
            *(
                layer
                for n_in, n_out in pairwise(sizes)
                for layer in (SeededLinear(n_in, n_out, generator), self.activation())
            )
        )
        self.by_domain = by_domain
        n_outputs = len(group_sizes) - 1 if by_domain else 1
        state = ENCODER_SIZES[-1]
        if by_domain:
            widest = max(group_sizes[1:])
            self.predictors = nn.ModuleList()
            n_in = state + widest
            for number, n_out in enumerate((*PREDICTOR_SIZES, 1)):
                fan_in = [state + size for size in group_sizes[1:]] if number == 0 else None
                self.predictors.append(StackedLinear(n_outputs, n_in, n_out, generator, fan_in))
                n_in = n_out
            self._code_index = _padded_codes(group_sizes)
        else:
            self.undivided = nn.Sequential(
                SeededLinear(state, UNDIVIDED_SIZE, generator),
                self.activation(),
                SeededLinear(UNDIVIDED_SIZE, 1, generator),
            )
        self.classifier = nn.Sequential(
            SeededLinear(n_outputs, CLASSIFIER_SIZE, generator),
            self.activation(),
            SeededLinear(CLASSIFIER_SIZE, 1, generator),
        )

    @classmethod
    def build(
        cls,
        embedding: Embedding,
        config: PredictorConfig,
        rows: LabelRows | None = None,  # noqa: ARG003
        seed: int = 0,
        rules: ContactRules = STRICT,  # noqa: ARG003
        groups: Sequence[FaceGroup] = (),  # noqa: ARG003
    ) -> PredictorNetwork:
        """Make the network of an embedding; rows, rules and groups are not used."""
        return cls(embedding.group_sizes, config.by_domain, seed)

    def forward(self, latent: torch.Tensor) -> NetworkOutput:
        """Predict from (B, D) latent codes."""
        state = self.encoder(latent)
        energy = self._domain_energy(state, latent) if self.by_domain else self.undivided(state)
        return NetworkOutput(energy, self.classifier(energy)[:, 0])

    def loss(
        self,
        output: NetworkOutput,
        batch: Targets,
        part: tuple[int, int],
        config: PredictorConfig,
        margin: float,
    ) -> torch.Tensor:
        """Return this process's share of the batch's mean loss: the paper's three terms."""
        row_batch = batch.part(*part)
        n_rows = len(batch.energy)
        total = (
            config.entropy_weight
            / n_rows
            * binary_cross_entropy_with_logits(output.logit, row_batch.colliding, reduction="sum")
        )
        if config.depth_weight:
            divided = (
                row_batch.domain_energy if config.by_domain else row_batch.domain_energy[:, :0]
            )
            losses = depth_loss(output.domain_energy, divided, row_batch.energy)
            total = total + config.depth_weight / n_rows * losses.sum()
        if config.rank_weight:
            losses = rank_loss(output.domain_energy.sum(dim=1), row_batch.energy, margin)
            n_pairs = max(ranked_pairs(batch.energy), 1)
            total = total + config.rank_weight / n_pairs * losses.sum()
        return total

    def _domain_energy(self, state: torch.Tensor, latent: torch.Tensor) -> torch.Tensor:
        index = self._code_index.to(latent.device)
        padded = torch.cat([latent, latent.new_zeros((len(latent), 1))], dim=1)
        codes = padded[:, index].transpose(0, 1)
        values = torch.cat([state.expand(len(index), -1, -1), codes], dim=2)
        for layer in self.predictors[:-1]:
            values = self.act(layer(values))
        energy: torch.Tensor = self.predictors[-1](values)[:, :, 0].T
        return energy


def _padded_codes(group_sizes: Sequence[int]) -> torch.Tensor:
    """Return (K, widest) indices into (Z_all, 0) of each domain's codes, padded with the 0."""
    latent_size, widest = sum(group_sizes), max(group_sizes[1:])
    index = torch.full((len(group_sizes) - 1, widest), latent_size)
    start = group_sizes[0]
    for domain, size in enumerate(group_sizes[1:]):
        index[domain, :size] = torch.arange(start, start + size)
        start += size
    return index
