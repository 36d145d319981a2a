"""Attention masks: the share of each domain in each vertex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph

from lcollision_core.embedding.seeding import bridged_edges
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, edge_graph, length_graph

LEAST_SHARE = 1e-3
"""Smaller shares of a vertex go to its other domains, so that masks have compact support."""

_UNTOUCHED = 1e-12
"""Of the mean squared weight: below this share no component touches a vertex."""


def attention_mask(
    components: npt.NDArray[np.floating], topology: Topology, rest_vertices: FloatArray
) -> npt.NDArray[np.float32]:
    """Compute the masks from the weights of level 1's fully connected layer.

    M^{ki} = Σ_j (C^{kji})² / Σ_k Σ_j (C^{kji})², with shares under `LEAST_SHARE` set to 0 and the
    rest scaled up again. A vertex that no component touches takes the mask of the nearest one
    that some component does, along the mesh.

    Parameters
    ----------
    components : (K, V, 9) array C
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    attention_mask : (K, V) float32 array, each column sums to 1 to rounding

    Raises
    ------
    ShapeError : the arrays do not fit together, or all weights are 0.

    Notes
    -----
    "Domain Decomposition via Attention" of Tan et al. 2021; the paper has no least share.
    """
    weights = np.asarray(components, dtype=np.float64)
    n_vertices = topology.n_vertices
    if weights.ndim != 3 or weights.shape[1] != n_vertices or len(weights) == 0:
        raise ShapeError.must_be("components", f"(K, {n_vertices}, 9)", weights.shape)
    squared = np.einsum("kvj,kvj->kv", weights, weights)
    total = squared.sum(axis=0)
    if not total.max() > 0.0:
        raise ShapeError("all weights of the components are 0, so no domain owns a vertex")
    owned = total > _UNTOUCHED * total.mean()
    shares = squared / np.where(owned, total, 1.0)
    shares[shares < min(LEAST_SHARE, 1.0 / len(shares))] = 0.0
    shares[:, owned] /= shares[:, owned].sum(axis=0)
    if not owned.all():
        shares[:, ~owned] = shares[:, _nearest_owned(owned, topology, rest_vertices)]
    mask: npt.NDArray[np.float32] = shares.astype(np.float32)
    return mask


def keep_one_patch(
    components: npt.NDArray[np.float32], topology: Topology, rest_vertices: FloatArray
) -> npt.NDArray[np.float32]:
    """Remove each component from vertices where it is strongest but disconnected from its domain.

    Poses that fold or tear, such as clothes, leave islands of one domain inside another. There
    the next strongest component takes over, until every domain is one connected patch.

    Parameters
    ----------
    components : (K, V, 9) float32 array C, of any norms; compared at unit norm
    topology : the connectivity; separate components count as tied to their nearest neighbour
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    components : (K, V, 9) float32 array, a copy with islands set to 0
    """
    kept = components.copy()
    edges = bridged_edges(topology, rest_vertices)
    while True:
        squared = (kept.astype(np.float64) ** 2).sum(axis=2)
        # As the masks will see them: each component of unit norm.
        squared /= squared.sum(axis=1, keepdims=True)
        # Vertices that no component touches belong to no patch: they follow their neighbours later.
        owner = np.where(squared.max(axis=0) > 0.0, squared.argmax(axis=0), -1)
        islands = owner[None] == np.arange(len(kept))[:, None]
        for domain, patch in enumerate(_largest_patches(owner, len(kept), edges)):
            islands[domain, patch] = False
        if not islands.any():
            return kept
        kept[islands] = 0.0


def _largest_patches(
    owner: npt.NDArray[np.intp], n_domains: int, edges: IntArray
) -> list[npt.NDArray[np.intp]]:
    """Return the vertices of each domain's largest connected patch, none for an empty domain."""
    inside = edges[owner[edges[:, 0]] == owner[edges[:, 1]]]
    graph = edge_graph(inside, len(owner), np.ones(len(inside)))
    _, patch = csgraph.connected_components(graph, directed=False)
    found = []
    for domain in range(n_domains):
        owned = np.flatnonzero(owner == domain)
        sizes = np.bincount(patch[owned], minlength=1)
        found.append(owned[patch[owned] == sizes.argmax()])
    return found


def _nearest_owned(
    owned: npt.NDArray[np.bool_], topology: Topology, rest_vertices: FloatArray
) -> npt.NDArray[np.intp]:
    """Return for each vertex that is not owned the nearest one that is."""
    graph = length_graph(bridged_edges(topology, rest_vertices), rest_vertices)
    _, _, source = csgraph.dijkstra(
        graph, indices=np.flatnonzero(owned), min_only=True, return_predecessors=True
    )
    nearest: npt.NDArray[np.intp] = np.asarray(source)[~owned].astype(np.intp)
    return nearest


@dataclass(frozen=True)
class MaskQuality:
    """Quality of a set of masks.

    Attributes
    ----------
    connected_share : (K,) float64 array, of the vertices that a domain owns more than any other
        does, the share in its largest connected patch; 0 for a domain that owns none
    domains_per_vertex : mean over vertices of 1 / Σ_k (M^{ki})², the effective number of domains
    """

    connected_share: FloatArray
    domains_per_vertex: float


def judge_masks(
    attention_mask: npt.NDArray[np.floating], topology: Topology, rest_vertices: FloatArray
) -> MaskQuality:
    """Measure whether each domain is one patch of the body.

    Parameters
    ----------
    attention_mask : (K, V) array, columns sum to 1
    topology : the connectivity; separate components count as tied to their nearest neighbour
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    quality : MaskQuality
    """
    mask = np.asarray(attention_mask, dtype=np.float64)
    edges = bridged_edges(topology, rest_vertices)
    owner = mask.argmax(axis=0)
    n_owned = np.bincount(owner, minlength=len(mask))
    in_patch = [len(patch) for patch in _largest_patches(owner, len(mask), edges)]
    connected = np.array(in_patch) / np.maximum(n_owned, 1)
    return MaskQuality(
        connected_share=connected,
        domains_per_vertex=float((1.0 / (mask**2).sum(axis=0)).mean()),
    )
