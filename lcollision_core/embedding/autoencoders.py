"""Trained autoencoders as arrays: their encoders run by NumPy, their decoders made into tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from lcollision_core.acap.scaling import FeatureScaling
from lcollision_core.embedding.decoder import DecoderGroup, FeatureDecoder, Float32Array
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

CENTRED_SCALE = 0.5
"""Scaled features lie in [-0.95, 0.95]; half their difference from the mean does so too, and
stays where tanh is nearly straight."""


@dataclass(frozen=True)
class AutoencoderWeights:
    """One trained autoencoder: see `tied_autoencoder`.

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

    def encode(self, features: Float32Array, ring: sparse.csr_matrix) -> Float32Array:
        """Return the (B, m) codes of (B, n, 9) features; `ring` (V, V) averages over one-rings."""
        around = ring_mean(features, ring[self.support][:, self.support])
        hidden = np.tanh(features @ self.self_weight + around @ self.ring_weight)
        codes: Float32Array = (
            hidden.reshape(len(hidden), -1) @ self.components.reshape(len(self.components), -1).T
        )
        return codes

    def decoder_table(
        self, ring: sparse.csr_matrix, dtype: npt.DTypeLike = np.float32
    ) -> npt.NDArray[Any]:
        """Return the (m, 9 n) table of which decoding is tanh of the codes' combination."""
        components = self.components.astype(dtype)
        around = ring_mean(components, ring[self.support][:, self.support])
        table = components @ self.self_weight.T + around @ self.ring_weight.T
        return table.reshape(len(table), -1)


def ring_average(topology: Topology) -> sparse.csr_matrix:
    """Return the (V, V) matrix that takes the mean over each one-ring; no ring gives 0."""
    counts = np.maximum(np.diff(topology.adjacency.indptr), 1)
    return sparse.csr_matrix(sparse.diags(1.0 / counts) @ topology.adjacency)


def ring_mean(values: npt.NDArray[Any], ring: sparse.csr_matrix) -> npt.NDArray[Any]:
    """Average (m, n, 9) values over one-rings by the (n, n) matrix `ring`, in the values' dtype."""
    n_rows, n_vertices, width = values.shape
    columns = values.transpose(1, 0, 2).reshape(n_vertices, n_rows * width)
    product: npt.NDArray[Any] = ring.astype(values.dtype) @ columns
    return product.reshape(n_vertices, n_rows, width).transpose(1, 0, 2)


def centre_features(
    features: npt.NDArray[Any], scaling: FeatureScaling, mean_features: Float32Array
) -> Float32Array:
    """Return what the autoencoders see of (B, V, 9) unscaled features, float32."""
    return (CENTRED_SCALE * (scaling.apply(features) - mean_features)).astype(np.float32)


def build_decoder(
    autoencoders: Sequence[AutoencoderWeights],
    scaling: FeatureScaling,
    mean_features: Float32Array,
    topology: Topology,
) -> FeatureDecoder:
    """Turn each autoencoder's decoder into one table: see `tied_autoencoder`.

    Parameters
    ----------
    autoencoders : level 1, then level 2's in the order of the domains
    scaling : of the features
    mean_features : (V, 9) float32 array, scaled
    topology : the connectivity

    Returns
    -------
    decoder : FeatureDecoder
    """
    ring = ring_average(topology)
    return FeatureDecoder(
        groups=tuple(
            # The support is copied: a model file's arrays are read-only, and the loops would be
            # compiled for both kinds.
            DecoderGroup(one.decoder_table(ring, np.float64).astype(np.float32), one.support.copy())
            for one in autoencoders
        ),
        offset=scaling.invert(mean_features.astype(np.float64)),
        scale=1.0 / (CENTRED_SCALE * scaling.scale),
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
    codes = [level1.encode(centred, ring)]
    residual = centred - np.tanh(codes[0] @ level1.decoder_table(ring)).reshape(centred.shape)
    for one, share in zip(level2, attention_mask, strict=True):
        masked = residual[:, one.support] * share[one.support][:, None]
        codes.append(one.encode(masked, ring))
    return np.concatenate(codes, axis=1)


def deviation_of(latent: npt.NDArray[Any]) -> FloatArray:
    """Return the (D,) root mean square of (N, D) codes, floored so that each code can move."""
    deviation = np.sqrt((np.asarray(latent, dtype=np.float64) ** 2).mean(axis=0))
    floored: FloatArray = np.maximum(deviation, max(1e-3 * float(deviation.max()), 1e-6))
    return floored
