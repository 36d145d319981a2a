"""Where the domains start: connected parts of the body that move as one."""

from __future__ import annotations

import heapq

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from lcollision_core.acap.bridges import component_bridges
from lcollision_core.acap.features import N_FEATURES, N_ROTATION
from lcollision_core.errors import PoseSetError, ShapeError
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, length_graph

POSITION_WEIGHT = 1.0
"""Radians of relative rotation that weigh as much as a normalised distance of 1."""

_MOTION_DIRECTIONS = 30
_LEAST_AREA_SHARE = 1e-12
_LEAST_RADIUS = 1e-3
_BISECTIONS = 30


def bridged_edges(topology: Topology, rest_vertices: FloatArray) -> IntArray:
    """Return the mesh's edges and the fewest further ones that make it one piece.

    Loose parts, such as eyeballs, and vertices in no face are tied to the body by their shortest
    segment, so that distances and neighbourhoods exist across the gap.

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
    _, nearest = cKDTree(rest_vertices[used]).query(rest_vertices[alone])
    ties = np.stack([alone, used[nearest]], axis=1).astype(np.int32)
    return np.concatenate([topology.edges, component_bridges(topology, rest_vertices), ties])


def vertex_areas(topology: Topology, rest_vertices: FloatArray) -> FloatArray:
    """Return a third of the area of the triangles round each vertex, (V,), normalised.

    Never 0, so that a vertex in no face can be averaged too.
    """
    corners = rest_vertices[topology.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    thirds = np.linalg.norm(normals, axis=1) / 6.0
    areas = np.bincount(topology.faces.ravel(), np.repeat(thirds, 3), minlength=topology.n_vertices)
    floored: FloatArray = np.maximum(areas, _LEAST_AREA_SHARE * areas.sum() + np.finfo(float).tiny)
    return floored


def moving_parts(
    features: npt.NDArray[np.floating],
    topology: Topology,
    rest_vertices: FloatArray,
    n_parts: int,
) -> IntArray:
    """Split the body into connected parts that each move rigidly over the poses.

    Ward's clustering of the vertices by their rotations in all poses and their place on the
    reference, weighed by area and restricted to neighbours on the mesh: two patches merge when
    that adds least to the variance within the parts.

    Parameters
    ----------
    features : (N, V, 9) array, unscaled deformation features
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference, normalised
    n_parts : how many, at most V

    Returns
    -------
    part : (V,) int32 array from 0, numbered along the longest side of the reference, from its
        upper end down

    Raises
    ------
    ShapeError : the arrays do not fit together.
    PoseSetError : more parts than vertices.

    Notes
    -----
    Ward 1963. Farthest-point seeds, which the paper's predecessors use, gave patches that a
    person would not name: see the table in `training`.
    """
    n_vertices = topology.n_vertices
    if np.ndim(features) != 3 or features.shape[1:] != (n_vertices, N_FEATURES):
        raise ShapeError.must_be("features", f"(N, {n_vertices}, {N_FEATURES})", np.shape(features))
    if not 1 <= n_parts <= n_vertices:
        raise PoseSetError(
            f"a mesh of {n_vertices} vertices cannot have {n_parts} domains",
            f"ask for 1 to {n_vertices}",
        )
    areas = vertex_areas(topology, rest_vertices)
    rotations = np.asarray(features[..., :N_ROTATION], dtype=np.float64)
    motion = rotations.transpose(1, 0, 2).reshape(n_vertices, -1) / np.sqrt(len(features))
    motion = motion - np.average(motion, axis=0, weights=areas)
    # The leading directions hold all that tells parts apart; the rest is noise that costs time.
    spread = motion.T @ (motion * areas[:, None])
    directions = np.linalg.eigh(spread)[1][:, ::-1][:, :_MOTION_DIRECTIONS]
    points = np.hstack([motion @ directions, POSITION_WEIGHT * rest_vertices])
    part = _ward(points, areas, bridged_edges(topology, rest_vertices), n_parts)

    up = rest_vertices[:, int(np.ptp(rest_vertices, axis=0).argmax())]
    levels = np.bincount(part, areas * up, n_parts) / np.bincount(part, areas, n_parts)
    rank = np.empty(n_parts, dtype=np.int32)
    rank[np.argsort(-levels, kind="stable")] = np.arange(n_parts, dtype=np.int32)
    return rank[part]


def _ward(points: FloatArray, masses: FloatArray, edges: IntArray, n_parts: int) -> IntArray:
    """Merge neighbouring patches until `n_parts` are left; (V,) part of each vertex."""
    n_vertices = len(points)
    centre = dict(enumerate(points))
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
    parent = np.arange(2 * n_vertices - n_parts)
    for merged in range(n_vertices, 2 * n_vertices - n_parts):
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
    part: IntArray = np.unique(parent[:n_vertices], return_inverse=True)[1].astype(np.int32)
    return part


def part_distances(part: IntArray, topology: Topology, rest_vertices: FloatArray) -> FloatArray:
    """Measure how far each vertex lies from each part along the mesh's edges.

    Parameters
    ----------
    part : (V,) int32 array from 0, the part of each vertex
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    distances : (K, V) float64 array, 0 inside the part, as fractions of the mesh's largest geodesic
        distance
    """
    edges = bridged_edges(topology, rest_vertices)
    graph = length_graph(edges, rest_vertices)
    start = int(np.argmax(csgraph.dijkstra(graph, indices=0)))
    largest = float(csgraph.dijkstra(graph, indices=start).max())
    distances = np.empty((int(part.max()) + 1, topology.n_vertices))
    for domain, row in enumerate(distances):
        inside = np.flatnonzero(part == domain)
        row[:] = csgraph.dijkstra(graph, indices=inside, min_only=True)
    return distances / max(largest, 1e-12)


def windows(distances: FloatArray, radius: float) -> FloatArray:
    """Return (K, V) weights that fall from 1 in each part to 0 at a distance of `radius`."""
    fading: FloatArray = np.clip(1.0 - distances / radius, 0.0, 1.0)
    return fading


def radius_of_overlap(distances: FloatArray, overlap: float) -> float:
    """Find the radius of windows that overlap as much as asked, whatever the size of the parts.

    Parameters
    ----------
    distances : (K, V) float64 array, see `part_distances`
    overlap : effective domains per vertex of the windows, mean of 1 / Σ_k (M^{ki})² with M^{ki}
        the windows' squared weights, each column scaled to sum to 1; it counts as at most
        (K + 1) / 2

    Returns
    -------
    radius : where the windows have faded to 0
    """
    wanted = min(overlap, 0.5 * (len(distances) + 1))
    low, high = _LEAST_RADIUS, 2.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        squared = windows(distances, middle) ** 2
        fractions = squared / squared.sum(axis=0)
        found = float((1.0 / (fractions**2).sum(axis=0)).mean())
        low, high = (middle, high) if found < wanted else (low, middle)
    return high


def locality_weights(distances: FloatArray, band: tuple[float, float]) -> FloatArray:
    """Weigh vertices by their distance from the parts: Lambda of the locality loss.

    Parameters
    ----------
    distances : (K, V) float64 array, see `part_distances`
    band : the distances where the weight begins to rise from 0, and where it is 1

    Returns
    -------
    weights : (K, V) float64 array in [0, 1]

    Notes
    -----
    The literature measures from the component's strongest vertex, so that every domain is a disc
    of one size; measured from the part, a torso may be large and a hand small, and a domain
    cannot drift over the body.
    """
    weights: FloatArray = np.clip((distances - band[0]) / (band[1] - band[0]), 0.0, 1.0)
    return weights


def initial_components(
    features: npt.NDArray[np.float32], distances: FloatArray, areas: FloatArray, radius: float
) -> npt.NDArray[np.float32]:
    """Start each domain from the leading principal component of its part and surroundings.

    Parameters
    ----------
    features : (N, V, 9) float32 array, scaled and centred
    distances : (K, V) float64 array, see `part_distances`
    areas : (V,) float64 array, what each vertex counts
    radius : distance from the part at which the component has faded to 0

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


def ring_average(topology: Topology) -> sparse.csr_matrix:
    """Return the (V, V) matrix that takes the mean over each one-ring; no ring gives 0."""
    counts = np.maximum(np.diff(topology.adjacency.indptr), 1)
    matrix = sparse.diags(1.0 / counts) @ topology.adjacency
    return sparse.csr_matrix(matrix)


def principal_components(rows: npt.NDArray[np.floating], n_wanted: int) -> FloatArray:
    """Return the (n, D) leading right singular vectors of (N, D) rows, n = min(wanted, N, D).

    The sign of each is fixed: its largest entry is positive.
    """
    _, _, right = np.linalg.svd(np.asarray(rows, dtype=np.float64), full_matrices=False)
    leading = right[:n_wanted]
    strongest = leading[np.arange(len(leading)), np.abs(leading).argmax(axis=1)]
    oriented: FloatArray = leading * np.where(strongest < 0.0, -1.0, 1.0)[:, None]
    return oriented
