"""The space in which a body is posed: codes, limits, body parts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Set
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.meshes.limbs import Limbs, far_apart
from lcollision_core.meshes.topology import FloatArray, Topology, length_graph

_STIFFENING = 1e-3
"""Added to the diagonal, relative to its mean, so that codes that move no vertex have a cost."""


@dataclass(frozen=True, eq=False)
class DisplacementMetrics:
    """The mean squared vertex displacement by a small change of D codes, part by part.

    Attributes
    ----------
    size : D
    codes : for each of K parts, the (n,) codes that move its vertices
    blocks : for each part, an (n, n) float64 array J_k^T J_k / V, where J_k is the Jacobian of its
        vertices by these codes; V counts the vertices of all parts
    """

    size: int
    codes: Sequence[npt.NDArray[np.intp]]
    blocks: Sequence[FloatArray]

    def squared(self, moved: FloatArray) -> FloatArray:
        """Return the (K,) contributions of the parts to the mean squared displacement."""
        return np.array(
            [
                moved[codes] @ block @ moved[codes]
                for codes, block in zip(self.codes, self.blocks, strict=True)
            ]
        )

    def weighted(self, weights: FloatArray) -> FloatArray:
        """Return the (D, D) sum of the parts' metrics with (K,) weights."""
        total = np.zeros((self.size, self.size))
        for weight, codes, block in zip(weights, self.codes, self.blocks, strict=True):
            if len(codes) == self.size:
                total += weight * block
            else:
                total[codes[:, None], codes] += weight * block
        return total

    @cached_property
    def definite(self) -> FloatArray:
        """The (D, D) sum of all metrics, made positive definite by a small diagonal term."""
        total = self.weighted(np.ones(len(self.blocks)))
        total[np.diag_indices_from(total)] += _STIFFENING * np.trace(total) / len(total)
        return total


MeanSlopes = Callable[[FloatArray, FloatArray], FloatArray]
"""Take (D,) codes and (n, V, 3) derivatives by vertices; return (3 m + n, D) derivatives by the
codes: see `PoseSpace.mean_slopes`."""

_HOLD, _MOVED = 0.1, 0.02
"""Price of the mean squared displacement of a body part since a drag began, and the normalised root
mean square displacement at which the price is half."""

_RELUCTANT = 10.0
"""Factor of that price for body parts outside the limb that is held."""

_JACOBIAN_POSES = 8
_REMEMBERED_POSES = 8
"""Poses whose features and vertices are cached: drags and Resolve return to them."""

_LEAST_VARIANCE = 0.02
"""Least variance, as a share of the training codes' mean variance: few poses leave most directions
without any."""


class PosesOnGpu(Protocol):
    """A decoder of codes on a GPU, for at most `at_once` poses at a time."""

    at_once: int

    def decode(self, codes: npt.NDArray[Any]) -> Any:
        """Decode (B, D) codes to (B, V, 3) float32 vertices on the GPU, in the data's unit."""


class PoseSpace(Protocol):
    """Poses of one mesh as vectors of D codes, which belong to K body parts.

    Lengths are normalised, and vertices are in model coordinates. Threads may share a space.
    """

    @property
    def topology(self) -> Topology:
        """The connectivity of all poses."""

    @property
    def rest_vertices(self) -> FloatArray:
        """(V, 3) float64 array, the reference."""

    @property
    def low(self) -> FloatArray:
        """(D,) float64 array, the lower bounds of the codes."""

    @property
    def high(self) -> FloatArray:
        """(D,) float64 array, the upper bounds."""

    @property
    def group_sizes(self) -> tuple[int, ...]:
        """Number of codes of each group; the codes are the groups in turn, then the shapes."""

    @property
    def n_shapes(self) -> int:
        """S, the number of shape codes, which come last; solvers leave them as posed."""

    @property
    def n_domains(self) -> int:
        """K, the number of body parts."""

    @property
    def vertex_domain(self) -> npt.NDArray[np.intp]:
        """(V,) the leading body part of each vertex, from 0."""

    @property
    def metric(self) -> FloatArray:
        """(D, D) symmetric positive definite G.

        (Z - Z')^T G (Z - Z') is, to first order, the mean squared vertex displacement.
        """

    @property
    def domain_metrics(self) -> DisplacementMetrics:
        """Contributions to the metric of the vertices that each of the K body parts leads."""

    @property
    def precision(self) -> FloatArray:
        """(D, D) symmetric positive definite P: Z^T P Z is D for a typical move between poses."""

    @property
    def longest_edges(self) -> FloatArray:
        """(E,) float64 array, the longest length of each edge in plausible poses."""

    @property
    def surface_graph(self) -> scipy.sparse.csr_matrix:
        """(V, V) lengths of the edges on the reference, for distances along the surface."""

    def codes_of(self, domains: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return (D,) whether each code belongs to one of the body parts."""

    @property
    def limbs(self) -> Limbs:
        """The tree of segments that move by themselves."""

    def price(self, moved: FloatArray, held: Set[int], whole_body: bool) -> FloatArray:
        """Return the (D, D) price of a change of the codes since a drag began.

        Parameters
        ----------
        moved : (D,) the change
        held : segments of `limbs`, of the held limb and of pinned ones
        whole_body : whether the other segments help readily, not only as a last resort
        """

    def shifted(self, codes: FloatArray, way: FloatArray) -> FloatArray:
        """Shift the whole body of (D,) codes by a (3,) vector, if its codes hold a position."""

    def decode(self, codes: FloatArray) -> FloatArray:
        """Decode (B, D) codes to (B, V, 3) vertices, on the calling thread.

        They may be cached for the next call, so callers must not write into them.
        """

    def gpu_decoder(self, body_size: float) -> PosesOnGpu | None:
        """Return a decoder on a GPU, to lengths in the data's unit; None if there is none.

        Its poses have no shapes.
        """

    def decode_some(self, codes: FloatArray, chosen: npt.NDArray[np.integer]) -> FloatArray:
        """Decode (B, D) codes to the (B, n, 3) vertices of (n,) indices, faster if possible."""

    def shaped_as(self, codes: FloatArray, vertices: FloatArray) -> PoseSpace:
        """Return the space of a body shaped so that (D,) codes decode to given (V, 3) vertices."""

    def pull_back(self, codes: FloatArray, by_vertices: FloatArray) -> FloatArray:
        """Turn derivatives by one pose's vertices, (n, V, 3), into those by its codes, (n, D)."""

    def mean_slopes(self, weights: scipy.sparse.csr_matrix) -> MeanSlopes:
        """Prepare the derivatives of patches' means by the codes, for the many poses of a drag.

        Parameters
        ----------
        weights : (m, V); row k times a pose's (V, 3) vertices is the mean of patch k

        Returns
        -------
        slopes : takes the (D,) codes of a pose and n further (n, V, 3) derivatives by its vertices
            (n may be 0); returns (3 m + n, D) derivatives by its codes: row 3 k + a is that of
            coordinate a of patch k's mean; the last n are `pull_back` of the further ones
        """


class LatentPoseSpace:
    """The latent poses of an embedding as a `PoseSpace`.

    Parameters
    ----------
    embedding : decodes the poses
    """

    n_shapes = 0

    def __init__(self, embedding: Embedding) -> None:
        self.embedding = embedding
        self.topology, self.rest_vertices = embedding.topology, embedding.rest_vertices
        self.low, self.high = embedding.box.low, embedding.box.high
        self.group_sizes, self.n_domains = embedding.group_sizes, embedding.n_domains
        self.vertex_domain = embedding.attention_mask.argmax(axis=0)
        # A cache of a method would keep the space and the embedding alive.
        remember = lru_cache(maxsize=_REMEMBERED_POSES)
        self._remembered = remember(partial(_features_and_vertices, embedding))
        self._detail: FloatArray | None = None
        self._shown: FloatArray | None = None
        self._origin: LatentPoseSpace | None = None

    @cached_property
    def domain_metrics(self) -> DisplacementMetrics:
        """J_k^T J_k / V of the decoder's Jacobian, averaged over evenly spaced training poses.

        J_k holds the rows of the vertices that domain k leads.
        """
        if self._origin is not None:
            return self._origin.domain_metrics
        embedding = self.embedding
        latent, size = embedding.training_latent, embedding.latent_size
        pose_numbers = np.unique(np.linspace(0, len(latent) - 1, _JACOBIAN_POSES).astype(int))
        led = [self.vertex_domain == domain for domain in range(self.n_domains)]
        gram = np.zeros((self.n_domains, size, size))
        for row in latent[pose_numbers]:
            features = embedding.decoder.features(row[None])[0]
            tangents = embedding.decoder.tangents(row)
            moved = embedding.codec.decode_jvp(features, tangents, n_threads=1)
            for domain, inside in enumerate(led):
                by_code = moved[:, inside].reshape(size, -1)
                gram[domain] += by_code @ by_code.T
        gram /= len(pose_numbers) * embedding.topology.n_vertices
        return DisplacementMetrics(size, [np.arange(size)] * self.n_domains, tuple(gram))

    @property
    def metric(self) -> FloatArray:
        """The sum of `domain_metrics`, with a small addition on the diagonal."""
        return self.domain_metrics.definite

    @cached_property
    def precision(self) -> FloatArray:
        """The inverse covariance of the training codes, shrunk towards a multiple of identity."""
        latent = self.embedding.training_latent.astype(np.float64)
        covariance = latent.T @ latent / len(latent)
        shrunk = _LEAST_VARIANCE * float(covariance.trace()) / len(covariance)
        return np.linalg.inv(covariance + shrunk * np.eye(len(covariance))).astype(np.float64)

    @cached_property
    def longest_edges(self) -> FloatArray:
        """(E,) float64 array, the longest length of each edge in the training poses."""
        if self._origin is not None and self._shown is not None:
            shown_lengths = self.topology.edge_lengths(self._shown)
            return np.maximum(self._origin.longest_edges, shown_lengths)
        longest = np.zeros(len(self.topology.edges))
        for row in self.embedding.training_latent:
            lengths = self.topology.edge_lengths(self.decode(row[None])[0])
            np.maximum(longest, lengths, out=longest)
        return longest

    @cached_property
    def surface_graph(self) -> scipy.sparse.csr_matrix:
        """(V, V) lengths of the edges on the reference."""
        return length_graph(self.topology.edges, self.rest_vertices)

    def codes_of(self, domains: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return (D,) whether each code belongs to the domains; see `Embedding.codes_of`."""
        return self.embedding.codes_of(domains)

    @cached_property
    def limbs(self) -> Limbs:
        """The tree of the domains: each hangs on the neighbour nearest to the one in the middle."""
        domains = self.vertex_domain[self.topology.edges]
        borders = np.zeros((self.n_domains, self.n_domains))
        np.add.at(borders, (domains[:, 0], domains[:, 1]), 1.0)
        np.fill_diagonal(borders, 0.0)
        borders += borders.T
        steps = scipy.sparse.csgraph.shortest_path(borders > 0.0, unweighted=True)
        root = int(np.where(np.isfinite(steps), steps, self.n_domains).sum(axis=1).argmin())
        nearer = steps[root][None, :] < steps[root][:, None]
        parents = np.where(nearer, borders, -1.0).argmax(axis=1)
        # Domains without neighbours hang on the middle one too.
        parents[~np.isfinite(steps[root])] = root
        parents[root] = -1
        n_children = np.bincount(parents[parents >= 0], minlength=self.n_domains)
        return Limbs(
            parents=parents,
            branches=n_children > 1,
            lengths=np.full(self.n_domains, np.inf),
            leads=self.vertex_domain,
            owner=np.concatenate(
                [
                    np.arange(self.n_domains),
                    np.repeat(np.arange(self.n_domains), self.group_sizes[1:]),
                ]
            ),
            is_relative=False,
        )

    def price(self, moved: FloatArray, held: Set[int], whole_body: bool) -> FloatArray:
        """Price the mean squared displacement, part by part; see `PoseSpace.price`.

        The farther a part has moved, the less each further step costs, so that few parts move:
        reweighted least squares, as for the group lasso (Yuan and Lin 2006).
        """
        metrics, limbs = self.domain_metrics, self.limbs
        shares = np.maximum(np.bincount(self.vertex_domain, minlength=self.n_domains), 1)
        squared = metrics.squared(moved) * len(self.vertex_domain) / shares
        others = 1.0 if whole_body else _RELUCTANT
        hangs = [bool(held & set(limbs.path(domain))) for domain in range(self.n_domains)]
        factor = np.where(hangs, 1.0, others)
        return metrics.weighted(factor * _HOLD / (1.0 + np.sqrt(np.maximum(squared, 0.0)) / _MOVED))

    def shifted(self, codes: FloatArray, way: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return the codes unchanged: a latent pose holds no position."""
        return codes

    def decode(self, codes: FloatArray) -> FloatArray:
        """Decode (B, D) latent poses to (B, V, 3) vertices; see `PoseSpace.decode`."""
        if len(codes) == 1:
            decoded = self._at(codes[0])[1][None]
        else:
            decoded = self.embedding.decode(codes, n_threads=1)
        return decoded if self._detail is None else decoded + self._detail

    def gpu_decoder(self, body_size: float) -> PosesOnGpu | None:
        """See `PoseSpace.gpu_decoder`."""
        if self._detail is not None:
            return None
        from lcollision_core.embedding.gpu_decoder import GpuDecoder

        return GpuDecoder(self.embedding, body_size)

    def shaped_as(self, codes: FloatArray, vertices: FloatArray) -> LatentPoseSpace:
        """Return the same poses with a detail added that is fixed in model coordinates."""
        shaped = copy(self)
        shaped.__dict__.pop("longest_edges", None)
        shaped._origin = self._origin or self
        shaped._detail, shaped._shown = vertices - self._at(codes)[1], vertices
        return shaped

    def decode_some(self, codes: FloatArray, chosen: npt.NDArray[np.integer]) -> FloatArray:
        """Decode (B, D) latent poses to (B, n, 3) vertices, in the time of all vertices."""
        return np.stack([self.decode(pose[None])[0, chosen] for pose in codes])

    def pull_back(self, codes: FloatArray, by_vertices: FloatArray) -> FloatArray:
        """Turn derivatives by one pose's vertices, (n, V, 3), into those by its codes, (n, D)."""
        features = self._at(codes)[0]
        by_features = self.embedding.codec.decode_vjp(features[None], by_vertices, n_threads=1)
        return self.embedding.decoder.pull_back(codes, by_features)

    def mean_slopes(self, weights: scipy.sparse.csr_matrix) -> MeanSlopes:
        """Solve once for the patches' means; see `PoseSpace.mean_slopes`."""
        codec, decoder = self.embedding.codec, self.embedding.decoder
        by_gradients = codec.means_by_gradients(weights)

        def slopes(codes: FloatArray, by_vertices: FloatArray) -> FloatArray:
            features = self._at(codes)[0]
            return decoder.pull_back(codes, codec.means_vjp(features, by_gradients, by_vertices))

        return slopes

    def _at(self, codes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the read-only (V, 9) features and (V, 3) vertices of (D,) codes."""
        return self._remembered(np.asarray(codes, dtype=np.float64).tobytes())


def _features_and_vertices(embedding: Embedding, codes: bytes) -> tuple[FloatArray, FloatArray]:
    """Decode the bytes of (D,) float64 codes."""
    # Keep the arrays writable: Numba would compile its loops again for read-only ones.
    features = embedding.decoder.features(np.frombuffer(codes)[None])
    return features[0], embedding.codec.decode(features, n_threads=1)[0]


_END = 0.8
"""Share of a part's vertices that lie before its far end."""

_FRAME = 0.15
"""Normalised radius of a frame, about the length of a foot."""


def long_axis(points: npt.NDArray[np.floating]) -> FloatArray:
    """Return the unit direction in which (n, 3) points spread most.

    Its largest component is positive, so that it does not depend on rounding.
    """
    arms = points.astype(np.float64) - points.mean(axis=0, dtype=np.float64)
    axis: FloatArray = np.linalg.eigh(arms.T @ arms)[1][:, -1]
    axis *= np.sign(axis[np.abs(axis).argmax()])
    return axis


def far_end(space: PoseSpace, domain: int) -> int:
    """Return the vertex in the middle of a body part's end, away from the rest of the body.

    Fingers do not count.

    Parameters
    ----------
    space : of the poses; the end is found on the reference
    domain : index from 0
    """
    inside = _without_fingers(space, domain)
    points = space.rest_vertices[inside]
    axis = long_axis(points)
    along = points @ (
        axis * np.sign(axis @ (points.mean(axis=0) - space.rest_vertices.mean(axis=0)))
    )
    end = along >= np.quantile(along, _END)
    away = np.linalg.norm(points - points[end].mean(axis=0), axis=1)
    return int(inside[end][away[end].argmin()])


def frame_round(space: PoseSpace, vertex: int) -> list[int]:
    """Return vertices that, with a given one, fix the orientation of a hand, foot or head.

    They are as far as possible from it and from each other, within the body part's nearer end.

    Parameters
    ----------
    space : of the poses; distances are measured on the reference
    vertex : index from 0
    """
    inside = _without_fingers(space, int(space.vertex_domain[vertex]))
    points = space.rest_vertices
    near = inside[np.linalg.norm(points[inside] - points[vertex], axis=1) < _FRAME]
    return far_apart(points, near, vertex)[1:]


def _without_fingers(space: PoseSpace, domain: int) -> npt.NDArray[np.intp]:
    """Return the vertices of a body part that do not belong to short limbs hanging on it."""
    inside = np.flatnonzero(space.vertex_domain == domain)
    counted = inside[~space.limbs.are_short[space.limbs.leads[inside]]]
    return counted if len(counted) else inside
