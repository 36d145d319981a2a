"""A check for self-collisions that shares no code with the project.

Two triangles in general position intersect if and only if an edge of one pierces the other. Every
edge is tested against every triangle near it, without a tree, depths or the project's file readers.
Contact rules are applied pair by pair, following docs/contact-rules.md.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

Array = npt.NDArray[np.float64]


def read_obj(path: Path) -> tuple[Array, npt.NDArray[np.int64]]:
    """Read the vertices and triangles of a plain OBJ file."""
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        kind, *values = line.split() or [""]
        if kind == "v":
            vertices.append([float(value) for value in values[:3]])
        elif kind == "f":
            faces.append([int(value.split("/")[0]) - 1 for value in values])
    return np.array(vertices), np.array(faces)


def crossing_pairs(vertices: Array, faces: npt.NDArray[np.int64]) -> set[tuple[int, int]]:
    """Return the pairs of triangles without a common vertex where one pierces the other."""
    corners = vertices[faces]
    middle = corners.mean(axis=1)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    # If two faces touch, the smaller one's middle is within twice the larger one's radius.
    reached = cKDTree(middle).query_ball_point(middle, 2.0 * radius)
    larger = np.repeat(np.arange(len(faces)), [len(others) for others in reached])
    near = np.stack([larger, np.concatenate(reached).astype(np.int64)], axis=1)
    order = np.lexsort((np.arange(len(faces)), radius))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(faces))
    near = np.sort(near[rank[near[:, 1]] < rank[near[:, 0]]], axis=1)
    apart = np.linalg.norm(middle[near[:, 0]] - middle[near[:, 1]], axis=1)
    near = near[apart <= radius[near].sum(axis=1)]
    low, high = corners.min(axis=1), corners.max(axis=1)
    near = near[(low[near] <= high[near[:, ::-1]]).all(axis=(1, 2))]
    shared = (faces[near[:, 0], :, None] == faces[near[:, 1], None, :]).any(axis=(1, 2))
    near = near[~shared]
    found = np.zeros(len(near), dtype=bool)
    for own, other in ((0, 1), (1, 0)):
        triangle = corners[near[:, other]]
        for start in range(3):
            edge = corners[near[:, own]][:, [start, (start + 1) % 3]]
            found |= _pierces(edge[:, 0], edge[:, 1], triangle)
    return {(int(a), int(b)) for a, b in near[found]}


class IndependentRules:
    """Contact rules, applied pair by pair; results about a face are kept for later poses.

    Parameters
    ----------
    rest, faces : of the rest pose
    touching_at_rest : pairs of its faces
    rules : as in JSON
    groups : faces by name
    joints : for each joint, the faces around it
    """

    def __init__(
        self,
        rest: Array,
        faces: npt.NDArray[np.int64],
        touching_at_rest: Iterable[tuple[int, int]],
        rules: Mapping[str, Any],
        groups: Mapping[str, set[int]],
        joints: Iterable[set[int]] = (),
    ) -> None:
        about = list(map(set, joints))
        self._joints = about if rules["joint_exclusion"] else []
        self._fold_joints: list[tuple[Array, float]] = []
        self._limits = self._fold_limits(rest, faces, about) if rules["near_by_limb"] else {}
        self._rest, self._corners, self._groups = rest, faces.tolist(), groups
        size = float(np.ptp(rest[np.unique(faces)], axis=0).max())
        self._near, self._tolerated = (
            rules["near_exclusion"] * size,
            rules["tolerated_depth"] * size,
        )
        self._ignored, self._left_out = rules["ignored"], rules["left_out"]
        self._tolerated_pairs = [(a, b, d * size) for a, b, d in rules["tolerated_pairs"]]
        self._of_rest = None if rules["rest_exclusion"] is None else rules["rest_exclusion"] * size
        self._edges: dict[int, dict[int, float]] = {}
        self._faces_of: dict[int, set[int]] = {}
        for face, (a, b, c) in enumerate(self._corners):
            for i, j in ((a, b), (b, c), (c, a)):
                length = float(np.linalg.norm(rest[i] - rest[j]))
                self._edges.setdefault(i, {})[j] = length
                self._edges.setdefault(j, {})[i] = length
                self._faces_of.setdefault(i, set()).add(face)
        self._touched: dict[int, set[int]] = {}
        for a, b in touching_at_rest:
            self._touched.setdefault(a, set()).add(b)
            self._touched.setdefault(b, set()).add(a)
        self._patches = [
            ("touching", *pair, rules["touching_radius"] * size) for pair in rules["touching"]
        ] + [("shape", *pair, 0.02 * size) for pair in rules["shape_touching"]]
        self._around: dict[tuple[int, float], set[int]] = {}
        self._near_corner: dict[int, set[int]] = {}

    def _fold_limits(
        self, rest: Array, faces: npt.NDArray[np.int64], joints: list[set[int]]
    ) -> dict[int, float]:
        """Return, for each vertex, twice the limb's thickness at the nearest joint."""
        own: dict[int, float] = {}
        for about in joints:
            middles = rest[faces[sorted(about)]].mean(axis=1)
            centre = middles.mean(axis=0)
            thickness = float(np.linalg.norm(middles - centre, axis=1).max())
            self._fold_joints.append((centre, 2.0 * thickness))
            for vertex in {int(v) for face in about for v in faces[face]}:
                own[vertex] = min(2.0 * thickness, own.get(vertex, np.inf))
        if not own:
            return dict.fromkeys(range(len(rest)), np.inf)
        known = np.array(sorted(own))
        # Few at a time, as their distances take memory.
        parts = np.array_split(rest, 1 + len(rest) // 1000)
        nearest = np.concatenate([known[cdist(part, rest[known]).argmin(axis=1)] for part in parts])
        return {vertex: own[int(at)] for vertex, at in enumerate(nearest)}

    def _may_fold(self, a: int, b: int) -> bool:
        """Whether some corners of both faces are near along the surface and in space at rest."""
        for i in self._corners[a]:
            if i not in self._near_corner:
                self._near_corner[i] = self._vertices_around([i], self._near)
            reached = self._near_corner[i]
            for j in self._corners[b]:
                apart = float(np.linalg.norm(self._rest[i] - self._rest[j]))
                limit = min(self._limits[i], self._limits[j])
                middle = 0.5 * (self._rest[i] + self._rest[j])
                for place, of_joint in self._fold_joints:
                    if np.linalg.norm(place - middle) <= np.sqrt(0.5) * apart:
                        limit = max(limit, of_joint)
                if j in reached and apart <= limit:
                    return True
        return False

    def excluding(self, pairs: Mapping[tuple[int, int], float]) -> dict[tuple[int, int], str]:
        """Return the first rule that excludes each pair; omit pairs that count.

        Parameters
        ----------
        pairs : colliding faces of a pose with their depths, in the unit of the rest pose
        """
        ruled = {pair: self._rule(*pair, depth) for pair, depth in pairs.items()}
        return {pair: rule for pair, rule in ruled.items() if rule is not None}

    def _rule(self, a: int, b: int, depth: float) -> str | None:
        near = self._near > 0.0 and b in self._faces_around(a, self._near)
        if near and (not self._limits or self._may_fold(a, b)):
            return "near"
        if self._of_rest is not None and self._is_of_rest(a, b, self._of_rest):
            return "rest"
        if any(self._is_of(one, two, a, b) for one, two in self._ignored):
            return "ignored"
        if any(face in self._groups[name] for name in self._left_out for face in (a, b)):
            return "ignored"
        own = [limit for *pair, limit in self._tolerated_pairs if self._is_of(*pair, a, b)]
        if depth <= min(own, default=self._tolerated):
            return "tolerated"
        if any(a in about and b in about for about in self._joints):
            return "joint"
        for rule, one, two, radius in self._patches:
            first, second = (self._faces_around(face, radius) for face in (one, two))
            if (a in first and b in second) or (b in first and a in second):
                return rule
        return None

    def _is_of(self, one: str, two: str, a: int, b: int) -> bool:
        first, second = self._groups[one], self._groups[two]
        return (a in first and b in second) or (b in first and a in second)

    def _is_of_rest(self, a: int, b: int, radius: float) -> bool:
        """Whether, at rest, a face near a touches a face near b."""
        by_b = self._faces_around(b, radius)
        return any(self._touched.get(face, set()) & by_b for face in self._faces_around(a, radius))

    def _faces_around(self, face: int, radius: float) -> set[int]:
        """Faces with a corner within `radius` of one of this face, along edges, by Dijkstra."""
        if radius == 0.0:
            return {face}
        known = self._around.get((face, radius))
        if known is not None:
            return known
        reached = self._vertices_around(self._corners[face], radius)
        found = set().union(*(self._faces_of[vertex] for vertex in reached))
        self._around[face, radius] = found
        return found

    def _vertices_around(self, starts: Iterable[int], radius: float) -> set[int]:
        reached: set[int] = set()
        waiting = [(0.0, corner) for corner in starts]
        while waiting:
            length, vertex = heapq.heappop(waiting)
            if vertex in reached:
                continue
            reached.add(vertex)
            for other, edge in self._edges[vertex].items():
                if other not in reached and length + edge <= radius:
                    heapq.heappush(waiting, (length + edge, other))
        return reached


def faces_about_joints(
    rest: Array,
    faces: npt.NDArray[np.int64],
    parents: list[int],
    places: Array,
    main_joint: list[int],
) -> list[set[int]]:
    """Return the faces around each joint and between branching ones, by docs/contact-rules.md.

    For rigs without twist joints and without unused joints that stand for others.
    """
    size = float(np.ptp(rest[np.unique(faces)], axis=0).max())
    owner = [
        main_joint[b] if main_joint[b] == main_joint[c] else main_joint[a] for a, b, c in faces
    ]
    middle = rest[faces].mean(axis=1)
    of_joint = {j: [f for f, own in enumerate(owner) if own == j] for j in sorted(set(owner))}

    def next_up(joint: int) -> int:
        above = parents[joint]
        return above if above < 0 or above in of_joint else next_up(above)

    def radius(own: list[int], start: Array, end: Array) -> float:
        length = float(np.linalg.norm(end - start))
        way = (end - start) / length if length else np.zeros(3)
        arms = middle[own] - start
        along = arms @ way
        away = np.linalg.norm(arms - along[:, None] * way, axis=1)
        near = away[np.abs(along) <= length / 3.0]
        return float(np.percentile(near if len(near) else away, 75.0))

    def near(joint: int, others: Iterable[int], limit: float) -> set[int]:
        own = np.array([f for j in others for f in of_joint[j]], dtype=np.int64)
        away = np.linalg.norm(middle[own] - places[joint], axis=1)
        return set(own[away <= limit].tolist())

    thickness: dict[int, float] = {}
    found = []
    for joint, own in of_joint.items():
        parent = next_up(joint)
        if parent < 0:
            continue
        below = [places[j] for j in of_joint if next_up(j) == joint]
        end = np.mean(below, axis=0) if below else middle[own].mean(axis=0)
        start = places[joint]
        thinner = min(radius(own, start, end), radius(of_joint[parent], start, places[parent]))
        thickness[joint] = min(2.0 * thinner, 0.3 * size)
        chain = [joint]
        while len(chain) < 4 and next_up(chain[-1]) >= 0:
            chain.append(next_up(chain[-1]))
        found.append(near(joint, chain, thickness[joint]))
    for one, other in combinations(thickness, 2):
        if next_up(one) == next_up(other):
            both = [near(j, (one, other), 0.8 * thickness[j]) for j in (one, other)]
            found.append(both[0] & both[1])
    return [about for about in found if len(about) > 1]


def _pierces(start: Array, stop: Array, triangle: Array) -> npt.NDArray[np.bool_]:
    """Return which segments cross their triangles, by signs of tetrahedra's volumes."""
    a, b, c = triangle.transpose(1, 0, 2)

    def side(p: Array, q: Array, r: Array, s: Array) -> Array:
        volume: Array = (np.cross(q - p, r - p) * (s - p)).sum(axis=1)
        return volume

    across = side(a, b, c, start) * side(a, b, c, stop) < 0.0
    turns = [side(start, stop, *ends) for ends in ((a, b), (b, c), (c, a))]
    signs = np.sign(turns)
    inside: npt.NDArray[np.bool_] = (signs == signs[0]).all(axis=0) & (signs[0] != 0.0)
    return across & inside
