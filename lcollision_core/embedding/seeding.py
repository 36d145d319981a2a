"""Seed the components of level 1, and compute attention masks from them."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.acap.features import N_FEATURES, N_ROTATION, component_bridges
from lcollision_core.errors import PoseSetError, ShapeError
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, edge_graph, length_graph

POSITION_WEIGHT = 1.0
"""Radians of relative rotation that count as much as a normalised length of 1."""

_MOTION_DIRECTIONS = 30
_LEAST_AREA_SHARE = 1e-12
_LEAST_RADIUS = 1e-3
_BISECTIONS = 30


def bridged_edges(topology: Topology, rest_vertices: FloatArray) -> IntArray:
    """Return the mesh's edges and additional ones that connect its components.

    Loose components, such as eyeballs, are tied to their neighbours, and vertices in no face to the
    nearest vertex, so that distances and neighbourhoods cross the gaps.

    Parameters
    ----------
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    edges : (E', 2) int32 array, E' >= E
    """
    _, component = topology.vertex_components
    alone = np.flatnonzero(np.bincount(component)[component] == 1)
    used = np.setdiff1d(np.arange(topology.n_vertices), alone)
    _, nearest = scipy.spatial.cKDTree(rest_vertices[used]).query(rest_vertices[alone])
    ties = np.stack([alone, used[nearest]], axis=1).astype(np.int32)
    return np.concatenate([topology.edges, component_bridges(topology, rest_vertices), ties])


def vertex_areas(topology: Topology, rest_vertices: FloatArray) -> FloatArray:
    """Return a third of the area of the triangles around each vertex, (V,).

    It is never 0, so that vertices in no face can be averaged too.
    """
    corners = rest_vertices[topology.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    thirds = np.linalg.norm(normals, axis=1) / 6.0
    areas = np.bincount(topology.faces.ravel(), np.repeat(thirds, 3), minlength=topology.n_vertices)
    floored: FloatArray = np.maximum(areas, _LEAST_AREA_SHARE * areas.sum() + np.finfo(float).tiny)
    return floored


def moving_domains(
    features: npt.NDArray[np.floating],
    topology: Topology,
    rest_vertices: FloatArray,
    n_domains: int,
) -> IntArray:
    """Split the body into connected domains that each move nearly rigidly over the poses.

    Ward's clustering of the vertices by their rotations in all poses and their position on the
    reference, weighted by area and restricted to neighbours on the mesh: the two patches whose
    merging adds least to the variance within the domains merge next.

    Parameters
    ----------
    features : (N, V, 9) array, unscaled deformation features
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference, in normalised lengths
    n_domains : number of domains, at most V

    Returns
    -------
    domain_of : (V,) int32 array from 0, numbered along the longest side of the reference, from its
        upper end downwards

    Raises
    ------
    PoseSetError : more domains than vertices.

    Notes
    -----
    Ward 1963. The paper's predecessors grow patches from farthest-point seeds.
    """
    n_vertices = topology.n_vertices
    if not 1 <= n_domains <= n_vertices:
        raise PoseSetError(
            f"a mesh of {n_vertices} vertices cannot have {n_domains} domains",
            f"ask for 1 to {n_vertices}",
        )
    areas = vertex_areas(topology, rest_vertices)
    rotations = np.asarray(features[..., :N_ROTATION], dtype=np.float64)
    motion = rotations.transpose(1, 0, 2).reshape(n_vertices, -1) / np.sqrt(len(features))
    motion = motion - np.average(motion, axis=0, weights=areas)
    # The leading directions distinguish the domains; the rest is noise that costs time.
    spread = motion.T @ (motion * areas[:, None])
    directions = np.linalg.eigh(spread)[1][:, ::-1][:, :_MOTION_DIRECTIONS]
    positions = np.hstack([motion @ directions, POSITION_WEIGHT * rest_vertices])
    domain_of = _ward(positions, areas, bridged_edges(topology, rest_vertices), n_domains)

    up = rest_vertices[:, int(np.ptp(rest_vertices, axis=0).argmax())]
    sizes = np.bincount(domain_of, areas, n_domains)
    levels = np.bincount(domain_of, areas * up, n_domains) / sizes
    rank = np.empty(n_domains, dtype=np.int32)
    rank[np.argsort(-levels, kind="stable")] = np.arange(n_domains, dtype=np.int32)
    return rank[domain_of]


def _ward(positions: FloatArray, masses: FloatArray, edges: IntArray, n_domains: int) -> IntArray:
    """Merge neighbouring patches until `n_domains` are left; return (V,) the vertices' domains."""
    n_vertices = len(positions)
    centre = dict(enumerate(positions))
    mass = dict(enumerate(masses.tolist()))
    neighbours: dict[int, set[int]] = {vertex: set() for vertex in range(n_vertices)}
    for a, b in edges.tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)

    def added_variance(a: int, b: int) -> float:
        offset = centre[a] - centre[b]
        return float(mass[a] * mass[b] / (mass[a] + mass[b]) * (offset @ offset))

    queue = [(added_variance(a, b), a, b) for a, b in edges.tolist()]
    heapq.heapify(queue)
    parent = np.arange(2 * n_vertices - n_domains)
    for merged in range(n_vertices, 2 * n_vertices - n_domains):
        _, a, b = heapq.heappop(queue)
        while a not in mass or b not in mass:
            _, a, b = heapq.heappop(queue)
        parent[a] = parent[b] = merged
        total = mass[a] + mass[b]
        centre[merged] = (mass[a] * centre[a] + mass[b] * centre[b]) / total
        around = (neighbours.pop(a) | neighbours.pop(b)) - {a, b}
        for patch in (a, b):
            del mass[patch], centre[patch]
        mass[merged] = total
        neighbours[merged] = around
        for patch in sorted(around):
            neighbours[patch] -= {a, b}
            neighbours[patch].add(merged)
            heapq.heappush(queue, (added_variance(patch, merged), patch, merged))
    for patch in range(len(parent) - 1, -1, -1):
        parent[patch] = parent[parent[patch]]
    domain: IntArray = np.unique(parent[:n_vertices], return_inverse=True)[1].astype(np.int32)
    return domain


def domain_distances(
    domain_of: IntArray, topology: Topology, rest_vertices: FloatArray
) -> FloatArray:
    """Measure how far each vertex lies from each domain along the mesh's edges.

    Parameters
    ----------
    domain_of : (V,) int32 array from 0, the domain of each vertex
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    distances : (K, V) float64 array, 0 inside the domain, as fractions of the mesh's largest
        geodesic distance
    """
    graph = length_graph(bridged_edges(topology, rest_vertices), rest_vertices)
    start = int(np.argmax(scipy.sparse.csgraph.dijkstra(graph, indices=0)))
    largest = float(scipy.sparse.csgraph.dijkstra(graph, indices=start).max())
    distances = np.empty((int(domain_of.max()) + 1, topology.n_vertices))
    for domain, row in enumerate(distances):
        inside = np.flatnonzero(domain_of == domain)
        row[:] = scipy.sparse.csgraph.dijkstra(graph, indices=inside, min_only=True)
    return distances / max(largest, 1e-12)


def windows(distances: FloatArray, radius: float) -> FloatArray:
    """Return (K, V) weights that fall from 1 in each domain to 0 at a distance of `radius`."""
    fading: FloatArray = np.clip(1.0 - distances / radius, 0.0, 1.0)
    return fading


def radius_of_overlap(distances: FloatArray, overlap: float) -> float:
    """Find the radius of windows with a given overlap, whatever the size of the domains.

    Parameters
    ----------
    distances : (K, V) float64 array, see `domain_distances`
    overlap : effective domains per vertex of the windows, the mean of 1 / Σ_k (M^{ki})² with M^{ki}
        the windows' squared weights, each column scaled to sum to 1; clipped at (K + 1) / 2

    Returns
    -------
    radius : distance at which the windows have faded to 0
    """
    target_overlap = min(overlap, 0.5 * (len(distances) + 1))
    low, high = _LEAST_RADIUS, 2.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        squared = windows(distances, middle) ** 2
        fractions = squared / squared.sum(axis=0)
        reached = float((1.0 / (fractions**2).sum(axis=0)).mean())
        low, high = (middle, high) if reached < target_overlap else (low, middle)
    return high


def initial_components(
    features: npt.NDArray[np.float32], distances: FloatArray, areas: FloatArray, radius: float
) -> npt.NDArray[np.float32]:
    """Start each domain from the leading principal component of the domain and its surroundings.

    Parameters
    ----------
    features : (N, V, 9) float32 array, scaled and centred
    distances : (K, V) float64 array, see `domain_distances`
    areas : (V,) float64 array, the weight of each vertex
    radius : distance from the domain at which the component has faded to 0

    Returns
    -------
    components : (K, V, 9) float32 array, each of unit norm
    """
    components = np.zeros((*distances.shape, N_FEATURES), dtype=np.float32)
    for domain, distance in enumerate(distances):
        window = windows(distance, radius)
        inside = np.flatnonzero(window)
        weight = window[inside] * np.sqrt(areas[inside] / areas.mean())
        weighed = (features[:, inside] * weight[:, None]).reshape(len(features), -1)
        leading = principal_components(weighed, 1)[0].reshape(-1, N_FEATURES)
        faded = leading * window[inside, None]
        components[domain, inside] = faded / np.linalg.norm(faded)
    return components


def principal_components(rows: npt.NDArray[np.floating], n_wanted: int) -> FloatArray:
    """Return the (n, D) leading right singular vectors of (N, D) rows, n = min(wanted, N, D).

    The sign of each is fixed: its largest entry is positive.
    """
    values = np.asarray(rows, dtype=np.float64)
    n_found = min(n_wanted, *values.shape)
    # Poses are few: the eigenvectors of their (N, N) products give the directions. The last step
    # gives orthonormal columns even if the rows span fewer.
    mixtures = np.linalg.eigh(values @ values.T)[1][:, ::-1][:, :n_found]
    leading = np.linalg.qr(values.T @ mixtures)[0].T
    strongest = leading[np.arange(len(leading)), np.abs(leading).argmax(axis=1)]
    oriented: FloatArray = leading * np.where(strongest < 0.0, -1.0, 1.0)[:, None]
    return oriented


LEAST_SHARE = 1e-3
"""Smaller shares of a vertex go to its other domains, so that masks have compact support."""

_UNTOUCHED = 1e-12
"""Share of the mean squared weight up to which no component touches a vertex."""


def attention_mask(
    components: npt.NDArray[np.floating], topology: Topology, rest_vertices: FloatArray
) -> npt.NDArray[np.float32]:
    """Compute the masks from the weights of level 1's fully connected layer.

    M^{ki} = Σ_j (C^{kji})² / Σ_k Σ_j (C^{kji})², with shares under `LEAST_SHARE` set to 0 and the
    rest rescaled. A vertex that no component touches takes the mask of the nearest touched one
    along the mesh.

    Parameters
    ----------
    components : (K, V, 9) array C
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    attention_mask : (K, V) float32 array, each column sums to 1 up to rounding

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

    Poses of surfaces that fold or tear, such as clothes, leave islands of one domain inside
    another. There the next strongest component takes over, until every domain is one connected
    patch.

    Parameters
    ----------
    components : (K, V, 9) float32 array C, of any norms; compared at unit norm
    topology : the connectivity; separate components count as tied to their nearest neighbour
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    components : (K, V, 9) float32 array, a copy with islands set to 0
    """
    patches = components.copy()
    edges = bridged_edges(topology, rest_vertices)
    while True:
        squared = (patches.astype(np.float64) ** 2).sum(axis=2)
        # The masks use each component at unit norm.
        squared /= squared.sum(axis=1, keepdims=True)
        # Vertices that no component touches belong to no patch; they later follow their neighbours.
        owner = np.where(squared.max(axis=0) > 0.0, squared.argmax(axis=0), -1)
        islands = owner[None] == np.arange(len(patches))[:, None]
        for domain, patch in enumerate(_largest_patches(owner, len(patches), edges)):
            islands[domain, patch] = False
        if not islands.any():
            return patches
        patches[islands] = 0.0


def _largest_patches(
    owner: npt.NDArray[np.intp], n_domains: int, edges: IntArray
) -> list[npt.NDArray[np.intp]]:
    """Return the vertices of each domain's largest connected patch, none for an empty domain."""
    inside = edges[owner[edges[:, 0]] == owner[edges[:, 1]]]
    graph = edge_graph(inside, len(owner), np.ones(len(inside)))
    _, patch = scipy.sparse.csgraph.connected_components(graph, directed=False)
    patches = []
    for domain in range(n_domains):
        owned = np.flatnonzero(owner == domain)
        sizes = np.bincount(patch[owned], minlength=1)
        patches.append(owned[patch[owned] == sizes.argmax()])
    return patches


def _nearest_owned(
    owned: npt.NDArray[np.bool_], topology: Topology, rest_vertices: FloatArray
) -> npt.NDArray[np.intp]:
    """Return the nearest owned vertex of each vertex that is not owned."""
    graph = length_graph(bridged_edges(topology, rest_vertices), rest_vertices)
    _, _, source = scipy.sparse.csgraph.dijkstra(
        graph, indices=np.flatnonzero(owned), min_only=True, return_predecessors=True
    )
    nearest: npt.NDArray[np.intp] = np.asarray(source)[~owned].astype(np.intp)
    return nearest


@dataclass(frozen=True)
class MaskQuality:
    """Quality of a set of masks.

    Attributes
    ----------
    connected_share : (K,) float64 array, share of a domain's vertices, where its mask is largest,
        in their largest connected patch; 0 for a domain without any
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
