"""From latent codes to the skin's contact features and folds, by compiled loops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.predictor.inference import field_kernels, skin_kernels
from lcollision_core.predictor.inference.field_kernels import UNITS
from lcollision_core.predictor.inference.network_kernels import Workspace
from lcollision_core.predictor.inference.skin_geometry import SkinGeometry

Float32Array = npt.NDArray[np.float32]


class PosedSkin(NamedTuple):
    """The skin of B poses.

    Attributes
    ----------
    frame : (B, N, 3, 3) of the first N points of the skin, as columns
    positions : (B, 3, P) of the points of the body, in normalised length
    field : (P, B, 2, 8) contact features, see `geometric.field.ContactField`
    folds : (S, B, 9 M) the deformation about the fold sites
    outputs, features, turns, rows : what the derivatives need: (B, T, 9) tanh of each group's
        outputs, (B, Q, 9) deformation features, those of `skin_kernels.rodrigues`, and
        (B, 3, Q, 3) rows of the deformation gradients
    """

    frame: Float32Array
    positions: Float32Array
    field: Float32Array
    folds: Float32Array
    outputs: Float32Array
    features: Float32Array
    turns: Float32Array
    rows: Float32Array


class CompiledSkin:
    """A reduced body posed by latent codes.

    Parameters
    ----------
    geometry : the points of the body
    weight : (3 P, P) float32 array, from the points' deformation gradients to their positions
    origin : (3, P) of the positions, in normalised length
    """

    def __init__(self, geometry: SkinGeometry, weight: Float32Array, origin: Float32Array) -> None:
        self._geometry, self._weight, self._origin = geometry, weight, origin

    def forward(self, codes: Float32Array, workspace: Workspace) -> PosedSkin:
        """Pose the skin by (B, D) codes, in a workspace's memory."""
        geometry, n_rows, empty = self._geometry, len(codes), workspace.empty
        (n_skin, _), (n_sites, n_members) = geometry.offset.shape, geometry.members.shape
        outputs = empty("outputs", n_rows, N_FEATURES * len(geometry.target))
        stop = 0
        for group in geometry.groups:
            start, stop = stop, stop + group.table.shape[1]
            np.matmul(codes[:, group.codes], group.table, out=outputs[:, start:stop])
        np.tanh(outputs, out=outputs)
        outputs = outputs.reshape(n_rows, -1, N_FEATURES)
        features = empty("features", n_rows, n_skin, N_FEATURES)
        skin_kernels.add_features(
            outputs, geometry.target, geometry.offset, geometry.scale, features
        )
        turns = skin_kernels.rodrigues(features)
        frame = empty("frame", n_rows, *geometry.rest_frame.shape)
        rows = empty("rows", n_rows, 3, n_skin, 3)
        skin_kernels.deform(features, turns, geometry.rest_frame, frame, rows)
        own = rows[:, :, : geometry.n_points].reshape(3 * n_rows, -1)
        moved = np.matmul(own, self._weight, out=empty("moved", 3 * n_rows, geometry.n_points))
        positions = moved.reshape(n_rows, 3, -1) + self._origin
        field = empty("field", geometry.n_points, n_rows, *UNITS.shape)
        field_kernels.contact_field(
            frame, positions, geometry.order, geometry.neighbour_blocks, field
        )
        folds = empty("folds", n_sites, n_rows, N_FEATURES * n_members)
        skin_kernels.fold_view(frame, rows, geometry.members, folds)
        return PosedSkin(frame, positions, field, folds, outputs, features, turns, rows)

    def backward(
        self,
        skin: PosedSkin,
        grad_field: Float32Array,
        grad_folds: Float32Array,
    ) -> Float32Array:
        """Pull derivatives by contact features and folds back to (B, D) codes."""
        geometry, n_rows = self._geometry, len(skin.frame)
        grad_frame, grad_positions = np.zeros_like(skin.frame), np.zeros_like(skin.positions)
        field_kernels.contact_field_backward(
            skin.frame,
            skin.positions,
            geometry.order,
            geometry.neighbour_blocks,
            skin.field,
            grad_field,
            grad_frame,
            grad_positions,
        )
        grad_rows = np.zeros_like(skin.rows)
        grad_own = grad_positions.reshape(3 * n_rows, -1) @ self._weight.T
        grad_rows[:, :, : geometry.n_points] = grad_own.reshape(n_rows, 3, -1, 3)
        skin_kernels.fold_view_backward(
            skin.frame, skin.rows, geometry.members, grad_folds, grad_frame, grad_rows
        )
        grad_features = np.empty_like(skin.features)
        skin_kernels.deform_backward(
            skin.features, skin.turns, geometry.rest_frame, grad_frame, grad_rows, grad_features
        )
        grad_products = np.empty((n_rows, skin.outputs[0].size), dtype=np.float32)
        skin_kernels.add_features_backward(
            skin.outputs, geometry.target, geometry.scale, grad_features, grad_products
        )
        grad_codes, start = [], 0
        for group in geometry.groups:
            stop = start + group.table.shape[1]
            grad_codes.append(grad_products[:, start:stop] @ group.table.T)
            start = stop
        return np.concatenate(grad_codes, axis=1)
