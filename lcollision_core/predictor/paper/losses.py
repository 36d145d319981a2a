"""The losses of Tan et al. 2021, section "Collision Predictor Based on Penetration".

Each returns a value for every row or pair, not yet averaged: processes that share a batch divide
their sums by the whole batch's count. Energies are scaled: divided by the mean PDe-sum of the
colliding training rows.
"""

from __future__ import annotations

import torch


def depth_loss(
    predicted: torch.Tensor, domain_energy: torch.Tensor, energy: torch.Tensor
) -> torch.Tensor:
    """L_PD: squared error of each domain's energy, and absolute error of their sum.

    Parameters
    ----------
    predicted : (B, K) S_k; K may be 1 where there is no domain but the whole
    domain_energy : (B, K) mask-weighted sums of PDe, or (B, 0) to leave the first term out (ND)
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
    """L_rank: by how much two rows' predicted energies fall short of their right order.

    Rows 0 and 1, 2 and 3 and so on form pairs; the rows come shuffled.

    Parameters
    ----------
    predicted_energy : (B,) S_sum
    energy : (B,) PDe-sum
    margin : alpha, by which the larger one should lead

    Returns
    -------
    losses : (B // 2,), 0 for pairs of equal energy: the paper defines none for them
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
