"""Sites where skin folds onto itself, and a few vertices about each that indicate the fold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import STRICT, CollisionDetector, ContactRules, SelfCollisions
from lcollision_core.embedding import Embedding
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes import FaceGroup
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.predictor.inference.points import (
    farthest_points,
    skin_distances,
    skin_graph,
)

FOLD_RADIUS = 0.045
"""Normalised length along the surface within which colliding faces are a fold of the skin.

Counted from the near exclusion, within which they are no collision.
"""

N_SITES = 128
N_MEMBERS = 12

_MEMBER_RADIUS = 0.03
"""Likewise: how far a site's members spread."""

_SPREAD, _REDUNDANCE = 0.02, 0.85
"""Normalised length within which a chosen site makes its neighbours redundant, and how much."""

_MASKED_FOLD = 0.2
"""Weight of a fold in a pose that collides elsewhere too."""

_SEARCHED_POSES = 3000
_POSES_AT_ONCE = 32


class FoldDetector:
    """The exact check, with folds distinguished from contact between parts.

    Parameters
    ----------
    embedding : of the body; poses are in normalised length
    rules, groups : which pairs do not count
    """

    def __init__(
        self, embedding: Embedding, rules: ContactRules, groups: Sequence[FaceGroup] = ()
    ) -> None:
        topology, rest = embedding.topology, embedding.rest_vertices
        radius = rules.near_exclusion + FOLD_RADIUS
        with_folds = replace(rules, near_exclusion=radius, near_by_limb=False)
        self._with_folds = CollisionDetector(topology, rest, with_folds, groups)
        self._by_rules = CollisionDetector(topology, rest, rules, groups)

    def detect(
        self, vertices: npt.NDArray[np.floating]
    ) -> tuple[SelfCollisions, npt.NDArray[np.bool_]]:
        """Find the n pairs of faces of a pose that count, and which of them are folds: (n,)."""
        found = self._by_rules.detect(vertices, counted_only=True)
        return found, self._with_folds.rules_of(found.pairs, found.penetration_depth) > 0


def find_fold_sites(
    embedding: Embedding,
    latent: npt.NDArray[np.floating],
    rules: ContactRules = STRICT,
    groups: Sequence[FaceGroup] = (),
) -> npt.NDArray[np.int64]:
    """Search colliding poses for the sites where the skin folds most often.

    Parameters
    ----------
    embedding : decodes
    latent : (n, D) poses that collide; some thousands are used
    rules, groups : which pairs do not count

    Returns
    -------
    members : (S, M) vertices spread about each site, its centre first; S is 0 for a body that does
        not fold
    """
    score = _fold_frequency(
        embedding, latent[:_SEARCHED_POSES], FoldDetector(embedding, rules, groups)
    )
    radius = _MEMBER_RADIUS + rules.near_exclusion
    graph = skin_graph(embedding)
    members: list[npt.NDArray[np.int64]] = []
    while len(members) < N_SITES and score.max(initial=0.0) > 0.0:
        centre = int(score.argmax())
        (distance,) = skin_distances(graph, np.array([centre]))
        members.append(_spread_members(embedding, distance, radius))
        score *= 1.0 - _REDUNDANCE * np.exp(-((distance / _SPREAD) ** 2))
        score[centre] = 0.0
    return np.array(members, dtype=np.int64).reshape(-1, N_MEMBERS)


def _fold_frequency(
    embedding: Embedding, latent: npt.NDArray[np.floating], detector: FoldDetector
) -> FloatArray:
    """Return (V,) in what fraction of the poses each vertex is part of a fold."""
    faces = embedding.topology.faces
    folded = [np.empty(0, dtype=np.int32)] * len(latent)
    weight = np.ones(len(latent))

    def search(start: int, stop: int) -> None:
        poses = embedding.decode(latent[start:stop], n_threads=1).astype(np.float32)
        for pose, vertices in enumerate(poses, start):
            found, are_folds = detector.detect(vertices)
            folded[pose] = np.unique(faces[found.pairs[are_folds]])
            if not are_folds.all():
                weight[pose] = _MASKED_FOLD

    for_blocks(search, len(latent), _POSES_AT_ONCE)
    frequency = np.zeros(len(embedding.rest_vertices))
    for pose, vertices in enumerate(folded):
        frequency[vertices] += weight[pose]
    return frequency / max(len(latent), 1)


def _spread_members(
    embedding: Embedding, distance: FloatArray, radius: float
) -> npt.NDArray[np.int64]:
    """Choose `N_MEMBERS` vertices about the one at distance 0, each farthest from those before."""
    order = distance.argsort(kind="stable")
    # A coarse mesh has too few within the radius: the nearest then; a tiny one repeats its own.
    n_near = max(int((distance <= radius).sum()), N_MEMBERS)
    near = np.resize(order[:n_near], n_near)
    members: npt.NDArray[np.int64] = near[
        farthest_points(embedding.rest_vertices[near], 0, N_MEMBERS)
    ]
    return members
