"""Reconstruction error of a latent space, and of plain principal components as a baseline."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from lcollision_core.acap.scaling import FeatureScaling
from lcollision_core.embedding.autoencoders import deviation_of
from lcollision_core.embedding.seeding import principal_components
from lcollision_core.meshes.alignment import fit_rigid
from lcollision_core.meshes.topology import FloatArray

_Figure = Annotated[float, Meta(ge=0.0, le=1e9)]


@dataclass(frozen=True)
class EmbeddingMetrics:
    """Measurements of training, in normalised lengths. Codes are fitted as `Embedding.encode` does.

    Attributes
    ----------
    level1_mean : vertex error of the training poses with level 1 alone, its codes as encoded
    guess_mean, guess_max : with both levels, codes straight from the encoders
    mean, max : with both levels, codes fitted
    held_out_mean, held_out_max : of poses that a second model was trained without, codes fitted;
        None if none was trained, like the next two
    pca_held_out_mean : the same of plain principal components of the same training poses' features,
        as many numbers as the latent has or the poses span, codes fitted in the same way
    pca_size : how many numbers that is
    acap_mean, acap_max : of encoding poses as features and decoding them, without any code
    connected_share : least fraction of a domain's vertices in its largest connected patch
    domains_per_vertex : effective number of domains of a vertex, 1 / Σ_k (M^{ki})², mean

    Raises
    ------
    ValueError : a value that cannot be.
    """

    level1_mean: _Figure
    guess_mean: _Figure
    guess_max: _Figure
    mean: _Figure
    max: _Figure
    held_out_mean: _Figure | None
    held_out_max: _Figure | None
    pca_held_out_mean: _Figure | None
    pca_size: Annotated[int, Meta(ge=0)] | None
    acap_mean: _Figure
    acap_max: _Figure
    connected_share: _Figure
    domains_per_vertex: _Figure

    def __post_init__(self) -> None:
        held_out = (self.held_out_mean, self.held_out_max, self.pca_held_out_mean, self.pca_size)
        if None in held_out and any(value is not None for value in held_out):
            raise ValueError("the held-out errors must be all there or all missing")


def vertex_distances(decoded: npt.NDArray[Any], vertices: npt.NDArray[Any]) -> FloatArray:
    """Return the distances of decoded vertices from given ones, each pose moved to fit best.

    Parameters
    ----------
    decoded, vertices : (B, V, 3) arrays, in one unit

    Returns
    -------
    distances : (B, V) float64 array, same unit
    """
    distances = np.empty(decoded.shape[:2])
    for pose, target in enumerate(decoded):
        rotation, translation = fit_rigid(vertices[pose], target)
        aligned = np.asarray(vertices[pose], dtype=np.float64) @ rotation.T + translation
        distances[pose] = np.linalg.norm(aligned - target, axis=1)
    return distances


@dataclass(frozen=True)
class LinearDecoder:
    """Plain principal components of features; decodes as `fitting.Decoder` asks.

    Attributes
    ----------
    basis : (m, V, 9) float64 array, orthonormal in scaled features, given unscaled
    offset : (V, 9) float64 array, the mean features
    """

    basis: FloatArray
    offset: FloatArray

    @property
    def latent_size(self) -> int:
        """The number of components, m."""
        return len(self.basis)

    def features(self, latent: npt.NDArray[Any]) -> FloatArray:
        """Decode (B, m) codes to (B, V, 9) unscaled features."""
        combined: FloatArray = self.offset + np.tensordot(
            np.asarray(latent, dtype=np.float64), self.basis, axes=1
        )
        return combined

    def tangent_groups(self, latent: npt.NDArray[Any]) -> Iterator[FloatArray]:  # noqa: ARG002
        """Yield the (m, V, 9) derivatives, the same everywhere."""
        yield self.basis


def feature_pca(
    features: FloatArray, n_numbers: int
) -> tuple[LinearDecoder, FloatArray, FloatArray]:
    """Fit plain principal components to features, scaled as the autoencoders see them.

    Parameters
    ----------
    features : (N, V, 9) float64 array, unscaled
    n_numbers : components wanted; N poses have at most N - 1

    Returns
    -------
    decoder : the decoder
    projection : (V, 9, m) float64 array, codes are (features - offset) times it
    deviation : (m,) float64 array, root mean square of the training codes, > 0
    """
    scale = FeatureScaling.fit(features).scale
    offset = features.mean(axis=0)
    rows = ((features - offset) * scale).reshape(len(features), -1)
    basis = principal_components(rows, max(1, min(n_numbers, len(features) - 1)))
    shaped = basis.reshape(len(basis), *offset.shape)
    projection = np.moveaxis(shaped * scale, 0, -1)
    return LinearDecoder(shaped / scale, offset), projection, deviation_of(rows @ basis.T)
