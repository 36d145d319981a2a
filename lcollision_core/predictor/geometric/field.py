"""What the points of the body feel of each other: compiled on the CPU, torch elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch.autograd.function import once_differentiable

from lcollision_core.errors import ShapeError
from lcollision_core.predictor.inference import field_kernels, skin_kernels
from lcollision_core.predictor.inference.field_kernels import BEHIND, BLOCK, FADE, REACHES
from lcollision_core.predictor.inference.skin_kernels import SMALLEST_SQUARED_ANGLE

_SYMMETRIC = [3, 4, 5, 4, 6, 7, 5, 7, 8]
"""Where the features hold the nine entries of S."""


class Decoding(NamedTuple):
    """How features follow from latent codes: those of each group move the points it supports.

    Attributes
    ----------
    blocks : (G, 4) int64 for each group the first and past the last of its codes, and likewise of
        the n = 9 N outputs that they make; all codes in their order; on the CPU
    tables : the groups' (codes, outputs) matrices one after the other, flat
    target : (N,) int32 the point that nine outputs belong to
    offset : (P, 9) features of codes 0, but for what the groups add
    scale : (9,) of the outputs
    """

    blocks: torch.Tensor
    tables: torch.Tensor
    target: torch.Tensor
    offset: torch.Tensor
    scale: torch.Tensor

    def products(self, latent: torch.Tensor) -> torch.Tensor:
        """Return (B, n) every group's codes times its table."""
        result = latent.new_empty((len(latent), len(self.target) * self.offset.shape[1]))
        for (codes, columns), table in self._groups():
            torch.mm(latent[:, codes], table, out=result[:, columns])
        return result

    def products_backward(self, grad_products: torch.Tensor) -> torch.Tensor:
        """Pull derivatives by the products back to the codes."""
        parts = [grad_products[:, columns] @ table.T for (_, columns), table in self._groups()]
        return torch.cat(parts, dim=1)

    def grouped(self, outputs: torch.Tensor) -> torch.Tensor:
        """View (B, n) outputs as (B, N, 9)."""
        return outputs.view(len(outputs), len(self.target), self.offset.shape[1])

    def _groups(self) -> Iterator[tuple[tuple[slice, slice], torch.Tensor]]:
        start = 0
        for first, last, left, right in self.blocks.tolist():
            shape = last - first, right - left
            table = self.tables[start : start + shape[0] * shape[1]].view(shape)
            yield (slice(first, last), slice(left, right)), table
            start += shape[0] * shape[1]


def decode_features(latent: torch.Tensor, decoding: Decoding) -> torch.Tensor:
    """Return the (B, P, 9) deformation features of (B, D) latent codes."""
    features: torch.Tensor = _Features.apply(latent, decoding)  # type: ignore[no-untyped-call]
    return features


def deform(features: torch.Tensor, rest_frame: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Turn the first points' frames, and return all points' deformation gradients R S.

    Parameters
    ----------
    features : (B, Q, 9) unscaled deformation features: log R, then the upper triangle of S
    rest_frame : (N, 3, 3) frames of the first N points on the reference, as columns

    Returns
    -------
    frame : (B, N, 3, 3) R F
    rows : (B, 3, 3 Q) the first, second and third rows of all gradients
    """
    if features.device.type == "cpu":
        frame, rows = _Deform.apply(features, rest_frame)  # type: ignore[no-untyped-call]
        return frame, rows.flatten(2)
    rotation = _rotations(features[..., :3])
    stretch = features[..., _SYMMETRIC].reshape(*features.shape[:-1], 3, 3)
    frame = rotation[:, : len(rest_frame)] @ rest_frame
    return frame, (rotation @ stretch).transpose(1, 2).flatten(2)


def contact_field(
    frame: torch.Tensor,
    places: torch.Tensor,
    order: torch.Tensor,
    apart: torch.Tensor,
    reach: torch.Tensor,
) -> torch.Tensor:
    """Sum up at each point what distant parts of the skin come near it.

    Implicit moving least squares (Kolluri 2008): another point at distance d weighs
    (1 - d^2 / reach^2)^3, and less as it falls behind the tangent plane. Whichever points they are,
    so there is no list of who may meet whom; smooth, and exactly 0 where nothing is near.

    Parameters
    ----------
    frame : (B, P, 3, 3) of each point, as columns, the outer normal first
    places : (B, 3, P)
    order : (O,) int32, all P points, neighbours next to each other, and some again until O is a
        multiple of `BLOCK`
    apart : (P, O) added to squared distances to the points in that order: 0 for pairs that see
        each other, which they do both ways, else 1, as for all that are there again
    reach : (2,) ascending, below 1

    Returns
    -------
    sums : (P, B, 2, 8): of the weights; of the point's heights above the others' tangent planes;
        of the offsets to them (3) and of their normals (3), in the point's frame

    Raises
    ------
    ShapeError : there are not two reaches, or the order or `apart` has another size.
    """
    if len(reach) != len(REACHES):
        raise ShapeError.must_be("reach", f"{len(REACHES)} numbers", len(reach))
    n_points, n_ordered = places.shape[2], len(order)
    if n_ordered != -(-n_points // BLOCK) * BLOCK or apart.shape != (n_points, n_ordered):
        raise ShapeError(
            f"{n_points} points are ordered in blocks of {BLOCK}",
            got=f"an order of {n_ordered} and pairs of shape {tuple(apart.shape)}",
        )
    if frame.device.type == "cpu":
        sums: torch.Tensor = _ContactField.apply(frame, places, order, apart, reach)  # type: ignore[no-untyped-call]
        return sums
    frame = frame[:, : places.shape[2]]
    index = order.long()
    offset = places[:, :, None, index] - places[..., None]
    squared = offset.square().sum(dim=1) + apart
    normal = frame[..., 0]
    step = ((torch.einsum("bipq,bpi->bpq", offset, normal) + BEHIND) / FADE).clamp(0.0, 1.0)
    facing = step.square() * (3.0 - 2.0 * step)
    normal = normal[:, index]
    above = -torch.einsum("bipq,bqi->bpq", offset, normal)
    parts = []
    for one in reach:
        weight = facing * (1.0 - squared / one.square()).clamp_min(0.0).pow(3)
        others = torch.einsum("bpq,bipq->bpi", weight, offset)
        normals = torch.einsum("bpq,bqi->bpi", weight, normal)
        local = (torch.einsum("bpij,bpi->bpj", frame, values) for values in (others, normals))
        heights = torch.stack([weight.sum(dim=2), (weight * above).sum(dim=2)], dim=2)
        parts.append(torch.cat([heights, *local], dim=2))
    return torch.stack(parts, dim=2).transpose(0, 1)


def normalised(sums: torch.Tensor, reach: torch.Tensor, full: float, some: float) -> torch.Tensor:
    """Turn the sums of `contact_field` into what a network takes, (P, B, 16).

    Parameters
    ----------
    sums, reach : as there
    full : the sum of weights that becomes one half
    some : added to it in the means, so that those of nothing are 0; the heights and offsets among
        them are in reaches
    """
    if sums.device.type == "cpu":
        inputs: torch.Tensor = _Normalised.apply(sums, reach, full, some)  # type: ignore[no-untyped-call]
        return inputs.flatten(2)
    weight = sums[..., :1]
    means = sums[..., 1:] / (weight + some)
    parts = [weight / (weight + full), means[..., :4] / reach[:, None], means[..., 4:]]
    return torch.cat(parts, dim=3).flatten(2)


def fold_view(frame: torch.Tensor, rows: torch.Tensor, members: torch.Tensor) -> torch.Tensor:
    """Return how the skin is deformed about some sites, whichever way the body is turned.

    Parameters
    ----------
    frame, rows : of the skin's points, as `deform` returns them
    members : (S, M) int32 points of each site; the first gives the frame

    Returns
    -------
    inputs : (S, B, 9 M) the members' gradients R S in that frame
    """
    if frame.device.type == "cpu":
        inputs: torch.Tensor = _FoldView.apply(frame, rows, members)  # type: ignore[no-untyped-call]
        return inputs
    index = members.long()
    gradients = _gradients(rows)[:, :, index]
    local = torch.einsum("bsik,bismj->sbmkj", frame[:, index[:, 0]], gradients)
    return local.flatten(2)


def _rotations(log: torch.Tensor) -> torch.Tensor:
    """Return exp of (..., 3) rotation vectors by Rodrigues' formula, smooth at 0."""
    squared = log.square().sum(dim=-1) + SMALLEST_SQUARED_ANGLE
    angle = squared.sqrt()
    versine = 2.0 * (0.5 * angle).sin().square()
    x, y, z = log.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    cross = cross.reshape(*log.shape[:-1], 3, 3)
    outer = log[..., :, None] * log[..., None, :]
    cosine = (1.0 - versine)[..., None, None] * torch.eye(3).to(log)
    return (
        cosine
        + (angle.sin() / angle)[..., None, None] * cross
        + (versine / squared)[..., None, None] * outer
    )


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, latent: torch.Tensor, decoding: Decoding) -> torch.Tensor:
        outputs = decoding.products(latent).tanh_()
        ctx.save_for_backward(outputs)
        ctx.decoding = decoding
        grouped = decoding.grouped(outputs)
        if latent.device.type != "cpu":
            features = decoding.offset.repeat(len(latent), 1, 1)
            return features.index_add_(1, decoding.target, grouped * decoding.scale)
        features = latent.new_empty((len(latent), *decoding.offset.shape))
        given = grouped, decoding.target, decoding.offset, decoding.scale, features
        skin_kernels.add_features(*_arrays(*given))
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_features: torch.Tensor) -> tuple[torch.Tensor, None]:
        (outputs,) = ctx.saved_tensors
        decoding: Decoding = ctx.decoding
        grouped = decoding.grouped(outputs)
        if outputs.device.type != "cpu":
            grad_outputs = grad_features[:, decoding.target.long()] * decoding.scale
            grad_inputs = grad_outputs * (1.0 - grouped.square())
        else:
            grad_inputs = torch.empty_like(grouped)
            given = grouped, decoding.target, decoding.scale, grad_features, grad_inputs
            skin_kernels.add_features_backward(*_arrays(*given))
        return decoding.products_backward(grad_inputs.flatten(1)), None


class _Deform(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, features: torch.Tensor, rest_frame: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.save_for_backward(features, rest_frame)
        n_rows, n_points, _ = features.shape
        frame = features.new_empty((n_rows, len(rest_frame), 3, 3))
        rows = features.new_empty((n_rows, 3, n_points, 3))
        skin_kernels.deform(*_arrays(features, rest_frame, frame, rows))
        return frame, rows

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_frame: torch.Tensor, grad_rows: torch.Tensor
    ) -> tuple[torch.Tensor, None]:
        features, rest_frame = ctx.saved_tensors
        grad_features = torch.empty_like(features, memory_format=torch.contiguous_format)
        skin_kernels.deform_backward(
            *_arrays(features, rest_frame, grad_frame, grad_rows, grad_features)
        )
        return grad_features, None


class _ContactField(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        frame: torch.Tensor,
        places: torch.Tensor,
        order: torch.Tensor,
        apart: torch.Tensor,
        reach: torch.Tensor,
    ) -> torch.Tensor:
        ctx.save_for_backward(frame, places)
        ctx.fixed = _fixed(order, apart, reach)
        sums = frame.new_empty((places.shape[2], len(frame), len(reach), 8))
        field_kernels.contact_field(*_arrays(frame, places), *ctx.fixed, *_arrays(sums))
        return sums

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad_sums: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, None, None, None]:
        frame, places = ctx.saved_tensors
        grad_frame, grad_places = _zeros_like(frame), _zeros_like(places)
        field_kernels.contact_field_backward(
            *_arrays(frame, places), *ctx.fixed, *_arrays(grad_sums, grad_frame, grad_places)
        )
        return grad_frame, grad_places, None, None, None


class _Normalised(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, sums: torch.Tensor, reach: torch.Tensor, full: float, some: float
    ) -> torch.Tensor:
        ctx.save_for_backward(sums, reach)
        ctx.constants = full, some
        inputs = torch.empty_like(sums)
        seen_sums, seen_reach, filled = _arrays(sums, reach, inputs)
        field_kernels.normalised(seen_sums, seen_reach, full, some, filled)
        return inputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_inputs: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        sums, reach = ctx.saved_tensors
        grad_sums = torch.empty_like(sums)
        seen_sums, seen_reach, given, filled = _arrays(sums, reach, grad_inputs, grad_sums)
        constants = ctx.constants
        field_kernels.normalised_backward(
            seen_sums, seen_reach, given, constants[0], constants[1], filled
        )
        return grad_sums, None, None, None


class _FoldView(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, frame: torch.Tensor, rows: torch.Tensor, members: torch.Tensor
    ) -> torch.Tensor:
        ctx.save_for_backward(frame, rows, members)
        inputs = frame.new_empty((len(members), len(frame), 9 * members.shape[1]))
        skin_kernels.fold_view(*_arrays(frame, _gradients(rows), members, inputs))
        return inputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, None]:
        frame, rows, members = ctx.saved_tensors
        grad_frame, grad_rows = _zeros_like(frame), _zeros_like(rows)
        skin_kernels.fold_view_backward(
            *_arrays(
                frame,
                _gradients(rows),
                members,
                grad_inputs,
                grad_frame,
                _gradients(grad_rows),
            )
        )
        return grad_frame, grad_rows, None


def _fixed(order: torch.Tensor, apart: torch.Tensor, reach: torch.Tensor) -> list[Any]:
    """Return what the loops of the contact field take of what is the same for all poses."""
    turns, pairs, steepness = _arrays(order, apart, reach.square().reciprocal())
    return [turns, field_kernels.by_blocks(pairs, turns), steepness]


def _gradients(rows: torch.Tensor) -> torch.Tensor:
    """View rows (B, 3, 3 P) as (B, 3, P, 3)."""
    return rows.reshape(*rows.shape[:2], rows.shape[2] // 3, 3)


def _zeros_like(values: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(values, memory_format=torch.contiguous_format)


def _arrays(*tensors: torch.Tensor) -> list[Any]:
    return [values.detach().contiguous().numpy() for values in tensors]
