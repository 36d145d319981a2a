"""Exact self-collision of poses that share one topology."""

from __future__ import annotations

import math
import queue
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.arrays import (
    ClearanceRule,
    Exclusions,
    FaceTree,
    SkippableNodes,
)
from lcollision_core.contact.continuous import LinearPath
from lcollision_core.contact.distance import triangle_distance
from lcollision_core.contact.exclusions import (
    NearestPair,
    TouchingGroups,
    exclusions_of,
    listed_exclusions,
    nearness_of,
    require_clearance,
    require_listable,
    rules_of,
)
from lcollision_core.contact.kernels import (
    COINCIDENT,
    COUNTED,
    LEAF_SIZE,
    N_KINDS,
    add_vertex_energy,
)
from lcollision_core.contact.search import (
    DEPTH_TOLERANCE,
    NO_TABLES,
    Cells,
    Searcher,
    UncountedTables,
    build_tree,
)
from lcollision_core.devices import uses_gpu
from lcollision_core.errors import ShapeError
from lcollision_core.jobs import UNWATCHED, Job, available_cores, for_blocks
from lcollision_core.meshes.contact_rules import N_RULES, STRICT, ContactRules, RuleCounts
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.face_groups import FaceGroup
from lcollision_core.meshes.precision import can_hold, first_not_finite
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

if TYPE_CHECKING:
    from lcollision_core.contact.gpu_search import GpuSearch


MAX_BODY_SIZE = 1e150
"""Largest body size in its unit; the least is the inverse. Squared lengths then neither overflow
nor vanish; either would call a colliding pose free."""

_SHARES = 1000
"""Units of a search for the progress of `CollisionDetector.summarise`."""

_POSES_PER_TASK = 16
"""Most poses that a thread takes at a time, for prompt cancellation and little idling at the
end."""

_NUMBERS_PER_TASK = 1 << 19
"""Most coordinates of these poses."""

_EDGES_A_STEP, _MOST_STEPS = 2.0, 8
"""Edge lengths that a mesh moves in a step of a path, and the most steps of a path."""

_TASKS_PER_THREAD = 4
"""Least number of tasks per thread for a small batch, to keep all threads busy."""


@dataclass(frozen=True, slots=True)
class SelfCollisions:
    """The collisions of one pose; lengths are normalised, that is, divided by the body size.

    Attributes
    ----------
    pairs : (P, 2) int32, face indices of the colliding pairs, the smaller first, rows in ascending
        order; in a summary only the deepest, the deepest first
    penetration_depth : (P,) float64, PD of each pair, > 1e-9; with a clearance, the distance that
        the pair lacks: the required distance less the signed distance
    vertex_energy : (V,) float64, PDe of Algorithm 1 in normalised length squared
    n_pairs : number of colliding pairs, including those not in `pairs`
    excluded : number of pairs that each contact rule excludes: they count neither for the verdict
        nor for the energy; 0 with `counted_only`; with a clearance only pairs that penetrate
    excluded_pairs, excluded_depth : (Q, 2) and (Q,), the excluded pairs and their depths; empty in
        a summary
    excluded_rule : (Q,) uint8, the rule of each: 1 for the first of `RuleCounts` and so on
    n_coincident_pairs : in a summary, number of pairs of faces that share no vertex, lie in one
        plane and overlap there: their depth is 0, so they do not collide
    counted_only : whether pairs that the contact rules exclude were left out
    """

    pairs: IntArray
    penetration_depth: FloatArray
    vertex_energy: FloatArray
    n_pairs: int
    excluded: RuleCounts
    excluded_pairs: IntArray
    excluded_depth: FloatArray
    excluded_rule: npt.NDArray[np.uint8]
    n_coincident_pairs: int = 0
    counted_only: bool = False

    @property
    def colliding(self) -> bool:
        """Whether the pose intersects itself."""
        return self.n_pairs > 0

    @property
    def energy(self) -> float:
        """PDe-sum, the penetration energy of the pose, in normalised length squared."""
        return float(self.vertex_energy.sum())

    @property
    def deepest(self) -> float:
        """Depth of the deepest pair, normalised; 0 where none collides."""
        return float(self.penetration_depth.max(initial=0.0))

    def exceeds(self, *others: SelfCollisions) -> bool:
        """Whether more pairs collide than in any other pose, or one is deeper than all theirs."""
        is_deeper = self.deepest > max(other.deepest for other in others) + DEPTH_TOLERANCE
        return is_deeper or self.n_pairs > max(other.n_pairs for other in others)


@dataclass(frozen=True, slots=True)
class BatchCollisions:
    """The collisions that `CollisionDetector.detect_batch` finds in B poses.

    Attributes
    ----------
    n_pairs : (B,) int64, number of colliding pairs
    n_excluded : (B, R) int64, number of pairs that each rule excludes, in the order of
        `RuleCounts`; 0 with `counted_only`
    vertex_energy : (B, V) float64, PDe of Algorithm 1 in normalised length squared
    """

    n_pairs: npt.NDArray[np.int64]
    n_excluded: npt.NDArray[np.int64]
    vertex_energy: FloatArray

    @property
    def n_near_pairs(self) -> npt.NDArray[np.int64]:
        """(B,) int64, number of pairs within the near exclusion."""
        return self.n_excluded[:, 0]

    @property
    def colliding(self) -> npt.NDArray[np.bool_]:
        """(B,) whether each pose intersects itself."""
        return self.n_pairs > 0


class CollisionDetector:
    """Exact detection of self-collisions in poses of one topology.

    Two faces collide when they share no vertex and their penetration depth exceeds
    `DEPTH_TOLERANCE`. Surfaces that coincide have depth 0: they touch, which is no collision; with
    a clearance, they are too near: see `with_clearance`. Several threads may use one detector at
    once. Vertices that no face uses are ignored.

    Parameters
    ----------
    topology : of all poses
    reference : (V, 3) array, a typical pose: the tree is built on it, and the longest
        side of its bounding box, the body size, is the unit of every result
    rules : which pairs do not count
    groups : groups of faces that the rules name
    size : overrides the body size, if the reference shows several bodies beside each other

    Attributes
    ----------
    clearance : the distance, in normalised length, below which two faces collide; 0 if they have to
        penetrate

    Raises
    ------
    ShapeError : `reference` is not a finite (V, 3) array with an extent between 1 / `MAX_BODY_SIZE`
        and `MAX_BODY_SIZE`, or the rules exclude too many pairs or name an unknown group.
    """

    def __init__(
        self,
        topology: Topology,
        reference: npt.ArrayLike,
        rules: ContactRules = STRICT,
        groups: Sequence[FaceGroup] = (),
        size: float | None = None,
    ) -> None:
        vertices = np.asarray(reference, dtype=np.float64)
        if vertices.shape != (topology.n_vertices, 3):
            raise ShapeError.must_be(
                "the reference", f"of shape ({topology.n_vertices}, 3)", vertices.shape
            )
        if (vertex := first_not_finite(vertices)) is not None:
            raise ShapeError("is not finite", where=f"vertex {vertex} of the reference")
        self.topology = topology
        self.rules, self.groups, self.reference = rules, tuple(groups), vertices
        self.body_size = body_size(vertices, topology) if size is None else size
        if self.body_size == 0.0:
            raise ShapeError("all vertices are at one point", "use a mesh with a size")
        if not 1.0 / MAX_BODY_SIZE <= self.body_size <= MAX_BODY_SIZE:
            needed = f"{1.0 / MAX_BODY_SIZE:.0e} to {MAX_BODY_SIZE:.0e}"
            raise ShapeError.must_be("the body size", needed, f"{self.body_size:.1e}", "scale it")
        self._tree: FaceTree = build_tree(vertices, topology.faces, topology.vertex_components[1])
        self._exclusions = self._exclusions_of(vertices, STRICT, ())
        if not rules.exclude_nothing:
            self._exclusions = self._exclusions_of(vertices, rules, groups)
        self._uncounted = UncountedTables(self._tree, self._exclusions)
        self._idle: queue.LifoQueue[Searcher] = queue.LifoQueue()
        self._gpu: GpuSearch | None = None
        self._nearness: ClearanceRule | None = None
        self._last_nearness: tuple[tuple[float, bool], ClearanceRule] | None = None
        self._may_touch: TouchingGroups = ()
        # Made when it is needed, and shared with copies.
        unit = self.body_size
        self._path = cache(lambda: LinearPath(topology, vertices / unit))

    @property
    def may_touch(self) -> TouchingGroups:
        """Pairs of groups of faces that may come to distance 0, whatever the clearance."""
        return self._may_touch

    @property
    def clearance(self) -> float:
        """The distance below which two faces collide, normalised."""
        return 0.0 if self._nearness is None else self._nearness.clearance

    def with_clearance(self, clearance: float, *, rest_is_known: bool = True) -> CollisionDetector:
        """Return a detector by which two faces collide if they are nearer than a clearance.

        The depth of a pair is the distance that it lacks: the distance required of it less its
        signed distance, see `contact.distance`. Contact rules hold as before; a pair may lack the
        tolerated depth. Of pairs that another rule excludes, only those that penetrate are
        reported. Coincident pairs are not counted separately.

        Parameters
        ----------
        clearance : >= 0 and below 1, in normalised length; with 0 faces have to penetrate
        rest_is_known : whether the reference is the rest pose; if not, faces joined by an edge, or
            by an edge path of a few clearances, collide only where they penetrate

        Raises
        ------
        ShapeError : the clearance is out of range.
        """
        require_clearance(clearance)
        if clearance == self.clearance == 0.0:
            return self
        other = copy(self)
        other._nearness = None if clearance == 0.0 else self._near(clearance, rest_is_known)
        return other

    def _near(self, clearance: float, rest_is_known: bool) -> ClearanceRule:
        last = self._last_nearness
        if last is None or last[0] != (clearance, rest_is_known):
            rule = nearness_of(
                clearance,
                self.topology,
                self.reference,
                self.body_size,
                self._may_touch,
                rest_is_known=rest_is_known,
            )
            # Kept, as the frames of a motion ask for the same distance in turn.
            self._last_nearness = last = (clearance, rest_is_known), rule
        return last[1]

    def without(self, faces: npt.NDArray[np.integer | np.bool_]) -> CollisionDetector:
        """Return a detector whose searches leave out some faces: indices or an (F,) mask."""
        left_out = np.zeros(self.topology.n_faces, dtype=np.bool_)
        left_out[faces] = True
        slots = self._tree.slot_face.reshape(-1, 1, LEAF_SIZE)
        corners = self._tree.corners.reshape(-1, 3, LEAF_SIZE)
        corners = np.where(left_out[slots], np.int32(-1), corners)
        return self._with(_tree=self._tree._replace(corners=corners.reshape(-1)))

    def _with(self, **changes: object) -> CollisionDetector:
        """Return a copy with other attributes and searchers, which hold tree and exclusions."""
        other = copy(self)
        vars(other).update(changes, _idle=queue.LifoQueue(), _gpu=None)
        return other

    def with_touching(self, pairs: TouchingGroups) -> CollisionDetector:
        """Return a detector whose clearances let faces of two groups come to distance 0."""
        other = copy(self)
        other._may_touch, other._nearness = tuple(pairs), None
        other._last_nearness = None
        return other

    def with_rules(
        self, rules: ContactRules, groups: Sequence[FaceGroup] = ()
    ) -> CollisionDetector:
        """Return a detector of the same mesh with other rules; unchanged lists are shared.

        Parameters and errors are those of the class.
        """
        before = self.rules
        lengths, lengths_before = (
            (version.near_exclusion, version.near_by_limb, version.rest_exclusion)
            for version in (rules, before)
        )
        if lengths != lengths_before or (
            rules.near_by_limb and not _same_joints(groups, self.groups)
        ):
            other = CollisionDetector(self.topology, self.reference, rules, groups, self.body_size)
            other._nearness, other._may_touch = self._nearness, self._may_touch
            return other
        near, rest = self._exclusions.near, self._exclusions.rest
        exclusions = listed_exclusions(
            near, rest, rules, self.topology, self.reference, self.body_size, groups
        )
        return self._with(
            rules=rules,
            groups=tuple(groups),
            _exclusions=exclusions,
            _uncounted=UncountedTables(self._tree, exclusions),
        )

    def touching_faces(self) -> IntArray:
        """Return the faces of the patches that, by the rules, touch in nearly every pose."""
        start, entry = self._exclusions.touching
        return np.union1d(np.flatnonzero(np.diff(start)), entry).astype(np.int32)

    def rules_of(
        self, pairs: npt.NDArray[np.integer], penetration_depth: FloatArray
    ) -> npt.NDArray[np.uint8]:
        """Return the rule that excludes each of (n, 2) colliding pairs, 0 if none does.

        Parameters
        ----------
        pairs : (n, 2) face indices
        penetration_depth : (n,) of the pairs, normalised
        """
        return rules_of(self._exclusions, pairs, penetration_depth)

    def tolerated_depths(self, pairs: npt.NDArray[np.integer]) -> FloatArray:
        """Return (n,) the normalised depth that the rules tolerate in each of (n, 2) pairs."""
        region, squared = self._exclusions.region, self._exclusions.squared_tolerance
        one, other = (region[pairs] if len(region) else np.zeros_like(pairs)).T
        tolerated: FloatArray = np.sqrt(squared[one, other])
        return tolerated

    def least_distance(
        self,
        vertices: npt.ArrayLike,
        bound: float,
        *,
        unit: float = 1.0,
        rest_is_known: bool = True,
    ) -> NearestPair | None:
        """Find where a pose comes nearest to itself: the largest clearance with which it is free.

        Faces near each other at rest count where they are nearer than half their distance there.
        Pairs that a contact rule excludes do not count; tolerated depths are ignored.

        Parameters
        ----------
        vertices : (V, 3) array
        bound : > 0 and below 1, in normalised length; larger distances are not looked for
        unit : as for `detect`
        rest_is_known : as for `with_clearance`

        Returns
        -------
        nearest : the pair of least signed distance; None if no pair is nearer than the bound

        Raises
        ------
        ShapeError : another shape, a bound out of range, or a vertex that is not finite or
            absurdly far away.
        """
        require_clearance(bound)
        pose = self._checked(vertices, (self.topology.n_vertices, 3))
        nearness = self._near(bound, rest_is_known)
        least, sides = np.inf, np.empty((0, 2), dtype=np.int32)
        with self._searcher() as searcher:
            for n_found in searcher.search(
                pose,
                unit=unit,
                uncounted=self._uncounted.nodes(),
                nearness=nearness,
                exclusions=self._exclusions._replace(
                    squared_tolerance=np.zeros_like(self._exclusions.squared_tolerance)
                ),
            ):
                counted = np.flatnonzero(searcher.found.rule[:n_found] == COUNTED)
                signed = searcher.signed[counted]
                nearest = min(least, float(signed.min(initial=np.inf)))
                slots = searcher.found.slots[counted[signed == nearest]]
                pairs = np.sort(self._tree.slot_face[slots], axis=1)
                # Keep the first of equally near pairs, whatever the order of the search.
                sides = np.concatenate([sides[: nearest == least], pairs])
                sides = sides[np.lexsort((sides[:, 1], sides[:, 0]))[:1]]
                least = nearest
        if not len(sides):
            return None
        faces = sides[0]
        corners = np.asarray(pose, dtype=np.float64)[self.topology.faces[faces]]
        weights = triangle_distance(corners[:1], corners[1:]).weights[0]
        return NearestPair(least, faces, np.einsum("sk,skc->sc", weights, corners))

    def detect(
        self, vertices: npt.ArrayLike, *, unit: float = 1.0, counted_only: bool = False
    ) -> SelfCollisions:
        """Find all colliding pairs of one pose.

        Parameters
        ----------
        vertices : (V, 3) array
        unit : of `vertices`, in units of the reference: 0.001 for millimetres if that is in metres
        counted_only : whether to leave out the pairs that a contact rule excludes, which is faster

        Raises
        ------
        ShapeError : another shape, or a vertex that is not finite or absurdly far away.
        """
        pose = self._checked(vertices, (self.topology.n_vertices, 3))
        uncounted = self._uncounted.nodes() if counted_only else NO_TABLES
        vertex_energy = np.zeros(self.topology.n_vertices)
        parts: list[tuple[IntArray, FloatArray, npt.NDArray[np.uint8]]] = []
        with self._searcher() as searcher:
            for n_found in searcher.search(
                pose, unit=unit, uncounted=uncounted, nearness=self._nearness
            ):
                candidates = searcher.found
                add_vertex_energy(self._tree, candidates, n_found, vertex_energy)
                pairs = np.sort(self._tree.slot_face[candidates.slots[:n_found]], axis=1)
                depth = np.sqrt(candidates.squared_depth[:n_found])
                parts.append((pairs, depth, candidates.rule[:n_found].copy()))
        pairs, depth, rule = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        pairs, depth, rule = pairs[order], depth[order], rule[order]
        counts = rule == COUNTED
        # With `counted_only`, the excluded pairs found depend on how far the tables are made.
        excluded = np.zeros(len(rule), dtype=np.bool_) if counted_only else ~counts
        return SelfCollisions(
            pairs[counts],
            depth[counts],
            vertex_energy,
            int(counts.sum()),
            RuleCounts.of(rule[excluded]),
            pairs[excluded],
            depth[excluded],
            rule[excluded],
            counted_only=counted_only and not self.rules.exclude_nothing,
        )

    def summarise(
        self,
        vertices: npt.ArrayLike,
        *,
        n_deepest: int = 100,
        job: Job = UNWATCHED,
    ) -> SelfCollisions:
        """Count the colliding pairs of one pose, however many, and keep the deepest.

        Parameters
        ----------
        vertices : (V, 3) array in the unit of the reference
        n_deepest : most pairs to keep; of equally deep ones the first
        job : reports an estimate of (units of the search done, all units); polled every few
            thousand pairs

        Raises
        ------
        ShapeError : another shape, or a vertex that is not finite or absurdly far away.
        CancelledError : the job was cancelled.
        """
        pose = self._checked(vertices, (self.topology.n_vertices, 3))
        vertex_energy = np.zeros(self.topology.n_vertices)
        n_by_rule = np.zeros(COINCIDENT + 1, dtype=np.int64)
        pairs, depth = np.empty((0, 2), dtype=np.int32), np.empty(0)
        with self._searcher() as searcher:
            for n_found in searcher.search(pose, with_coincident=True, nearness=self._nearness):
                job.check()
                candidates = searcher.found
                add_vertex_energy(self._tree, candidates, n_found, vertex_energy)
                rule = candidates.rule[:n_found]
                n_by_rule += np.bincount(rule, minlength=len(n_by_rule))
                counts = rule == COUNTED
                if len(depth) == n_deepest > 0:
                    counts &= np.sqrt(candidates.squared_depth[:n_found]) >= depth[-1]
                deep = np.flatnonzero(counts)
                sides = np.sort(self._tree.slot_face[candidates.slots[deep]], axis=1)
                pairs = np.concatenate([pairs, sides])
                depth = np.concatenate([depth, np.sqrt(candidates.squared_depth[deep])])
                order = np.lexsort((pairs[:, 1], pairs[:, 0], -depth))[:n_deepest]
                pairs, depth = pairs[order], depth[order]
                job.report(int(_SHARES * searcher.share_done), _SHARES)
        n_pairs, *n_excluded, n_coincident = n_by_rule.tolist()
        return SelfCollisions(
            pairs,
            depth,
            vertex_energy,
            n_pairs,
            RuleCounts(*n_excluded),
            pairs[:0],
            depth[:0],
            np.empty(0, dtype=np.uint8),
            n_coincident,
        )

    def detect_batch(
        self,
        vertices: npt.ArrayLike,
        *,
        workers: int | None = None,
        counted_only: bool = False,
        job: Job = UNWATCHED,
    ) -> BatchCollisions:
        """Find the energies and the numbers of colliding pairs of many poses.

        Parameters
        ----------
        vertices : (B, V, 3) array in the unit of the reference
        workers : threads, default one per available core; the result does not depend on it
        counted_only : as for `detect`
        job : reports (poses done, all poses); polled every few poses

        Raises
        ------
        ShapeError : another shape, or a vertex that is not finite or absurdly far away.
        CancelledError : the job was cancelled.
        """
        poses = self._checked(vertices, (-1, self.topology.n_vertices, 3))
        vertex_energy = np.zeros(poses.shape[:2])
        uncounted = self._uncounted.nodes() if counted_only else NO_TABLES
        n_by_rule = self._count(poses, workers, job, uncounted, vertex_energy=vertex_energy)
        n_excluded = n_by_rule[:, 1 : 1 + N_RULES]
        if counted_only:
            # The excluded pairs found depend on how far the tables are made.
            n_excluded[:] = 0
        return BatchCollisions(n_by_rule[:, COUNTED], n_excluded, vertex_energy)

    def cell_energies(
        self,
        vertices: npt.ArrayLike,
        folds: CollisionDetector,
        cells: IntArray,
        n_cells: int,
    ) -> FloatArray:
        """Sum the energy of poses by cells of the skin, on the calling thread.

        A clearance is not supported.

        Parameters
        ----------
        vertices : as for `detect_batch`
        folds : of the same mesh, with other rules
        cells : (2, V) int32, each vertex's cell in pairs that count by those rules too, and in
            pairs that they exclude, from 0
        n_cells : C, above all of these

        Returns
        -------
        cell_energy : (B, C) float64, of the pairs that count, in normalised length squared
        """
        poses = self._checked(vertices, (-1, self.topology.n_vertices, 3))
        energy = np.zeros((len(poses), n_cells))
        both = Cells(folds._exclusions, cells)
        uncounted = self._uncounted.nodes()
        self._count(poses, 1, UNWATCHED, uncounted, cells=both, cell_energy=energy)
        return energy

    def are_colliding(
        self,
        vertices: npt.ArrayLike,
        *,
        workers: int | None = None,
        job: Job = UNWATCHED,
        unit: float = 1.0,
    ) -> npt.NDArray[np.bool_]:
        """Return (B,) whether each pose intersects itself, stopping at its first pair.

        Parameters and errors are those of `detect_batch` and, for `unit`, of `detect`.
        """
        poses = self._checked(vertices, (-1, self.topology.n_vertices, 3))
        uncounted = self._uncounted.nodes()
        n_by_rule = self._count(poses, workers, job, uncounted, first_only=True, unit=unit)
        colliding: npt.NDArray[np.bool_] = n_by_rule[:, COUNTED] > 0
        return colliding

    def collide_between(
        self, start: npt.ArrayLike, end: npt.ArrayLike, *, unit: float = 1.0
    ) -> bool:
        """Return whether a free pose touches itself on the linear path to another.

        Pairs that a contact rule excludes do not count, but tolerated depths and clearances are
        ignored. Pairs that touch at the start collide, even if they move apart.

        Parameters
        ----------
        start, end : (V, 3) arrays; each vertex moves on a line
        unit : as for `detect`

        Returns
        -------
        collide : False is certain; True is possible for pairs that come as near as 10⁻⁶

        Raises
        ------
        MissingExtraError : ipctk is not installed.
        ShapeError : another shape, or a vertex that is not finite or absurdly far away.
        """
        shape = (self.topology.n_vertices, 3)
        poses = [
            np.asarray(self._checked(end_pose, shape), np.float64) for end_pose in (start, end)
        ]
        if not np.isfinite(poses[1][self.topology.faces]).all():
            raise ShapeError("a vertex is not finite", where="the end pose of the path")
        moves = (poses[1] - poses[0])[self.topology.used_vertices]
        # A shift of the whole mesh brings no points nearer, but would make many boxes overlap.
        poses[1] = poses[1] - moves.mean(axis=0)
        length = float(np.percentile(np.linalg.norm(moves - moves.mean(axis=0), axis=1), 90))
        edge = self._path().edge * self.body_size / unit
        step = max(_EDGES_A_STEP * edge, length / _MOST_STEPS)
        n = math.ceil(length / step) if length > 0.0 else 1
        between = [poses[0] + (poses[1] - poses[0]) * (at / n) for at in range(1, n)]
        places = pairwise((poses[0], *between, poses[1]))
        return any(self._collide_on_step(*ends, unit) for ends in places)

    def _collide_on_step(self, start: FloatArray, end: FloatArray, unit: float) -> bool:
        parts: list[IntArray] = []
        with self._searcher() as searcher:
            for n_found in searcher.search(
                start, end=end, unit=unit, uncounted=self._uncounted.nodes(wait=True)
            ):
                counts = searcher.found.rule[:n_found] == COUNTED
                parts.append(self._tree.slot_face[searcher.found.slots[:n_found][counts]])
        middle = start[self.topology.faces].mean(axis=(0, 1))
        first, last = ((pose - middle) * (unit / self.body_size) for pose in (start, end))
        return self._path().touches(np.concatenate(parts), first, last)

    def _exclusions_of(
        self, reference: FloatArray, rules: ContactRules, groups: Sequence[FaceGroup]
    ) -> Exclusions:
        touching = np.empty((0, 2), dtype=np.int32)
        if rules.rest_exclusion is not None:
            touching = self._touching_pairs(reference)
        return exclusions_of(rules, self.topology, reference, self.body_size, touching, groups)

    def _touching_pairs(self, reference: FloatArray) -> IntArray:
        """Return (n, 2) int32, the pairs that collide or coincide in the reference.

        Poses are checked as they are drawn, so the reference is also checked with that rounding.
        """
        searcher = self._new_searcher()
        parts: list[IntArray] = []
        n_touching = 0
        drawn = [np.float32] if can_hold(reference, self.topology, np.float32) else []
        for dtype in (np.float64, *drawn):
            for n_found in searcher.search(reference.astype(dtype), with_coincident=True):
                n_touching += n_found
                require_listable(n_touching, "rest exclusion")
                parts.append(np.sort(self._tree.slot_face[searcher.found.slots[:n_found]], axis=1))
        return np.unique(np.concatenate(parts), axis=0)

    def _checked(self, vertices: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[np.floating]:
        """Return float vertices of the given shape; -1 stands for any number of poses.

        Raises
        ------
        ShapeError : another shape.
        """
        array = np.asarray(vertices)
        if array.ndim != len(shape) or array.shape[-2:] != shape[-2:]:
            shape_text = ", ".join("B" if size < 0 else str(size) for size in shape)
            raise ShapeError.must_be("vertices", f"of shape ({shape_text})", array.shape)
        return array if array.dtype.kind == "f" else array.astype(np.float64)

    def _count(
        self,
        poses: npt.NDArray[np.floating],
        workers: int | None,
        job: Job,
        uncounted: SkippableNodes,
        *,
        cells: Cells | None = None,
        first_only: bool = False,
        unit: float = 1.0,
        **energies: FloatArray,
    ) -> npt.NDArray[np.int64]:
        """Return (B, `N_KINDS`) numbers of pairs by rule; see `Searcher.count`."""
        n_threads = available_cores() if workers is None else workers
        at_most = min(_POSES_PER_TASK, _NUMBERS_PER_TASK // poses[0].size) if len(poses) else 1
        size = -(-len(poses) // (_TASKS_PER_THREAD * n_threads)) if n_threads > 1 else at_most
        n_by_rule = np.zeros((len(poses), N_KINDS), dtype=np.int64)

        def count(start: int, stop: int) -> None:
            with self._searcher() as searcher:
                searcher.count(
                    poses[start:stop],
                    start,
                    n_by_rule[start:stop],
                    cells=cells,
                    first_only=first_only,
                    unit=unit,
                    uncounted=uncounted,
                    nearness=self._nearness,
                    **{name: energy[start:stop] for name, energy in energies.items()},
                )

        if self._nearness is None and uses_gpu(len(poses), self.topology.n_faces):
            for number in self.gpu_search().count(
                poses,
                n_by_rule,
                cells=cells,
                first_only=first_only,
                unit=unit,
                uncounted=uncounted,
                job=job,
                **energies,
            ):
                count(number, number + 1)
            return n_by_rule
        # Starting a thread takes a third of the time of a pose of 2000 vertices.
        for_blocks(count, len(poses), max(1, min(at_most, size)), n_threads, job)
        return n_by_rule

    def gpu_search(self) -> GpuSearch:
        """Return the search on a GPU, without a clearance."""
        if self._gpu is None:
            from lcollision_core.contact.gpu_search import GpuSearch

            self._gpu = GpuSearch(self._tree, self._exclusions, self.topology, self.body_size)
        return self._gpu

    def uncounted_nodes(self) -> SkippableNodes:
        """Return the nodes that a search for pairs that count can skip, as far as known."""
        return self._uncounted.nodes()

    def _new_searcher(self) -> Searcher:
        return Searcher(self._tree, self._exclusions, self.topology, self.body_size)

    @contextmanager
    def _searcher(self) -> Iterator[Searcher]:
        """Lend the work arrays of one thread, reused from search to search."""
        try:
            searcher = self._idle.get_nowait()
        except queue.Empty:
            searcher = self._new_searcher()
        try:
            yield searcher
        finally:
            self._idle.put(searcher)


def _same_joints(some: Sequence[FaceGroup], others: Sequence[FaceGroup]) -> bool:
    """Whether the groups about joints have the same faces."""
    one, other = ([group for group in groups if group.about_joint] for groups in (some, others))
    return len(one) == len(other) and all(
        np.array_equal(a.faces, b.faces) for a, b in zip(one, other, strict=True)
    )
