"""Slow references that share nothing with the code under test.

They use neither trees nor boxes nor the eleven axes of the closed form, but the Minkowski
difference of two triangles, the hull of nine points. Its depth at the origin is the smallest value
of its support function over the unit normals of all planes through three of the points: these
include the facets' normals, and no direction gives less.
"""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog

FloatArray = npt.NDArray[np.float64]

TRIPLES = list(itertools.combinations(range(9), 3))
_ACROSS_EDGES = [
    (3 * i + j, 3 * i + k, 3 * m + j)
    for (i, m), (j, k) in itertools.product(itertools.combinations(range(3), 2), repeat=2)
]


def exact_depth(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Return the penetration depth of two triangles (3, 3), exact but for the last root."""
    return exact_depth_and_direction(a, b)[0]


def exact_depth_and_direction(a: npt.ArrayLike, b: npt.ArrayLike) -> tuple[float, FloatArray]:
    """Return the depth and a unit direction to move a along so that it leaves b."""
    first, second, unit_length = _integers(a, b)
    points = [[p[c] - q[c] for c in range(3)] for p in first for q in second]
    depth_squared: Fraction | None = None
    direction = [0, 0, 0]
    for i, j, k in TRIPLES:
        u = [points[j][c] - points[i][c] for c in range(3)]
        v = [points[k][c] - points[i][c] for c in range(3)]
        n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
        length_squared = n[0] ** 2 + n[1] ** 2 + n[2] ** 2
        if length_squared == 0:
            continue
        along = [n[0] * p[0] + n[1] * p[1] + n[2] * p[2] for p in points]
        # To separate the triangles, move a against n past the highest point, or along n.
        for support, sign in ((max(along), -1), (-min(along), 1)):
            if support <= 0:
                return 0.0, np.zeros(3)
            squared = Fraction(support * support, length_squared)
            if depth_squared is None or squared < depth_squared:
                depth_squared, direction = squared, [sign * x for x in n]
    if depth_squared is None:
        return 0.0, np.zeros(3)
    largest = max(map(abs, direction))
    unit = np.array([float(Fraction(x, largest)) for x in direction])
    return _root(depth_squared * unit_length**2), unit / np.linalg.norm(unit)


def _integers(a: npt.ArrayLike, b: npt.ArrayLike) -> tuple[list, list, Fraction]:
    """Return the corners as integers in a common unit, without rounding."""
    exact = [[[Fraction(float(x)) for x in corner] for corner in np.asarray(t)] for t in (a, b)]
    parts = max(x.denominator for triangle in exact for corner in triangle for x in corner)
    first, second = [[[int(x * parts) for x in corner] for corner in t] for t in exact]
    return first, second, Fraction(1, parts)


def _root(value: Fraction) -> float:
    """Return the root of a rational that may be outside the range of floats."""
    bits = value.numerator.bit_length() - value.denominator.bit_length()
    shift = 128 - bits
    shift += shift % 2
    scaled = value * Fraction(2) ** shift
    return math.ldexp(math.sqrt(float(scaled)), -shift // 2)


def are_disjoint(a: FloatArray, b: FloatArray) -> bool:
    """Decide by a linear program whether two triangles have no point in common."""
    # Barycentric coordinates of one point in both triangles.
    points = np.concatenate([a.T, -b.T], axis=1)
    sums = np.array([[1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 1]])
    answer = linprog(
        np.zeros(6),
        A_eq=np.concatenate([points, sums]),
        b_eq=[0, 0, 0, 1, 1],
        options={"primal_feasibility_tolerance": 1e-10},
    )
    assert answer.status in (0, 2), answer.message
    return bool(answer.status == 2)


class ReferencePairs(NamedTuple):
    """All pairs deeper than a tolerance: (P, 2), rows ascending, and their depths (P,)."""

    pairs: npt.NDArray[np.int64]
    depth: FloatArray


def all_pairs(vertices: npt.ArrayLike, faces: npt.ArrayLike, tolerance: float) -> ReferencePairs:
    """Measure every pair of faces that share no vertex.

    Parameters
    ----------
    vertices : (V, 3) array
    faces : (F, 3) integer array
    tolerance : depth up to which a pair is omitted, in the unit of `vertices`
    """
    corners_of = np.asarray(faces)
    points = np.asarray(vertices, dtype=np.float64)
    triangles = points[corners_of]
    blocks = [np.empty((0, 2), dtype=np.int64)]
    for start in range(0, len(triangles), 256):
        rows = np.arange(start, min(start + 256, len(triangles)))
        straddles = _straddles(triangles[rows], points, corners_of)
        a, b = np.nonzero(straddles)
        a = rows[a]
        blocks.append(np.stack([a, b], axis=1))
    # A pair is kept if each face has corners on both sides of the other's plane.
    candidates = np.concatenate(blocks)
    keys = candidates[:, 0] * len(triangles) + candidates[:, 1]
    reverse = candidates[:, 1] * len(triangles) + candidates[:, 0]
    candidates = candidates[
        (candidates[:, 0] < candidates[:, 1]) & np.isin(keys, reverse, assume_unique=True)
    ]
    shared = (
        (corners_of[candidates[:, 0]][:, :, None] == corners_of[candidates[:, 1]][:, None, :])
        .any(axis=2)
        .any(axis=1)
    )
    candidates = candidates[~shared]
    depth = depths(triangles[candidates[:, 0]], triangles[candidates[:, 1]])
    deep = depth > tolerance
    return ReferencePairs(candidates[deep], depth[deep])


def _straddles(planes: FloatArray, points: FloatArray, faces: npt.NDArray) -> npt.NDArray[np.bool_]:
    """(R, F) whether face f is not entirely on one side of the plane of triangle r, with slack."""
    normals = np.cross(planes[:, 1] - planes[:, 0], planes[:, 2] - planes[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    # The slack keeps pairs that rounding could remove; `depths` decides on them.
    slack = 1e-12 * max(float(np.ptp(points, axis=0).max()), float(np.abs(points).max()))
    heights = points @ normals.T - np.einsum("rc,rc->r", normals, planes[:, 0])
    above, below = heights > -slack, heights < slack
    a, b, c = faces.T
    return ((above[a] | above[b] | above[c]) & (below[a] | below[b] | below[c])).T


def depths(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the depths (P,) of triangles a and b (P, 3, 3), in floating point."""
    depth = np.full(len(a), np.inf)
    active = np.arange(len(a))
    # The pairs are the last axis, so that all sums and extremes are over leading ones.
    points = (a[:, :, None] - b[:, None, :]).reshape(-1, 9, 3)
    here = np.ascontiguousarray(points.transpose(1, 2, 0))
    # Planes along an edge of each separate most pairs that do not meet, and come first, one by one.
    rest = [triple for triple in TRIPLES if triple not in _ACROSS_EDGES]
    for triples in map(np.array, [*([triple] for triple in _ACROSS_EDGES), rest]):
        i, j, k = (here[corners] for corners in triples.T)
        u, v = j - i, k - i
        n = np.cross(u, v, axis=1)
        length = np.linalg.norm(n, axis=1)
        spans = length > 1e-12 * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
        n /= np.where(spans, length, 1.0)[:, None]
        along = np.einsum("tcp,kcp->ktp", n, here)
        support = np.minimum(along.max(axis=0), -along.min(axis=0))
        least = np.where(spans, np.maximum(support, 0.0), np.inf).min(axis=0)
        depth[active] = np.minimum(depth[active], least)
        meet = depth[active] > 0.0
        active, here = active[meet], np.compress(meet, here, axis=2)
    return np.where(np.isinf(depth), 0.0, depth)


def exact_distance(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Return the distance of two triangles (3, 3), exact but for the last root.

    The squared distance is a convex function of the corners' weights, so at its minimum its
    derivative is 0 with some weights fixed at 0: all choices are tried, in fractions.
    """
    first, second, unit_length = _integers(a, b)
    best: Fraction | None = None
    supports = [s for n in (1, 2, 3) for s in itertools.combinations(range(3), n)]
    for one, two in itertools.product(supports, supports):
        origin = [p - q for p, q in zip(first[one[0]], second[two[0]], strict=True)]
        ways = [[first[k][c] - first[one[0]][c] for c in range(3)] for k in one[1:]]
        ways += [[second[two[0]][c] - second[k][c] for c in range(3)] for k in two[1:]]
        weights = _least(origin, ways)
        if weights is None:
            continue
        of_one, of_two = weights[: len(one) - 1], weights[len(one) - 1 :]
        if min([*weights, 1 - sum(of_one), 1 - sum(of_two)]) < 0:
            continue
        place = [
            origin[c] + sum(w * way[c] for w, way in zip(weights, ways, strict=True))
            for c in range(3)
        ]
        squared = Fraction(sum(x * x for x in place))
        best = squared if best is None else min(best, squared)
    assert best is not None
    return _root(best * unit_length**2)


def _least(origin: list, ways: list) -> list[Fraction] | None:
    """Return the weights of `ways` whose sum with `origin` is nearest to 0; None if not unique."""
    rows = [
        [Fraction(sum(u[c] * v[c] for c in range(3))) for v in ways]
        + [Fraction(-sum(u[c] * origin[c] for c in range(3)))]
        for u in ways
    ]
    for i in range(len(rows)):
        pivot = next((r for r in range(i, len(rows)) if rows[r][i] != 0), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for r in range(len(rows)):
            if r != i:
                rows[r] = [x - rows[r][i] * y for x, y in zip(rows[r], rows[i], strict=True)]
    return [row[-1] for row in rows]


def distances(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the distances (P,) of triangles a and b (P, 3, 3), in floating point.

    As in `exact_distance`, all choices of corners with non-zero weights are tried.
    """
    squared = np.full(len(a), np.inf)
    supports = [s for n in (1, 2, 3) for s in itertools.combinations(range(3), n)]
    for one, two in itertools.product(supports, supports):
        origin = a[:, one[0]] - b[:, two[0]]
        ways = [a[:, k] - a[:, one[0]] for k in one[1:]]
        ways += [b[:, two[0]] - b[:, k] for k in two[1:]]
        if not ways:
            squared = np.minimum(squared, (origin**2).sum(axis=1))
            continue
        if len(ways) > 3:
            continue  # They cross: then some edge pierces a face, which is another choice.
        across = np.stack(ways, axis=2)
        left, stretch, right = np.linalg.svd(across, full_matrices=False)
        inverse = np.divide(1.0, stretch, out=np.full_like(stretch, np.nan), where=stretch > 1e-12)
        weights = np.einsum("pkw,pk,pck,pc->pw", right, inverse, left, -origin, optimize=True)
        of_one = weights[:, : len(one) - 1].sum(axis=1)
        of_two = weights[:, len(one) - 1 :].sum(axis=1)
        inside = (weights >= 0.0).all(axis=1) & (of_one <= 1.0) & (of_two <= 1.0)
        place = origin + np.einsum("pcw,pw->pc", across, weights)
        found = np.where(inside, (place**2).sum(axis=1), np.inf)
        squared = np.minimum(squared, np.nan_to_num(found, nan=np.inf))
    return np.sqrt(squared)


def signed_distances(
    vertices: npt.ArrayLike, faces: npt.NDArray[np.int32], bound: float
) -> ReferencePairs:
    """Return all pairs without a common vertex that are nearer than a bound, and their distances.

    If two faces penetrate by more than 1e-9, the distance is minus the depth. The bound and the
    distances are in the unit of `vertices`.
    """
    triangles = np.asarray(vertices, dtype=np.float64)[faces]
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    blocks = []
    for start in range(0, len(faces), 256):
        rows = np.arange(start, min(start + 256, len(faces)))
        near = rows[:, None] < np.arange(len(faces))
        for axis in range(3):
            near &= low[rows, axis, None] - high[:, axis] < bound
            near &= low[:, axis] - high[rows, axis, None] < bound
        a, b = np.nonzero(near)
        blocks.append(np.stack([rows[a], b], axis=1))
    pairs = np.concatenate(blocks)
    pairs = pairs[~(faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None]).any(axis=(1, 2))]
    a, b = triangles[pairs[:, 0]], triangles[pairs[:, 1]]
    depth = depths(a, b)
    signed, apart = -depth, depth <= 1e-9
    signed[apart] = distances(a[apart], b[apart])
    near = signed < bound
    return ReferencePairs(pairs[near], signed[near])
