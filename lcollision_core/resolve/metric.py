"""Distances of latent poses: by their codes, or by the displacement of the vertices."""

from __future__ import annotations

import numpy as np

from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray

_JACOBIAN_POSES = 8
_STIFFENING = 1e-3
"""Of the mean diagonal: what a code costs that moves no vertex, so that the metric is definite."""


def relative_distance(latent: FloatArray, target: FloatArray) -> float:
    """Measure ||Z - Z*|| / ||Z*|| of two (D,) poses, or ||Z - Z*|| where Z* is the zero pose."""
    return float(np.linalg.norm(latent - target)) / (float(np.linalg.norm(target)) or 1.0)


def displacement_metric(embedding: Embedding) -> FloatArray:
    """Return the vertex-displacement metric: (D, D), symmetric and positive definite.

    (Z - Z')^T G (Z - Z') is, to first order, the mean squared vertex displacement in squared
    normalised length: G is J^T J / V of the decoder's Jacobian J, averaged over evenly spaced
    training poses.
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
    return gram
