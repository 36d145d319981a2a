"""A trained latent space of poses: what the model file keeps, and what decodes and encodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.features import N_FEATURES
from lcollision_core.acap.reconstruct import BLOCK_POSES
from lcollision_core.acap.scaling import FeatureScaling
from lcollision_core.embedding.autoencoders import (
    AutoencoderWeights,
    build_decoder,
    centre_features,
    deviation_of,
    run_encoders,
)
from lcollision_core.embedding.decoder import FeatureDecoder, Float32Array
from lcollision_core.embedding.fitting import LatentFit, fit_latent
from lcollision_core.embedding.latent_box import LatentBox
from lcollision_core.embedding.metrics import EmbeddingMetrics
from lcollision_core.embedding.pose_draws import PoseDraws
from lcollision_core.errors import LCollisionError, ModelFileError, ShapeError
from lcollision_core.jobs import CancelToken, for_blocks
from lcollision_core.json_values import from_json
from lcollision_core.meshes.alignment import fit_rigid
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, array_of
from lcollision_core.model_file import required_array

_LARGEST_SHARE, _LARGEST_WEIGHT = 1.01, 1e4
_LARGEST_CODE, _LARGEST_COORDINATE = 1e6, 1e6
_LEAST_LEADING, _LEAST_SIZE = 1e-6, 1e-3
"""What the arrays of a file may hold: weights of norm 1 and features within 1 of 0, the others far
beyond what training finds, and far below what overflows."""


@dataclass(frozen=True)
class Embedding:
    """The bilevel autoencoder of one body; immutable and safe to share between threads.

    A latent Z_all is (Z_0, Z_1, ..., Z_K): level 1's K codes, then each domain's. Latent 0 is the
    mean of the training poses' features.

    Attributes
    ----------
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference, in normalised lengths
    alignment_weights : (V,) float64 array, how much each vertex leads when a mesh is aligned
    scaling : of the features
    mean_features : (V, 9) float32 array, mean of the scaled training features
    level1 : its support is all vertices
    level2 : K autoencoders, on the vertices of their domains
    attention_mask : (K, V) float32 array, each column sums to 1
    training_latent : (N, D) float32 array, codes of the training poses
    box : the latent box
    metrics : what training measured, None before it has
    config : how it was trained, the values of an `EmbeddingConfig` by name; kept as they are, so
        that a model outlives the choices of the program that trained it
    seed : of the order of level 2's batches
    bridges : (n, 2) int32 array, edges between connected components: see `component_bridges`. None
        where there are none, and of models that were trained before these were kept
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
        """The features' codec, its matrix factored once."""
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
        return tuple(len(one.components) for one in (self.level1, *self.level2))

    def codes_of(self, domains: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return which codes belong to domains: (D,), true for Z_k and for Z_0's code of each.

        These are the codes that a lock of the domains holds.
        """
        chosen = np.zeros(self.n_domains, dtype=np.bool_)
        chosen[list(domains)] = True
        return chosen[self.domain_of_code]

    @cached_property
    def domain_of_code(self) -> npt.NDArray[np.intp]:
        """(D,) the domain that each code belongs to."""
        domains = np.arange(self.n_domains)
        return np.concatenate([domains, np.repeat(domains, self.group_sizes[1:])])

    @cached_property
    def draws(self) -> PoseDraws:
        """Draws poses like those that people make from the training poses."""
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
        vertices : (B, V, 3) float64 array, in normalised lengths, placed as the reference; a pose
            gets the same bits in whichever batch it comes, on however many threads

        Raises
        ------
        ShapeError : another shape.
        """
        rows = array_of(latent, "latent")
        if rows.ndim != 2 or rows.shape[1] != self.latent_size:
            raise ShapeError.must_be("latent", f"of shape (B, {self.latent_size})", rows.shape)
        vertices = np.empty((len(rows), self.topology.n_vertices, 3))

        # Both are made before threads ask for them.
        decoder, codec = self.decoder, self.codec

        def decode_block(start: int, stop: int) -> None:
            vertices[start:stop] = codec.decode(decoder.features(rows[start:stop]), n_threads=1)

        for_blocks(decode_block, len(rows), BLOCK_POSES, n_threads)
        return vertices

    def guess(self, features: npt.NDArray[Any]) -> Float32Array:
        """Run the encoders: (B, V, 9) unscaled features to a (B, D) float32 latent."""
        centred = centre_features(features, self.scaling, self.mean_features)
        return run_encoders(centred, self.level1, self.level2, self.attention_mask, self.topology)

    def encode(
        self,
        vertices: npt.NDArray[Any],
        cancel: CancelToken | None = None,
        *,
        in_place: bool = False,
    ) -> LatentFit:
        """Find the latent codes of a mesh in any rigid position.

        The encoders guess from the features of the aligned mesh; a few Gauss-Newton steps on the
        vertex error then settle code and rigid motion together.

        Parameters
        ----------
        vertices : (V, 3) finite array, in normalised lengths
        cancel : polled before each step
        in_place : the mesh lies as the reference does and stays there: the codes take up how it is
            turned against the training poses, as far as they can

        Returns
        -------
        fit : LatentFit

        Raises
        ------
        ShapeError : another shape.
        CancelledError : `cancel` was set.
        """
        vertices = self.topology.gathered(np.asarray(vertices, np.float64))
        aligned = vertices
        if not in_place:
            weights = np.zeros(self.topology.n_vertices)
            weights[self.topology.picked] = self.alignment_weights[self.topology.picked]
            rotation, translation = fit_rigid(vertices, self.rest_vertices, weights)
            aligned = vertices @ rotation.T + translation
        guess = self.guess(self.codec.encode(aligned[None]))[0]
        return fit_latent(
            self.decoder,
            self.codec,
            vertices,
            guess,
            self.latent_deviation,
            cancel,
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
        for domain, one in enumerate((self.level1, *self.level2), start=-1):
            name = "level1" if domain < 0 else f"level2_{domain}"
            arrays[f"{name}_components"] = one.components
            arrays[f"{name}_self_weight"] = one.self_weight
            arrays[f"{name}_ring_weight"] = one.ring_weight
            if domain >= 0:
                arrays[f"{name}_support"] = one.support
                arrays[f"{name}_mask"] = self.attention_mask[domain, one.support]
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
        """Rebuild an embedding from what `to_arrays` returned.

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
        # Sizes are the arrays' own: nothing is made of a size that is only announced.
        need = partial(required_array, arrays)
        rest = need("rest_vertices", np.float64, (None, 3), _LARGEST_COORDINATE)
        n_vertices, n_domains = len(rest), values.n_domains
        if values.n_vertices != n_vertices:
            raise ValueError(f"it announces {values.n_vertices} vertices, but has {n_vertices}")
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
                f"it announces {n_domains} domains, but its level 1 has {len(level1.components)}"
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
        latent_size = n_domains + sum(len(one.components) for one in level2)
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
    """The JSON values beside an embedding's arrays."""

    n_vertices: int
    n_domains: int
    scaling: FeatureScaling
    metrics: EmbeddingMetrics | None
    config: Mapping[str, Any]
    seed: int


def _require_size(rest: FloatArray, topology: Topology) -> None:
    """Refuse a reference that is not in normalised lengths, as far as its faces tell."""
    used = rest[topology.faces.reshape(-1)]
    size = float(np.ptp(used, axis=0).max())
    # A vertex in no face counted once, and may have made the others smaller.
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
