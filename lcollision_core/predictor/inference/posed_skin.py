"""From latent codes to the places, frames and folds of the skin, by compiled loops."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.predictor.inference import network_kernels, skin_kernels
from lcollision_core.predictor.inference.skin_geometry import SkinGeometry

Float32Array = npt.NDArray[np.float32]


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
    origin: Float32Array

    @cached_property
    def weight_back(self) -> Float32Array:
        """Transposed, of which the way back reads rows, too."""
        return np.ascontiguousarray(self.weight.T)


class PosedSkin:
    """The skin of B poses, in memory that is used again for others.

    Parameters
    ----------
    skin : what is fixed
    n_rows : B

    Attributes
    ----------
    frame : (B, N, 3, 3) of the first N points of the skin, as columns
    places : (B, 3, P) of the points of the body, in heights
    view : (S, B, 9 M) the deformation about the fold sites
    """

    def __init__(self, skin: SkinMap, n_rows: int) -> None:
        geometry = self._geometry = skin.geometry
        self._skin = skin
        self._rest_frame = geometry.rest_frame.astype(np.float32)
        n_skin, n_sites, n_members = len(geometry.offset), *geometry.members.shape
        self._outputs = np.empty((n_rows, len(geometry.target), N_FEATURES), dtype=np.float32)
        self._products = self._outputs.reshape(n_rows, N_FEATURES * len(geometry.target))
        self._features = np.empty((n_rows, n_skin, N_FEATURES), dtype=np.float32)
        self._rows = np.empty((n_rows, 3, n_skin, 3), dtype=np.float32)
        self.frame = np.empty((n_rows, len(geometry.rest_frame), 3, 3), dtype=np.float32)
        self.places = np.empty((n_rows, 3, geometry.n_points), dtype=np.float32)
        self.view = np.empty((n_sites, n_rows, N_FEATURES * n_members), dtype=np.float32)

    def set_codes(self, latent: Float32Array) -> None:
        """Fill in all attributes, of (B, D) codes."""
        geometry = self._geometry
        skin_kernels.products(latent, geometry.tables, geometry.blocks, self._products)
        np.tanh(self._products, out=self._products)
        skin_kernels.add_features(
            self._outputs, geometry.target, geometry.offset, geometry.scale, self._features
        )
        skin_kernels.deform(self._features, self._rest_frame, self.frame, self._rows)
        network_kernels.multiply(
            _flat_rows(self._rows), self._skin.weight[None], _flat_rows(self.places[..., None])
        )
        self.places += self._skin.origin
        skin_kernels.fold_view(self.frame, self._rows, geometry.members, self.view)

    def grad_codes(
        self, grad_frame: Float32Array, grad_places: Float32Array, grad_view: Float32Array
    ) -> Float32Array:
        """Pull derivatives by the attributes back to (B, D) of the codes; spoils the first."""
        geometry = self._geometry
        grad_rows = np.zeros_like(self._rows)
        grad_features, grad_outputs = np.empty_like(self._features), np.empty_like(self._outputs)
        network_kernels.multiply(
            _flat_rows(grad_places[..., None]), self._skin.weight_back[None], _flat_rows(grad_rows)
        )
        skin_kernels.fold_view_backward(
            self.frame, self._rows, geometry.members, grad_view, grad_frame, grad_rows
        )
        skin_kernels.deform_backward(
            self._features, self._rest_frame, grad_frame, grad_rows, grad_features
        )
        skin_kernels.add_features_backward(
            self._outputs, geometry.target, geometry.scale, grad_features, grad_outputs
        )
        grad_latent = np.empty((len(grad_rows), int(geometry.blocks[-1, 1])), dtype=np.float32)
        grad_products = grad_outputs.reshape(self._products.shape)
        skin_kernels.products_backward(grad_products, geometry.tables, geometry.blocks, grad_latent)
        return grad_latent


def _flat_rows(values: Float32Array) -> Float32Array:
    """View (B, 3, n, m) values as (1, 3 B, n m)."""
    return values.reshape(1, 3 * len(values), values.shape[2] * values.shape[3])
