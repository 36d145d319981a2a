"""Deformation features of a mesh, their scaling, and connected components."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.meshes.normals import vertex_normals
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

N_FEATURES = 9
N_ROTATION = 3
_SERIES_BELOW = 1e-2


@compiled
def exponential_coefficients(angle_squared: float) -> tuple[float, float, float]:
    """Evaluate the functions of theta in the exponential map and its derivative.

    They are sin(theta)/theta, (1 - cos(theta))/theta^2 and (theta - sin(theta))/theta^3. For small
    theta, where the quotients lose digits, their Taylor series are used.
    """
    if angle_squared < _SERIES_BELOW:
        t = angle_squared
        return (
            1.0 - t / 6.0 * (1.0 - t / 20.0 * (1.0 - t / 42.0 * (1.0 - t / 72.0))),
            0.5 * (1.0 - t / 12.0 * (1.0 - t / 30.0 * (1.0 - t / 56.0 * (1.0 - t / 90.0)))),
            (1.0 - t / 20.0 * (1.0 - t / 42.0 * (1.0 - t / 72.0 * (1.0 - t / 110.0)))) / 6.0,
        )
    angle = math.sqrt(angle_squared)
    sine = math.sin(angle)
    return (
        sine / angle,
        (1.0 - math.cos(angle)) / angle_squared,
        (angle - sine) / (angle_squared * angle),
    )


@compiled
def exponential(x: float, y: float, z: float, rotation: FloatArray) -> None:
    """Write the rotation matrix of the vector (x, y, z) = theta * axis, any theta (Rodrigues)."""
    a, b, _ = exponential_coefficients(x * x + y * y + z * z)
    rotation[0, 0] = 1.0 - b * (y * y + z * z)
    rotation[0, 1] = b * x * y - a * z
    rotation[0, 2] = b * x * z + a * y
    rotation[1, 0] = b * x * y + a * z
    rotation[1, 1] = 1.0 - b * (x * x + z * z)
    rotation[1, 2] = b * y * z - a * x
    rotation[2, 0] = b * x * z - a * y
    rotation[2, 1] = b * y * z + a * x
    rotation[2, 2] = 1.0 - b * (x * x + y * y)


@compiled_part
def stretch_product(r: FloatArray, s: FloatArray, product: FloatArray) -> None:
    """Write R S; the six numbers `s` are the upper triangle of S, row by row."""
    for a in range(3):
        product[a, 0] = r[a, 0] * s[0] + r[a, 1] * s[1] + r[a, 2] * s[2]
        product[a, 1] = r[a, 0] * s[1] + r[a, 1] * s[3] + r[a, 2] * s[4]
        product[a, 2] = r[a, 0] * s[2] + r[a, 1] * s[4] + r[a, 2] * s[5]


@compiled
def gradients_from_features(features: FloatArray, gradients: FloatArray) -> FloatArray:
    """Write T_i = exp(log R_i) S_i, (B, V, 3, 3), of (B, V, 9) features, and return them."""
    rotation = np.empty((3, 3))
    for pose in range(len(features)):
        for i in range(features.shape[1]):
            vertex_features = features[pose, i]
            exponential(vertex_features[0], vertex_features[1], vertex_features[2], rotation)
            stretch_product(rotation, vertex_features[3:], gradients[pose, i])
    return gradients


@compiled
def push_forward(features: FloatArray, tangents: FloatArray, gradients: FloatArray) -> None:
    """Write the derivatives of T along several changes of the features of one pose.

    Parameters
    ----------
    features : (V, 9) float64 array
    tangents : (m, V, 9) float64 array
    gradients : (m, V, 3, 3) float64 array, overwritten

    Notes
    -----
    d exp(a) = [J da]_x exp(a) with the left Jacobian
    J = I + (1 - cos t)/t^2 [a]_x + (t - sin t)/t^3 [a]_x^2, t = |a|.
    """
    rotation = np.empty((3, 3))
    turned = np.empty((3, 3))
    for i in range(len(features)):
        x, y, z = features[i, 0], features[i, 1], features[i, 2]
        exponential(x, y, z, rotation)
        _, b, c = exponential_coefficients(x * x + y * y + z * z)
        stretch_product(rotation, features[i, 3:], turned)
        for along in range(len(tangents)):
            tangent, out = tangents[along, i], gradients[along, i]
            u, v, w = tangent[0], tangent[1], tangent[2]
            k0, k1, k2 = y * w - z * v, z * u - x * w, x * v - y * u
            p0 = u + b * k0 + c * (y * k2 - z * k1)
            p1 = v + b * k1 + c * (z * k0 - x * k2)
            p2 = w + b * k2 + c * (x * k1 - y * k0)
            stretch_product(rotation, tangent[3:], out)
            for column in range(3):
                t0, t1, t2 = turned[0, column], turned[1, column], turned[2, column]
                out[0, column] += p1 * t2 - p2 * t1
                out[1, column] += p2 * t0 - p0 * t2
                out[2, column] += p0 * t1 - p1 * t0


@compiled
def pull_back(features: FloatArray, grad_gradient: FloatArray, grad_features: FloatArray) -> None:
    """Write a loss's derivative by the features, given that by T: the transpose of `push_forward`.

    Parameters
    ----------
    features : (V, 9) float64 array
    grad_gradient : (V, 3, 3) float64 array
    grad_features : (V, 9) float64 array, overwritten
    """
    rotation = np.empty((3, 3))
    turned = np.empty((3, 3))
    h = np.empty((3, 3))
    for i in range(len(features)):
        x, y, z = features[i, 0], features[i, 1], features[i, 2]
        exponential(x, y, z, rotation)
        _, b, c = exponential_coefficients(x * x + y * y + z * z)
        stretch_product(rotation, features[i, 3:], turned)
        g = grad_gradient[i]
        p0, p1, p2 = 0.0, 0.0, 0.0
        for k in range(3):
            p0 += turned[1, k] * g[2, k] - turned[2, k] * g[1, k]
            p1 += turned[2, k] * g[0, k] - turned[0, k] * g[2, k]
            p2 += turned[0, k] * g[1, k] - turned[1, k] * g[0, k]
        # The transposed left Jacobian is the left Jacobian of -a.
        k0, k1, k2 = y * p2 - z * p1, z * p0 - x * p2, x * p1 - y * p0
        grad_features[i, 0] = p0 - b * k0 + c * (y * k2 - z * k1)
        grad_features[i, 1] = p1 - b * k1 + c * (z * k0 - x * k2)
        grad_features[i, 2] = p2 - b * k2 + c * (x * k1 - y * k0)
        for a in range(3):
            for column in range(3):
                h[a, column] = (
                    rotation[0, a] * g[0, column]
                    + rotation[1, a] * g[1, column]
                    + rotation[2, a] * g[2, column]
                )
        grad_features[i, 3] = h[0, 0]
        grad_features[i, 4] = h[0, 1] + h[1, 0]
        grad_features[i, 5] = h[0, 2] + h[2, 0]
        grad_features[i, 6] = h[1, 1]
        grad_features[i, 7] = h[1, 2] + h[2, 1]
        grad_features[i, 8] = h[2, 2]


@compiled
def pull_back_means(
    features: FloatArray, by_gradients: FloatArray, grad_features: FloatArray
) -> None:
    """Write the derivatives of patches' means by the features, given those by T.

    Coordinate a of a mean depends only on row a of each T_i, and in the same way for all three, so
    one row replaces the three matrices that `pull_back` would take.

    Parameters
    ----------
    features : (V, 9) float64 array
    by_gradients : (m, V, 3) float64 array, derivatives of m patches' means by the rows of T
    grad_features : (m, 3, V, 9) float64 array, overwritten
    """
    rotation = np.empty((3, 3))
    turned = np.empty((3, 3))
    units = np.eye(3)
    for i in range(len(features)):
        x, y, z = features[i, 0], features[i, 1], features[i, 2]
        exponential(x, y, z, rotation)
        _, b, c = exponential_coefficients(x * x + y * y + z * z)
        stretch_product(rotation, features[i, 3:], turned)
        for patch in range(len(by_gradients)):
            g = by_gradients[patch, i]
            g0, g1, g2 = g[0], g[1], g[2]
            u0 = turned[0, 0] * g0 + turned[0, 1] * g1 + turned[0, 2] * g2
            u1 = turned[1, 0] * g0 + turned[1, 1] * g1 + turned[1, 2] * g2
            u2 = turned[2, 0] * g0 + turned[2, 1] * g1 + turned[2, 2] * g2
            for a in range(3):
                out = grad_features[patch, a, i]
                # As in `pull_back`, p = u x e_a, and the left Jacobian of -log R.
                e0, e1, e2 = units[a, 0], units[a, 1], units[a, 2]
                p0, p1, p2 = u1 * e2 - u2 * e1, u2 * e0 - u0 * e2, u0 * e1 - u1 * e0
                k0, k1, k2 = y * p2 - z * p1, z * p0 - x * p2, x * p1 - y * p0
                out[0] = p0 - b * k0 + c * (y * k2 - z * k1)
                out[1] = p1 - b * k1 + c * (z * k0 - x * k2)
                out[2] = p2 - b * k2 + c * (x * k1 - y * k0)
                r0, r1, r2 = rotation[a, 0], rotation[a, 1], rotation[a, 2]
                out[3] = r0 * g0
                out[4] = r0 * g1 + r1 * g0
                out[5] = r0 * g2 + r2 * g0
                out[6] = r1 * g1
                out[7] = r1 * g2 + r2 * g1
                out[8] = r2 * g2


SCALED_BOUND = 0.95
"""Training features fill [-0.95, 0.95] (Gao et al. 2019), inside the range of tanh."""


_LARGEST_FEATURE, _LARGEST_SCALE = 100.0, 1e18
"""Bounds beyond any training set, in radians or as a stretch; numbers that hardly differ have large
scales."""


@dataclass(frozen=True)
class FeatureScaling:
    """One affine map for all entries of log R and one for all entries of S.

    Attributes
    ----------
    rotation_centre, rotation_scale : scaled = (log R - centre) * scale, log R in radians
    stretch_centre, stretch_scale : scaled = (S - centre) * scale

    Raises
    ------
    ValueError : a centre or a scale is out of range.
    """

    rotation_centre: float
    rotation_scale: float
    stretch_centre: float
    stretch_scale: float

    def __post_init__(self) -> None:
        for name in ("rotation_centre", "stretch_centre"):
            if not abs(getattr(self, name)) <= _LARGEST_FEATURE:
                raise ValueError(f"{name} must be within {_LARGEST_FEATURE:g} of 0")
        for name in ("rotation_scale", "stretch_scale"):
            if not 1.0 / _LARGEST_FEATURE <= getattr(self, name) <= _LARGEST_SCALE:
                raise ValueError(
                    f"{name} must be from {1.0 / _LARGEST_FEATURE:g} to {_LARGEST_SCALE:g}, got "
                    f"{getattr(self, name):g}"
                )

    @classmethod
    def fit(cls, features: npt.NDArray[Any]) -> FeatureScaling:
        """Choose the maps that take the extremes of (..., V, 9) unscaled features to +-0.95.

        Entries that are all equal, as in a set of one undeformed pose, are only shifted to 0.
        """
        centres_and_scales = []
        for numbers in (features[..., :N_ROTATION], features[..., N_ROTATION:]):
            low, high = float(numbers.min()), float(numbers.max())
            scale = 2.0 * SCALED_BOUND / (high - low) if high > low else 1.0
            centres_and_scales += [0.5 * (low + high), scale]
        return cls(*centres_and_scales)

    @property
    def scale(self) -> FloatArray:
        """The scales of a feature's entries, (9,)."""
        return _per_number(self.rotation_scale, self.stretch_scale)

    def apply(self, features: npt.NDArray[Any]) -> FloatArray:
        """Scale (..., 9) features."""
        centre = _per_number(self.rotation_centre, self.stretch_centre)
        scaled: FloatArray = (features - centre) * self.scale
        return scaled

    def invert(self, scaled: npt.NDArray[Any]) -> FloatArray:
        """Convert scaled (..., 9) features back to radians and stretches."""
        centre = _per_number(self.rotation_centre, self.stretch_centre)
        features: FloatArray = scaled / self.scale + centre
        return features


def _per_number(rotation: float, stretch: float) -> FloatArray:
    return np.repeat([rotation, stretch], [N_ROTATION, N_FEATURES - N_ROTATION])


BRIDGE_WEIGHT, OLDER_BRIDGE_WEIGHT = 0.03, 0.01
"""Weight of an edge between components, low enough to place them and bend the mesh little. The
second is that of models trained before layers were joined to the surface below."""

_EDGES_EACH = 128
"""Most edges between two components. They fix their mean position, as of a ball in its socket.

For the X Bot's poses, encoded and decoded, the mean error is 5.9 % of the body size with one edge
from each component to the largest, 0.9 % with one to its neighbour, 0.5 % with 128, and 0.34 % with
its layers joined too."""

_COVERED_WITHIN = 0.03
"""Normalised distance within which a layer covers a surface."""

_SAME_WAY = 0.5
"""Least cosine between the normals of a layer and of the surface below; hands face a coat."""

_LEAST_LENGTH = 1e-12
"""Least normalised length of an edge between components, as a graph has no edge of length 0."""


def component_bridges(
    topology: Topology, rest_vertices: FloatArray, *, layers: bool = True
) -> IntArray:
    """Join each connected component to a neighbour by the shortest edges from vertex to vertex.

    Features do not hold the position of a component. Edges to its neighbour let eyes or buttons
    follow the body that they sit on, and each shell of a robot the next. Joined components form a
    tree. Each vertex of a component that lies on another, as clothes on skin, is joined to it.

    Parameters
    ----------
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference, in normalised lengths
    layers : whether each vertex of a layer is joined to the surface below

    Returns
    -------
    bridges : (n, 2) int32 array; vertices in no face have none and stay at their positions in the
        reference

    Notes
    -----
    The Euclidean minimum spanning tree of points is a subgraph of their Delaunay triangulation.
    If there is none, as for points in a plane, components are joined to the largest.
    """
    _, component = topology.vertex_components
    size = np.bincount(component)
    used = np.flatnonzero(size[component] > 1)
    _, of_point = np.unique(component[used], return_inverse=True)
    n_components = int(of_point.max()) + 1
    if n_components == 1:
        return np.empty((0, 2), dtype=np.int32)
    points = rest_vertices[used]
    edges = np.concatenate([_neighbours(points), _to_the_largest(points, of_point)])
    ends = of_point[edges]
    across = ends[:, 0] != ends[:, 1]
    edges, ends = edges[across], np.sort(ends[across], axis=1)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) + _LEAST_LENGTH
    order = np.lexsort((lengths, ends[:, 1], ends[:, 0]))
    edges, ends, lengths = edges[order], ends[order], lengths[order]
    pairs, first, pair_of = np.unique(ends, axis=0, return_index=True, return_inverse=True)
    shape = (n_components, n_components)
    graph = scipy.sparse.coo_matrix((lengths[first], tuple(pairs.T)), shape=shape).tocsr()
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    of_tree = np.zeros(shape, dtype=np.bool_)
    of_tree[tree.row, tree.col] = True
    rank = np.arange(len(edges)) - first[pair_of.ravel()]
    bridging = of_tree[tuple(ends.T)] & (rank < _EDGES_EACH)
    if layers:
        normals = vertex_normals(rest_vertices, topology.faces)[used]
        same_way = (normals[edges[:, 0]] * normals[edges[:, 1]]).sum(axis=1) > _SAME_WAY
        covers = same_way & (lengths < _COVERED_WITHIN)
        for own, other in ((0, 1), (1, 0)):
            # Edges are sorted by length, so a vertex's first edge to a component is the shortest.
            place = np.flatnonzero(covers)
            key = edges[place, own].astype(np.int64) * n_components + of_point[edges[place, other]]
            bridging[place[np.unique(key, return_index=True)[1]]] = True
    bridges: IntArray = used[edges[bridging]].astype(np.int32)
    return np.unique(np.sort(bridges, axis=1), axis=0) if layers else bridges


def _neighbours(points: FloatArray) -> npt.NDArray[np.intp]:
    """Return (n, 2) edges of the Delaunay triangulation of points, none if there is none."""
    try:
        delaunay = scipy.spatial.Delaunay(points)
    except scipy.spatial.QhullError:
        return np.empty((0, 2), dtype=np.intp)
    edges = [delaunay.simplices[:, pair] for pair in combinations(range(4), 2)]
    # The triangulation leaves out points that coincide with others.
    return np.concatenate([*edges, delaunay.coplanar[:, [0, 2]]]).astype(np.intp)


def _to_the_largest(points: FloatArray, of_point: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return an edge from each component to the largest, so that all are surely joined."""
    main = np.flatnonzero(of_point == np.bincount(of_point).argmax())
    others = np.setdiff1d(np.arange(len(points)), main)
    distance, nearest = scipy.spatial.cKDTree(points[main]).query(points[others])
    order = np.lexsort((distance, of_point[others]))
    _, first = np.unique(of_point[others][order], return_index=True)
    first_edges = order[first]
    return np.stack([others[first_edges], main[nearest[first_edges]]], axis=1)
