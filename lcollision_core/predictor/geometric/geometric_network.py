"""The default preset's network: its inputs are the body's shape, not the latent codes.

A latent code is a poor coordinate for collision: whether a hand touches a thigh depends on where
both are, and that on every joint between. So the codes are decoded to some hundred points of the
skin first (`ReducedBody`), and each has contact features (`ContactField`) of what comes near: how
much, how far above that skin's surface, in what direction. Skin that folds onto itself, in an
elbow, shows in the deformation of the few vertices about it (`fold_view`). Small networks, one for
each point and each site, say whether the patch of skin round it collides, and how deeply, and are
taught that by its exact energy, which is worth hundreds of labels a pose. What follows joins them
to the domains' energies and the logit.

What was tried, with its figures, is in docs/experiments.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, silu, smooth_l1_loss

from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes import STRICT, ContactRules, FaceGroup
from lcollision_core.predictor.geometric.field import ContactField
from lcollision_core.predictor.geometric.folds import N_MEMBERS, find_fold_sites
from lcollision_core.predictor.geometric.reduced_body import ReducedBody
from lcollision_core.predictor.inference.compiled_network import SQUASHED
from lcollision_core.predictor.inference.field_kernels import UNITS
from lcollision_core.predictor.inference.network_kernels import Workspaces
from lcollision_core.predictor.inference.points import N_POINTS, skin_cells
from lcollision_core.predictor.inference.skin import CompiledSkin
from lcollision_core.predictor.inference.skin_geometry import SkinGeometry
from lcollision_core.predictor.network_base import (
    NetworkOutput,
    PredictorNetwork,
    SeededLinear,
    SkinCells,
    StackedLinear,
    Targets,
)

if TYPE_CHECKING:
    from lcollision_core.embedding import Embedding
    from lcollision_core.labels import LabelRows
    from lcollision_core.predictor.config import PredictorConfig

PATCH_WIDTH = 32
HEAD_SIZES = (256, 64)

_ROWS_AT_ONCE, _ROWS_OF_A_THREAD = 128, 32
"""Poses of which all arrays are in memory together, and whose skin a thread poses at once."""

_PATCH_WEIGHT, _DEPTH_WEIGHT = 20.0, 5.0
_FOLD_WEIGHT, _FOLD_DEPTH_WEIGHT = 5.0, 1.25
"""Weights of cross entropies and depths, means over hundreds of mostly free patches."""

_FITTED_POSES = 4000
_MEASURED_POSES = 2000
_LEAST_DEVIATION, _LEAST_GRADIENT_DEVIATION = 2e-2, 1e-3


class _Auxiliary(NamedTuple):
    """What the loss needs beside energies and logit.

    Attributes
    ----------
    patch_logit : (B, P + S) of each patch and each fold colliding
    patch_root : (B, P + S) square roots of their energies
    root_energy : (B, K + 1) square roots of the domains' energies and of their sum
    """

    patch_logit: torch.Tensor
    patch_root: torch.Tensor
    root_energy: torch.Tensor


class GeometricNetwork(PredictorNetwork):
    """Patches of skin, each with a network that reads its contact features.

    Parameters
    ----------
    embedding : of the body
    seed : of the initial weights
    sites : (S, M) integer array, vertices about each site where the skin folds, see
        `find_fold_sites`
    n_points, width : P, and the size of the patches' hidden layers

    Raises
    ------
    ValueError : the sites are not of this body.

    Attributes
    ----------
    skin : what it looks at
    """

    site_vertices: torch.Tensor

    def __init__(
        self,
        embedding: Embedding,
        seed: int,
        sites: npt.NDArray[np.integer],
        n_points: int = N_POINTS,
        width: int = PATCH_WIDTH,
    ) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.skin = skin = SkinGeometry.of(embedding, sites, n_points)
        self.body = ReducedBody(skin)
        self.field = ContactField(skin)
        self._workspaces = Workspaces()
        # Of the model file: found in labelled poses.
        self.register_buffer("site_vertices", torch.tensor(sites, dtype=torch.int32))
        self.patch = _PatchNetworks(skin.n_points, UNITS.size, width, generator)
        self.fold = _PatchNetworks(len(sites), 9 * N_MEMBERS, width, generator)
        sizes = (2 * (skin.n_points + len(sites)), *HEAD_SIZES)
        self.head = nn.ModuleList(
            SeededLinear(n_in, n_out, generator)
            for n_in, n_out in zip(sizes, (*HEAD_SIZES, embedding.n_domains + 2), strict=True)
        )
        self.any_hit = nn.Parameter(torch.tensor([1.0, 0.0]))

    @classmethod
    def build(
        cls,
        embedding: Embedding,
        config: PredictorConfig,
        rows: LabelRows | None = None,
        seed: int = 0,
        rules: ContactRules = STRICT,
        groups: Sequence[FaceGroup] = (),
    ) -> PredictorNetwork:
        """Make the network of an embedding, its points, sites and inputs fitted to the rows.

        Raises
        ------
        LCollisionError : a network without domains is asked for.
        """
        if not config.by_domain:
            raise LCollisionError(
                "only the preset paper has a network without domains", "add --preset paper"
            )
        if rows is None:
            return cls(embedding, seed, np.empty((0, N_MEMBERS), dtype=np.int64))
        sites = find_fold_sites(embedding, rows.latent[rows.colliding], rules, groups)
        network = cls(embedding, seed, sites)
        network._fit(embedding, rows.latent)
        return network

    @classmethod
    def restore(
        cls,
        embedding: Embedding,
        config: PredictorConfig,  # noqa: ARG003
        state: dict[str, torch.Tensor],
    ) -> PredictorNetwork:
        """Make a trained network from its state dict, whose sizes may be an older program's.

        Raises
        ------
        KeyError, ValueError, RuntimeError : the state dict does not fit the embedding.
        """
        sites = state["site_vertices"].numpy().astype(np.int64)
        n_points = state["body.points"].shape[1]
        width = state["patch.layers.0.weight"].shape[2]
        network = cls(embedding, 0, sites, n_points, width)
        network.load_state_dict(state)
        return network

    def _fit(self, embedding: Embedding, latent: npt.NDArray[np.floating]) -> None:
        vertex = self.skin.point_vertices
        fitted = latent[:_FITTED_POSES]
        positions = np.concatenate(
            [
                embedding.decode(fitted[start : start + 256])[:, vertex]
                for start in range(0, len(fitted), 256)
            ]
        )
        self.body.fit(fitted, positions)
        some = torch.tensor(fitted[:_MEASURED_POSES], dtype=torch.float32)
        with torch.no_grad():
            fields, folds = zip(*(self._inputs(part) for part in _parts(some)), strict=True)
        self.patch.fit(torch.cat(fields, dim=1), _LEAST_DEVIATION)
        self.fold.fit(torch.cat(folds, dim=1), _LEAST_GRADIENT_DEVIATION)

    def skin_cells(self, embedding: Embedding) -> SkinCells:
        """Divide the skin into patches and folds, whose exact energies the loss needs."""
        centres = self.site_vertices[:, 0].cpu().numpy()
        return SkinCells(
            skin_cells(embedding, self.skin.point_vertices), skin_cells(embedding, centres)
        )

    def _inputs(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (P, B, n) contact features, and (S, B, n) how each site is deformed."""
        is_plain = latent.dtype == torch.float32 and not latent.requires_grad
        if latent.device.type == "cpu" and is_plain:
            return self._compiled_inputs(latent.numpy())
        frame, gradients, positions = self.body(latent)
        return self.field(frame, positions).flatten(2), self.body.fold_view(frame, gradients)

    def _compiled_inputs(
        self, latent: npt.NDArray[np.float32]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the inputs by the compiled loops, in a few times less time than torch takes."""
        skin = CompiledSkin(self.skin, self.body.points.numpy(), self.body.origin.numpy())
        field = np.empty((self.skin.n_points, len(latent), UNITS.size), dtype=np.float32)
        folds = np.empty((len(self.site_vertices), len(latent), 9 * N_MEMBERS), dtype=np.float32)

        def fill(start: int, stop: int) -> None:
            with self._workspaces.lent() as workspace:
                posed = skin.forward(latent[start:stop], workspace)
                field[:, start:stop] = posed.field.reshape(len(field), stop - start, -1)
                folds[:, start:stop] = posed.folds

        for_blocks(fill, len(latent), _ROWS_OF_A_THREAD)
        return torch.from_numpy(field), torch.from_numpy(folds)

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
        field, folds = self._inputs(latent)
        outputs = torch.cat([self.patch(field), self.fold(folds)])
        patch_logit, patch_root = outputs[..., 0].T, outputs[..., 1].T
        values = torch.cat([torch.tanh(patch_logit / SQUASHED), patch_root], dim=1)
        for layer in self.head[:-1]:
            values = silu(layer(values))
        values = self.head[-1](values)
        contact = torch.logsumexp(patch_logit, dim=1) * self.any_hit[0] + self.any_hit[1]
        root = values[:, 1:]
        # Energies are learned as square roots: their tail is long.
        energy = root[:, :-1].clamp_min(0.0).square()
        return NetworkOutput(
            energy, values[:, 0] + contact, _Auxiliary(patch_logit, patch_root, root)
        )

    def loss(
        self,
        output: NetworkOutput,
        batch: Targets,
        part: tuple[int, int],
        config: PredictorConfig,
        margin: float,  # noqa: ARG002
    ) -> torch.Tensor:
        """Sum up this process's share of the batch's mean loss: patches included, no ranking."""
        own = batch.part(*part)
        if not len(own.energy):
            # The mean of no row is not a number; their sum is 0, and depends on the parameters.
            return output.logit.sum()
        fraction = len(own.energy) / len(batch.energy)
        patch_logit, patch_root, root = output.auxiliary
        total = config.entropy_weight * binary_cross_entropy_with_logits(
            output.logit, own.colliding
        )
        n_patches = self.skin.n_points
        for cells, weight, depth_weight in (
            (slice(0, n_patches), _PATCH_WEIGHT, _DEPTH_WEIGHT),
            (slice(n_patches, None), _FOLD_WEIGHT, _FOLD_DEPTH_WEIGHT),
        ):
            taught = own.patch_root[:, cells]
            if taught.shape[1]:
                colliding = (taught > 0.0).to(patch_logit)
                total = total + weight * binary_cross_entropy_with_logits(
                    patch_logit[:, cells], colliding
                )
                total = total + depth_weight * smooth_l1_loss(patch_root[:, cells], taught)
        labelled = torch.cat([own.domain_energy, own.energy[:, None]], dim=1).sqrt()
        total = total + config.depth_weight * smooth_l1_loss(root, labelled)
        return fraction * total


class _PatchNetworks(nn.Module):
    """A small network for each of n patches: (n, B, n_in) to (n, B, 2), logit and root energy."""

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(self, n_patches: int, n_in: int, width: int, generator: torch.Generator) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_patches, 1, n_in))
        self.register_buffer("deviation", torch.ones(n_patches, 1, n_in))
        sizes = (n_in, width, width, 2)
        self.layers = nn.ModuleList(
            StackedLinear(n_patches, a, b, generator) for a, b in pairwise(sizes)
        )
        with torch.no_grad():
            # Most patches are free in most poses.
            cast(StackedLinear, self.layers[-1]).bias[:, :, 0] = -3.0

    def fit(self, inputs: torch.Tensor, least_deviation: float) -> None:
        """Store the means and deviations of some inputs."""
        if not inputs.numel():
            return
        self.mean.copy_(inputs.mean(dim=1, keepdim=True))
        self.deviation.copy_(inputs.std(dim=1, keepdim=True) + least_deviation)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        # In one pass over the inputs.
        scale = self.deviation.reciprocal()
        values = torch.addcmul(-self.mean * scale, inputs, scale)
        for layer in self.layers[:-1]:
            values = silu(layer(values))
        outputs: torch.Tensor = self.layers[-1](values)
        return outputs


def _parts(rows: torch.Tensor) -> list[torch.Tensor]:
    return [rows[start : start + _ROWS_AT_ONCE] for start in range(0, len(rows), _ROWS_AT_ONCE)]
