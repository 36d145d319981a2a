"""The search of one thread: its work arrays, and what it finds of a pose."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.arrays import (
    Exclusions,
    FaceTree,
    Found,
    Nearness,
    PoseWork,
    UncountedNodes,
)
from lcollision_core.contact.coincident import coincide
from lcollision_core.contact.distance import drop_far, keep_near
from lcollision_core.contact.kernels import (
    COUNTED,
    LEAF_SIZE,
    MAX_DISTANCE,
    drop_excluded,
    judge,
    look_again,
    search_pose,
)
from lcollision_core.contact.tree import allocate_work
from lcollision_core.contact.uncounted import NOTHING_KNOWN
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import Topology

DEPTH_TOLERANCE = 1e-9
"""Depth in normalised length up to which two faces touch; beyond it they collide."""

_PAIRS_AT_ONCE = 1 << 14
"""Pairs that a thread's buffer holds; they are passed on whenever it is full."""

_REMEMBERED, _OF_A_POSE = 256, 64
"""Pairs of earlier poses that are looked at first where one that counts is enough, and how many of
each: poses that are asked about in turn, as by Resolve, mostly collide at the same places."""


class Searcher:
    """One thread's work arrays and the search with them.

    Parameters
    ----------
    tree, exclusions, topology : of the detector
    body_size : in the reference's unit

    Attributes
    ----------
    found : pairs of the pose at hand
    signed : (P,) float64 array, their signed distances where a clearance is asked for
    """

    def __init__(
        self, tree: FaceTree, exclusions: Exclusions, topology: Topology, body_size: float
    ) -> None:
        self._tree = tree
        self._exclusions = exclusions
        self._body_size = body_size
        self._scale = 1.0 / body_size
        self._work: PoseWork = allocate_work(tree, topology.n_vertices)
        self._pose = np.empty((topology.n_vertices, 3))
        self._unused = topology.unused_vertices
        self._faces, self._used = topology.faces, topology.faces[0, 0]
        self._waiting = 0
        self._remembered = np.empty((0, 2), dtype=np.int32)
        self.found = Found(
            slots=np.empty((_PAIRS_AT_ONCE, 2), dtype=np.int32),
            squared_depth=np.empty(_PAIRS_AT_ONCE),
            rule=np.empty(_PAIRS_AT_ONCE, dtype=np.uint8),
        )
        self.signed = np.empty(_PAIRS_AT_ONCE)

    def search(
        self,
        pose: npt.NDArray[np.floating],
        *,
        first_only: bool = False,
        number: int | None = None,
        unit: float = 1.0,
        with_coincident: bool = False,
        uncounted: UncountedNodes = NOTHING_KNOWN,
        nearness: Nearness | None = None,
        exclusions: Exclusions | None = None,
        end: npt.NDArray[np.floating] | None = None,
    ) -> Iterator[int]:
        """Yield at least once how many pairs of a pose (V, 3) `found` holds, until the search ends.

        `number` is the pose's index in its batch, for the error message; `unit` is as of
        `CollisionDetector.detect`; `nearness` is what makes pairs too near, whose signed distances
        `signed` then holds; without it, `with_coincident` finds pairs that lie on each other too,
        with depth 0; `exclusions` stand for the detector's own; with `end`, (V, 3) and finite,
        pairs are found whose boxes overlap on the linear path there, with the rules that they have
        where they penetrate; the others are as of `search_pose`. With `first_only`, some of the
        pairs of poses before may be all that is found.
        """
        ruled = self._exclusions if exclusions is None else exclusions
        np.copyto(self._pose, pose)
        self._pose[self._unused] = self._pose[self._used]
        self._scale = unit / self._body_size
        self._waiting = 0
        enlarged = 0.0 if nearness is None else nearness.clearance
        swept = np.asarray([] if end is None else end, dtype=np.float64).reshape(-1, 3)
        if end is not None or with_coincident:
            enlarged = max(enlarged, DEPTH_TOLERANCE)
        if first_only:
            n_found = look_again(
                self._pose,
                self._scale,
                DEPTH_TOLERANCE,
                self._tree,
                self._work,
                self._remembered,
                enlarged > 0.0,
                self.found,
            )
            n_found, some_count = self._judged(n_found, ruled, nearness)
            if some_count:
                yield n_found
                return
        while True:
            n_found, self._waiting = search_pose(
                self._pose,
                self._scale,
                DEPTH_TOLERANCE,
                self._tree,
                ruled,
                uncounted,
                self._work,
                first_only,
                self.found,
                enlarged,
                swept,
                self._waiting,
                LEAF_SIZE,
            )
            if n_found < 0:
                self._refuse(number)
            if end is not None:
                # What the rules say of pairs that penetrate, however deeply.
                self.found.squared_depth[:n_found] = np.inf
                judge(self._tree, ruled, self.found, 0, n_found)
            elif nearness is not None or with_coincident:
                n_found, some_count = self._judged(n_found, ruled, nearness, with_coincident)
                if some_count and first_only:
                    self._waiting = 0
            if end is None and exclusions is None:
                self._remember(n_found)
            yield n_found
            if self._waiting == 0:
                return

    def _judged(
        self,
        n_found: int,
        exclusions: Exclusions,
        nearness: Nearness | None,
        with_coincident: bool = False,
    ) -> tuple[int, bool]:
        """Keep what is too near, or coincides, and say by which rules; return if some counts."""
        tree, vertices, found = self._tree, self._work.vertices, self.found
        if nearness is not None:
            n_found = drop_far(tree, vertices, nearness, n_found, found)
            n_found = drop_excluded(tree, exclusions, found, n_found)
            n_found = keep_near(
                tree, vertices, nearness, DEPTH_TOLERANCE, n_found, found, self.signed
            )
        elif with_coincident:
            n_found = self._keep_coincident(n_found)
        return n_found, judge(tree, exclusions, found, 0, n_found)

    def _keep_coincident(self, n_found: int) -> int:
        """Drop pairs that neither penetrate nor lie on each other; return how many are left."""
        found = self.found
        kept = found.squared_depth[:n_found] > 0.0
        apart = np.flatnonzero(~kept)
        corners = self._faces[self._tree.slot_face[found.slots[apart]]]
        kept[apart] = coincide(self._work.vertices[corners], DEPTH_TOLERANCE)
        n_kept = int(kept.sum())
        for array in (found.slots, found.squared_depth):
            array[:n_kept] = array[:n_found][kept]
        return n_kept

    def _remember(self, n_found: int) -> None:
        counted = np.flatnonzero(self.found.rule[:n_found] == COUNTED)
        if len(counted):
            by_depth = counted[np.argsort(-self.found.squared_depth[counted])]
            some = self.found.slots[by_depth[:: -(-len(counted) // _OF_A_POSE)]]
            pairs = np.concatenate([some, self._remembered])
            keys = pairs @ np.array([len(self._tree.slot_face), 1], dtype=np.int64)
            _, first = np.unique(keys, return_index=True)
            self._remembered = pairs[np.sort(first)][:_REMEMBERED]

    @property
    def share_done(self) -> float:
        """The fraction of the search that is guessed to be done."""
        return 1.0 - float(self._work.fraction[: self._waiting].sum())

    def _refuse(self, number: int | None) -> NoReturn:
        within = np.abs(self._pose) * self._scale <= MAX_DISTANCE  # False for NaN
        vertex = int(np.flatnonzero(~within.all(axis=1))[0])
        where = "" if number is None else f" of pose {number}"
        position = self._pose[vertex].tolist()
        what = (
            f"is more than {MAX_DISTANCE:.0e} body sizes away from the origin"
            if np.isfinite(position).all()
            else "is not finite"
        )
        raise ShapeError(f"vertex {vertex}{where} {what}, at {position}", "move or repair the mesh")
