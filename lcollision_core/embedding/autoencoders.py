"""Trained autoencoders as arrays: their encoders run by NumPy, their decoders made into tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES, N_ROTATION
from lcollision_core.acap.scaling import FeatureScaling
from lcollision_core.embedding.decoder import DecoderGroup, FeatureDecoder, Float32Array
from lcollision_core.embedding.seeding import ring_average
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

CENTRED_SCALE = 0.5
"""Scaled features lie in [-0.95, 0.95]; half their difference from the mean does so too, and
stays where tanh is nearly straight."""


@dataclass(frozen=True)
class AutoencoderWeights:
    """One trained autoencoder: see `network`.

    Attributes
    ----------
    components : (m, n, 9) float32 array C, each code's weights of norm 1
    self_weight, ring_weight : (9, 9) float32 arrays, the graph convolution
    support : (n,) int32 array, the vertices it sees, ascending
    """

    components: Float32Array
    self_weight: Float32Array
    ring_weight: Float32Array
    support: IntArray


def centre_features(
    features: npt.NDArray[Any], scaling: FeatureScaling, mean_features: Float32Array
) -> Float32Array:
    """Return what the autoencoders see of (B, V, 9) unscaled features, float32."""
    scaled = scaling.apply(np.asarray(features, dtype=np.float64))
    centred: Float32Array = (CENTRED_SCALE * (scaled - mean_features)).astype(np.float32)
    return centred


def build_decoder(
    parts: Sequence[AutoencoderWeights],
    scaling: FeatureScaling,
    mean_features: Float32Array,
    topology: Topology,
) -> FeatureDecoder:
    """Fold each autoencoder's decoder into one table: see `network`.

    Parameters
    ----------
    parts : level 1, then level 2's in the order of the domains
    scaling : of the features
    mean_features : (V, 9) float32 array, scaled
    topology : the connectivity

    Returns
    -------
    decoder : FeatureDecoder
    """
    ring = ring_average(topology)
    groups = []
    for part in parts:
        components = part.components.astype(np.float64)
        around = _ring_mean(components, ring[part.support][:, part.support])
        table = components @ part.self_weight.T + around @ part.ring_weight.T
        # Never read-only, which a model file's arrays are: loops would be compiled for both.
        support = np.array(part.support)
        groups.append(DecoderGroup(table.reshape(len(table), -1).astype(np.float32), support))
    numbers = np.where(
        np.arange(N_FEATURES) < N_ROTATION, scaling.rotation_scale, scaling.stretch_scale
    )
    return FeatureDecoder(
        groups=tuple(groups),
        offset=scaling.invert(mean_features.astype(np.float64)),
        scale=1.0 / (CENTRED_SCALE * numbers),
    )


def run_encoders(
    centred: Float32Array,
    level1: AutoencoderWeights,
    level2: Sequence[AutoencoderWeights],
    attention_mask: Float32Array,
    topology: Topology,
) -> Float32Array:
    """Encode both levels: Z_0 of the features, Z_k of level 1's residual under mask k.

    Parameters
    ----------
    centred : (B, V, 9) float32 array, see `centre_features`
    level1, level2 : the autoencoders
    attention_mask : (K, V) float32 array
    topology : the connectivity

    Returns
    -------
    latent : (B, D) float32 array
    """
    ring = ring_average(topology)
    codes, residual = [], centred
    for domain, part in enumerate((level1, *level2), start=-1):
        inputs = residual[:, part.support]
        if domain >= 0:
            inputs = inputs * attention_mask[domain, part.support][:, None]
        local_ring = ring[part.support][:, part.support]
        around = _ring_mean(inputs, local_ring)
        hidden = np.tanh(inputs @ part.self_weight + around @ part.ring_weight)
        weights = part.components.reshape(len(part.components), -1)
        codes.append(hidden.reshape(len(hidden), -1) @ weights.T)
        if domain < 0:
            back = _ring_mean(part.components, local_ring)
            table = part.components @ part.self_weight.T + back @ part.ring_weight.T
            output = np.tanh(codes[0] @ table.reshape(len(table), -1))
            residual = centred - output.reshape(centred.shape)
    latent: Float32Array = np.concatenate(codes, axis=1).astype(np.float32)
    return latent


def deviation_of(latent: npt.NDArray[Any]) -> FloatArray:
    """Return the (D,) root mean square of (N, D) codes, floored so that no code is nailed to 0."""
    deviation = np.sqrt((np.asarray(latent, dtype=np.float64) ** 2).mean(axis=0))
    floored: FloatArray = np.maximum(deviation, max(1e-3 * float(deviation.max()), 1e-6))
    return floored


def _ring_mean(values: npt.NDArray[Any], ring: Any) -> npt.NDArray[Any]:
    """Average (m, n, 9) values over one-rings, (n, n), in the values' dtype."""
    n_rows, n_vertices, width = values.shape
    columns = values.transpose(1, 0, 2).reshape(n_vertices, n_rows * width)
    product = ring.astype(values.dtype) @ columns
    averaged: npt.NDArray[Any] = product.reshape(n_vertices, n_rows, width).transpose(1, 0, 2)
    return averaged
