"""Decode latent codes to features with the autoencoders of both levels, without torch.

Every autoencoder's decoder is tanh of a linear map of its codes (see `stages`), in level 2 on the
vertices of its domain only, so a pose costs one pass over a few megabytes of float32.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.acap.features import N_FEATURES, FeatureScaling
from lcollision_core.compiled import compiled, compiled_part, compiled_sums, inlined
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

Float32Array = npt.NDArray[np.float32]

_BLOCK = 576
"""Numbers summed at a time: they stay in the first-level cache during the loop over codes."""


@dataclass(frozen=True)
class DecoderGroup:
    """One autoencoder's decoder: features on `support` are tanh(codes @ weights).

    Attributes
    ----------
    weights : (m, 9 n) float32 array
    support : (n,) int32 array, ascending vertex indices
    """

    weights: Float32Array
    support: IntArray


class _Tables(NamedTuple):
    """All groups' weights, block by block, so that one loop decodes them all.

    They are read front to end, where `weights` would be read in strides: half the time or less on
    a mesh of 10 000 vertices, whose weights exceed any cache.

    Attributes
    ----------
    numbers : the groups' weights in a row, each (n_blocks, m, `_BLOCK`), the last block padded
        with 0
    first_number : (G + 1,) where each group's weights begin
    first_code : (G + 1,) where each group's codes begin in the latent
    support, first_support : vertices of all groups, and (G + 1,) where each group's begin
    """

    numbers: Float32Array
    first_number: npt.NDArray[np.int64]
    first_code: npt.NDArray[np.int64]
    support: IntArray
    first_support: npt.NDArray[np.int64]


@dataclass(frozen=True)
class FeatureDecoder:
    """The sum of all autoencoders' outputs, unscaled.

    Attributes
    ----------
    groups : level 1, then one of level 2 per domain; the latent holds their codes in this order
    offset : (V, 9) float64 array, the features of latent 0
    scale : (9,) float64 array, factor from an autoencoder's output to unscaled features
    """

    groups: tuple[DecoderGroup, ...]
    offset: FloatArray
    scale: FloatArray

    @property
    def latent_size(self) -> int:
        """D, the number of codes of all groups."""
        return sum(len(group.weights) for group in self.groups)

    def features(self, latent: npt.NDArray[Any]) -> FloatArray:
        """Decode (B, D) latent codes to (B, V, 9) float64 deformation features, unscaled.

        The batch does not change the bits of a pose.

        Raises
        ------
        ShapeError : another shape.
        """
        rows = self._checked(latent)
        features = np.empty((len(rows), *self.offset.shape))
        _fill_features(rows, *self._tables, self.offset, self.scale, features)
        return features

    @cached_property
    def _tables(self) -> _Tables:
        sizes = [-(-group.weights.shape[1] // _BLOCK) * _BLOCK for group in self.groups]
        counts = [len(group.weights) for group in self.groups]
        first = np.cumsum([0, *np.multiply(sizes, counts)])
        numbers = np.zeros(first[-1], dtype=np.float32)
        for group, start, stop in zip(self.groups, first, first[1:], strict=False):
            # A view, block after block; the last one is filled only in part.
            blocks = numbers[start:stop].reshape(-1, len(group.weights), _BLOCK)
            for number, block in enumerate(blocks):
                part = group.weights[:, number * _BLOCK : (number + 1) * _BLOCK]
                block[:, : part.shape[1]] = part
        supports = [group.support for group in self.groups]
        return _Tables(
            numbers,
            first,
            np.cumsum([0, *counts]),
            np.concatenate(supports),
            np.cumsum([0, *map(len, supports)]),
        )

    def tangents(self, latent: npt.NDArray[Any]) -> FloatArray:
        """Differentiate the features of one (D,) latent: (D, V, 9) float64 array."""
        return np.concatenate(list(self.tangent_groups(latent)))

    def tangent_groups(self, latent: npt.NDArray[Any]) -> Iterator[FloatArray]:
        """Yield the rows of `tangents` group by group, to save memory."""
        row = self._checked(np.asarray(latent)[None])[0]
        start = 0
        for group in self.groups:
            stop = start + len(group.weights)
            slope = 1.0 - np.tanh(row[start:stop] @ group.weights) ** 2
            by_code = (group.weights * slope).reshape(stop - start, -1, N_FEATURES)
            tangents = np.zeros((stop - start, *self.offset.shape))
            tangents[:, group.support] = by_code * self.scale
            yield tangents
            start = stop

    def pull_back(self, latent: npt.NDArray[Any], by_features: npt.NDArray[Any]) -> FloatArray:
        """Turn derivatives by one pose's features, (n, V, 9), into those by its codes, (n, D).

        This is the transpose of `tangents` at the (D,) latent.
        """
        codes = self._checked(np.asarray(latent)[None])[0]
        scaled = (by_features * self.scale).astype(np.float32)
        by_codes = np.zeros((len(scaled), len(codes)))
        tables = self._tables
        for number, group in enumerate(self.groups):
            first, stop = tables.first_code[number : number + 2]
            blocks = tables.numbers[slice(*tables.first_number[number : number + 2])]
            blocks = blocks.reshape(-1, len(group.weights), _BLOCK)
            # Columns of one row would be another type of array, and compiled once more.
            _pull_group(codes[first:stop], blocks, group.support, scaled, by_codes, first)
        return by_codes

    def _checked(self, latent: npt.NDArray[Any]) -> Float32Array:
        if np.ndim(latent) != 2 or np.shape(latent)[1] != self.latent_size:
            raise ShapeError.must_be(
                "latent", f"of shape (B, {self.latent_size})", np.shape(latent)
            )
        return np.array(latent, dtype=np.float32, order="C")


@inlined
def _times(a, b):  # type: ignore[no-untyped-def]
    """Multiply with separate rounding; a GPU would fuse the product with a sum."""
    return a * b


@compiled_part
def take_tanh(values: Float32Array) -> None:
    """Replace numbers by their tanh, in place.

    By its continued fraction at x / 4 and two double-angle steps: within 2e-7 of the true value
    and, unlike libm's, vectorised.
    """
    one = np.float32(1.0)
    for i in range(len(values)):
        x = np.float32(0.25) * min(max(values[i], np.float32(-12.0)), np.float32(12.0))
        s = _times(x, x)
        top = np.float32(1260.0) + _times(s, np.float32(21.0))
        top = _times(x, np.float32(10395.0) + _times(s, top))
        bottom = np.float32(4725.0) + _times(s, np.float32(210.0) + s)
        t = top / (np.float32(10395.0) + _times(s, bottom))
        t = (t + t) / (one + _times(t, t))
        values[i] = (t + t) / (one + _times(t, t))


@compiled
def _fill_features(
    latent: Float32Array,
    numbers: Float32Array,
    first_number: npt.NDArray[np.int64],
    first_code: npt.NDArray[np.int64],
    support: IntArray,
    first_support: npt.NDArray[np.int64],
    offset: FloatArray,
    scale: FloatArray,
    features: FloatArray,
) -> None:
    """Write offset + scale * tanh(codes @ weights) of all groups as the (B, V, 9) features.

    Parameters
    ----------
    latent : (B, D) codes of all groups
    numbers to first_support : see `_Tables`
    offset, scale : see `FeatureDecoder`
    """
    total = np.empty(_BLOCK, dtype=np.float32)
    for pose in range(len(latent)):
        for v in range(len(offset)):
            for j in range(9):
                features[pose, v, j] = offset[v, j]
    for group in range(len(first_code) - 1):
        start, stop = first_code[group], first_code[group + 1]
        at = first_number[group]
        for first in range(first_support[group], first_support[group + 1], _BLOCK // 9):
            last = min(first + _BLOCK // 9, first_support[group + 1])
            for pose in range(len(latent)):
                row = numbers[at : at + _BLOCK]
                for i in range(_BLOCK):
                    total[i] = latent[pose, start] * row[i]
                for k in range(1, stop - start):
                    # To the compiler, a sum as an index may be negative, which prevents
                    # vectorisation.
                    code, row = latent[pose, start + k], numbers[at + k * _BLOCK :]
                    for i in range(_BLOCK):
                        total[i] += code * row[i]
                take_tanh(total)
                for n in range(last - first):
                    out = features[pose, support[first + n]]
                    for j in range(9):
                        out[j] += scale[j] * total[9 * n + j]
            at += (stop - start) * _BLOCK


@compiled_sums
def _pull_group(
    codes: npt.NDArray[np.float32],
    blocks: npt.NDArray[np.float32],
    support: npt.NDArray[np.int32],
    by_output: npt.NDArray[np.float32],
    by_codes: FloatArray,
    first_code: int,
) -> None:
    """Add the derivative by one group's codes, given that by its scaled output.

    Parameters
    ----------
    codes : (m,) float32 array
    blocks : (n_blocks, m, `_BLOCK`) of `_Tables`
    support : of a `DecoderGroup`
    by_output : (n, V, 9) float32 array
    by_codes : (n, D) float64 array, added to from column `first_code`
    """
    width = blocks.shape[2]
    slope = np.empty(width, dtype=np.float32)
    weighted = np.empty(width, dtype=np.float32)
    for block in range(len(blocks)):
        slope[:] = np.float32(0.0)
        for k in range(len(codes)):
            weights = blocks[block, k]
            for i in range(width):
                slope[i] += codes[k] * weights[i]
        take_tanh(slope)
        for i in range(width):
            slope[i] = np.float32(1.0) - slope[i] * slope[i]
        first = block * width // 9
        n_here = min(width // 9, len(support) - first)
        for row in range(len(by_output)):
            for n in range(n_here):
                given = by_output[row, support[first + n]]
                for j in range(9):
                    weighted[9 * n + j] = given[j] * slope[9 * n + j]
            for k in range(len(codes)):
                weights = blocks[block, k]
                total = np.float32(0.0)
                for i in range(9 * n_here):
                    total += weighted[i] * weights[i]
                by_codes[row, first_code + k] += total


CENTRED_SCALE = 0.5
"""Scaled features lie in [-0.95, 0.95]; half their difference from the mean does so too, and
stays where tanh is nearly linear."""


@dataclass(frozen=True)
class AutoencoderWeights:
    """One trained autoencoder: see `stages.TiedAutoencoder`.

    Attributes
    ----------
    components : (m, n, 9) float32 array C, each code's weights at norm 1
    self_weight, ring_weight : (9, 9) float32 arrays, the graph convolution
    support : (n,) int32 array, its vertices, ascending
    """

    components: Float32Array
    self_weight: Float32Array
    ring_weight: Float32Array
    support: IntArray

    def encode(self, features: Float32Array, ring: scipy.sparse.csr_matrix) -> Float32Array:
        """Return the (B, m) codes of (B, n, 9) features; `ring` (V, V) averages over one-rings."""
        around = ring_mean(features, ring[self.support][:, self.support])
        hidden = np.tanh(features @ self.self_weight + around @ self.ring_weight)
        codes: Float32Array = (
            hidden.reshape(len(hidden), -1) @ self.components.reshape(len(self.components), -1).T
        )
        return codes

    def decoder_table(
        self, ring: scipy.sparse.csr_matrix, dtype: npt.DTypeLike = np.float32
    ) -> npt.NDArray[Any]:
        """Return the (m, 9 n) table of the decoder: decoding is tanh of the codes times it."""
        components = self.components.astype(dtype)
        around = ring_mean(components, ring[self.support][:, self.support])
        table = components @ self.self_weight.T + around @ self.ring_weight.T
        return table.reshape(len(table), -1)


def ring_average(topology: Topology) -> scipy.sparse.csr_matrix:
    """Return the (V, V) matrix that averages over each one-ring; an empty ring gives 0."""
    counts = np.maximum(np.diff(topology.adjacency.indptr), 1)
    return scipy.sparse.csr_matrix(scipy.sparse.diags(1.0 / counts) @ topology.adjacency)


def ring_mean(values: npt.NDArray[Any], ring: scipy.sparse.csr_matrix) -> npt.NDArray[Any]:
    """Average (m, n, 9) values over one-rings by the (n, n) matrix `ring`, in the values' dtype."""
    n_rows, n_vertices, width = values.shape
    columns = values.transpose(1, 0, 2).reshape(n_vertices, n_rows * width)
    product: npt.NDArray[Any] = ring.astype(values.dtype) @ columns
    return product.reshape(n_vertices, n_rows, width).transpose(1, 0, 2)


def centre_features(
    features: npt.NDArray[Any], scaling: FeatureScaling, mean_features: Float32Array
) -> Float32Array:
    """Return the autoencoders' float32 input for (B, V, 9) unscaled features."""
    return (CENTRED_SCALE * (scaling.apply(features) - mean_features)).astype(np.float32)


def build_decoder(
    autoencoders: Sequence[AutoencoderWeights],
    scaling: FeatureScaling,
    mean_features: Float32Array,
    topology: Topology,
) -> FeatureDecoder:
    """Turn each autoencoder's decoder into one table: see `AutoencoderWeights.decoder_table`.

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
            # Copy the support: a model file's arrays are read-only, and the loops would be
            # compiled for both kinds.
            DecoderGroup(
                autoencoder.decoder_table(ring, np.float64).astype(np.float32),
                autoencoder.support.copy(),
            )
            for autoencoder in autoencoders
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
    """Encode both levels: Z_0 from the features, Z_k from level 1's residual under mask k.

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
    for encoder, share in zip(level2, attention_mask, strict=True):
        masked = residual[:, encoder.support] * share[encoder.support][:, None]
        codes.append(encoder.encode(masked, ring))
    return np.concatenate(codes, axis=1)


def deviation_of(latent: npt.NDArray[Any]) -> FloatArray:
    """Return the (D,) root mean square of (N, D) codes, floored so that each code can move."""
    deviation = np.sqrt((np.asarray(latent, dtype=np.float64) ** 2).mean(axis=0))
    floored: FloatArray = np.maximum(deviation, max(1e-3 * float(deviation.max()), 1e-6))
    return floored
