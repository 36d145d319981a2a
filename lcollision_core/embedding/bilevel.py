"""The embedding: two levels of autoencoders, codes fitted to poses, the latent box, metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import Annotated, Any, Protocol

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import Meta

from lcollision_core.acap.codec import BLOCK_POSES, AcapCodec
from lcollision_core.acap.features import N_FEATURES, FeatureScaling
from lcollision_core.embedding.decoder import (
    AutoencoderWeights,
    FeatureDecoder,
    Float32Array,
    build_decoder,
    centre_features,
    deviation_of,
    run_encoders,
)
from lcollision_core.embedding.seeding import principal_components
from lcollision_core.errors import LCollisionError, ModelFileError, ShapeError
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.json_values import from_json
from lcollision_core.meshes.alignment import fit_rigid
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, latent_array
from lcollision_core.model_file import required_array

MAX_STEPS = 20
"""Most Jacobians computed; the fit ends earlier when a step with a new one gains under 2 %."""

PRIOR_SHARE = 2.5e-3
"""Cost of a code at one training deviation, relative to the current mean squared vertex distance.
It determines codes that the vertices do not, and vanishes for a mesh that the decoder can
represent, whose codes are thus recovered."""

_SETTLED = 0.02
_WORTH_REUSE = 0.1
"""Share of the cost that a step must gain for another with the same Jacobian, as decoding costs far
less than a Jacobian."""
_HALVINGS = 5


class Decoder(Protocol):
    """Decode latent codes to unscaled features, with derivatives: see `FeatureDecoder`."""

    @property
    def latent_size(self) -> int:
        """D, the number of codes."""

    def features(self, latent: npt.NDArray[Any]) -> FloatArray:
        """Decode (B, D) codes to (B, V, 9) features."""

    def tangent_groups(self, latent: npt.NDArray[Any]) -> Iterator[FloatArray]:
        """Yield derivatives at (D,) codes, arrays of (m, V, 9) with D rows in all."""


@dataclass(frozen=True)
class LatentFit:
    """A code fitted to a mesh.

    Attributes
    ----------
    latent : (D,) array
    rotation, translation : (3, 3) and (3,) float64 arrays, in normalised lengths:
        `vertices @ rotation.T + translation` is the aligned mesh, nearest to the decoded one
    mean_error, max_error : distance of the decoded vertices from the aligned ones, in normalised
        lengths
    """

    latent: npt.NDArray[np.floating]
    rotation: FloatArray
    translation: FloatArray
    mean_error: float
    max_error: float


@dataclass(frozen=True)
class _Candidate:
    latent: npt.NDArray[np.float32]
    rotation: FloatArray
    translation: FloatArray
    decoded: FloatArray
    residual: FloatArray
    misfit: float

    def cost(self, stiffness: FloatArray) -> float:
        return self.misfit + float((stiffness * self.latent.astype(np.float64) ** 2).sum())


def fit_latent(
    decoder: Decoder,
    codec: AcapCodec,
    vertices: npt.NDArray[Any],
    guess: npt.NDArray[Any],
    deviation: npt.NDArray[Any],
    job: Job = UNWATCHED,
    *,
    in_place: bool = False,
    n_threads: int | None = None,
) -> LatentFit:
    """Fit codes and a rigid motion to a mesh together.

    Minimise the mean squared vertex distance over all rigid motions of the mesh by damped
    Gauss-Newton from a guess, with several steps per Jacobian. Each step that starts from a squared
    distance d² adds the prior `PRIOR_SHARE` d² Σ (z / deviation)².

    Parameters
    ----------
    decoder : latent codes to features
    codec : features to vertices
    vertices : (V, 3) array, in normalised lengths, in any rigid position; only vertices that a face
        uses count
    guess : (D,) array, initial codes
    deviation : (D,) array > 0, of the training codes
    job : polled before each Jacobian
    in_place : whether the mesh stays in place and only the codes are fitted
    n_threads : threads to compute a Jacobian on, one for each core by default

    Returns
    -------
    fit : LatentFit

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    inverse_variance = np.asarray(deviation, dtype=np.float64) ** -2.0
    picked = codec.topology.used_index
    target = np.asarray(vertices, dtype=np.float64)[picked]
    n_vertices, n_codes = len(target), len(inverse_variance)

    def at(latent: npt.NDArray[Any]) -> _Candidate:
        code = latent.astype(np.float32)
        decoded = codec.decode(decoder.features(code[None]), n_threads=1)[0, picked]
        rotation, translation = np.eye(3), np.zeros(3)
        if not in_place:
            rotation, translation = fit_rigid(target, decoded)
        residual = decoded - (target @ rotation.T + translation)
        misfit = float((residual**2).sum() / n_vertices)
        return _Candidate(code, rotation, translation, decoded, residual, misfit)

    def jacobian_at(candidate: _Candidate) -> FloatArray:
        features = decoder.features(candidate.latent[None])[0]
        jacobian = np.empty((n_codes + (0 if in_place else 6), n_vertices, 3))
        start = 0
        for tangents in decoder.tangent_groups(candidate.latent):
            moved = codec.decode_jvp(features, tangents, n_threads)
            jacobian[start : start + len(moved)] = moved[:, picked]
            start += len(moved)
        if not in_place:
            # The mesh may turn and shift with the pose, so only changes that no small rigid motion
            # could undo count.
            jacobian[n_codes : n_codes + 3] = np.eye(3)[:, None]
            centred = candidate.decoded - candidate.decoded.mean(axis=0)
            jacobian[n_codes + 3 :] = np.cross(np.eye(3)[:, None], centred)
        return jacobian.reshape(len(jacobian), -1)

    best = at(np.asarray(guess))
    for _ in range(MAX_STEPS):
        job.check()
        jacobian = jacobian_at(best)
        gram = jacobian @ jacobian.T / n_vertices
        gains: list[float] = []
        while not gains or gains[-1] > _WORTH_REUSE:
            stiffness = PRIOR_SHARE * best.misfit * inverse_variance
            slope = jacobian @ best.residual.ravel() / n_vertices
            slope[:n_codes] += stiffness * best.latent
            normal = gram.copy()
            normal[np.arange(n_codes), np.arange(n_codes)] += stiffness
            # A mesh on a line does not determine one rotation.
            normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal)
            step = np.linalg.solve(normal, slope)[:n_codes]
            halved = (at(best.latent - 0.5**power * step) for power in range(_HALVINGS))
            start_cost = best.cost(stiffness)
            better = next(
                (shorter for shorter in halved if shorter.cost(stiffness) < start_cost), None
            )
            if better is None:
                gains.append(0.0)
            else:
                gains.append(1.0 - better.cost(stiffness) / start_cost)
                best = better
        if gains[0] < _SETTLED:
            break
    distances = np.linalg.norm(best.residual, axis=1)
    mean_error, max_error = float(distances.mean()), float(distances.max())
    return LatentFit(best.latent, best.rotation, best.translation, mean_error, max_error)


Uniform = Callable[[tuple[int, int]], FloatArray]
"""Return an array of the given shape with numbers in [0, 1)."""

_BLENDED = 3
"""Number of known poses in a blend."""

_NOISE = 0.1
"""Largest standard deviation of the noise added to a blend, as a share of the box."""


@dataclass(frozen=True, eq=False)
class PoseDraws:
    """Draw latent poses from N known ones, with the caller's random numbers.

    Attributes
    ----------
    known : (N, D) float64 array, N > 0
    part_of_code : (D,) integers, the body part that each code belongs to
    low, high : (D,) float64 arrays, the latent box
    """

    known: FloatArray
    part_of_code: npt.NDArray[np.intp]
    low: FloatArray
    high: FloatArray

    def blends(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Blend three known poses each, with weights uniform on the simplex: (n_poses, D)."""
        pose_numbers = self._chosen(uniform((n_poses, _BLENDED)))
        weights = -np.log1p(-uniform((n_poses, _BLENDED)))
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        blended: FloatArray = np.einsum("ni,nid->nd", weights, self.known[pose_numbers])
        return blended

    def noisy_blends(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Blend known poses and add normal noise of a random size: (n_poses, D), in the box."""
        blended = self.blends(n_poses, uniform)
        # Take the middle of one of 2**53 intervals: a 0 would become minus infinity.
        noise = scipy.special.ndtri(uniform(blended.shape) + 2.0**-54)
        size = _NOISE * uniform((n_poses, 1)) * (self.high - self.low)
        noisy: FloatArray = np.clip(blended + size * noise, self.low, self.high)
        return noisy

    def mixed_parts(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Take each body part from another known pose: (n_poses, D)."""
        n_parts = int(self.part_of_code.max()) + 1
        pose_numbers = self._chosen(uniform((n_poses, n_parts)))
        return self.known[pose_numbers[:, self.part_of_code], np.arange(len(self.low))]

    def between(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Draw poses on motions through four known poses each: (n_poses, D), in the box.

        Each lies between the second and the third on a Catmull-Rom spline.
        """
        before, start, end, after = self.known[self._chosen(uniform((n_poses, 4)))].swapaxes(0, 1)
        t = uniform((n_poses, 1))
        bent = (2 * before - 5 * start + 4 * end - after) * t**2
        bent += (3 * (start - end) - before + after) * t**3
        moment: FloatArray = np.clip(start + 0.5 * ((end - before) * t + bent), self.low, self.high)
        return moment

    def _chosen(self, uniform: FloatArray) -> npt.NDArray[np.intp]:
        return (uniform * len(self.known)).astype(np.intp)


BOX_SCALE = 1.2
"""A new model's box is this multiple of its training codes' range (Tan et al. 2021)."""

_LEAST_RANGE = 1e-6
"""Least bound of a code, so that the range of one that no training pose uses straddles 0."""
_LARGEST_BOUND = 1e7
"""Far beyond any training code, far below overflow."""

BOX_ARRAYS = frozenset({"box_low", "box_high"})

ROWS_PER_BLOCK = 32
"""Rows that one thread draws, decodes and labels at a time."""


@dataclass(frozen=True, eq=False)
class LatentBox:
    """The box of a model's poses, for labelling, Resolve and the range of sliders.

    Attributes
    ----------
    low, high : (D,) float64 arrays, below 0 and above 0
    """

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]

    @classmethod
    def around(cls, training_latent: npt.NDArray[np.float32]) -> LatentBox:
        """Return the box of a new model: `BOX_SCALE` times the range of its (N, D) codes."""
        low = np.minimum(training_latent.min(axis=0), -_LEAST_RANGE).astype(np.float64)
        high = np.maximum(training_latent.max(axis=0), _LEAST_RANGE).astype(np.float64)
        return cls(BOX_SCALE * low, BOX_SCALE * high)

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, npt.NDArray[Any]], training_latent: npt.NDArray[np.float32]
    ) -> LatentBox:
        """Rebuild a box from the arrays of `to_arrays`, or from the codes if a model has none.

        Raises
        ------
        ValueError : an end is missing, of another type or shape, or on the wrong side of 0.
        """
        if not BOX_ARRAYS & arrays.keys():
            return cls.around(training_latent)
        shape = training_latent.shape[1:]
        low = required_array(arrays, "box_low", np.float64, shape, _LARGEST_BOUND)
        high = required_array(arrays, "box_high", np.float64, shape, _LARGEST_BOUND)
        if low.max() > -_LEAST_RANGE or high.min() < _LEAST_RANGE:
            raise ValueError("its arrays box_low and box_high must lie below 0 and above 0")
        return cls(low, high)

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of a model file, for `from_arrays`."""
        return {"box_low": self.low, "box_high": self.high}

    def draw(self, seed: int, block: int) -> npt.NDArray[np.float32]:
        """Draw one block of the endless sequence of samples.

        Row i of the sequence is row i % `ROWS_PER_BLOCK` of block i // `ROWS_PER_BLOCK`, in
        whatever order blocks are drawn.

        Parameters
        ----------
        seed : >= 0, of the sequence
        block : >= 0

        Returns
        -------
        latent : (ROWS_PER_BLOCK, D) float32 array, in the box up to rounding
        """
        uniform = numbers_of(seed, block)((ROWS_PER_BLOCK, len(self.low)))
        latent: npt.NDArray[np.float32] = (self.low + (self.high - self.low) * uniform).astype(
            np.float32
        )
        return latent


def numbers_of(*key: int) -> Uniform:
    """Return the endless sequence of numbers in [0, 1) of a key of integers >= 0."""
    # NumPy promises to keep seeding and raw bits, but not the output of `Generator`: a store must
    # continue with the same rows after an update.
    bits = np.random.Philox(np.random.SeedSequence(key))

    def uniform(shape: tuple[int, int]) -> npt.NDArray[np.float64]:
        numbers = bits.random_raw(shape) >> np.uint64(11)
        return numbers.astype(np.float64) * 2.0**-53

    return uniform


_Figure = Annotated[float, Meta(ge=0.0, le=1e9)]


@dataclass(frozen=True)
class EmbeddingMetrics:
    """Errors of training, in normalised lengths, with codes fitted as by `Embedding.encode`.

    Attributes
    ----------
    level1_mean : vertex error of the training poses with level 1 alone, with the encoder's codes
    guess_mean, guess_max : with both levels, with the encoders' codes
    mean, max : with both levels, with fitted codes
    held_out_mean, held_out_max : of poses that a second model was trained without, with fitted
        codes; None if none was trained, like the next two
    pca_held_out_mean : the same for plain principal components of the same training poses'
        features, as many as the latent has codes or the poses span
    pca_size : number of these components
    acap_mean, acap_max : of encoding poses as features and decoding them, without any code
    connected_share : least fraction of a domain's vertices in its largest connected patch
    domains_per_vertex : mean effective number of domains of a vertex, 1 / Σ_k (M^{ki})²

    Raises
    ------
    ValueError : only some of the held-out errors are None.
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
    """Return the distances of decoded vertices from given ones, after the best rigid alignment.

    Parameters
    ----------
    decoded, vertices : (B, V, 3) arrays, in one unit

    Returns
    -------
    distances : (B, V) float64 array, in the same unit
    """
    distances = np.empty(decoded.shape[:2])
    for pose, target in enumerate(decoded):
        rotation, translation = fit_rigid(vertices[pose], target)
        aligned = np.asarray(vertices[pose], dtype=np.float64) @ rotation.T + translation
        distances[pose] = np.linalg.norm(aligned - target, axis=1)
    return distances


@dataclass(frozen=True)
class LinearDecoder:
    """Plain principal components of features, as a `Decoder`.

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
        """Yield the (m, V, 9) derivatives, which are constant."""
        yield self.basis


def feature_pca(
    features: FloatArray, n_numbers: int
) -> tuple[LinearDecoder, FloatArray, FloatArray]:
    """Fit plain principal components to features, scaled as for the autoencoders.

    Parameters
    ----------
    features : (N, V, 9) float64 array, unscaled
    n_numbers : components wanted; N poses have at most N - 1

    Returns
    -------
    decoder : the components
    projection : (V, 9, m) float64 array; codes are (features - offset) times it
    deviation : (m,) float64 array, root mean square of the training codes, > 0
    """
    scale = FeatureScaling.fit(features).scale
    offset = features.mean(axis=0)
    rows = ((features - offset) * scale).reshape(len(features), -1)
    basis = principal_components(rows, max(1, min(n_numbers, len(features) - 1)))
    shaped = basis.reshape(len(basis), *offset.shape)
    projection = np.moveaxis(shaped * scale, 0, -1)
    return LinearDecoder(shaped / scale, offset), projection, deviation_of(rows @ basis.T)


_LARGEST_SHARE, _LARGEST_WEIGHT = 1.01, 1e4
_LARGEST_CODE, _LARGEST_COORDINATE = 1e6, 1e6
_LEAST_LEADING, _LEAST_SIZE = 1e-6, 1e-3
"""Bounds on the arrays of a file: weights of norm 1 and features in [-1, 1]; the other bounds lie
far beyond trained values and far below overflow."""


@dataclass(frozen=True)
class Embedding:
    """The bilevel autoencoder of one body; immutable and safe to share between threads.

    A latent Z_all is (Z_0, Z_1, ..., Z_K): level 1's K codes, then each domain's. Latent 0 is the
    mean of the training poses' features.

    Attributes
    ----------
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference, in normalised lengths
    alignment_weights : (V,) float64 array, weight of each vertex when a mesh is aligned
    scaling : of the features
    mean_features : (V, 9) float32 array, mean of the scaled training features
    level1 : the autoencoder of all vertices
    level2 : K autoencoders, on the vertices of their domains
    attention_mask : (K, V) float32 array, each column sums to 1
    training_latent : (N, D) float32 array, codes of the training poses
    box : the latent box
    metrics : measured after training, None before
    config : how it was trained, the values of an `EmbeddingConfig` by name; a plain mapping, so
        that a model outlives changes of that class
    seed : of the order of level 2's batches
    bridges : (n, 2) int32 array, edges between connected components: see `component_bridges`. None
        if there are none, and for models trained before they were stored
    """

    topology: Topology
    rest_vertices: FloatArray
    alignment_weights: FloatArray
    scaling: FeatureScaling
    mean_features: Float32Array
    level1: AutoencoderWeights
    level2: tuple[AutoencoderWeights, ...]
    attention_mask: Float32Array
    training_latent: Float32Array
    box: LatentBox
    metrics: EmbeddingMetrics | None
    config: Mapping[str, Any]
    seed: int
    bridges: IntArray | None = None

    @cached_property
    def codec(self) -> AcapCodec:
        """The features' codec, with its matrix factored once."""
        return AcapCodec(self.topology, self.rest_vertices, self.alignment_weights, self.bridges)

    @cached_property
    def decoder(self) -> FeatureDecoder:
        """The decoders of both levels as tables."""
        return build_decoder(
            (self.level1, *self.level2), self.scaling, self.mean_features, self.topology
        )

    @property
    def n_domains(self) -> int:
        """K = |Z_0|."""
        return len(self.level2)

    @property
    def group_sizes(self) -> tuple[int, ...]:
        """(|Z_0|, |Z_1|, ..., |Z_K|)."""
        return tuple(len(level.components) for level in (self.level1, *self.level2))

    def codes_of(self, domains: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return (D,) whether each code belongs to the domains: all of Z_k, and its code of Z_0.

        A lock of the domains holds these codes.
        """
        is_wanted = np.zeros(self.n_domains, dtype=np.bool_)
        is_wanted[list(domains)] = True
        return is_wanted[self.domain_of_code]

    @cached_property
    def domain_of_code(self) -> npt.NDArray[np.intp]:
        """(D,) the domain that each code belongs to."""
        domains = np.arange(self.n_domains)
        return np.concatenate([domains, np.repeat(domains, self.group_sizes[1:])])

    @cached_property
    def draws(self) -> PoseDraws:
        """Draws of poses like those that people make from the training poses."""
        return PoseDraws(
            self.training_latent.astype(np.float64),
            self.domain_of_code,
            self.box.low,
            self.box.high,
        )

    @property
    def latent_size(self) -> int:
        """D = |Z_all|."""
        return sum(self.group_sizes)

    @cached_property
    def latent_deviation(self) -> FloatArray:
        """(D,) root mean square of the training poses' codes, > 0."""
        return deviation_of(self.training_latent)

    def decode(self, latent: npt.NDArray[Any], n_threads: int | None = None) -> FloatArray:
        """Decode latent codes to meshes.

        Parameters
        ----------
        latent : (B, D) array
        n_threads : threads to spread the poses over, one for each core by default

        Returns
        -------
        vertices : (B, V, 3) float64 array, in normalised lengths, placed as the reference; neither
            batch nor threads change the bits of a pose

        Raises
        ------
        ShapeError : another shape.
        """
        rows = latent_array(latent)
        if rows.ndim != 2 or rows.shape[1] != self.latent_size:
            raise ShapeError.must_be("latent", f"of shape (B, {self.latent_size})", rows.shape)
        vertices = np.empty((len(rows), self.topology.n_vertices, 3))

        # Compute the cached properties before threads use them.
        decoder, codec = self.decoder, self.codec

        def decode_block(start: int, stop: int) -> None:
            vertices[start:stop] = codec.decode(decoder.features(rows[start:stop]), n_threads=1)

        for_blocks(decode_block, len(rows), BLOCK_POSES, n_threads)
        return vertices

    def guess(self, features: npt.NDArray[Any]) -> Float32Array:
        """Run the encoders on (B, V, 9) unscaled features; return a (B, D) float32 latent."""
        centred = centre_features(features, self.scaling, self.mean_features)
        return run_encoders(centred, self.level1, self.level2, self.attention_mask, self.topology)

    def encode(
        self,
        vertices: npt.NDArray[Any],
        job: Job = UNWATCHED,
        *,
        in_place: bool = False,
    ) -> LatentFit:
        """Find the latent codes of a mesh in any rigid position.

        The encoders guess from the features of the aligned mesh; a few Gauss-Newton steps on the
        vertex error then fit the codes and the rigid motion together.

        Parameters
        ----------
        vertices : (V, 3) finite array, in normalised lengths
        job : polled before each step
        in_place : whether the mesh is placed like the reference and stays there; the codes then
            absorb its rotation relative to the training poses, as far as they can

        Returns
        -------
        fit : LatentFit

        Raises
        ------
        ShapeError : another shape.
        CancelledError : the job was cancelled.
        """
        vertices = self.topology.gathered(np.asarray(vertices, np.float64))
        aligned = vertices
        if not in_place:
            weights = np.zeros(self.topology.n_vertices)
            weights[self.topology.used_index] = self.alignment_weights[self.topology.used_index]
            rotation, translation = fit_rigid(vertices, self.rest_vertices, weights)
            aligned = vertices @ rotation.T + translation
        guess = self.guess(self.codec.encode(aligned[None]))[0]
        return fit_latent(
            self.decoder,
            self.codec,
            vertices,
            guess,
            self.latent_deviation,
            job,
            in_place=in_place,
        )

    def to_arrays(self) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
        """Return arrays and JSON metadata, for `from_arrays`."""
        arrays: dict[str, npt.NDArray[Any]] = {
            "faces": self.topology.faces,
            "rest_vertices": self.rest_vertices,
            "alignment_weights": self.alignment_weights,
            "mean_features": self.mean_features,
            "training_latent": self.training_latent,
            **self.box.to_arrays(),
        }
        if self.bridges is not None:
            arrays["bridges"] = self.bridges
        for domain, level in enumerate((self.level1, *self.level2), start=-1):
            name = "level1" if domain < 0 else f"level2_{domain}"
            arrays[f"{name}_components"] = level.components
            arrays[f"{name}_self_weight"] = level.self_weight
            arrays[f"{name}_ring_weight"] = level.ring_weight
            if domain >= 0:
                arrays[f"{name}_support"] = level.support
                arrays[f"{name}_mask"] = self.attention_mask[domain, level.support]
        metadata = {
            "n_vertices": self.topology.n_vertices,
            "n_domains": self.n_domains,
            "scaling": asdict(self.scaling),
            "metrics": None if self.metrics is None else asdict(self.metrics),
            "config": dict(self.config),
            "seed": self.seed,
        }
        return arrays, metadata

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, npt.NDArray[Any]], metadata: Mapping[str, Any]
    ) -> Embedding:
        """Rebuild an embedding from the arrays and metadata of `to_arrays`.

        Raises
        ------
        ModelFileError : something is missing, or the arrays do not fit together.
        """
        try:
            return cls._read(arrays, from_json(_Values, metadata, "embedding"))
        except (LCollisionError, ValueError) as error:
            advice = "train or copy the model again"
            raise ModelFileError.because(
                "the model's embedding", "does not fit together", error, advice
            ) from error

    @classmethod
    def _read(cls, arrays: Mapping[str, npt.NDArray[Any]], values: _Values) -> Embedding:
        # Take sizes from the arrays: nothing is allocated by a size that is only announced.
        need = partial(required_array, arrays)
        rest = need("rest_vertices", np.float64, (None, 3), _LARGEST_COORDINATE)
        n_vertices, n_domains = len(rest), values.n_domains
        if values.n_vertices != n_vertices:
            raise ValueError(f"it declares {values.n_vertices} vertices but contains {n_vertices}")
        topology = Topology(need("faces", np.int32, (None, 3)), n_vertices)
        _require_size(rest, topology)
        leading = need("alignment_weights", np.float64, (n_vertices,), _LARGEST_WEIGHT)
        if leading.min() < 0.0 or leading.max() < _LEAST_LEADING:
            raise ValueError("its alignment_weights must be at least 0, and one of them more")
        shape = (n_vertices, N_FEATURES)
        mean_features = need("mean_features", np.float32, shape, _LARGEST_SHARE)
        level1 = _read_autoencoder(arrays, "level1", np.arange(n_vertices, dtype=np.int32))
        if len(level1.components) != n_domains:
            raise ValueError(
                f"it declares {n_domains} domains, but its level 1 has {len(level1.components)}"
            )
        level2, mask = [], np.zeros((n_domains, n_vertices), dtype=np.float32)
        for domain in range(n_domains):
            name = f"level2_{domain}"
            support = need(f"{name}_support", np.int32, (None,))
            if not 0 <= support[0] <= support[-1] < n_vertices or (np.diff(support) <= 0).any():
                raise ValueError(
                    f"its array {name}_support is not an ascending list of its {n_vertices} "
                    "vertices"
                )
            level2.append(_read_autoencoder(arrays, name, support))
            share = need(f"{name}_mask", np.float32, support.shape)
            if share.min() < 0.0:
                raise ValueError(f"its array {name}_mask has a share below 0")
            mask[domain, support] = share
        if np.abs(mask.sum(axis=0) - 1.0).max() > 1e-5:
            raise ValueError("its attention masks do not sum to 1")
        latent_size = n_domains + sum(len(autoencoder.components) for autoencoder in level2)
        latent = need("training_latent", np.float32, (None, latent_size), _LARGEST_CODE)
        bridges = None
        if "bridges" in arrays:
            bridges = need("bridges", np.int32, (None, 2))
            named = 0 <= bridges.min() <= bridges.max() < n_vertices
            if not named or (bridges[:, 0] == bridges[:, 1]).any():
                raise ValueError(f"its array bridges must join pairs of its {n_vertices} vertices")
        return cls(
            topology=topology,
            rest_vertices=rest,
            alignment_weights=leading,
            scaling=values.scaling,
            mean_features=mean_features,
            level1=level1,
            level2=tuple(level2),
            attention_mask=mask,
            training_latent=latent,
            box=LatentBox.from_arrays(arrays, latent),
            metrics=values.metrics,
            config=dict(values.config),
            seed=values.seed,
            bridges=bridges,
        )


@dataclass(frozen=True)
class _Values:
    """The JSON metadata of an embedding."""

    n_vertices: int
    n_domains: int
    scaling: FeatureScaling
    metrics: EmbeddingMetrics | None
    config: Mapping[str, Any]
    seed: int


def _require_size(rest: FloatArray, topology: Topology) -> None:
    """Raise `ValueError` if the faces' vertices show that a reference is not normalised."""
    used = rest[topology.faces.reshape(-1)]
    size = float(np.ptp(used, axis=0).max())
    # Vertices in no face once counted, and may have made the others smaller.
    if not _LEAST_SIZE <= size <= 1.0 + _LEAST_SIZE:
        raise ValueError(f"its array rest_vertices must have a body size of 1, got {size:.6g}")


def _read_autoencoder(
    arrays: Mapping[str, npt.NDArray[Any]], name: str, support: npt.NDArray[np.int32]
) -> AutoencoderWeights:
    need = partial(required_array, arrays)
    shape, square = (None, len(support), N_FEATURES), (N_FEATURES, N_FEATURES)
    return AutoencoderWeights(
        components=need(f"{name}_components", np.float32, shape, _LARGEST_SHARE),
        self_weight=need(f"{name}_self_weight", np.float32, square, _LARGEST_WEIGHT),
        ring_weight=need(f"{name}_ring_weight", np.float32, square, _LARGEST_WEIGHT),
        support=support,
    )
