"""From latent codes to the places, frames and folds of the skin, by compiled loops.

Of few poses their points are what is taken several at a time, of many the poses: half of the time
for three times the memory.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.predictor import batch_kernels, network_kernels, skin_kernels
from lcollision_core.predictor.skin_geometry import SkinGeometry

Array = npt.NDArray[np.floating[Any]]
Float32Array = npt.NDArray[np.float32]

_POINTS_AT_ONCE = 64
"""Of many poses: what moves them is made and added up while it is in the caches."""


@dataclass(frozen=True, eq=False)
class SkinMap:
    """From codes to places: what is fixed.

    Attributes
    ----------
    geometry : where the body is looked at
    weight : (3 P, P) float32 array, of the points' deformation gradients in their places
    origin : (3, P) of the places, in heights
    """

    geometry: SkinGeometry
    weight: Float32Array
    origin: Array

    @cached_property
    def weight_back(self) -> Float32Array:
        """Transposed, of which the way back reads rows, too."""
        return np.ascontiguousarray(self.weight.T)

    @cached_property
    def tables(self) -> list[tuple[slice, npt.NDArray[np.int32], Float32Array]]:
        """For some points at a time the codes that move them, they, and the (9 n, codes) table."""
        rows = N_FEATURES * _POINTS_AT_ONCE
        return [
            (
                group,
                target[start : start + _POINTS_AT_ONCE],
                np.ascontiguousarray(table.T[N_FEATURES * start :][:rows]),
            )
            for group, target, table in self.geometry.groups()
            for start in range(0, len(target), _POINTS_AT_ONCE)
        ]


class SkinOfPoses(ABC):
    """The skin of B poses, in memory that is used for others again.

    Attributes
    ----------
    frame : (B, N, 3, 3) of the first N points of the skin, or at least of the body, as columns
    places : (B, 3, P) of the points of the body, in heights
    view : (S, B, 9 M) the deformation about the fold sites
    """

    frame: Array
    places: Array
    view: Array

    @abstractmethod
    def set_codes(self, latent: Array) -> None:
        """Fill in all attributes, of (B, D) codes."""


class SkinOfFew(SkinOfPoses):
    """In double precision, without torch, and with the way back.

    Parameters
    ----------
    skin : what is fixed
    n_rows : B
    """

    def __init__(self, skin: SkinMap, n_rows: int) -> None:
        geometry = self._geometry = skin.geometry
        self._skin = skin
        # Loops over numbers of two sizes are slow.
        self._offset = geometry.offset.astype(np.float64)
        self._scale = geometry.scale.astype(np.float64)
        self._rest_frame = geometry.rest_frame.astype(np.float64)
        n_skin, n_sites, n_members = len(geometry.offset), *geometry.members.shape
        self._outputs = np.empty((n_rows, len(geometry.target), N_FEATURES))
        self._products = self._outputs.reshape(n_rows, N_FEATURES * len(geometry.target))
        self._features = np.empty((n_rows, n_skin, N_FEATURES))
        self._rows = np.empty((n_rows, 3, n_skin, 3))
        self.frame = np.empty((n_rows, len(geometry.rest_frame), 3, 3))
        self.places = np.empty((n_rows, 3, geometry.n_points))
        self.view = np.empty((n_sites, n_rows, N_FEATURES * n_members))

    def set_codes(self, latent: Array) -> None:
        """Fill in all attributes, of (B, D) codes."""
        geometry = self._geometry
        skin_kernels.products(latent, geometry.tables, geometry.blocks, self._products)
        np.tanh(self._products, out=self._products)
        skin_kernels.add_features(
            self._outputs, geometry.target, self._offset, self._scale, self._features
        )
        skin_kernels.deform(self._features, self._rest_frame, self.frame, self._rows)
        network_kernels.stacked_products(
            _flat_rows(self._rows), self._skin.weight[None], _flat_rows(self.places[..., None])
        )
        self.places += self._skin.origin
        skin_kernels.fold_view(self.frame, self._rows, geometry.members, self.view)

    def by_codes(self, by_frame: Array, by_places: Array, by_view: Array) -> Array:
        """Pull derivatives by the attributes back to (B, D) of the codes; spoils the first."""
        geometry = self._geometry
        by_rows = np.zeros_like(self._rows)
        by_features, by_outputs = np.empty_like(self._features), np.empty_like(self._outputs)
        network_kernels.stacked_products(
            _flat_rows(by_places[..., None]), self._skin.weight_back[None], _flat_rows(by_rows)
        )
        skin_kernels.fold_view_backward(
            self.frame, self._rows, geometry.members, by_view, by_frame, by_rows
        )
        skin_kernels.deform_backward(
            self._features, self._rest_frame, by_frame, by_rows, by_features
        )
        skin_kernels.add_features_backward(
            self._outputs, geometry.target, self._scale, by_features, by_outputs
        )
        by_latent = np.empty((len(by_rows), int(geometry.blocks[-1, 1])))
        by_products = by_outputs.reshape(self._products.shape)
        skin_kernels.products_backward(by_products, geometry.tables, geometry.blocks, by_latent)
        return by_latent


class SkinOfMany(SkinOfPoses):
    """In single precision, the products by torch, and poses last, see `batch_kernels`.

    Parameters
    ----------
    skin : what is fixed
    n_rows : B
    """

    def __init__(self, skin: SkinMap, n_rows: int) -> None:
        geometry = self._geometry = skin.geometry
        self._weight, self._tables = skin.weight, skin.tables
        self._origin = skin.origin.astype(np.float32)[..., None]
        self._rest_frame = geometry.rest_frame.astype(np.float32)
        n_points, n_frames, n_skin = geometry.n_points, len(self._rest_frame), len(geometry.offset)
        n_sites, n_members = geometry.members.shape

        def empty(*shape: int) -> Float32Array:
            return np.empty(shape, dtype=np.float32)

        self._outputs = empty(_POINTS_AT_ONCE, N_FEATURES, n_rows)
        self._features = empty(n_skin, N_FEATURES, n_rows)
        self._rows = empty(3, n_skin, 3, n_rows)
        self._turned = empty(n_frames, 3, 3, n_rows)
        self._placed = empty(3, n_points, n_rows)
        self._view = empty(n_sites, N_FEATURES * n_members, n_rows)
        self.frame = empty(n_rows, n_points, 3, 3)
        self.places = empty(n_rows, 3, n_points)
        self.view = self._view.transpose(0, 2, 1)

    def set_codes(self, latent: Array) -> None:
        """Fill in all attributes, of (B, D) codes."""
        import torch

        geometry, n_rows = self._geometry, len(latent)
        codes = torch.from_numpy(np.ascontiguousarray(latent.T))
        self._features[:] = geometry.offset[..., None]
        for group, target, table in self._tables:
            outputs = self._outputs[: len(target)]
            products = torch.from_numpy(outputs).view(-1, n_rows)
            torch.mm(torch.from_numpy(table), codes[group], out=products)
            # Not torch's, which takes 13 times as long on an AMD processor.
            np.tanh(outputs, out=outputs)
            batch_kernels.add_features(outputs, target, geometry.scale, self._features)
        batch_kernels.deform(self._features, self._rest_frame, self._rows, self._turned, self.frame)
        gradients = torch.from_numpy(self._rows).view(3, -1, n_rows)[:, : len(self._weight)]
        weight = torch.from_numpy(self._weight).T.expand(3, -1, -1)
        torch.bmm(weight, gradients, out=torch.from_numpy(self._placed))
        self._placed += self._origin
        self.places[:] = self._placed.transpose(2, 0, 1)
        batch_kernels.fold_view(self._turned, self._rows, geometry.members, self._view)


def _flat_rows(values: Array) -> Array:
    """View (B, 3, n, m) values as (1, 3 B, n m)."""
    return values.reshape(1, 3 * len(values), values.shape[2] * values.shape[3])
