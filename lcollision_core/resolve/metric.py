"""How far apart two latent poses are: in their codes, or to the eye."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray

_JACOBIAN_POSES = 8
_STIFFENING = 1e-3
"""Of the mean diagonal: what a code costs that moves no vertex, so that the metric is definite."""


def relative_distance(latent: FloatArray, target: FloatArray) -> float:
    """Measure ||Z - Z*|| / ||Z*|| of two (D,) poses, or ||Z - Z*|| where Z* is the zero pose."""
    return float(np.linalg.norm(latent - target)) / (float(np.linalg.norm(target)) or 1.0)


@dataclass(frozen=True, eq=False)
class LatentMetric:
    """The squared distance d(Z, Z') = (Z - Z')^T G (Z - Z').

    Attributes
    ----------
    gram : (D, D) float64 array G, symmetric and positive definite
    """

    gram: FloatArray

    @classmethod
    def latent(cls, size: int) -> LatentMetric:
        """Return ||Z - Z'||^2, the objective of equation 1 of Tan et al. 2021."""
        return cls(np.eye(size))

    @classmethod
    def eye(cls, embedding: Embedding) -> LatentMetric:
        """Return the mean squared vertex displacement in squared heights, to first order.

        G is J^T J / V of the decoder's Jacobian J, averaged over evenly spaced training poses.
        """
        latent = embedding.training_latent
        chosen = np.unique(np.linspace(0, len(latent) - 1, _JACOBIAN_POSES).astype(int))
        gram = np.zeros((embedding.latent_size, embedding.latent_size))
        for row in latent[chosen]:
            features = embedding.decoder.features(row[None])[0]
            tangents = embedding.decoder.tangents(row)
            moved = embedding.codec.decode_jvp(features, tangents, n_threads=1)
            by_code = moved.reshape(len(moved), -1)
            gram += by_code @ by_code.T / (len(chosen) * embedding.topology.n_vertices)
        gram[np.diag_indices_from(gram)] += _STIFFENING * np.trace(gram) / len(gram)
        return cls(gram)

    def weighted(self, code_weights: FloatArray) -> LatentMetric:
        """Return the metric in which moving code i costs `code_weights[i]` times as much."""
        root = np.sqrt(code_weights)
        return LatentMetric(self.gram * np.outer(root, root))

    def squared(self, moved: FloatArray) -> FloatArray:
        """Measure (..., D) differences of poses: (...) squared distances."""
        distance: FloatArray = np.einsum("...i,ij,...j->...", moved, self.gram, moved)
        return distance
