"""What the networks of `config.Architecture` share: latent codes in, energies and a logit out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.labels import LabelRows
from lcollision_core.meshes import STRICT, ContactRules, FaceGroup
from lcollision_core.predictor.config import PredictorConfig


class NetworkOutput(NamedTuple):
    """The outputs of a network for B poses.

    Attributes
    ----------
    domain_energy : (B, K) S_k, scaled, may be below 0; (B, 1) from a network without domains
    logit : (B,) logit of the collision probability
    auxiliary : further outputs that the network's own loss needs
    """

    domain_energy: torch.Tensor
    logit: torch.Tensor
    auxiliary: tuple[torch.Tensor, ...] = ()


class Targets(NamedTuple):
    """The labels of B poses.

    Attributes
    ----------
    domain_energy : (B, K) scaled
    energy : (B,) scaled
    colliding : (B,) 1 for poses that collide, else 0
    patch_root : (B, P + S) see `PatchLabeller.roots`; (B, 0) for a network without patches
    """

    domain_energy: torch.Tensor
    energy: torch.Tensor
    colliding: torch.Tensor
    patch_root: torch.Tensor

    def part(self, start: int, stop: int) -> Targets:
        """Return rows `start` to `stop` - 1."""
        return Targets(*(values[start:stop] for values in self))


@dataclass(frozen=True, eq=False)
class SkinCells:
    """The division of the skin into patches and folds.

    Attributes
    ----------
    patch : (V,) the patch of each vertex, 0 to P - 1, for contact between parts
    fold : (V,) the site of each vertex, 0 to S - 1, for folds; all -1 if there are none
    """

    patch: npt.NDArray[np.int64]
    fold: npt.NDArray[np.int64]

    @property
    def n_patches(self) -> int:
        """P."""
        return int(self.patch.max()) + 1

    @property
    def n_folds(self) -> int:
        """S."""
        return int(self.fold.max()) + 1


class PredictorNetwork(nn.Module, ABC):
    """A preset's network: differentiable from latent codes to energies and a logit.

    A model file stores only its state dict, in float32. `build` may use the training rows only for
    values of the state dict.
    """

    @classmethod
    @abstractmethod
    def build(
        cls,
        embedding: Embedding,
        config: PredictorConfig,
        rows: LabelRows | None = None,
        seed: int = 0,
        rules: ContactRules = STRICT,
        groups: Sequence[FaceGroup] = (),
    ) -> PredictorNetwork:
        """Make the network of an embedding.

        Parameters
        ----------
        embedding : of the latent codes
        config : how to train
        rows : some of the training rows, as in the store; None if a state dict will be loaded
        seed : of the initial weights
        rules, groups : the contact rules of the labels, and the groups that they name
        """

    @classmethod
    def restore(
        cls, embedding: Embedding, config: PredictorConfig, state: dict[str, torch.Tensor]
    ) -> PredictorNetwork:
        """Make a trained network from its state dict.

        Raises
        ------
        KeyError, ValueError, RuntimeError : the state dict does not fit the embedding.
        """
        network = cls.build(embedding, config)
        network.load_state_dict(state)
        return network

    def skin_cells(self, embedding: Embedding) -> SkinCells | None:  # noqa: ARG002
        """Divide the skin, if the network learns patch by patch."""
        return None

    @abstractmethod
    def forward(self, latent: torch.Tensor) -> NetworkOutput:
        """Predict from (B, D) latent codes."""

    @abstractmethod
    def loss(
        self,
        output: NetworkOutput,
        batch: Targets,
        part: tuple[int, int],
        config: PredictorConfig,
        margin: float,
    ) -> torch.Tensor:
        """Return this process's share of the batch's mean loss.

        Parameters
        ----------
        output : for the rows of `part`
        batch : the labels of the whole batch
        part : start and stop of this process's rows in the batch; the start is even
        config : the terms' weights
        margin : of the ranking loss, scaled
        """


class StackedLinear(nn.Module):
    """K linear layers of one size as a single batched product: (K, B, n_in) to (K, B, n_out).

    Parameters
    ----------
    n_stacked, n_in, n_out : K and the sizes
    generator : of the initial weights, uniform within 1/sqrt(fan-in) like PyTorch's
    fan_in : (K,) number of inputs that are not always 0, by default `n_in` each
    """

    def __init__(
        self,
        n_stacked: int,
        n_in: int,
        n_out: int,
        generator: torch.Generator,
        fan_in: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        counted = torch.tensor(fan_in or [n_in] * n_stacked, dtype=torch.float32)
        bound = counted.rsqrt()[:, None, None]
        weight = torch.rand((n_stacked, n_in, n_out), generator=generator) * 2.0 - 1.0
        bias = torch.rand((n_stacked, 1, n_out), generator=generator) * 2.0 - 1.0
        self.weight = nn.Parameter(weight * bound)
        self.bias = nn.Parameter(bias * bound)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Apply layer k to values k."""
        return torch.baddbmm(self.bias, values, self.weight)


class SeededLinear(nn.Module):
    """A linear layer whose initial weights come from a generator, uniform like PyTorch's.

    Parameters
    ----------
    n_in, n_out : the sizes
    generator : of the initial weights
    """

    def __init__(self, n_in: int, n_out: int, generator: torch.Generator) -> None:
        super().__init__()
        bound = n_in**-0.5
        weight = torch.rand((n_in, n_out), generator=generator) * 2.0 - 1.0
        bias = torch.rand(n_out, generator=generator) * 2.0 - 1.0
        self.weight = nn.Parameter(weight * bound)
        self.bias = nn.Parameter(bias * bound)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Map (B, n_in) to (B, n_out)."""
        return torch.addmm(self.bias, values, self.weight)
