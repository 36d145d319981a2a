"""The default network: a reduced body, its folds and a contact field between parts, with torch.

A latent code is a poor coordinate for collision: whether a hand touches a thigh depends on the
positions of both, and these on every joint between. So the codes are first decoded to a few hundred
points of the skin (`ReducedBody`), and each has contact features (`ContactField`) of nearby skin:
how much there is, at what height above its surface, in what direction. Skin that folds onto itself,
as in an elbow, shows in the deformation of a few vertices around it (`fold_view`). Small networks,
one for each point and each site, predict whether the surrounding patch of skin collides, and how
deeply. Their targets are the patches' exact energies, which are worth hundreds of labels per pose.
A head combines them to the domains' energies and the logit.

Experiments and their figures are in docs/experiments.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, silu, smooth_l1_loss

from lcollision_core.contact import STRICT, CollisionDetector, ContactRules
from lcollision_core.devices import has_gpu_kernels
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes import FaceGroup
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.predictor.compiled_network import (
    SQUASHED,
    CompiledSkin,
    SkinGeometry,
    farthest_points,
    skin_cells,
    skin_distances,
    skin_graph,
)
from lcollision_core.predictor.kernels import (
    BEHIND,
    FADE,
    FULL,
    RADII,
    SMALLEST_SQUARED_ANGLE,
    SOME,
    STEEPNESS,
    UNITS,
    Workspaces,
)
from lcollision_core.predictor.network_base import (
    NetworkOutput,
    PredictorNetwork,
    SeededLinear,
    SkinCells,
    StackedLinear,
    Targets,
)

if TYPE_CHECKING:
    from lcollision_core.labels import LabelRows
    from lcollision_core.predictor.config import PredictorConfig


class ContactField(torch.nn.Module):
    """Sums at each point over distant parts of the skin that come near it.

    Implicit moving least squares (Kolluri 2008): another point at distance d has weight
    (1 - d^2 / radius^2)^3, and less behind the tangent plane. All pairs of points count, so no list
    of possible contacts is needed; the sums are smooth, and exactly 0 where nothing is near.

    Parameters
    ----------
    skin : of the body
    """

    geodesic_neighbours: torch.Tensor

    def __init__(self, skin: SkinGeometry) -> None:
        super().__init__()
        near = torch.tensor(skin.geodesic_neighbours)
        self.register_buffer("geodesic_neighbours", near, persistent=False)

    def forward(self, frame: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
        """Return the contact features.

        Parameters
        ----------
        frame : (B, N, 3, 3) local frames of the first N points, as columns, the outer normal first
        positions : (B, 3, P)

        Returns
        -------
        field : (P, B, 2, 8) for each radius: the amount of nearby skin, from 0 to 1; and weighted
            means of the point's heights above the others' tangent planes, of the offsets to them
            (3) and of their normals (3), in the point's frame, heights and offsets in radii
        """
        frame = frame[:, : positions.shape[2]]
        offset = positions[:, :, None] - positions[..., None]
        squared = offset.square().sum(dim=1) + self.geodesic_neighbours
        normal = frame[..., 0]
        step = ((torch.einsum("bipq,bpi->bpq", offset, normal) + BEHIND) / FADE).clamp(0.0, 1.0)
        facing = step.square() * (3.0 - 2.0 * step)
        above = -torch.einsum("bipq,bqi->bpq", offset, normal)
        parts = []
        for steepness, radius in zip(STEEPNESS, RADII, strict=True):
            weight = facing * (1.0 - squared * steepness).clamp_min(0.0).pow(3)
            total = weight.sum(dim=2, keepdim=True)
            height = (weight * above).sum(dim=2, keepdim=True)
            offsets = torch.einsum("bpq,bipq,bpij->bpj", weight, offset, frame)
            normals = torch.einsum("bpq,bqi,bpij->bpj", weight, normal, frame)
            sums = torch.cat([height / radius, offsets / radius, normals], dim=2)
            parts.append(torch.cat([total / (total + FULL), sums / (total + SOME)], dim=2))
        return torch.stack(parts, dim=2).transpose(0, 1)


class NetworkSizes(NamedTuple):
    """The sizes of a network, for a mesh with enough vertices; see docs/experiments.md.

    Attributes
    ----------
    points : P, all over the skin
    sites : S at most, where the skin folds
    width : of the patches' hidden layers
    """

    points: int
    sites: int
    width: int


SIZES = {"default": NetworkSizes(240, 128, 32), "large": NetworkSizes(480, 256, 64)}
"""By preset."""


FOLD_RADIUS = 0.045
"""Normalised length along the surface, beyond the near exclusion, up to which colliding faces are a
fold of the skin."""

N_MEMBERS = 12

_MEMBER_RADIUS = 0.03
"""Normalised length, likewise, over which a site's members spread."""

_SPREAD, _REDUNDANCE = 0.02, 0.85
"""Normalised length within which a chosen site makes its neighbours redundant, and by how much."""

_MASKED_FOLD = 0.2
"""Weight of a fold in a pose that collides elsewhere too."""

_SEARCHED_POSES = 3000
_POSES_AT_ONCE = 32


class FoldDetector:
    """The exact check, with folds distinguished from contact between parts.

    Parameters
    ----------
    embedding : of the body; poses are in normalised length
    rules, groups : the contact rules, and the groups that they name
    """

    def __init__(
        self, embedding: Embedding, rules: ContactRules, groups: Sequence[FaceGroup] = ()
    ) -> None:
        topology, rest = embedding.topology, embedding.rest_vertices
        radius = rules.near_exclusion + FOLD_RADIUS
        with_folds = replace(rules, near_exclusion=radius, near_by_limb=False)
        self._with_folds = CollisionDetector(topology, rest, with_folds, groups)
        self._by_rules = CollisionDetector(topology, rest, rules, groups)

    def energies(
        self, vertices: npt.NDArray[np.floating], cells: npt.NDArray[np.int32], n_cells: int
    ) -> FloatArray:
        """Sum the energy of (B, V, 3) poses by cells, (B, n_cells), on the calling thread.

        Parameters
        ----------
        cells : (2, V) each vertex's cell in pairs of faces that are no folds, and in folds
        """
        return self._by_rules.cell_energies(vertices, self._with_folds, cells, n_cells)


def find_fold_sites(
    embedding: Embedding,
    latent: npt.NDArray[np.floating],
    rules: ContactRules = STRICT,
    groups: Sequence[FaceGroup] = (),
    n_sites: int = SIZES["default"].sites,
) -> npt.NDArray[np.int64]:
    """Search colliding poses for the sites where the skin folds most often.

    Parameters
    ----------
    embedding : decodes the poses
    latent : (n, D) poses that collide; at most `_SEARCHED_POSES` are used
    rules, groups : the contact rules, and the groups that they name
    n_sites : how many are chosen at most

    Returns
    -------
    members : (S, M) vertices spread around each site, its centre first; S is 0 for a body that does
        not fold
    """
    score = _fold_frequency(
        embedding, latent[:_SEARCHED_POSES], FoldDetector(embedding, rules, groups)
    )
    radius = _MEMBER_RADIUS + rules.near_exclusion
    graph = skin_graph(embedding)
    members: list[npt.NDArray[np.int64]] = []
    while len(members) < n_sites and score.max(initial=0.0) > 0.0:
        centre = int(score.argmax())
        (distance,) = skin_distances(graph, np.array([centre]))
        members.append(_spread_members(embedding, distance, radius))
        score *= 1.0 - _REDUNDANCE * np.exp(-((distance / _SPREAD) ** 2))
        score[centre] = 0.0
    return np.array(members, dtype=np.int64).reshape(-1, N_MEMBERS)


def _fold_frequency(
    embedding: Embedding, latent: npt.NDArray[np.floating], detector: FoldDetector
) -> FloatArray:
    """Return (V,) the fraction of poses in which each vertex is part of a fold."""
    n_vertices = len(embedding.rest_vertices)
    # In folds each vertex is a cell; all other contact is one cell.
    cells = np.stack([np.full(n_vertices, n_vertices), np.arange(n_vertices)]).astype(np.int32)
    folded, weight = np.zeros((len(latent), n_vertices), dtype=np.bool_), np.ones(len(latent))

    def search(start: int, stop: int) -> None:
        poses = embedding.decode(latent[start:stop], n_threads=1).astype(np.float32)
        energy = detector.energies(poses, cells, n_vertices + 1)
        folded[start:stop] = energy[:, :-1] > 0.0
        weight[start:stop][energy[:, -1] > 0.0] = _MASKED_FOLD

    for_blocks(search, len(latent), _POSES_AT_ONCE)
    frequency = np.zeros(n_vertices)
    for pose, vertices in enumerate(folded):
        frequency[vertices] += weight[pose]
    return frequency / max(len(latent), 1)


def _spread_members(
    embedding: Embedding, distance: FloatArray, radius: float
) -> npt.NDArray[np.int64]:
    """Choose `N_MEMBERS` vertices around the one at distance 0 by farthest-point sampling."""
    order = distance.argsort(kind="stable")
    # If a coarse mesh has too few within the radius, take the nearest; a tiny one repeats vertices.
    n_near = max(int((distance <= radius).sum()), N_MEMBERS)
    near = np.resize(order[:n_near], n_near)
    members: npt.NDArray[np.int64] = near[
        farthest_points(embedding.rest_vertices[near], 0, N_MEMBERS)
    ]
    return members


_DAMPING = 1e-8

_SYMMETRIC = [3, 4, 5, 4, 6, 7, 5, 7, 8]
"""Indices of the nine entries of S in the features."""


class ReducedBody(nn.Module):
    """Decode latent codes to the deformation of the skin and the positions of the body's points.

    The gradients are those of the embedding. Positions are a linear map of the gradients at the
    points, fitted to decoded poses, as the body's vertices are a linear map of all gradients.

    Parameters
    ----------
    skin : of the body

    Attributes
    ----------
    output_index : (G, Q) int32, each point's place among the outputs of `products` for each group
        of codes, -1 for a group that does not move it
    """

    output_index: torch.Tensor
    offset: torch.Tensor
    rest_frame: torch.Tensor
    scale: torch.Tensor
    target: torch.Tensor
    members: torch.Tensor
    points: torch.Tensor
    origin: torch.Tensor

    def __init__(self, skin: SkinGeometry) -> None:
        super().__init__()
        self.n_points = skin.n_points
        self._codes = [group.codes for group in skin.groups]
        fixed = {f"table{number}": group.table for number, group in enumerate(skin.groups)}
        for name in ("offset", "scale", "rest_frame", "target", "members"):
            fixed[name] = getattr(skin, name)
        fixed["output_index"] = np.full((len(skin.groups), len(skin.offset)), -1, dtype=np.int32)
        stop = 0
        for row, group in zip(fixed["output_index"], skin.groups, strict=True):
            start, stop = stop, stop + group.table.shape[1] // skin.offset.shape[1]
            row[skin.target[start:stop]] = np.arange(start, stop)
        for name, values in fixed.items():
            self.register_buffer(name, torch.tensor(values), persistent=False)
        # Stored in the model file: fitted, not a function of the embedding.
        self.register_buffer("points", torch.zeros(3 * self.n_points, self.n_points))
        self.register_buffer("origin", torch.zeros(3, self.n_points))

    def fit(self, latent: npt.NDArray[np.floating], positions: npt.NDArray[np.floating]) -> None:
        """Fit the positions' linear map by ridge regression.

        Parameters
        ----------
        latent : (n, D) array, n a few thousand
        positions : (n, P, 3) array, the points of the decoded poses, in normalised length
        """
        width = 3 * self.n_points + 3
        square = np.zeros((width, width))
        product = np.zeros((width, self.n_points))
        for start in range(0, len(latent), 256):
            part = slice(start, start + 256)
            with torch.no_grad():
                _, gradients, _ = self(torch.tensor(latent[part], dtype=torch.float32))
            rows = gradients[:, :, : self.n_points].reshape(-1, width - 3).double().numpy()
            rows = np.concatenate([rows, np.tile(np.eye(3), (len(rows) // 3, 1))], axis=1)
            square += rows.T @ rows
            product += rows.T @ positions[part].transpose(0, 2, 1).reshape(-1, self.n_points)
        square += _DAMPING * np.trace(square) / width * np.eye(width)
        solution = torch.tensor(np.linalg.solve(square, product), dtype=torch.float32)
        self.points.copy_(solution[:-3])
        self.origin.copy_(solution[-3:])

    def products(self, latent: torch.Tensor) -> torch.Tensor:
        """Return the (B, T, 9) outputs of (B, D) codes, before tanh; see `SkinGeometry.target`."""
        products = [
            latent[:, codes] @ self.get_buffer(f"table{number}")
            for number, codes in enumerate(self._codes)
        ]
        return torch.cat(products, dim=1).view(len(latent), len(self.target), len(self.scale))

    def features(self, latent: torch.Tensor) -> torch.Tensor:
        """Return the skin's (B, Q, 9) deformation features of (B, D) codes."""
        outputs = self.products(latent).tanh()
        offset = self.offset.repeat(len(latent), 1, 1)
        features: torch.Tensor = offset.index_add(1, self.target, outputs * self.scale)
        return features

    def positions(self, gradients: torch.Tensor) -> torch.Tensor:
        """Return the points' (B, 3, P) positions by rows of deformation gradients."""
        return gradients[:, :, : self.n_points].flatten(2) @ self.points + self.origin

    def forward(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the skin posed by (B, D) codes.

        Returns
        -------
        frame : (B, N, 3, 3) local frames of the first N points: R F, with F those on the reference
        gradients : (B, 3, Q, 3) rows of the deformation gradients R S
        positions : (B, 3, P) of the points of the body, in normalised length
        """
        features = self.features(latent)
        rotation = _rotations(features[..., :3])
        stretch = features[..., _SYMMETRIC].view(*features.shape[:2], 3, 3)
        frame = rotation[:, : len(self.rest_frame)] @ self.rest_frame
        gradients = (rotation @ stretch).transpose(1, 2)
        return frame, gradients, self.positions(gradients)

    def fold_view(self, frame: torch.Tensor, gradients: torch.Tensor) -> torch.Tensor:
        """Return the skin's deformation around the fold sites, invariant to rotation of the body.

        Returns
        -------
        inputs : (S, B, 9 M) the members' gradients R S in the frame of each site's first member
        """
        (n_sites, n_members), n_rows = self.members.shape, len(frame)
        member_frame = frame.index_select(1, self.members[:, 0]).transpose(2, 3).flatten(0, 1)
        member_gradients = gradients.index_select(2, self.members.flatten())
        member_gradients = (
            member_gradients.view(n_rows, 3, n_sites, 3 * n_members).transpose(1, 2).flatten(0, 1)
        )
        local = (member_frame @ member_gradients).view(n_rows, n_sites, 3, n_members, 3)
        inputs: torch.Tensor = local.permute(1, 0, 3, 2, 4).flatten(2)
        return inputs


def _rotations(log: torch.Tensor) -> torch.Tensor:
    """Return exp of (..., 3) rotation vectors by Rodrigues' formula, smooth at 0."""
    squared = log.square().sum(dim=-1) + SMALLEST_SQUARED_ANGLE
    angle = squared.sqrt()
    versine = 2.0 * (0.5 * angle).sin().square()
    x, y, z = log.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    cross = cross.view(*log.shape, 3)
    outer = log[..., :, None] * log[..., None, :]
    cosine = (1.0 - versine)[..., None, None] * torch.eye(3).to(log)
    return (
        cosine
        + (angle.sin() / angle)[..., None, None] * cross
        + (versine / squared)[..., None, None] * outer
    )


HEAD_SIZES = (256, 64)

_ROWS_AT_ONCE, _ROWS_OF_A_THREAD = 128, 32
"""Poses whose arrays are in memory together, and poses whose skin one thread computes at once."""

_PATCH_WEIGHT, _DEPTH_WEIGHT = 20.0, 5.0
_FOLD_WEIGHT, _FOLD_DEPTH_WEIGHT = 5.0, 1.25
"""Weights of the patches' and folds' cross entropies and depths, means over hundreds of mostly free
patches."""

_FITTED_POSES = 4000
_MEASURED_POSES = 2000
_LEAST_DEVIATION, _LEAST_GRADIENT_DEVIATION = 2e-2, 1e-3


class _Auxiliary(NamedTuple):
    """Outputs that the loss needs besides energies and logit.

    Attributes
    ----------
    patch_logit : (B, P + S) logits of a collision of each patch and each fold
    patch_root : (B, P + S) square roots of their energies
    root_energy : (B, K + 1) square roots of the domains' energies and of their sum
    """

    patch_logit: torch.Tensor
    patch_root: torch.Tensor
    root_energy: torch.Tensor


class GeometricNetwork(PredictorNetwork):
    """A network for each patch of skin, which reads its contact features, and a common head.

    Parameters
    ----------
    embedding : of the body
    seed : of the initial weights
    sites : (S, M) integer array, vertices around each site where the skin folds, see
        `find_fold_sites`
    n_points, width : P, and the size of the patches' hidden layers

    Raises
    ------
    ValueError : the sites are not of this body.

    Attributes
    ----------
    skin : the points of the body and the fold sites
    """

    site_vertices: torch.Tensor

    def __init__(
        self,
        embedding: Embedding,
        seed: int,
        sites: npt.NDArray[np.integer],
        n_points: int = SIZES["default"].points,
        width: int = SIZES["default"].width,
    ) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.skin = skin = SkinGeometry.of(embedding, sites, n_points)
        self.body = ReducedBody(skin)
        self.field = ContactField(skin)
        self._workspaces = Workspaces()
        # Stored in the model file: found in labelled poses.
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
        """Make the network of an embedding, with its points, sites and inputs fitted to the rows.

        Raises
        ------
        LCollisionError : a network without domains is requested.
        """
        if not config.by_domain:
            raise LCollisionError(
                "only the preset paper has a network without domains", "add --preset paper"
            )
        sizes = SIZES[config.preset]
        if rows is None:
            no_sites = np.empty((0, N_MEMBERS), dtype=np.int64)
            return cls(embedding, seed, no_sites, sizes.points, sizes.width)
        colliding = rows.latent[rows.colliding]
        sites = find_fold_sites(embedding, colliding, rules, groups, sizes.sites)
        network = cls(embedding, seed, sites, sizes.points, sizes.width)
        network._fit(embedding, rows.latent)
        return network

    @classmethod
    def restore(
        cls,
        embedding: Embedding,
        config: PredictorConfig,  # noqa: ARG003
        state: dict[str, torch.Tensor],
    ) -> PredictorNetwork:
        """Make a trained network from its state dict, whose sizes may be of an older version.

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
        """Return (P, B, n) contact features, and (S, B, n) deformations of the sites."""
        is_plain = latent.dtype == torch.float32 and not latent.requires_grad
        if latent.device.type == "cpu" and is_plain:
            return self._compiled_inputs(latent.numpy())
        if latent.device.type == "cuda" and is_plain and has_gpu_kernels():
            return self._gpu_inputs(latent)
        frame, gradients, positions = self.body(latent)
        return self.field(frame, positions).flatten(2), self.body.fold_view(frame, gradients)

    def _compiled_inputs(
        self, latent: npt.NDArray[np.float32]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the inputs by the compiled loops, which are several times faster than torch."""
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

    def _gpu_inputs(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the inputs by our kernels, in a tenth of torch's launches."""
        from lcollision_core.predictor import gpu_inputs as gpu

        body = self.body
        fixed = body.output_index, body.offset, body.scale, body.rest_frame
        frame, gradients = gpu.posed_skin(body.products(latent), *fixed)
        neighbours = self.field.geodesic_neighbours
        field = gpu.contact_field(frame, body.positions(gradients), neighbours)
        return field.flatten(2), gpu.fold_view(frame, gradients, body.members)

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
        # Energies are learned as square roots, as they have a long tail.
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
        """Return this process's share of the batch's mean loss, with patches, without ranking."""
        row_batch = batch.part(*part)
        if not len(row_batch.energy):
            # The mean of no rows is NaN; their sum is 0, and depends on the parameters.
            return output.logit.sum()
        fraction = len(row_batch.energy) / len(batch.energy)
        patch_logit, patch_root, root = output.auxiliary
        total = config.entropy_weight * binary_cross_entropy_with_logits(
            output.logit, row_batch.colliding
        )
        n_patches = self.skin.n_points
        for cells, weight, depth_weight in (
            (slice(0, n_patches), _PATCH_WEIGHT, _DEPTH_WEIGHT),
            (slice(n_patches, None), _FOLD_WEIGHT, _FOLD_DEPTH_WEIGHT),
        ):
            taught = row_batch.patch_root[:, cells]
            if taught.shape[1]:
                colliding = (taught > 0.0).to(patch_logit)
                total = total + weight * binary_cross_entropy_with_logits(
                    patch_logit[:, cells], colliding
                )
                total = total + depth_weight * smooth_l1_loss(patch_root[:, cells], taught)
        labelled = torch.cat([row_batch.domain_energy, row_batch.energy[:, None]], dim=1).sqrt()
        total = total + config.depth_weight * smooth_l1_loss(root, labelled)
        return fraction * total


class _PatchNetworks(nn.Module):
    """A small network for each of n patches, (n, B, n_in) to (n, B, 2): logit and root energy."""

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
        """Store the means and deviations of inputs."""
        if not inputs.numel():
            return
        self.mean.copy_(inputs.mean(dim=1, keepdim=True))
        self.deviation.copy_(inputs.std(dim=1, keepdim=True) + least_deviation)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        # Standardise in one pass over the inputs.
        scale = self.deviation.reciprocal()
        values = torch.addcmul(-self.mean * scale, inputs, scale)
        for layer in self.layers[:-1]:
            values = silu(layer(values))
        outputs: torch.Tensor = self.layers[-1](values)
        return outputs


def _parts(rows: torch.Tensor) -> list[torch.Tensor]:
    return [rows[start : start + _ROWS_AT_ONCE] for start in range(0, len(rows), _ROWS_AT_ONCE)]
